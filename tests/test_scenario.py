"""Scenarios: what is written reads back, what is wrong is named, and agents between waypoints."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis.extra.numpy import arrays

from log2sim.datatypes import CATEGORIES, Agent, Finding, IgnoreRegions, LabelView, MapFrame, Scenario, Waypoints
from log2sim.geometry import Array, Camera, quaternion_from_rotation, rotation_from_rpy


def make_agent(agent_id: str = "car-1", seed: int = 0, count: int = 7, *, visible: bool = False) -> Agent:
    rng = np.random.default_rng(seed)
    return Agent(
        id=agent_id,
        category="car",
        size_m=(4.37, 1.83, 1.0 / 3.0),
        waypoints=Waypoints(
            t_s=np.cumsum(rng.uniform(0.05, 0.15, count)),
            x_m=rng.normal(0, 1e6, count),
            y_m=rng.normal(0, 1, count) * 1e-7,
            z_m=rng.normal(0, 1, count),
            yaw_rad=rng.uniform(-np.pi, np.pi, count),
            speed_mps=rng.normal(0, 10, count),
            observed=rng.random(count) < 0.5,
            sigma_xy_m=rng.uniform(0, 1, count),
            visible=rng.random(count) < 0.5 if visible else None,
        ),
        static=False,
        rear_axle_offset_m=1.3,
        color={"rgb": [200, 10, 0], "name": "red"},
        confidence=0.87,
        quality={"points": 31, "note": "überholt"},
    )


def make_scenario() -> Scenario:
    return Scenario(
        name="Straße 1",
        t0_ns=1_700_000_000_123_456_789,
        duration_s=3.3,
        agents=(
            make_agent("ego"),
            make_agent("car-1", 1, visible=True),
            replace(make_agent("x", 2, 1), color=None, static=True),
        ),
        map=MapFrame(49.01, 8.43, 115.2, "+proj=utm +zone=32", (457000.0, 5428000.0, 0.0)),
        cameras=({"name": "front", "used": True, "homography": None},),
        stages=({"stage": "fuse", "kept": False, "reason": "one camera sees no object twice"},),
        provenance={"seed": 3},
    )


def drive(t_s: list[float], yaw_rad: list[float] | None = None) -> Agent:
    """An agent at x = 10 t, y = -t, z = 1, speeding up as 2 t."""
    t = np.array(t_s)
    yaw = np.zeros(len(t)) if yaw_rad is None else np.array(yaw_rad)
    return replace(
        make_agent(),
        waypoints=Waypoints(t, 10 * t, -t, np.ones(len(t)), yaw, 2 * t, np.ones(len(t), dtype=bool), 0 * t),
    )


def test_between_waypoints_all_is_linear() -> None:
    asked = np.array([1.0, 1.05, 1.3, 1.99, 2.0])
    state = drive([1.0, 1.1, 1.4, 2.0]).at(asked)
    assert state.valid.all()
    np.testing.assert_allclose(state.x_m, 10 * asked, atol=1e-12)
    np.testing.assert_allclose(state.y_m, -asked, atol=1e-12)
    np.testing.assert_allclose(state.z_m, 1.0)
    np.testing.assert_allclose(state.speed_mps, 2 * asked, atol=1e-12)


def test_long_gaps_are_not_bridged_when_asked() -> None:
    agent, asked = drive([0.0, 0.1, 3.0, 3.1]), [0.05, 0.1, 0.2, 2.9, 3.0, 3.05]
    assert agent.at(asked).valid.all()
    assert agent.at(asked, max_gap_s=1.0).valid.tolist() == [True, True, False, False, True, True]


def test_the_file_states_its_frame_and_an_older_one_still_loads() -> None:
    scenario = make_scenario()
    document = scenario.to_dict()
    assert (document["map"]["frame"], document["map"]["position"]) == ("enu", "box_center")
    assert replace(scenario, map=MapFrame()).to_dict()["map"]["frame"] == "local"
    assert "plan" not in document
    older = {**document, "plan": document["stages"], "map": {**document["map"]}}
    del older["stages"], older["map"]["frame"], older["map"]["position"]
    assert Scenario.from_dict(older).to_dict() == document


def test_arrays_along_agents_and_times_hold_the_rows_of_the_table() -> None:
    pytest.importorskip("xarray")
    scenario = make_scenario()
    arrays, table = scenario.to_xarray(), scenario.to_dataframe()
    for row in table.itertuples():
        cell = arrays.sel(agent=row.agent, t_s=row.t_s)
        for name in ("x_m", "yaw_rad", "sigma_xy_m", "observed", "category", "length_m", "confidence"):
            np.testing.assert_equal(cell[name].item(), getattr(row, name))
    assert int(np.isfinite(arrays.x_m).sum()) == len(table)
    assert arrays.x_m.attrs["units"] == "m"
    assert Scenario("nothing", 0, 0.0, ()).to_xarray().sizes == {"agent": 0, "t_s": 0}


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
