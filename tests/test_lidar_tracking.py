"""Following boxes through ray-cast sweeps where no camera detects them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worlds import Solid, scan, standing

from log2sim.agents.static import BoxState, LidarMatch, left_free, match_boxes, match_standing, track_with_lidar
from log2sim.datatypes import Obstacles, Rays
from log2sim.geometry import rotation_from_rpy
from log2sim.perception.boxes import rotate

T0_NS = 1_700_000_000_000_000_000
SIZE = np.array([4.4, 1.85, 1.6])
STEP_NS = 100_000_000


def obstacles(solids, *, far=(0.0, 0.0, 0.0), turn=0.0, stamp_ns=T0_NS, t_s=0.0, **options):
    """The points above ground of one sweep over solids, the world turned and moved afterwards."""
    xyz, _ = scan(solids, noise_m=0.01, **options)
    xyz = xyz[xyz[:, 2] > 0.2]
    turned = np.column_stack([rotate(xyz[:, :2], turn), xyz[:, 2]]).astype(np.float32)
    sensor = np.array([0.0, 0.0, 1.9], dtype=np.float32)
    return Obstacles(stamp_ns, np.array(far, dtype=np.float64), turned, np.full(len(xyz), t_s, np.float32), sensor)


def seen(cloud, xy, yaw=0.0, bottom=0.0, size=SIZE):
    box = BoxState(cloud.stamp_ns, np.asarray(xy, dtype=np.float64), np.zeros(2), yaw, size, bottom)
    return match_boxes(cloud, 7, [box])[0]


@pytest.mark.parametrize(("x", "y", "yaw_deg"), [(12, 3, 20), (18, -5, 90), (25, 4, 150), (15, 0, 5)])
@pytest.mark.parametrize("off", [(0.0, 0.0), (0.3, -0.2), (-0.25, 0.3)])
def test_a_car_is_found_where_it_stands_though_the_guess_is_off(x, y, yaw_deg, off):
    car = standing(x, y, yaw_deg)
    sighting = seen(obstacles([car]), np.array([x, y]) + off, car.yaw_rad)
    error = sighting.xy_m - [x, y]
    assert np.hypot(*error) < 0.15
    assert error @ np.linalg.solve(sighting.covariance, error) < 9.21
    assert sighting.tick == 7
    assert sighting.points >= 8


@pytest.mark.parametrize(("far", "turn"), [((5e5, 5e6, 90.0), 0.0), ((-7.0, 3.0, 0.0), 2.0), ((1e6, -1e6, 5.0), -1.0)])
def test_the_sighting_moves_and_turns_with_the_world(far, turn):
    car = standing(14, 3, 25)
    here = seen(obstacles([car]), (14.2, 3.1), car.yaw_rad)
    guess = rotate(np.array([14.2, 3.1]), turn) + far[:2]
    there = seen(obstacles([car], far=far, turn=turn), guess, car.yaw_rad + turn, bottom=far[2])
    np.testing.assert_allclose(there.xy_m, rotate(here.xy_m, turn) + far[:2], atol=0.01)
    r = rotation_from_rpy(0, 0, turn)[:2, :2]
    np.testing.assert_allclose(there.covariance, r @ here.covariance @ r.T, atol=0.01)
    assert abs(there.points - here.points) <= 3


@pytest.mark.parametrize("shown_m", [3.0, 2.0])
def test_what_is_hidden_of_the_box_is_behind_and_widens_the_covariance_by_it(shown_m):
    cloud = obstacles([standing(14, 3)])
    near = cloud.xyz[:, 0] < 14 - 2.2 + shown_m
    sighting = seen(replace(cloud, xyz=cloud.xyz[near], t_s=cloud.t_s[near]), (14.0, 3.0))
    assert np.hypot(*(sighting.xy_m - [14, 3])) < 0.15
    assert np.sqrt(sighting.covariance[0, 0]) == pytest.approx((4.4 - shown_m) / np.sqrt(12), rel=0.25)
    assert np.sqrt(sighting.covariance[1, 1]) < 0.25


# Following


def drive(states, *, gone=(), **options):
    """Obstacles of one sweep a tick over a car at the states (x, y, yaw); None where it is told to be gone."""
    clouds = [
        None if k in gone else obstacles([standing(x, y, np.rad2deg(yaw))], stamp_ns=T0_NS + k * STEP_NS, **options)
        for k, (x, y, yaw) in enumerate(states)
    ]
    return clouds, T0_NS + np.arange(len(states)) * STEP_NS


def run(clouds, t_ns, ticks, xy, velocity, yaw=0.0, start=0):
    state = BoxState(int(t_ns[start]), np.array(xy, dtype=float), np.array(velocity, dtype=float), yaw, SIZE, 0.0)
    return track_with_lidar(clouds, ticks, t_ns, state)


def test_a_moving_car_is_followed_with_its_time():
    states = [(10 + 0.8 * k, 3.0, 0.0) for k in range(15)]
    clouds, t_ns = drive(states)
    found = run(clouds, t_ns, range(1, 15), states[0][:2], (8.0, 0.0))
    assert [s.tick for s in found] == list(range(1, 15))
    for s in found:
        assert np.hypot(*(s.xy_m - states[s.tick][:2])) < 0.3
        assert s.t_ns == t_ns[s.tick]


def test_a_turning_car_is_followed_around_the_bend():
    yaw = np.linspace(0.0, 0.15, 15)
    step = 0.8 * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    xy = np.array([10.0, -2.0]) + np.cumsum(step, axis=0) - step[0]
    clouds, t_ns = drive([(x, y, a) for (x, y), a in zip(xy, yaw)])
    found = run(clouds, t_ns, range(1, 15), xy[0], (8.0, 0.0))
    assert [s.tick for s in found] == list(range(1, 15))
    assert max(np.hypot(*(s.xy_m - xy[s.tick])) for s in found) < 0.3


def test_boxes_that_stand_are_matched_together_as_each_alone():
    places = [(12.0, 3.0), (20.0, -6.0), (400.0, 0.0)]
    clouds = [
        None if k == 2 else obstacles([standing(*place) for place in places[:2]], stamp_ns=T0_NS + k * STEP_NS)
        for k in range(6)
    ]
    t_ns = T0_NS + np.arange(6) * STEP_NS
    boxes = [BoxState(T0_NS, np.array(place), np.zeros(2), 0.0, SIZE, 0.0) for place in places]
    known = [np.array([0, 1]), np.array([4]), np.array([0])]
    found = match_standing(clouds, boxes, known)
    alone = [track_with_lidar(clouds, [t for t in range(6) if t not in k], t_ns, b) for b, k in zip(boxes, known)]
    assert [[m.tick for m in matches] for matches in found] == [[3, 4, 5], [0, 1, 3, 5], []]
    for one, other in zip(found, alone):
        assert [(m.tick, m.t_ns, *m.xy_m) for m in one] == [(m.tick, m.t_ns, *m.xy_m) for m in other]


# Vehicles beside the sensor, of which a flank is seen

BUS = (12.0, 2.55, 3.1)
ALL_AROUND, AHEAD = (-180.0, 180.0), (-90.0, 90.0)


def around(solids, azimuth_deg=ALL_AROUND, stamp_ns=T0_NS):
    """The points above ground of one sweep from (0, 0), with its rays."""
    xyz, _ = scan(solids, azimuth_deg=azimuth_deg, steps=(720, 32), noise_m=0.01)
    sensor = np.array([[0.0, 0.0, 1.9]], dtype=np.float32)
    rays = Rays(
        xyz.astype(np.float32),
        np.zeros(len(xyz), np.float32),
        np.zeros(len(xyz), np.uint8),
        sensor,
        np.zeros((1, 3), np.float32),
    )
    above = xyz[xyz[:, 2] > 0.2].astype(np.float32)
    return Obstacles(stamp_ns, np.zeros(3), above, np.zeros(len(above), np.float32), sensor[0], rays)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(
    ("x", "azimuth_deg"), [(0.0, ALL_AROUND), (4.0, ALL_AROUND), (-3.0, ALL_AROUND), (1.0, AHEAD), (-4.5, AHEAD)]
)
def test_a_bus_beside_the_sensor_is_found_by_its_flank_and_one_end(x, azimuth_deg, side):
    y = 3.0 * side
    match = seen(around([standing(x, y, 0, BUS)], azimuth_deg), (x + 0.3, y + 0.1), size=np.array(BUS))
    assert np.hypot(*(match.xy_m - [x, y])) < 0.3


def test_a_flank_that_is_longer_than_its_box_by_as_much_as_detectors_err_is_found():
    match = seen(around([standing(0.0, 3.0, 0, BUS)]), (0.1, 3.1), size=np.array([9.8, *BUS[1:]]))
    assert np.hypot(*(match.xy_m - [0.0, 3.0])) < 0.3


WALL = Solid((0.0, 3.0, 1.5), (80.0, 2.55, 3.0))


@pytest.mark.parametrize(("azimuth_deg", "forward"), [(ALL_AROUND, True), (ALL_AROUND, False), (AHEAD, True)])
def test_a_bus_is_followed_past_the_sensor_for_as_long_as_points_show_it(azimuth_deg, forward):
    x = 16.0 - 1.4 * np.arange(20)
    t_ns = T0_NS + np.arange(20) * STEP_NS
    clouds = [around([standing(p, 3.0, 180, BUS)], azimuth_deg, int(t)) for p, t in zip(x, t_ns)]
    shown = [k for k in range(20) if (np.abs(clouds[k].xyz[:, 0] - x[k]) < 6.1).sum() >= 50]
    first, rest = (shown[0], shown[1:]) if forward else (shown[-1], shown[-2::-1])
    start = BoxState(int(t_ns[first]), np.array([x[first], 3.0]), np.array([-14.0, 0.0]), np.pi, np.array(BUS), 0.0)
    found = track_with_lidar(clouds, [*rest, *range(shown[-1] + 1, 20)] if forward else rest, t_ns, start)
    assert [m.tick for m in found] == rest
    assert max(np.hypot(*(m.xy_m - [x[m.tick], 3.0])) for m in found) < 0.6


def test_what_moves_leaves_its_place_free_and_clutter_does_not():
    x = 16.0 - 1.4 * np.arange(20)
    matches = [LidarMatch(k, T0_NS + k * STEP_NS, np.array([p, 3.0]), np.eye(2), np.pi, 50) for k, p in enumerate(x)]
    bus = [around([standing(p, 3.0, 180, BUS)]) for p in x]
    assert left_free(bus, matches, np.array(BUS), 0.0)[[0, -1]].all()
    row = [around([WALL])] * len(x)
    assert not left_free(row, matches, np.array(BUS), 0.0).any()
