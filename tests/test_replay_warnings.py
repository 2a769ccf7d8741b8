"""Warnings of collisions: when agents are known to an end, when the ego is warned, and whether it stands in time."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run as run_command
from replay_maneuvers import MANEUVERS, agent_from, driven, scenario_of
from replay_scenes import LENGTH_M, line, parked, walker

from log2sim.datatypes import Agent, Scenario
from log2sim.errors import ConfigError
from log2sim.prediction.motion_table import table_of
from log2sim.simulation.expected_motion import EgoPath, EgoStates, WarningSettings
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay
from log2sim.simulation.warnings import BrakeWhenWarned, Watch, describe_warnings, warn

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"
TOWN_MPS = 30 / 3.6
CERTAIN = WarningSettings(min_probability=0.01, early_probability=0.01)


def seen(agent: Agent, **spans: tuple[float, float]) -> Agent:
    """An agent that each end observes in one span."""
    return replace(agent, observed_by={end: (span,) for end, span in spans.items()})


def crossing_walker(meets_s: float, duration_s: float = 14.0, speed: float = 1.4) -> Agent:
    """Walks across the way of an ego at 30 km/h from the right, and is in the middle of it when the ego comes by."""
    front_m = TOWN_MPS * meets_s + LENGTH_M / 2
    return walker("p", front_m, -speed * meets_s, speed, duration_s, np.pi / 2)


def town_ego(duration_s: float = 14.0) -> Agent:
    return line("ego", 0.0, speed=TOWN_MPS, duration_s=duration_s)


def turned(scenario: Scenario, angle: float, shift: complex) -> Scenario:
    """The scenario on a map that is turned about its origin and then shifted."""
    agents = []
    for a in scenario.agents:
        w = a.waypoints
        place = (w.x_m + 1j * w.y_m) * np.exp(1j * angle) + shift
        agents.append(replace(a, waypoints=replace(w, x_m=place.real, y_m=place.imag, yaw_rad=w.yaw_rad + angle)))
    return replace(scenario, agents=tuple(agents))


def test_the_paper_s_stopping_distance_from_30_km_per_h_is_12_7_m() -> None:
    assert WarningSettings().stopping_distance_m(np.array(TOWN_MPS)) == pytest.approx(12.67, abs=0.005)
    assert WarningSettings(reaction_s=0.0).stopping_distance_m(np.array(20.0)) == pytest.approx(25.0)
    assert WarningSettings().needed_mps2(TOWN_MPS, 12.6736) == pytest.approx(8.0, abs=1e-3)
    assert WarningSettings().needed_mps2(TOWN_MPS, 8.0) is None


@pytest.mark.parametrize(("own", "theirs"), [(10.0, 10.0), (5.0, 20.0), (25.0, 8.0)])
def test_the_time_to_a_head_on_collision_is_exact(own: float, theirs: float) -> None:
    start_m = 9 * (own + theirs)
    scene = scenario_of(
        line("ego", 0.0, speed=own, duration_s=12.0), line("a", start_m, speed=theirs, duration_s=12.0, yaw=np.pi)
    )
    (event,) = warn(scene).events
    gap_m = start_m - LENGTH_M - (own + theirs) * event.warned.t_s
    assert event.warned.distance_m == pytest.approx(gap_m, abs=2e-3)
    assert event.ttc_s == pytest.approx(gap_m / (own + theirs), abs=2e-3)
    assert event.way_m == pytest.approx(own * event.ttc_s, abs=0.02)
    assert event.needed_mps2 == pytest.approx(own**2 / (2 * (event.way_m - own)), rel=1e-2)


def test_who_stands_in_the_way_is_warned_of_when_the_margin_begins() -> None:
    scene = scenario_of(line("ego", 0.0, speed=15.0, duration_s=10.0), parked("k", 120.0, 0.0))
    (event,) = warn(scene).events
    stopping_m = 15.0 + 15.0**2 / 16
    assert event.warned.stopping_m == pytest.approx(stopping_m, abs=1e-3)
    due_s = (120.0 - LENGTH_M - stopping_m - 15.0) / 15.0
    assert due_s <= event.warned.t_s < due_s + 0.1 + 1e-6
    assert event.probability == 1.0
    assert event.braking_suffices


def test_an_agent_is_known_from_the_third_observation_of_a_chosen_end() -> None:
    p = seen(crossing_walker(8.0), vehicle=(6.0, 14.0), road=(3.0, 14.0))
    scene = scenario_of(town_ego(), p)
    for ends, known_s in {"vehicle": 6.2, "road": 3.2, "both": 3.2}.items():
        (event,) = warn(scene, ends=ends).events
        assert event.known.t_s == pytest.approx(known_s)
        assert event.known_by == {"vehicle": 6.2, "road": 3.2}
        center_m = complex(p.waypoints.x_m[0] - TOWN_MPS * known_s, p.waypoints.y_m[0] + 1.4 * known_s)
        ahead, aside = center_m.real - LENGTH_M / 2 - 0.3, abs(center_m.imag) - 0.9 - 0.3
        assert event.known.distance_m == pytest.approx(np.hypot(ahead, max(aside, 0.0)), abs=0.02)


def test_nobody_is_warned_of_whom_the_chosen_end_does_not_know() -> None:
    scene = scenario_of(town_ego(), seen(crossing_walker(8.0), road=(3.0, 14.0)))
    assert warn(scene, ends="vehicle").events == ()
    result = replay(scene, dt_s=0.05)
    (event,) = warn(scene, result, ends="vehicle").events
    assert event.warned is None
    assert event.known is None
    assert event.collision_s == pytest.approx(8.0, abs=0.2)
    assert "no warning" in describe_warnings(warn(scene, result, ends="vehicle"))


def test_with_one_end_nothing_is_said_of_which_end_knows_it() -> None:
    scene = scenario_of(town_ego(), seen(crossing_walker(8.0), vehicle=(3.0, 14.0)))
    found = warn(scene, ends="both")
    assert found.tells_ends
    assert found.events[0].known_by == {}
    assert (found.known_agents, warn(scene, ends="road").known_agents) == (1, 0)
    assert "they know 0 of 1 other agents" in describe_warnings(warn(scene, ends="road"))
    untold = warn(scenario_of(town_ego(), crossing_walker(8.0)), ends="road")
    assert not untold.tells_ends
    assert [e.agent for e in untold.events] == ["p"]


def test_what_was_seen_once_is_not_known() -> None:
    assert warn(scenario_of(town_ego(), seen(crossing_walker(8.0), vehicle=(6.0, 6.1)))).events == ()


def test_who_was_lost_is_expected_to_go_on_for_a_while_and_then_forgotten() -> None:
    """The walker steps behind a van 4 s before the collision: it is remembered for 1.2 s, too short for a warning."""
    lost_s = 4.0
    short = scenario_of(town_ego(), seen(crossing_walker(8.0), vehicle=(1.0, lost_s)))
    assert warn(short).events == ()
    longer = scenario_of(town_ego(), seen(crossing_walker(8.0), vehicle=(1.0, 5.8)))
    (event,) = warn(longer).events
    assert event.warned.t_s < 7.0
    assert event.spans_s[-1][1] == pytest.approx(7.0)
    # A static agent stays.
    stays = seen(parked("k", 80.0, 0.0), vehicle=(1.0, 2.0))
    assert warn(scenario_of(town_ego(), stays)).events[0].agent == "k"


def test_who_is_lost_is_expected_from_where_it_was_seen_last() -> None:
    """The oncoming car is lost 3 s before it meets the ego, and warned of after that: the time to the collision stays exact."""
    oncoming = seen(line("a", 120.0 + LENGTH_M, speed=10.0, yaw=np.pi, duration_s=8.0), road=(0.0, 3.0))
    (event,) = warn(scenario_of(line("ego", 0.0, speed=10.0, duration_s=8.0), oncoming), settings=CERTAIN).events
    assert 3.2 < event.warned.t_s < 4.2
    assert event.ttc_s == pytest.approx(6.0 - event.warned.t_s, abs=5e-3)


def test_what_an_agent_does_while_nobody_looks_is_not_known() -> None:
    steady = crossing_walker(8.0)
    w = steady.waypoints
    unseen = (w.t_s > 3.05) & (w.t_s < 3.95)
    strays = replace(steady, waypoints=replace(w, x_m=w.x_m - 2.0 * unseen, y_m=w.y_m + 1.5 * unseen))
    spans = {"vehicle": ((0.0, 3.0), (4.0, 14.0))}
    found = [warn(scenario_of(town_ego(), replace(a, observed_by=spans))) for a in (steady, strays)]
    assert found[0].events
    assert found[0] == found[1]


def test_an_ego_that_brakes_for_it_already_is_not_warned() -> None:
    t = np.arange(0.0, 10.05, 0.1)
    speed = np.clip(10.0 - 2.0 * (t - 2.0), 0.0, 10.0)
    way = np.where(t < 2.0, 10.0 * t, 20.0 + np.minimum(t - 2.0, 5.0) * (10.0 - np.minimum(t - 2.0, 5.0)))
    ego = agent_from(t, way, 0 * t, 0 * t, speed, id="ego")
    stands = parked("k", 45.0 + LENGTH_M + 2.0, 0.0)
    assert warn(scenario_of(ego, stands)).events == ()
    assert warn(scenario_of(line("ego", 0.0, speed=10.0, duration_s=5.0), stands)).events


def test_the_ego_is_expected_along_its_path_as_far_aside_as_it_is_and_off_it_straight_on() -> None:
    bend = driven(lambda t: np.full_like(t, 8.0), lambda s: np.where(s > 20, 1 / 15, 0.0), 8.0, id="ego")
    way, lead_s = EgoPath(bend), np.array([0.0, 1.0, 3.0])
    at_s = np.array([1.0])
    x, y, _, yaw, speed = bend.trajectory.at(at_s)
    states = EgoStates(x, y + 0.8, yaw, speed, np.zeros(1), way.progress(x, y))
    ahead = bend.trajectory.at(at_s + lead_s)
    wanted = ahead.x_m + 1j * ahead.y_m + 0.8j * np.exp(1j * ahead.yaw_rad)
    assert np.abs(way.at(states, lead_s).position_m[0] - wanted).max() < 0.3
    off = way.at(states._replace(y_m=y + 5.0), lead_s).position_m[0]
    assert np.abs(off - (x + 1j * (y + 5.0) + 8.0 * lead_s)).max() < 1e-6
    slows = way.at(states._replace(accel_mps2=np.array([-4.0])), lead_s).position_m[0]
    assert abs(slows[2] - slows[0]) == pytest.approx(8.0, abs=0.01)  # v^2 / 2a


def test_who_is_elsewhere_than_in_the_scenario_is_expected_from_there() -> None:
    scene = scenario_of(line("ego", 0.0, speed=10.0, duration_s=8.0), line("a", 40.0, 12.0, speed=2.0, duration_s=8.0))
    watch = Watch(scene, scene.others, CERTAIN, table_of(scene).t_s)
    ego = EgoStates(*(np.array([v]) for v in (20.0, 0.0, 0.0, 10.0, 0.0, 20.0)))
    tick = np.array([20])
    assert not watch.courses(ego, tick).due.any()
    beside = np.array([44.0 + 0.0j]), np.array([2.0])
    found = watch.courses(ego, tick, beside)
    assert found.due.all()
    assert found.ttc_s[0] == pytest.approx((24.0 - LENGTH_M) / 8.0, abs=1e-3)
    slower = watch.courses(ego, tick, (beside[0], np.array([1.0])))
    assert slower.ttc_s[0] == pytest.approx((24.0 - LENGTH_M) / 9.0, abs=1e-3)


def test_nothing_later_than_the_moment_is_used() -> None:
    """Cut short at a warning, the scenario gives the same warning; velocities of waypoints rest on the next one, which is kept."""
    t = np.arange(0.0, 10.05, 0.1)
    turns = driven(
        lambda s: np.full_like(s, 8.0),
        lambda s: np.clip((s - 20) / 100, 0, 0.08),
        10.0,
        id="a",
        start=(90.0, 3.5, np.pi),
    )
    scene = scenario_of(
        line("ego", 0.0, speed=9.0, duration_s=10.0), turns, walker("p", 40.0, -8.0, 1.5, 10.0, np.pi / 2)
    )
    whole = warn(scene, settings=CERTAIN)
    assert len(whole.events) == 2
    for event in whole.events:
        until = np.searchsorted(t, event.warned.t_s + 1e-6)
        cut = [replace(a, waypoints=a.waypoints.take(slice(0, until + 1))) for a in scene.others]
        again = warn(replace(scene, agents=(scene.ego, *cut)), settings=CERTAIN).of(event.agent)
        assert again.warned == event.warned
        assert again.probability == event.probability


@pytest.mark.parametrize(("angle", "shift"), [(0.7, 3000 - 500j), (np.pi, 4e5 + 5e6j), (-2.0, 0j)])
def test_warnings_do_not_depend_on_the_map(angle: float, shift: complex) -> None:
    scene = scenario_of(town_ego(), crossing_walker(8.0), line("a", 150.0, 0.3, speed=9.0, yaw=np.pi, duration_s=14.0))
    one, other = (warn(s).events for s in (scene, turned(scene, angle, shift)))
    assert [e.agent for e in one] == [e.agent for e in other] == ["p", "a"]
    for a, b in zip(one, other):
        assert a.warned.t_s == b.warned.t_s
        assert (a.ttc_s, a.way_m, a.probability) == pytest.approx((b.ttc_s, b.way_m, b.probability), abs=2e-3)


def test_warnings_do_not_depend_on_the_time_step() -> None:
    scene = scenario_of(town_ego(), crossing_walker(8.0))
    found = [warn(scene, replay(scene, mode="exact", dt_s=dt)).events[0] for dt in (0.01, 0.05, 0.1)]
    for event in found[1:]:
        assert event.warned.t_s == pytest.approx(found[0].warned.t_s)
        assert event.ttc_s == pytest.approx(found[0].ttc_s, abs=0.01)


def test_ordinary_traffic_gives_no_warning() -> None:
    ego = line("ego", 0.0, speed=14.0, duration_s=12.0)
    beside = [parked(f"k{n}", 20.0 * n, -2.6) for n in range(1, 8)]
    scene = scenario_of(
        ego, *beside, line("ahead", 25.0, speed=14.0, duration_s=12.0), line("behind", -15.0, speed=16.0, duration_s=6.0),
        line("oncoming", 250.0, 3.5, speed=14.0, yaw=np.pi, duration_s=12.0), walker("w", 30.0, -4.5, 1.4, 12.0, 0.0),
        walker("before", 90.0, -3.0, 1.4, 12.0, np.pi / 2), line("crossed", 120.0, -20.0, speed=12.0, yaw=np.pi / 2, duration_s=4.0),
    )  # fmt: skip
    assert warn(scene).events == ()


def lifted(agent: Agent, z_m: np.ndarray | float) -> Agent:
    w = agent.waypoints
    return replace(agent, waypoints=replace(w, z_m=np.broadcast_to(z_m, len(w)).astype(float)))


def test_who_crosses_on_a_bridge_is_no_danger_and_who_stands_up_the_slope_is() -> None:
    below = line("ego", 0.0, speed=15.0, duration_s=8.0)
    assert warn(scenario_of(below, lifted(parked("k", 80.0, 0.0, np.pi / 2), 6.0))).events == ()
    uphill = lifted(below, 0.1 * below.waypoints.x_m)
    assert warn(scenario_of(uphill, lifted(parked("k", 80.0, 0.0), 8.0))).events


def test_oncoming_traffic_in_a_bend_gives_no_warning() -> None:
    def circle(radius_m: float, speed: float, begin: float, id: str) -> Agent:
        t = np.arange(0, 10.05, 0.1)
        angle = begin + speed / radius_m * t
        x, y = abs(radius_m) * np.cos(angle), abs(radius_m) * np.sin(angle)
        return agent_from(t, x, y, angle + np.sign(radius_m) * np.pi / 2, np.full(len(t), speed), id=id)

    scene = scenario_of(circle(60.0, 9.0, 0.0, "ego"), circle(-56.5, 9.0, 2.4, "a"))
    assert warn(scene).events == ()


def test_a_standing_ego_is_not_warned() -> None:
    scene = scenario_of(line("ego", 0.0, speed=0.0, duration_s=8.0), line("a", -50.0, speed=10.0, duration_s=8.0))
    assert warn(scene).events == ()


def test_without_an_ego_each_vehicle_is_warned_as_an_ego_would_be() -> None:
    """Two encounters far from each other: of a car and a walker, and of two cars head-on, each of which is warned."""
    p = crossing_walker(8.0)
    (expected,) = warn(scenario_of(town_ego(), p)).events
    far = 5000.0
    one = line("one", far, speed=10.0, duration_s=12.0)
    two = line("two", far + 180.0, speed=10.0, duration_s=12.0, yaw=np.pi)
    standing = line("standing", far, speed=0.0, duration_s=12.0, y_m=50.0)
    scene = scenario_of(replace(town_ego(), id="car"), p, one, two, standing)
    found = {(e.driver, e.agent): e for e in warn(scene).events}
    assert set(found) == {("car", "p"), ("one", "two"), ("two", "one")}
    assert found["car", "p"] == replace(expected, driver="car")
    assert found["one", "two"].ttc_s == pytest.approx(found["two", "one"].ttc_s, abs=2e-3)
    doubtful = replace(line("doubtful", far, speed=10.0, duration_s=12.0, y_m=90.0), quarantined=True)
    scene = replace(scene, agents=(*scene.agents, doubtful))  # who is not in the replay
    hit = {(e.driver, e.agent): e.collision_s for e in warn(scene, replay(scene, dt_s=0.05)).events}
    assert hit["one", "two"] == hit["two", "one"] == pytest.approx((180.0 - LENGTH_M) / 20.0, abs=0.1)


def test_a_vehicle_that_the_end_does_not_know_cannot_be_warned() -> None:
    car, p = replace(town_ego(), id="car"), crossing_walker(8.0)
    known = scenario_of(seen(car, road=(0.0, 14.0)), seen(p, road=(0.0, 14.0)))
    assert [e.driver for e in warn(known, ends="road").events] == ["car"]
    assert warn(scenario_of(seen(car, vehicle=(0.0, 14.0)), seen(p, road=(0.0, 14.0))), ends="road").events == ()
    two = [
        line(name, x, speed=10.0, duration_s=12.0, yaw=yaw) for name, x, yaw in (("a", 0.0, 0.0), ("b", 180.0, np.pi))
    ]
    unknown = scenario_of(*(seen(a, vehicle=(0.0, 12.0)) for a in two))
    (missed,) = warn(unknown, replay(unknown, dt_s=0.05), ends="road").events
    assert missed.warned is None


def test_nobody_to_warn_is_told_before_anything_is_simulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def simulate(*_: object, **__: object) -> None:
        raise AssertionError("simulated")

    monkeypatch.setattr("log2sim.simulation.runner.replay", simulate)
    world = scenario_of(line("a", 0.0, speed=0.0), crossing_walker(8.0))
    with pytest.raises(ConfigError, match="nobody could be warned"):
        warn(world)
    world.save(tmp_path / "s.json")
    for options in ([], ["--brake"]):
        assert "no agent 'ego'" in run_command("replay", tmp_path / "s.json", "--warn", "road", *options).line


def test_settings_of_warnings_have_limits() -> None:
    with pytest.raises(ConfigError, match="expected one of vehicle, road, both"):
        WarningSettings("rode")
    with pytest.raises(ConfigError, match="reaction_s is -1"):
        WarningSettings(reaction_s=-1.0)


def test_the_ego_that_brakes_when_warned_stands_in_time_if_its_end_sees_the_walker() -> None:
    p = seen(crossing_walker(6.0, 8.0), vehicle=(5.1, 8.0), road=(3.0, 8.0))
    scene = scenario_of(town_ego(8.0), p)
    hits = []
    for ends in ("vehicle", "road", "both"):
        result = replay(scene, ego=BrakeWhenWarned(WarningSettings(ends)), dt_s=0.1, model="kinematic")
        hits.append(len(result.metrics["collisions"]))
    assert hits == [1, 0, 0]


def test_the_ego_drives_on_as_in_the_scenario_when_its_way_is_clear() -> None:
    scene = scenario_of(town_ego(), crossing_walker(4.0))
    ego = replay(scene, ego=BrakeWhenWarned(), dt_s=0.1, model="kinematic").agent("ego")
    assert ego.speed_mps.min() < 0.05
    assert ego.speed_mps[-1] == pytest.approx(TOWN_MPS, abs=0.5)
    assert ego.speed_mps.max() < TOWN_MPS + 1.5  # it does not hurry after what it lost
    quiet = replay(scenario_of(town_ego(5.0)), ego=BrakeWhenWarned(), dt_s=0.1).agent("ego")
    assert np.abs(quiet.x_m - TOWN_MPS * quiet.t_s).max() < 0.05


def test_an_ego_in_reverse_is_warned_of_what_is_behind_it_and_stands_before() -> None:
    t = np.arange(0.0, 8.05, 0.1)
    ego = agent_from(t, -3.0 * t, 0 * t, 0 * t, np.full(len(t), -3.0), id="ego")
    scene = scenario_of(ego, parked("k", -16.0, 0.0), line("before", 8.0, speed=0.0, duration_s=8.0))
    (event,) = warn(scene).events
    assert event.agent == "k"
    assert event.ttc_s == pytest.approx((16.0 - LENGTH_M) / 3.0 - event.warned.t_s, abs=0.01)
    braked = replay(scene, ego=BrakeWhenWarned(), dt_s=0.1, model="kinematic")
    assert braked.metrics["collisions"] == []
    assert braked.agent("ego").speed_mps[-1] == 0.0


def test_the_ego_that_is_not_warned_drives_as_in_the_scenario() -> None:
    for name in ("turn of radius 8 m", "reversing", "brake to stop and go"):
        ego = replace(MANEUVERS[name](), id="ego")
        own = replay(scenario_of(ego), ego=BrakeWhenWarned(), dt_s=0.1, model="kinematic").agent("ego")
        x, y = ego.trajectory.at(own.t_s)[:2]
        assert np.hypot(own.x_m - x, own.y_m - y).max() < 0.25


def test_the_file_holds_the_warnings(tmp_path: Path) -> None:
    scene = scenario_of(town_ego(), seen(crossing_walker(8.0), vehicle=(6.0, 14.0), road=(3.0, 14.0)))
    scene.save(tmp_path / "s.json")
    files = [str(tmp_path / name) for name in ("s.json", "r.json")]
    ran = run_command("replay", files[0], "--warn", "both", "--dt", "0.05", "--out", files[1])
    assert ran.code == 0
    out = ran.out
    assert "1 warning in 14.0 s of driving, by the sensors of vehicle and road: they know 1 of 1 other agents" in out
    assert "(to the road alone from 3.20 s; to the vehicle alone from 6.20 s)" in out
    loaded = Replay.load(files[1])
    assert loaded.warnings == warn(scene, loaded)
    assert "warnings" not in json.loads((SAMPLE.parent / "truth.json").read_text(encoding="utf-8"))


@pytest.mark.slow
def test_braking_needs_warnings() -> None:
    assert "--brake: brakes when the ego is warned; add --warn" in run_command("replay", str(SAMPLE), "--brake").line
    ran = run_command("replay", str(SAMPLE), "--warn", "vehicle", "--brake", "--dt", "0.1")
    assert ran.code == 0
    assert "no warnings in" in ran.out
