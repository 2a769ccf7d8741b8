"""Scenarios: what is written reads back, what is wrong is named, and agents between waypoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from log2sim.datatypes import Agent, MapFrame, Scenario, Waypoints


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
