"""The rating of agents: signs of evidence, invariance, and errors that more ticks do not average away."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_size import T0_NS, measured, moved

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.confidence import (
    MAX_CONFIDENCE,
    MIN_CONFIDENCE,
    POSITION_VARIANCE,
    SIGNS,
    SPEED_VARIANCE,
    WITH_LIDAR,
    WITHOUT_LIDAR,
    YAW_VARIANCE,
    Evidence,
    confidence_of,
    evidence_of,
    rate_agents,
)
from log2sim.agents.hypotheses import Part
from log2sim.agents.moving import moving_candidate
from log2sim.agents.static import static_candidates
from log2sim.datatypes import Finding, Track
from log2sim.datatypes.log_odds import log_odds_of, probability_of

TIMELINE = Timeline(T0_NS + np.arange(60) * 100_000_000, T0_NS)


DARK = [None] * len(TIMELINE.t_ns)


NAMES = [f.name for f in fields(Evidence)]


@cache
def parked(count: int = 8) -> AgentCandidate:
    return candidate_of(measured([(12.0, 6.0, 0.3)] * count))


@cache
def driving(count: int = 12) -> AgentCandidate:
    return candidate_of(measured([(8.0 + 0.6 * k, 5.0, 0.0) for k in range(count)]), static=False)


def candidate_of(track: Track, *, static: bool = True) -> AgentCandidate:
    if static:
        return static_candidates([Part(track, static=True)], DARK, TIMELINE)[0]
    return moving_candidate(track, DARK, TIMELINE, smooth=True)


def rated(candidate: AgentCandidate) -> AgentCandidate:
    return rate_agents([candidate], TIMELINE, lidar=True)[0]


def test_every_weight_has_the_sign_of_its_reason():
    assert set(WITH_LIDAR) | set(WITHOUT_LIDAR) == {"bias", *NAMES} == {"bias", *SIGNS}
    for weights in (WITH_LIDAR, WITHOUT_LIDAR):
        assert [name for name, weight in weights.items() if SIGNS.get(name, 0) * weight < 0] == []
    assert min(*POSITION_VARIANCE.values(), *YAW_VARIANCE.values(), *SPEED_VARIANCE.values()) >= 0


@settings(deadline=None)
@given(
    st.lists(st.floats(-3, 3), min_size=len(NAMES), max_size=len(NAMES)),
    st.sampled_from(NAMES),
    st.floats(0, 3),
    st.booleans(),
)
def test_more_of_a_good_reason_never_lowers_a_confidence(values, name, more, lidar):
    weak = Evidence(**dict(zip(NAMES, values)))
    weight = (WITH_LIDAR if lidar else WITHOUT_LIDAR).get(name, 0.0)
    strong = replace(weak, **{name: getattr(weak, name) + (SIGNS[name] or np.sign(weight)) * more})
    low, high = confidence_of(weak, lidar=lidar), confidence_of(strong, lidar=lidar)
    assert MIN_CONFIDENCE <= low <= high <= MAX_CONFIDENCE


@pytest.mark.parametrize("make", [parked, driving])
def test_ratings_are_those_of_a_map_that_is_shifted_and_turned(make):
    candidate = make()
    static = candidate.agent.static
    other = candidate_of(moved(candidate.track, np.array([300.0, -80.0, 4.0]), 2.1), static=static)
    a, b = rated(candidate).agent, rated(other).agent
    assert a.confidence == pytest.approx(b.confidence, abs=0.01)
    np.testing.assert_allclose(a.waypoints.sigma_xy_m, b.waypoints.sigma_xy_m, rtol=0.02)
    np.testing.assert_allclose(a.waypoints.sigma_yaw_rad, b.waypoints.sigma_yaw_rad, rtol=0.05)


def test_doubts_scattered_positions_and_a_hidden_length_lower_a_confidence():
    candidate = parked()
    before = rated(candidate).agent.confidence
    assert rated(candidate.doubted([Finding("empty", text="rays pass through")])).agent.confidence < before
    m = candidate.track.measurements
    wild = m.center_m + np.random.default_rng(0).normal(0, 2.0, m.center_m.shape) * [1, 1, 0]
    scattered = replace(candidate, track=replace(candidate.track, measurements=replace(m, center_m=wild)))
    assert rated(scattered).agent.confidence < before
    high = m.low_m + (m.high_m - m.low_m) * [0.3, 1.0]
    part = replace(candidate, track=replace(candidate.track, measurements=replace(m, high_m=high)))
    assert evidence_of(part, TIMELINE).hidden > evidence_of(candidate, TIMELINE).hidden + 0.4
    assert rated(part).agent.confidence < before
    assert rated(part).agent.waypoints.sigma_xy_m[0] > 1.1 * rated(candidate).agent.waypoints.sigma_xy_m[0]


def test_evidence_is_bounded_where_there_is_nothing_but_boxes_of_images():
    candidate = parked(3)
    m = candidate.track.measurements
    bare = replace(
        m, points=np.zeros(3, dtype=np.int64), low_m=np.full((3, 2), np.nan), high_m=np.full((3, 2), np.nan),
        source=np.full(3, "topdown", dtype="<U16"), camera=np.full(3, "front"), yaw_rad=np.full(3, np.nan),
    )  # fmt: skip
    found = evidence_of(replace(candidate, track=replace(candidate.track, measurements=bare)), TIMELINE)
    assert np.isfinite(list(asdict(found).values())).all()
    assert (found.hidden, found.blind) == (1.0, 1.0)


@given(st.floats(1e-6, 1 - 1e-6))
def test_one_undoes_the_other_and_a_complement_has_the_opposite_sign(p: float) -> None:
    assert probability_of(log_odds_of(p)) == pytest.approx(p, rel=1e-9)
    assert log_odds_of(1 - p) == pytest.approx(-log_odds_of(p), abs=1e-9)
