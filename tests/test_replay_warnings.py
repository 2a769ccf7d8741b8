"""Warnings of collisions: when agents are known to an end, when the ego is warned, and whether it stands in time."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run as run_command
from replay_maneuvers import driven, scenario_of
from replay_scenes import LENGTH_M, line, parked, walker

from log2sim.datatypes import Agent, Scenario
from log2sim.simulation.expected_motion import WarningSettings
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay
from log2sim.simulation.warnings import BrakeWhenWarned, warn

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


def test_the_ego_that_brakes_when_warned_stands_in_time_if_its_end_sees_the_walker() -> None:
    p = seen(crossing_walker(6.0, 8.0), vehicle=(5.1, 8.0), road=(3.0, 8.0))
    scene = scenario_of(town_ego(8.0), p)
    hits = []
    for ends in ("vehicle", "road", "both"):
        result = replay(scene, ego=BrakeWhenWarned(WarningSettings(ends)), dt_s=0.1, model="kinematic")
        hits.append(len(result.metrics["collisions"]))
    assert hits == [1, 0, 0]


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
