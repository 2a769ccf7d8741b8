"""Which end is the front: small worlds of a street with traffic on either side, a car park, a side street, a lone car."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worlds import rows_at

from log2sim.agents.candidate import Timeline, candidate_of
from log2sim.agents.heading import decide_headings
from log2sim.agents.moving import turn_to_courses
from log2sim.agents.size import TrackGeometry
from log2sim.config import Config
from log2sim.datatypes import TYPICAL_SIZE_M, Boxes3D, Track, Waypoints

T_NS = np.arange(20) * 100_000_000
TIMELINE = Timeline(T_NS, 0)
CAR_M = np.array([4.4, 1.8, 1.5])


def candidate(x, y, yaw, speed=0.0, *, front=None, score=0.9, axis=True, category="car"):
    """An agent at x, y that starts there with a speed along its yaw; a 3D detector's boxes point along `front`."""
    t = T_NS / 1e9
    xy = np.array([x, y]) + np.outer(speed * t, [np.cos(yaw), np.sin(yaw)])
    m = rows_at(xy, category, t_ns=T_NS)
    if front is not None:
        m = replace(m, box_yaw_rad=np.full(20, front), heading_score=np.full(20, score))
    w = Waypoints(
        t_s=t, x_m=xy[:, 0], y_m=xy[:, 1], z_m=np.zeros(20), yaw_rad=np.full(20, yaw), speed_mps=np.full(20, speed),
        observed=np.ones(20, dtype=bool), sigma_xy_m=np.full(20, 0.1), sigma_yaw_rad=np.full(20, 0.02),
    )  # fmt: skip
    geometry = TrackGeometry(CAR_M, xy, m.covariance, np.zeros(20), yaw if axis else None)
    return candidate_of(Track(category, np.arange(20), m), geometry, w, {}, static=speed == 0)


def ego(heading=0.0, speed=8.0):
    along = np.outer(speed * np.arange(20) / 10, [np.cos(heading), np.sin(heading)])
    return np.column_stack([along, np.full(20, heading)])


def decided(*candidates, path=None):
    """Headings in degrees and agents after the decision."""
    agents = [c.agent for c in decide_headings(candidates, ego() if path is None else path, TIMELINE)]
    return [round(float(np.rad2deg(a.waypoints.yaw_rad[0]))) % 360 for a in agents], agents


def ambiguous(agent):
    return [d.flag for d in agent.doubts] == ["heading_ambiguous"]


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_parked_cars_point_with_the_traffic_of_their_side(side, yaw):
    """Oncoming traffic passes on the left where traffic keeps right (side 1), on the right in the mirror."""
    oncoming = candidate(40.0, 3.5 * side, np.pi, 9.0)
    parked = [candidate(8.0 * k, y * side, yaw) for k in range(3) for y in (-3.0, 6.5)]
    headings, agents = decided(oncoming, *parked)
    assert headings == [180, *[0, 180] * 3]
    assert min(a.quality["heading_confidence"] for a in agents) > 0.7
    assert not any(a.doubts for a in agents)
    # Not -0.0, though some are turned round.
    assert not any(np.signbit(a.waypoints.speed_mps).any() for a in agents[1:])


def test_a_queue_on_the_own_lane_points_ahead():
    headings, agents = decided(*[candidate(15.0 + 7 * k, 0.2, np.pi) for k in range(3)])
    assert headings == [0, 0, 0]
    assert min(a.quality["heading_confidence"] for a in agents) > 0.8


def test_a_car_park_is_decided_by_each_car_alone_with_a_weak_say_of_its_neighbors():
    known = [
        candidate(2.7 * k - 8, -20.0, np.pi / 2, front=np.pi / 2 * (-1 if k == 2 else 1), score=0.97) for k in range(6)
    ]
    headings, _ = decided(*known, candidate(2.7 * 6 - 8, -20.0, np.pi / 2))
    assert headings == [90, 90, 270, 90, 90, 90, 90]


def cut(c, rows):
    """The candidate at some of its waypoints."""
    return replace(c, agent=replace(c.agent, waypoints=c.agent.waypoints.take(rows)))


