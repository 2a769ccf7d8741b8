"""Scenario files of random scenarios: what is saved reads back to exactly the same numbers."""

from __future__ import annotations

import json
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis.extra.numpy import arrays

from log2sim.datatypes import CATEGORIES, Agent, Finding, IgnoreRegions, LabelView, MapFrame, Scenario, Waypoints
from log2sim.geometry import Array, Camera, quaternion_from_rotation, rotation_from_rpy

FINITE = st.floats(-1e8, 1e8, allow_subnormal=True)
FRACTION = st.floats(0.0, 1.0)
NAMES = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12)


def times(count: int) -> st.SearchStrategy[Array]:
    """Strictly increasing times, some a nanosecond apart, some a year after the start."""
    steps = arrays(np.float64, (count,), elements=st.floats(1e-9, 10.0))
    return st.builds(lambda start, step: np.maximum.accumulate(start + np.cumsum(step)), st.floats(-1e3, 3e4), steps)


def doubts() -> st.SearchStrategy[Finding]:
    """Doubts, some of which hold all the time."""
    time = st.none() | st.floats(-1e6, 1e6)
    text = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
    return st.builds(Finding, NAMES, start_s=time, end_s=time, text=text)


@st.composite
def agents(draw: st.DrawFn, agent_id: str) -> Agent:
    count = draw(st.integers(1, 6))
    column = arrays(np.float64, (count,), elements=FINITE)
    flags = arrays(np.bool_, (count,))
    t_s = draw(times(count).filter(lambda t: bool(np.all(np.diff(t) > 0))))
    waypoints = Waypoints(
        t_s, draw(column), draw(column), draw(column), draw(column), draw(column), draw(flags),
        np.abs(draw(column)), draw(st.none() | column), draw(st.none() | column), draw(st.none() | flags),
    )  # fmt: skip
    size = draw(st.tuples(*[st.floats(1e-3, 50.0)] * 3))
    color = draw(st.none() | st.just({"rgb": [1, 2, 3], "name": "blue"}))
    return Agent(
        agent_id, draw(st.sampled_from(CATEGORIES)), size, waypoints, draw(st.booleans()), draw(st.floats(-5.0, 5.0)),
        color, draw(FRACTION), {"note": draw(NAMES)}, tuple(draw(st.lists(doubts(), max_size=2))),
    )  # fmt: skip


@st.composite
def ignore_regions(draw: st.DrawFn) -> IgnoreRegions:
    frames, regions = draw(st.integers(1, 4)), draw(st.integers(0, 5))
    rpy = draw(arrays(np.float64, (frames, 3), elements=st.floats(-3.0, 3.0)))
    K = np.array([[draw(st.floats(1.0, 5e3)), 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]])
    lens = draw(st.sampled_from([("none", ()), ("brown", (-0.2, 0.1, 0.0, 1e-5)), ("fisheye", (0.1, 0.0, 0.0, 0.0))]))
    view = LabelView(
        Camera(draw(NAMES), 1280, 720, K, "map", np.eye(4), *lens),
        np.cumsum(draw(arrays(np.float64, (frames,), elements=st.floats(0.01, 1.0)))),
        draw(arrays(np.float64, (frames, 3), elements=FINITE)),
        quaternion_from_rotation(rotation_from_rpy(*rpy.T)),
        draw(arrays(np.int64, (regions,), elements=st.integers(0, frames - 1))),
        draw(arrays(np.float64, (regions, 4), elements=st.floats(0.0, 1280.0))),
    )
    return IgnoreRegions((view,), draw(st.booleans()))


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    ids = draw(st.lists(NAMES | st.just("ego"), max_size=3, unique=True))
    offset = draw(st.tuples(*[st.integers(-(10**5), 10**5).map(lambda km: 1000.0 * km)] * 3))
    return Scenario(
        name=draw(st.text(st.characters(exclude_categories=["Cs"]), max_size=12)),
        t0_ns=draw(st.integers(0, 2**62)),
        duration_s=draw(st.floats(0.0, 1e6)),
        agents=tuple(draw(agents(i)) for i in ids),
        map=MapFrame(draw(st.none() | st.floats(-90, 90)), draw(st.none() | st.floats(-180, 180)), None, None, offset),
        provenance={"seed": draw(st.integers(0, 2**31))},
        ignore_regions=draw(st.none() | ignore_regions()),
    )


def bits(scenario: Scenario) -> list[object]:
    """All numbers of the trajectories, and of the ignore regions, as bytes."""
    columns = (*Waypoints.FLOATS, *Waypoints.OPTIONAL_FLOATS, "observed", "visible")
    out: list[object] = []
    for a in scenario.agents:
        out += a.doubts
        out += [None if (v := getattr(a.waypoints, k)) is None else v.tobytes() for k in columns]
    for view in scenario.ignore_regions.views if scenario.ignore_regions else ():
        names = ("t_s", "translation_m", "rotation_wxyz", "region_frame", "region_px")
        out += [getattr(view, k).tobytes() for k in names]
        out += [view.camera.name, view.camera.K.tobytes(), view.camera.distortion_model, view.camera.distortion]
    return out


@settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(scenarios())
def test_a_saved_scenario_reads_back_bit_by_bit(tmp_path: Path, scenario: Scenario) -> None:
    path = tmp_path / "scenario.json"
    scenario.save(path)
    again = Scenario.load(path)
    assert bits(again) == bits(scenario)
    for name in ("name", "t0_ns", "duration_s", "map", "provenance"):
        assert getattr(again, name) == getattr(scenario, name), name
    for a, b in zip(scenario.agents, again.agents, strict=True):
        for name in set(vars(a)) - {"waypoints"}:
            assert getattr(a, name) == getattr(b, name), name
    assert again.digest == scenario.digest
    before = path.read_bytes()
    again.save(path)
    assert path.read_bytes() == before
    assert json.loads(before)["scenario_version"] == 1
