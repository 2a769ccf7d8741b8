"""Contacts between stored states: closed forms, and overlaps at a thousand times as many moments."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from export_worlds import straight, world
from replay_maneuvers import agent_from, scenario_of
from scipy.optimize import brentq

from log2sim.datatypes import Agent, Scenario
from log2sim.errors import CheckFailed
from log2sim.geometry import rectangles_overlap, wrap_angle
from log2sim.simulation import Controls, Observation
from log2sim.simulation.metrics.all_metrics import require_strict, summarize
from log2sim.simulation.metrics.collisions import MAX_STEPS, BoxTracks, RelativeMotion, collisions, first_contact
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay

SPACING_S = 0.05
T_S = np.arange(0, 81) * SPACING_S


def boxes_of(*tracks, size=(4.0, 2.0, 1.5)):
    """Boxes from tracks of functions x, y, yaw of time, and times from which to which each is there."""
    shape = (len(T_S), len(tracks))
    x, y, yaw = (np.full(shape, np.nan) for _ in range(3))
    for k, (fx, fy, fyaw, *life) in enumerate(tracks):
        begin, end = life or (T_S[0], T_S[-1])
        there = np.abs(T_S - (begin + end) / 2) < (end - begin) / 2 + 1e-9
        for column, f in ((x, fx), (y, fy), (yaw, fyaw)):
            column[there, k] = (f(T_S) if callable(f) else np.full(len(T_S), f))[there]
    sizes = np.array(size if np.ndim(size) == 2 else [size] * len(tracks), float)
    return BoxTracks(x, y, np.where(np.isnan(x), np.nan, 0.8), wrap_angle(yaw), np.zeros(shape), sizes)


def events_of(boxes):
    count = len(boxes.size_m)
    far = BoxTracks(*(c + 1e4 * np.arange(count) for c in (boxes.x_m, boxes.y_m)), boxes.z_m, boxes.yaw_rad, boxes.speed_mps, boxes.size_m)  # fmt: skip
    return collisions(boxes, far, np.ones(count, bool), T_S, [str(k) for k in range(count)])


@pytest.mark.parametrize("start", np.linspace(60.0, 66.0, 13))
@pytest.mark.parametrize("offset", [0.0, 1e7])
def test_two_that_meet_head_on_touch_when_the_gap_is_closed_and_none_tunnels_at_60_mps(start, offset):
    bicycle = (1.8, 0.6, 1.7)
    a, b = (lambda t: offset + 60 * t, offset, 0.0), (lambda t: offset + start - 60 * t, offset + 0.2, np.pi)
    (event,) = events_of(boxes_of(a, b, size=bicycle))
    assert event["t_s"] == pytest.approx((start - 1.8) / 120, abs=1e-4)
    assert event["until_s"] == pytest.approx((start + 1.8) / 120, abs=1e-4)
    assert event["relative_speed_mps"] == pytest.approx(120.0, abs=1e-3)
    assert not event["from_start"]
    beside = (lambda t: offset + start - 60 * t, offset + 0.61, np.pi)
    assert events_of(boxes_of(a, beside, size=bicycle)) == []


@pytest.mark.parametrize("late_s", [-0.08, -0.06, 0.0, 0.06, 0.08])
def test_two_that_cross_at_right_angles_touch_while_both_cover_the_crossing(late_s):
    a = (lambda t: 50 * (t - 1.013), 0.0, 0.0)
    b = (0.0, lambda t: 30 * (t - 1.013 - late_s), np.pi / 2)
    # Each covers the other's lane while its center is within (4 + 2) / 2 of it.
    begin = max(1.013 - 3 / 50, 1.013 + late_s - 3 / 30)
    end = min(1.013 + 3 / 50, 1.013 + late_s + 3 / 30)
    (event,) = events_of(boxes_of(a, b))
    assert (event["t_s"], event["until_s"]) == pytest.approx((begin, end), abs=1e-4)
    assert event["relative_speed_mps"] == pytest.approx(np.hypot(50, 30), abs=1e-3)


@pytest.mark.parametrize("view", [0.0, 0.5, -2.0])
@pytest.mark.parametrize("rate", [1.5, -6.0])
def test_a_bar_that_turns_touches_when_its_corner_gets_there(rate, view):
    bar, wall = (10.0, 0.5, 2.0), (2.0, 40.0, 2.0)
    gap = 4.6
    a = (0.0, 0.0, lambda t: view + np.pi / 2 + rate * t)  # seen from some sides its yaw passes pi
    b = ((gap + 1.0) * np.cos(view), (gap + 1.0) * np.sin(view), view)

    def reach(t):
        yaw = np.pi / 2 + rate * t
        return 5.0 * abs(np.cos(yaw)) + 0.25 * abs(np.sin(yaw)) - gap

    expected = brentq(reach, 0.0, np.pi / 2 / abs(rate))
    event = events_of(boxes_of(a, b, size=(bar, wall)))[0]
    assert event["t_s"] == pytest.approx(expected, abs=1e-4)


def random_motions(count, seed):
    rng = np.random.default_rng(seed)
    size_a, size_b = (
        np.stack([rng.uniform(0.5, 12, count), rng.uniform(0.4, 3, count), np.ones(count)]) for _ in range(2)
    )
    place, way = rng.uniform(-9, 9, (2, count)), rng.normal(0, 6, (2, count))
    turn = rng.uniform(-0.6, 0.6, (2, count)) * (rng.uniform(size=count) < 0.7)
    zero = np.zeros(count)
    yaw = rng.uniform(-np.pi, np.pi, (2, count))
    return RelativeMotion(np.stack([*place, zero]), np.stack([*way, zero]), yaw, turn, size_a, size_b)


def overlapping(m, u):
    apart, yaw = m.apart_m + u * m.change_m, m.yaw_rad + u * m.turn_rad
    return rectangles_overlap(*apart[:2], *yaw, m.size_a_m.T, m.size_b_m.T)


def test_first_touches_are_those_of_a_thousand_moments():
    motion = random_motions(3000, seed=4)
    moments = np.linspace(0, 1, 1025)
    seen = np.stack([overlapping(motion, u) for u in moments])
    ever, first = seen.any(axis=0), moments[np.argmax(seen, axis=0)]
    found = first_contact(motion)
    touched = ~np.isnan(found)
    assert 0.2 < ever.mean() < 0.8
    brief = seen.sum(axis=0) <= 1024 / MAX_STEPS
    assert not np.any(~touched & ever & ~brief)
    assert np.mean(~touched & ever) < 0.003
    assert overlapping(motion.take(touched), found[touched]).all()
    both = touched & ever & ~brief
    late = found[both] - first[both]
    assert np.all(late < 1 / MAX_STEPS)
    assert np.mean(np.abs(late) < 2 / 1024) > 0.99  # the others graze for less than a step before


def test_boxes_that_appear_inside_each_other_say_so_and_those_of_other_times_do_not_meet():
    stands, passes = (0.0, 0.0, 0.0), (lambda t: -8 + 4 * t, 0.0, 0.0)
    (event,) = events_of(boxes_of(stands, (*passes, 1.5, 4.0)))
    assert event["from_start"]
    assert event["t_s"] == pytest.approx(1.5)
    (event,) = events_of(boxes_of((*stands, 0.0, 1.5), passes))
    assert not event["from_start"]
    assert (event["t_s"], event["until_s"]) == pytest.approx((1.0, 1.5), abs=1e-4)
    assert events_of(boxes_of((*stands, 0.0, 0.9), passes)) == []
    assert events_of(boxes_of((*stands, 0.0, 2.0), (0.0, 0.0, 0.0, 2.05, 4.0))) == []


@pytest.mark.parametrize("mode", ["exact", "pid"])
def test_a_collision_does_not_depend_on_the_step(mode):
    t = np.arange(0, 41) * 0.1
    a = agent_from(t, 30 * t, 0 * t, 0 * t, np.full(41, 30.0), id="a")
    b = agent_from(t, 131.0 - 30 * t, 0 * t + 0.4, np.full(41, np.pi), np.full(41, 30.0), id="b")
    for dt_s in (0.005, 0.01, 0.02, 0.05, 0.1):
        (event,) = replay(scenario_of(a, b), mode=mode, dt_s=dt_s).metrics["collisions"]
        assert event["t_s"] == pytest.approx((131.0 - 4.4) / 60, abs=2e-4)
        assert event["relative_speed_mps"] == pytest.approx(60.0, abs=0.01)


RECONSTRUCTED = {"history": ["reconstruct"], "detector": "labels"}


def standing(name: str, x_m: float, y_m: float) -> Agent:
    return replace(straight(name, start=(x_m, y_m), speed=0.0, t_s=np.array([0.0, 3.0])), static=True)


def scene(**provenance: Any) -> Scenario:
    """An ego that passes a wall, and a car that drives through a parked one 20 m aside."""
    agents = (
        straight("ego"),
        standing("wall", 30.0, 0.0),
        straight("car", start=(0.0, 20.0)),
        standing("parked", 9.0, 20.0),
    )
    return replace(world(*agents), provenance=provenance)


def accelerate(observation: Observation) -> Controls:
    """Drive into the wall."""
    return Controls(accel_mps2=8.0, steer_rad=0.0)


def owners(result: Replay) -> list[tuple[tuple[str, ...], str]]:
    return [(tuple(e["agents"]), e["belongs_to"]) for e in result.metrics["collisions"]]


@pytest.mark.parametrize(("provenance", "kind"), [(RECONSTRUCTED, "reconstruction"), ({}, "scenario")])
def test_overlaps_of_its_own_boxes_are_the_scenarios_and_new_ones_the_replays(provenance: Any, kind: str) -> None:
    result = replay(scene(**provenance), ego=accelerate, dt_s=0.02)
    assert owners(result) == [(("car", "parked"), kind), (("ego", "wall"), "replay")]
    assert result.metrics["new_collisions"] == 1
    lines = summarize(result).splitlines()
    assert any(line.startswith(f"2 collisions, 1 of the replay and 1 of the {kind} itself · ") for line in lines)
    assert lines[-2].startswith("  ego and wall collide at")
    assert lines[-2].endswith("m/s)")
    assert lines[-1].startswith("  car and parked collide at")
    assert lines[-1].endswith(f", in the {kind} itself")
    with pytest.raises(CheckFailed, match=r"ego and wall collide at .* the scenario has no such collision") as failed:
        require_strict(result)
    assert "parked" not in str(failed.value)


def test_older_files_that_only_say_in_log_are_read_and_written() -> None:
    """They lack the owner and call the contact of a pair that touches in the scenario "log"."""
    result = replay(scene(**RECONSTRUCTED), ego=accelerate, dt_s=0.02)
    assert {c["contact"] for c in result.metrics["conflicts"]} == {"new", "scenario"}
    document = result.to_dict()
    metrics = document["metrics"]
    for event in [*metrics["collisions"], *(e for m in metrics["by_agent"].values() for e in m["collisions"])]:
        event.pop("belongs_to", None)
    for conflict in metrics["conflicts"]:
        conflict["contact"] = conflict["contact"].replace("scenario", "log")
    read = Replay.from_dict(document)
    assert owners(read) == [(("car", "parked"), "scenario"), (("ego", "wall"), "replay")]
    assert read.metrics["by_agent"]["ego"]["collisions"][0]["belongs_to"] == "replay"
    assert {c["contact"] for c in read.metrics["conflicts"]} == {"new", "scenario"}
    assert Replay.from_dict(read.to_dict()).metrics == read.metrics
