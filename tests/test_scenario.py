"""Scenarios: what is written reads back, what is wrong is named, and agents between waypoints."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from log2sim.datatypes import Agent, MapFrame, Scenario, Waypoints
from log2sim.errors import ScenarioError


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


def test_what_is_saved_reads_back_to_the_same_numbers(tmp_path: Path) -> None:
    scenario, path = make_scenario(), tmp_path / "deep" / "scenario.json"
    scenario.save(path)
    again = Scenario.load(path)
    for name in ("name", "t0_ns", "duration_s", "map", "cameras", "stages", "provenance"):
        assert getattr(again, name) == getattr(scenario, name), name
    for a, b in zip(scenario.agents, again.agents, strict=True):
        for name in ("id", "category", "size_m", "static", "rear_axle_offset_m", "color", "confidence", "quality"):
            assert getattr(a, name) == getattr(b, name), name
        for name in (*Waypoints.FLOATS, "observed", "visible"):
            column, read = getattr(a.waypoints, name), getattr(b.waypoints, name)
            assert (column is None and read is None) or column.tobytes() == read.tobytes(), name
    again.save(tmp_path / "twice.json")
    assert (tmp_path / "twice.json").read_bytes() == path.read_bytes()
    assert list(path.parent.iterdir()) == [path]


def test_beside_another_a_scenario_has_its_start_and_its_map() -> None:
    here = make_scenario()
    start_s, (dx, dy, dz) = 0.25, (400_000.0, -3.5, 120.0)
    other = replace(here, t0_ns=here.t0_ns - 250_000_000, map=replace(here.map, offset_m=tuple(
        a - b for a, b in zip(here.map.offset_m, (dx, dy, dz))
    )))  # fmt: skip
    moved = here.aligned_to(other)
    assert (moved.t0_ns, moved.map) == (other.t0_ns, other.map)
    for a, b in zip(here.agents, moved.agents, strict=True):
        for name, step in (("t_s", start_s), ("x_m", dx), ("y_m", dy), ("z_m", dz), ("yaw_rad", 0.0)):
            np.testing.assert_allclose(getattr(b.waypoints, name) - getattr(a.waypoints, name), step, atol=1e-9)
    with pytest.raises(ScenarioError, match="bring both to one projection"):
        replace(here, map=replace(here.map, projection="+proj=utm +zone=32")).aligned_to(
            replace(here, map=replace(here.map, projection="+proj=utm +zone=33"))
        )


def test_the_ego_is_told_from_the_others() -> None:
    scenario = make_scenario()
    assert scenario.ego is scenario.agents[0]
    assert [a.id for a in scenario.others] == ["car-1", "x"]
    assert replace(scenario, agents=scenario.agents[1:]).ego is None


def agent_of(document: dict[str, Any]) -> dict[str, Any]:
    return document["agents"][1]


def column(name: str, index: int, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        agent_of(document)["waypoints"][name][index] = value

    return change


BROKEN: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "a later version": (lambda d: d.update(scenario_version=2), r"scenario_version is 2, expected 1"),
    "no version": (lambda d: d.pop("scenario_version"), r"scenario_version is None, expected 1"),
    "a missing field": (lambda d: agent_of(d).pop("size_m"), r"agents\[1\].*'size_m' is a required"),
    "a field too many": (lambda d: agent_of(d).update(colour=None), r"agents\[1\].*colour"),
    "no height": (lambda d: agent_of(d)["size_m"].update(height=0), r"agents\[1\]\.size_m\.height"),
    "a text for a number": (column("x_m", 2, "12"), r"agents\[1\]\.waypoints\.x_m\[2\]"),
    "a number for a flag": (column("observed", 2, 1), r"agents\[1\]\.waypoints\.observed\[2\]"),
    "no waypoint": (lambda d: agent_of(d)["waypoints"].update(t_s=[]), r"agents\[1\]\.waypoints\.t_s"),
    "columns of unlike length": (
        lambda d: agent_of(d)["waypoints"]["y_m"].pop(),
        r"'car-1': waypoints\.y_m has 6 values, t_s has 7",
    ),
    "flags of unlike length": (lambda d: agent_of(d)["waypoints"]["visible"].pop(), r"waypoints\.visible has 6"),
    "times that repeat": (
        lambda d: agent_of(d)["waypoints"].update(t_s=[0.0, 0.1, 0.2, 0.2, 0.4, 0.5, 0.6]),
        r"'car-1': waypoints\.t_s does not increase at index 3 \(0\.2 s\)",
    ),
    "times out of order": (
        lambda d: agent_of(d)["waypoints"].update(t_s=[0.0, 0.1, 0.3, 0.2, 0.4, 0.5, 0.6]),
        r"waypoints\.t_s does not increase at index 3",
    ),
    "an unknown category": (lambda d: agent_of(d).update(category="tram"), r"'car-1': category 'tram' is not known"),
    "an id twice": (lambda d: agent_of(d).update(id="ego"), r"agent 'ego': the id occurs twice"),
    "a confidence above one": (lambda d: agent_of(d).update(confidence=1.2), r"agents\[1\]\.confidence"),
    "a start that is no integer": (lambda d: d.update(t0_ns=1.5), r"t0_ns"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_what_is_wrong_is_named_with_its_file_and_place(case: str, tmp_path: Path) -> None:
    document = make_scenario().to_dict()
    change, message = BROKEN[case]
    change(document)
    path = tmp_path / "scenario.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(ScenarioError, match=message) as caught:
        Scenario.load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]", "scenario_version is None"),
        ('"scenario"', "scenario_version is None"),
        ("{", "line 1, column 2"),
        ("", "line 1, column 1"),
        ("[" * 100_000, "not valid JSON"),
        ('{"scenario_version": NaN}', "scenario_version is NaN, expected a finite"),
        ('{"scenario_version": -Infinity}', "scenario_version is -Infinity, expected"),
        ('{"scenario_version": NaN', "a number is NaN, expected a finite"),
        ("[NaN, " + "[" * 100_000, "a number is NaN, expected a finite"),
    ],
    ids=["list", "text", "cut", "empty", "deep", "nan", "infinity", "nan-cut", "nan-deep"],
)
def test_files_that_are_no_scenario(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "scenario.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError, match=message) as caught:
        Scenario.load(path)
    assert str(path) in str(caught.value)


def test_a_number_too_large_for_a_float_is_not_finite(tmp_path: Path) -> None:
    path, document = tmp_path / "scenario.json", make_scenario().to_dict()
    column("z_m", 4, 123456.789)(document)
    path.write_text(json.dumps(document).replace("123456.789", "1e999"), encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"agents\[1\]\.waypoints\.z_m\[4\] is 1e999, expected"):
        Scenario.load(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"nothing\.json: no such file"):
        Scenario.load(tmp_path / "nothing.json")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_scenario_that_cannot_be_written_leaves_what_was_there(bad: float, tmp_path: Path) -> None:
    scenario, path = make_scenario(), tmp_path / "scenario.json"
    scenario.save(path)
    before = path.read_bytes()
    waypoints = replace(scenario.agents[1].waypoints, x_m=np.array([0, 1, bad, 3, 4, 5, 6]))
    broken = replace(scenario, agents=(replace(scenario.agents[1], waypoints=waypoints),))
    with pytest.raises((ScenarioError, ValueError)):
        broken.save(path)
    with pytest.raises(ScenarioError, match="name"):
        replace(scenario, name=7).save(path)  # type: ignore[arg-type]
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


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


def test_yaw_takes_the_shorter_arc() -> None:
    state = drive([0.0, 1.0, 2.0, 3.0], [3.0, -3.0, 3.0, 0.5]).at([0.25, 0.5, 1.5, 2.5])
    arc = 2 * np.pi - 6.0
    expected = [3.0 + arc / 4, -np.pi, -np.pi, 1.75]
    np.testing.assert_allclose(np.exp(1j * state.yaw_rad), np.exp(1j * np.array(expected)), atol=1e-12)
    assert ((state.yaw_rad >= -np.pi) & (state.yaw_rad < np.pi)).all()


def test_outside_its_life_an_agent_is_not_there() -> None:
    state = drive([1.0, 2.0]).at([0.9, 1.0 - 1e-5, 1.0 - 1e-7, 2.0 + 1e-7, 2.1])
    assert state.valid.tolist() == [False, False, True, True, False]
    for name in ("x_m", "y_m", "z_m", "yaw_rad", "speed_mps"):
        assert np.isnan(getattr(state, name)).tolist() == [True, True, False, False, True], name
    np.testing.assert_allclose(state.x_m[2:4], [10.0, 20.0])
    assert drive([1.0, 2.0]).at([0.5, 2.5], margin_s=0.6).valid.all()


def test_long_gaps_are_not_bridged_when_asked() -> None:
    agent, asked = drive([0.0, 0.1, 3.0, 3.1]), [0.05, 0.1, 0.2, 2.9, 3.0, 3.05]
    assert agent.at(asked).valid.all()
    assert agent.at(asked, max_gap_s=1.0).valid.tolist() == [True, True, False, False, True, True]


def test_a_single_waypoint_is_a_moment() -> None:
    state = drive([1.0]).at([0.5, 1.0, 1.5])
    assert state.valid.tolist() == [False, True, False]
    assert state.x_m[1] == 10.0
    assert drive([1.0]).at(1.0).x_m.tolist() == [10.0]


def test_agents_are_looked_up_by_their_ids() -> None:
    scenario = make_scenario()
    assert [scenario[id] for id in scenario] == list(scenario.agents)
    assert "car-1" in scenario
    assert "car-7" not in scenario
    with pytest.raises(KeyError, match=r"no agent 'car-7'.*car-1"):
        scenario["car-7"]


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