@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_what_drives_off_or_stops_had_its_front_where_it_has_it_then(yaw):
    # So slow that it shows no direction of traffic.
    moving = candidate(30.0, 40.0, 0.0, 1.4, front=0.0, score=0.99)
    before, after = candidate(31.0, 40.0, yaw), candidate(32.0, 40.0, yaw)
    driving, stopping = cut(moving, slice(8, 20)), cut(moving, slice(0, 13))
    for world in ((cut(before, slice(0, 5)), driving), (cut(after, slice(15, 20)), stopping)):
        headings, agents = decided(*world)
        assert headings == [0, 0]
        assert agents[0].quality["heading_confidence"] > 0.9
    # Another place, another vehicle.
    assert decided(cut(candidate(31.0, 44.0, yaw), slice(0, 5)), driving)[1][0].quality["heading_confidence"] < 0.6


def test_a_lone_car_is_doubted_and_says_so_in_its_quality():
    (heading,), (agent,) = decided(candidate(30.0, 40.0, 1.0), path=np.zeros((0, 3)))
    assert heading == 57
    assert agent.quality["heading_confidence"] == 0.5
    assert ambiguous(agent)


def test_headings_do_not_depend_on_the_map_or_on_the_order():
    turn = 2.2

    def go(c):
        w = c.agent.waypoints
        x, y = (np.cos(turn) * w.x_m - np.sin(turn) * w.y_m, np.sin(turn) * w.x_m + np.cos(turn) * w.y_m)
        return replace(
            c, agent=replace(c.agent, waypoints=replace(w, x_m=x + 900, y_m=y - 400, yaw_rad=w.yaw_rad + turn))
        )

    world = [candidate(40.0, 3.5, np.pi, 9.0), *[candidate(8.0 * k, -3.0, np.pi * (k % 2)) for k in range(3)]]
    path = ego() @ np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]]) + [
        900,
        -400,
        turn,
    ]
    here, there = decided(*world)[1], decided(*[go(c) for c in world][::-1], path=path)[1][::-1]
    for a, b in zip(here, there):
        assert np.cos(b.waypoints.yaw_rad[0] - a.waypoints.yaw_rad[0] - turn) == pytest.approx(1.0)
        assert b.quality["heading_confidence"] == pytest.approx(a.quality["heading_confidence"], abs=2e-3)


def boxes_of_sweeps(category, velocity, yaw, *, turned, rate_hz=10.0, count=20):
    """Boxes of one object sweep by sweep, of which a random share is turned round, each as sure of its front as any other."""
    rng, t_s = np.random.default_rng(3), np.arange(count) / rate_hz
    yaw = yaw + np.pi * (rng.random(count) < turned)
    return np.rint(t_s * 1e9).astype(np.int64), [
        Boxes3D(
            np.array([round(t * 1e9)]), np.array([[5.0 + velocity[0] * t, 2.0 + velocity[1] * t, 0.8]]),
            np.array([TYPICAL_SIZE_M[category]]), np.array([y]), np.array([0.8]), np.array([category]), np.array([0.7]),
            np.array([40]),
        )
        for t, y in zip(t_s, yaw)
    ]  # fmt: skip


@pytest.mark.parametrize("rate_hz", [2.0, 10.0, 20.0])
@pytest.mark.parametrize(("category", "speed"), [("car", 8.0), ("truck", 6.0), ("cyclist", 4.0), ("pedestrian", 1.4)])
def test_boxes_of_sweeps_point_where_their_object_goes(category, speed, rate_hz):
    course = 2.2
    velocity = speed * np.array([np.cos(course), np.sin(course)])
    t_ns, found = boxes_of_sweeps(category, velocity, course, turned=0.8, rate_hz=rate_hz)
    turned = turn_to_courses(found, t_ns, Config().track)
    assert all(np.cos(b.yaw_rad[0] - course) > 0.99 for b in turned)
    assert np.mean([b.heading_score[0] for b in turned]) > 0.85
    assert all(np.array_equal(a.center_m, b.center_m) for a, b in zip(found, turned))
