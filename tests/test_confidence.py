"""The judgement of agents: signs of evidence, invariance, and errors that more ticks do not average away."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_size import T0_NS, measured, moved

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.evidence import SIGNS, Recording, gather
from log2sim.agents.hypotheses import Part
from log2sim.agents.judge import judge, probabilities
from log2sim.agents.moving import moving_candidate
from log2sim.agents.static import static_candidates
from log2sim.agents.weights import CONFIDENCE, RIGHT, THERE, VARIANCES
from log2sim.datatypes import MAX_SIZE_M, Finding, Track
from log2sim.datatypes.log_odds import MAX_PROBABILITY, MIN_PROBABILITY, log_odds_of, probability_of

TIMELINE = Timeline(T0_NS + np.arange(60) * 100_000_000, T0_NS)
DARK = [None] * len(TIMELINE.t_ns)


RECORDING = Recording(True, DARK, TIMELINE)


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
    return judge([candidate], None, RECORDING)[0]


def test_every_weight_has_the_sign_of_its_reason():
    for table in (*THERE.values(), *RIGHT.values()):
        assert set(table) <= {"bias", *SIGNS}
        assert [name for name, weight in table.items() if SIGNS.get(name, 0) * weight < 0] == []
    assert min(weight for table in VARIANCES.values() for weight in table.values()) >= 0
    assert min(slope for _, slope in CONFIDENCE.values()) > 0


@settings(deadline=None)
@given(
    st.lists(st.floats(-3, 3), min_size=len(SIGNS), max_size=len(SIGNS)),
    st.sampled_from(sorted(SIGNS)),
    st.floats(0, 3),
    st.booleans(),
)
def test_more_of_a_good_reason_never_lowers_a_confidence(values, name, more, lidar):
    table = {"bias": np.ones(2), "confirmed": np.ones(2)} | {n: np.full(2, v) for n, v in zip(SIGNS, values)}
    table[name] = table[name] + np.array([0.0, SIGNS[name] * more])
    there, right = probabilities(table, lidar=lidar)
    assert there[0] <= there[1]
    assert MIN_PROBABILITY <= right[0] <= right[1] <= MAX_PROBABILITY


@pytest.mark.parametrize("make", [parked, driving])
def test_ratings_are_those_of_a_map_that_is_shifted_and_turned(make):
    candidate = make()
    static = candidate.agent.static
    other = candidate_of(moved(candidate.track, np.array([300.0, -80.0, 4.0]), 2.1), static=static)
    a, b = rated(candidate).agent, rated(other).agent
    assert a.confidence == pytest.approx(b.confidence, abs=0.01)
    np.testing.assert_allclose(a.waypoints.sigma_xy_m, b.waypoints.sigma_xy_m, rtol=0.02)
    np.testing.assert_allclose(a.waypoints.sigma_yaw_rad, b.waypoints.sigma_yaw_rad, rtol=0.05)


def test_doubts_and_scattered_positions_lower_a_confidence_and_a_hidden_length_widens_sigmas():
    candidate = parked()
    before = rated(candidate).agent.confidence
    assert rated(candidate.doubted([Finding("jump", text="it jumps")])).agent.confidence < before
    m = candidate.track.measurements
    wild = m.center_m + np.random.default_rng(0).normal(0, 2.0, m.center_m.shape) * [1, 1, 0]
    scattered = replace(candidate, track=replace(candidate.track, measurements=replace(m, center_m=wild)))
    assert rated(scattered).agent.confidence < before
    high = m.low_m + (m.high_m - m.low_m) * [0.3, 1.0]
    part = replace(candidate, track=replace(candidate.track, measurements=replace(m, high_m=high)))
    assert rated(part).agent.waypoints.sigma_xy_m[0] > rated(candidate).agent.waypoints.sigma_xy_m[0]


def test_reasons_are_given_for_what_is_rather_wrong_alone():
    candidate = parked()
    longest = replace(candidate.agent, size_m=(MAX_SIZE_M["car"][0], *candidate.agent.size_m[1:]))
    sure, vague = (
        rated(replace(candidate, agent=replace(longest, quality={"heading_confidence": p}))).agent for p in (0.999, 0.5)
    )
    assert (sure.confidence > 0.5, sure.doubts) == (True, ())
    assert (vague.confidence < 0.5, [d.kind for d in vague.doubts]) == (True, ["unlikely_size"])


def test_evidence_is_bounded_where_there_is_nothing_but_boxes_of_images():
    candidate = parked(3)
    m = candidate.track.measurements
    bare = replace(
        m, points=np.zeros(3, dtype=np.int64), low_m=np.full((3, 2), np.nan), high_m=np.full((3, 2), np.nan),
        source=np.full(3, "topdown", dtype="<U16"), camera=np.full(3, "front"), yaw_rad=np.full(3, np.nan),
    )  # fmt: skip
    found = gather([replace(candidate, track=replace(candidate.track, measurements=bare))], RECORDING)
    assert np.isfinite(list(found.values())).all()
    assert judge([], None, RECORDING) == []


def test_few_detections_in_images_are_no_evidence_against_an_object_in_sweeps():
    candidate = parked()

    def detected(count: int) -> AgentCandidate:
        m = candidate.track.measurements
        m = replace(m, box_yaw_rad=m.yaw_rad, camera=np.where(np.arange(8) < count, "front", ""))
        return replace(candidate, track=replace(candidate.track, measurements=m))

    none, few, all_ = gather([detected(0), detected(1), detected(8)], RECORDING)["image"]
    assert none == few == 0 < all_


@given(st.floats(1e-6, 1 - 1e-6))
def test_one_undoes_the_other_and_a_complement_has_the_opposite_sign(p: float) -> None:
    assert probability_of(log_odds_of(p)) == pytest.approx(p, rel=1e-9)
    assert log_odds_of(1 - p) == pytest.approx(-log_odds_of(p), abs=1e-9)
