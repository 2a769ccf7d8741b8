"""Edits against closed forms, what they leave alone, and what they warn of."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import waypoints

from log2sim.datatypes import Agent, Scenario, Waypoints
from log2sim.edit.apply import edit
from log2sim.edit.edits import Add, CutIn, Edit, Lateral, Only, Remove, Replace, Shift, Speed, Window
from log2sim.errors import CheckFailed, ConfigError
from log2sim.geometry import Array, wrap_angle
from log2sim.simulation.runner import replay

TRUTH = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"


def agent(id: str, t_s: Array, x_m: Any, y_m: Any, yaw_rad: Any, speed_mps: Any, **changes: Any) -> Agent:
    """A car with these columns, scalars standing for all times."""
    w = waypoints(t_s, x_m, y_m, 0.8, wrap_angle(yaw_rad), speed_mps)
    return Agent(**{"id": id, "category": "car", "size_m": (4.0, 2.0, 1.6), "waypoints": w, **changes})


def straight(id: str, speed_mps: float = 10.0, y_m: float = 0.0, x0_m: float = 0.0, end_s: float = 4.0) -> Agent:
    t = np.linspace(0.0, end_s, 41)
    return agent(id, t, x0_m + speed_mps * t, y_m, 0.0, speed_mps)


def circling(radius_m: float, speed_mps: float, start_rad: float = 1.2) -> Agent:
    """A car on a circle about the origin, counter-clockwise when driving forward, over yaw +-pi."""
    t = np.linspace(0.0, 3.0, 61)
    angle = start_rad + speed_mps / radius_m * t
    return agent("car", t, radius_m * np.cos(angle), radius_m * np.sin(angle), angle + np.pi / 2, speed_mps)


def parked(id: str = "parked", x_m: float = 30.0, y_m: float = -3.0, yaw_rad: float = 0.4) -> Agent:
    return agent(id, np.array([0.0, 4.0]), x_m, y_m, yaw_rad, 0.0, static=True)


def scenario(*agents: Agent) -> Scenario:
    return Scenario(name="made", t0_ns=0, duration_s=4.0, agents=agents)


def only_one(source: Agent, *edits: Edit) -> Waypoints:
    """The waypoints of the one agent of a scenario after edits."""
    (after,) = edit(scenario(source), edits).scenario.agents
    return after.waypoints


def columns(w: Waypoints) -> Array:
    return np.stack([getattr(w, k) for k in Waypoints.FLOATS])


@pytest.mark.parametrize("speed_mps", [6.0, -2.0], ids=["forward", "reversing"])
@pytest.mark.parametrize("meters", [3.5, -8.0])
def test_a_circle_moved_sideways_is_the_circle_about_the_same_center(speed_mps: float, meters: float) -> None:
    before = circling(10.0, speed_mps).waypoints
    w = only_one(circling(10.0, speed_mps), Lateral("car", meters))
    np.testing.assert_allclose(np.hypot(w.x_m, w.y_m), 10.0 - meters, rtol=1e-12)
    np.testing.assert_allclose(w.speed_mps, speed_mps * (1 - meters / 10.0), rtol=1e-9)
    np.testing.assert_array_equal(w.yaw_rad, before.yaw_rad)
    np.testing.assert_array_equal(w.z_m, before.z_m)


@pytest.mark.parametrize("factor", [0.5, 1.25, 3.0])
def test_a_faster_agent_is_at_the_same_places_earlier(factor: float) -> None:
    t = np.linspace(0.6, 3.6, 31)
    source = agent("car", t, 2.0 * (t - 0.6) ** 2, 0.0, 0.0, 4.0 * (t - 0.6))  # 4 m/s2 from rest
    after = edit(scenario(source), [Speed("car", factor)]).scenario
    w = after.agents[0].waypoints
    assert w.t_s[0] == 0.6
    assert w.t_s[-1] == pytest.approx(0.6 + 3.0 / factor)
    np.testing.assert_allclose(w.x_m, 2.0 * (factor * (w.t_s - 0.6)) ** 2, atol=1e-12)
    np.testing.assert_allclose(np.diff(w.speed_mps) / np.diff(w.t_s), 4.0 * factor**2)
    assert after.duration_s == pytest.approx(max(4.0, 0.6 + 3.0 / factor))


def test_what_a_shift_brings_before_the_start_is_cut() -> None:
    source = straight("car")
    w = only_one(source, Shift("car", -1.03))
    assert w.t_s[0] == 0.0
    assert w.t_s[-1] == pytest.approx(2.97)
    assert w.x_m[0] == pytest.approx(10.3)  # between waypoints at 1.0 and 1.1 s
    assert (np.diff(w.t_s) > 0).all()
    np.testing.assert_allclose(w.x_m, 10.3 + 10.0 * w.t_s)
    on_waypoint = only_one(source, Shift("car", -float(source.waypoints.t_s[10])))
    assert len(on_waypoint) == 31
    with pytest.raises(ConfigError, match=r"nothing is left of agent 'car', which is there until 4 s"):
        only_one(source, Shift("car", -4.1))


def test_agents_are_left_out_and_all_others_stay_as_they_are() -> None:
    source = scenario(straight("ego"), straight("a", y_m=4.0), straight("b", y_m=8.0), parked())
    removed = edit(source, [Remove("a"), Remove("parked")]).scenario
    assert [x.id for x in removed.agents] == ["ego", "b"]
    kept = edit(source, [Only(("parked", "ego"))]).scenario
    assert [x.id for x in kept.agents] == ["ego", "parked"]
    assert kept.duration_s == 4.0
    shifted = edit(source, [Shift("a", 1.0)]).scenario
    assert [x is y for x, y in zip(shifted.agents, source.agents)] == [True, False, True, True]


def test_the_source_is_not_changed_and_named_in_the_provenance(tmp_path: Path) -> None:
    source = replace(Scenario.load(TRUTH), provenance={"seed": 3})
    before = source.to_dict()
    once = edit(source, [Remove("bus_1"), Shift("car_turning", 1.5)])
    assert source.to_dict() == before
    once.scenario.save(tmp_path / "once.json")
    read = Scenario.load(tmp_path / "once.json")
    twice = edit(read, [Only(("ego", "car_turning")), Lateral("ego", 0.5), Speed("ego", 2.0)]).scenario
    assert twice.provenance == {
        "seed": 3,
        "edits": [
            {
                "source_digest": source.digest,
                "edits": [
                    {"kind": "remove", "agent": "bus_1"},
                    {"kind": "shift", "agent": "car_turning", "seconds": 1.5},
                ],
            },
            {
                "source_digest": read.digest,
                "edits": [
                    {"kind": "only", "agents": ["ego", "car_turning"]},
                    {"kind": "lateral", "agent": "ego", "meters": 0.5},
                    {"kind": "speed", "agent": "ego", "factor": 2.0},
                ],
            },
        ],
    }
    assert source.digest == replay(source, mode="exact", dt_s=0.1).scenario_digest
    assert read.digest == once.scenario.digest != source.digest


def test_a_new_collision_is_told_with_its_pair_and_time() -> None:
    # Crossing ways: the ego passes the origin at 2 s, the other car at 0.6 s; 1.4 s later they are there together.
    t = np.linspace(0.0, 4.0, 41)
    source = scenario(
        agent("ego", t, 10.0 * t - 20.0, 0.0, 0.0, 10.0), agent("other", t, 0.0, 10.0 * t - 6.0, math.pi / 2, 10.0)
    )
    assert edit(source, [Shift("other", 0.1)]).warnings == ()
    (warning,) = edit(source, [Shift("other", 1.4)]).warnings
    # Bumpers at 3 m from the crossing (half a length and half a width) touch 0.3 s before both are there.
    assert "agents 'ego' and 'other' collide at 1.70 s at 14.1 m/s" in warning
    result = edit(source, [Shift("other", 1.4)])
    with pytest.raises(CheckFailed, match="'ego' and 'other' collide"):
        result.require_clean()
    edit(source, [Shift("other", 0.1)]).require_clean()


def test_accelerations_beyond_the_limit_are_told_with_value_and_time() -> None:
    t = np.linspace(0.0, 4.0, 41)
    speed = 20.0 - np.where(t < 2.0, 0.0, 4.0 * (t - 2.0))  # brakes with 4 m/s2 from 2 s on
    x = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t))])
    source = scenario(agent("car", t, x, 0.0, 0.0, speed))
    assert edit(source, [Speed("car", 1.6)]).warnings == ()  # 10.24 m/s2
    (warning,) = edit(source, [Speed("car", 1.7)]).warnings  # 11.56 m/s2
    assert "agent 'car': acceleration 11.6 m/s2 at 1.2" in warning
    assert "limit 10.4 m/s2" in warning


@pytest.mark.parametrize(
    ("edits", "message"),
    [
        ([], "no edits"),
        ([Remove("cra")], r"no agent 'cra' \(did you mean 'car'\?\); known: car, parked"),
        ([Only(("car", "x"))], "only: no agent 'x'"),
        ([Remove("car"), Shift("car", 1.0)], "shift: agent 'car' is left out by another edit"),
        ([Remove("car"), Remove("parked")], "leaves out every agent"),
        ([Shift("car", 1.0), Shift("car", 2.0)], "shift: agent 'car' is named twice"),
        ([Speed("parked", 2.0)], "agent 'parked' is static"),
    ],
)
def test_what_cannot_be_done_is_refused(edits: list[Edit], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        edit(scenario(straight("car"), parked()), edits)


@pytest.mark.parametrize("meters", [-3.5, 3.5])
def test_a_lane_change_starts_and_ends_parallel_and_moves_as_it_points(meters: float) -> None:
    source = straight("car", 12.0, end_s=6.0)
    edited = edit(scenario(source), [Lateral("car", meters, Window(1.0, 3.0))])
    (after,) = edited.scenario.agents
    assert edited.warnings == ()
    t = np.array([0.0, 1.0, 4.0, 6.0])
    np.testing.assert_allclose(after.at(t).y_m, [0.0, 0.0, meters, meters], atol=1e-6)
    np.testing.assert_allclose(after.at(t).yaw_rad, 0.0, atol=1e-6)
    fine = np.linspace(0.0, 6.0, 601)
    s = after.at(fine)
    vx, vy = np.gradient(s.x_m, fine), np.gradient(s.y_m, fine)
    np.testing.assert_allclose(s.speed_mps, np.hypot(vx, vy), atol=0.02)
    np.testing.assert_allclose(np.arctan2(vy, vx), s.yaw_rad, atol=0.005)
    # Least jerk: the largest acceleration across is 10 / sqrt(3) times the offset over the square of the time.
    across = np.gradient(np.gradient(s.y_m, fine), fine)[5:-5]
    assert np.abs(across).max() == pytest.approx(10 / np.sqrt(3) * abs(meters) / 3.0**2, rel=0.05)
    assert len(edit(scenario(straight("car", 30.0)), [Lateral("car", 10.0, Window(1.0, 1.0))]).warnings) >= 1


def test_a_window_of_slower_driving_keeps_the_path_and_comes_back_to_its_speed() -> None:
    source = straight("car", 10.0, end_s=4.0)
    after = edit(scenario(source), [Speed("car", 0.5, Window(1.0, 2.0))]).scenario.agents[0]
    s = after.at(np.array([0.5, 2.0, 3.5]))
    np.testing.assert_allclose(s.speed_mps, [10.0, 5.0, 10.0], atol=0.05)
    # Half a second of each ramp at 7.5 m/s on average, a second at 5 m/s: 12.5 m in 2 s instead of 20 m.
    assert s.x_m[2] == pytest.approx(35.0 - 7.5, abs=0.05)
    assert after.waypoints.x_m[-1] == pytest.approx(40.0)
    fine = np.linspace(0.0, 4.5, 451)
    np.testing.assert_allclose(np.gradient(after.at(fine).x_m, fine)[1:-1], after.at(fine).speed_mps[1:-1], atol=0.3)


def test_a_cut_in_ends_on_the_path_of_the_ego_with_the_gap_that_was_asked_for() -> None:
    ego, car = straight("ego", 10.0, end_s=6.0), straight("car", 12.0, y_m=3.5, x0_m=-20.0, end_s=8.0)
    edited = edit(replace(scenario(ego, car), duration_s=8.0), [CutIn("car", Window(2.0, 2.0), 6.0)])
    after = {a.id: a for a in edited.scenario.agents}
    at = np.array([4.0, 5.0])
    np.testing.assert_allclose(after["car"].at(at).y_m, 0.0, atol=0.01)
    gap = after["car"].at(at).x_m[0] - after["ego"].at(at).x_m[0] - 4.0
    assert gap == pytest.approx(6.0, abs=1.3)  # steps of a tenth of a second
    with pytest.raises(ConfigError, match="never 500 m ahead"):
        edit(scenario(ego, car), [CutIn("car", Window(2.0, 2.0), 500.0)])


def test_agents_are_added_and_replaced_on_the_ground() -> None:
    ego = circling(20.0, 8.0)
    source = scenario(replace(ego, id="ego"), parked())
    edits = [
        Add("car", 5.0, 6.0, 0.5),
        Add("truck", 0.0, 0.0, 0.0, 3.0),
        Add("car", ahead_of="ego", meters=5.0),
        Replace("parked", "truck"),
    ]
    after = {a.id: a for a in edit(source, edits).scenario.agents}
    assert list(after) == ["ego", "parked", "car-1", "truck-1", "car-2"]
    assert after["car-1"].is_permanent
    assert after["parked"].category == "truck"
    for a in after.values():
        np.testing.assert_allclose(a.waypoints.z_m - a.size_m[2] / 2, 0.0, atol=1e-9)
    assert after["truck-1"].at(2.0).x_m[0] == pytest.approx(6.0)
    t = np.array([0.5, 2.0])
    lead, follow = after["car-2"].at(t), after["ego"].at(t)
    ahead = wrap_angle(np.arctan2(lead.y_m, lead.x_m) - np.arctan2(follow.y_m, follow.x_m)) * 20.0
    np.testing.assert_allclose(ahead, 5.0, atol=0.05)
    np.testing.assert_allclose(np.hypot(lead.x_m, lead.y_m), 20.0, atol=0.05)
    assert not after["car-2"].waypoints.observed.any()
