"""Fusion of the vehicle's and the road's LiDARs: boxes side by side, clouds by viewpoint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plain_settings import AGENTS_ALONE
from worlds import cloud_at, rows_at, tiny_log, tiny_table

from log2sim.config import Config
from log2sim.datatypes import Boxes3D, Measurements
from log2sim.evaluation.detection.detect_log import drop_ego
from log2sim.geometry import wrap_angle
from log2sim.perception.cooperative import (
    SeenBoxes,
    align_parts,
    match_by_covariance,
    merge_by_covariance,
    moving_boxes,
    refine_boxes,
    refine_by_views,
    take_off_offset,
)
from log2sim.perception.lidar.cloud import CloudSensor, assemble_views, join_parts, obstacles_of
from log2sim.perception.lidar.measure import follow_box, measure
from log2sim.pipeline import reconstruct
from log2sim.plan import FusionLevel, fusion_level

POST = {
    "name": "post",
    "mount": "map",
    "position_m": [32.0, 7.0, 3.5],
    "yaw_deg": -150.0,
    "channels": 24,
    "elevation_deg": [-22.0, 3.0],
    "azimuth_step_deg": 0.5,
    "range_m": 60.0,
}
CAR = (0.0, 0.0, 0.8, 4.5, 1.8, 1.6, 0.0)


def boxes_at(*rows, category="car", score=0.6, points=50, t_ns=0):
    """Boxes with x, y, z, length, width, height, yaw."""
    rows = np.array(rows, dtype=np.float64).reshape(-1, 7)
    n = len(rows)
    return Boxes3D(
        np.full(n, t_ns, np.int64), rows[:, :3], rows[:, 3:6], rows[:, 6], np.full(n, 0.9), np.full(n, category, "<U16"),
        np.full(n, score), np.full(n, points, np.int64),
    )  # fmt: skip


def seen(boxes, side_m=0.1, yaw_rad=0.05):
    n = len(boxes)
    return SeenBoxes(boxes, np.broadcast_to(side_m, (n, 2, 2)).astype(float), np.full(n, yaw_rad))


def test_each_side_comes_from_whoever_sees_it() -> None:
    # The one end knows the rear of a car 4.5 m long and takes it for 4.0 m, the other knows the front and takes it for 5.2 m.
    rear = seen(boxes_at((-0.25, 0, 0.8, 4.0, 1.8, 1.6, 0)), [[[0.05, 0.5], [0.1, 0.1]]])
    front = seen(boxes_at((-0.35, 0, 0.8, 5.2, 1.8, 1.6, 0)), [[[0.5, 0.05], [0.1, 0.1]]])
    merged = merge_by_covariance(rear, front)
    assert merged.boxes.size_m[0, 0] == pytest.approx(4.5, abs=0.05)
    assert merged.boxes.center_m[0, :2] == pytest.approx([0, 0], abs=0.03)
    assert (merged.sigma_m <= 0.12).all()
    assert merged.boxes.score[0] == pytest.approx(1 - 0.4**2)
    assert merged.boxes.points[0] == 100


def test_what_moves_between_the_times_of_both_ends_is_put_at_one() -> None:
    # At 15 m/s, with sweeps 0.1 s apart.
    a = seen(boxes_at(CAR, t_ns=0, points=100))
    b = seen(boxes_at((1.5, *CAR[1:]), t_ns=100_000_000, points=100))
    merged = merge_by_covariance(a, b).boxes
    assert merged.center_m[0, 0] == pytest.approx(15 * merged.t_ns[0] / 1e9, abs=0.05)
    assert merged.size_m[0, 0] == pytest.approx(4.5, abs=0.05)
    assert match_by_covariance(a, b)[0].tolist() == [0]
    # Its size is known to both, wherever it is.
    longer = seen(boxes_at((1.5, 0, 0.8, 4.7, 1.8, 1.6, 0), t_ns=100_000_000, points=100))
    assert merge_by_covariance(a, longer).boxes.size_m[0, 0] == pytest.approx(4.6, abs=0.02)
    # Boxes of one time are as far apart by mistake; none is between them.
    still = seen(boxes_at((1.5, *CAR[1:]), t_ns=0, points=100))
    assert abs(merge_by_covariance(a, still).boxes.size_m[0, 0] - 4.5) < 0.2


@settings(max_examples=25, deadline=None)
@given(
    st.floats(-np.pi, np.pi), st.floats(-50, 50), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-0.1, 0.1),
    st.floats(0.03, 0.5),
)  # fmt: skip
def test_merging_turns_and_moves_with_the_world(turn, shift, dx, dy, dyaw, sigma) -> None:
    def in_world(x, y, yaw):
        c, s = np.cos(turn), np.sin(turn)
        return (c * x - s * y + shift, s * x + c * y - shift, 0.8, 4.5, 1.8, 1.6, yaw + turn)

    a, b = seen(boxes_at(in_world(0, 0, 0)), 0.1), seen(boxes_at(in_world(dx, dy, dyaw)), sigma)
    plain = merge_by_covariance(seen(boxes_at(CAR), 0.1), seen(boxes_at((dx, dy, *CAR[2:6], dyaw)), sigma)).boxes
    merged = merge_by_covariance(a, b).boxes
    x, y = plain.center_m[0, :2]
    assert merged.center_m[0, :2] == pytest.approx(in_world(x, y, 0)[:2], abs=1e-6)
    assert merged.size_m == pytest.approx(plain.size_m, abs=1e-6)
    assert wrap_angle(merged.yaw_rad - plain.yaw_rad - turn) == pytest.approx(0, abs=1e-9)


def test_neighbors_are_matched_with_their_own() -> None:
    parked = boxes_at(*((0.0, 2.4 * k, 0.8, 4.5, 1.8, 1.6, 0) for k in range(4)))
    moved = replace(parked, center_m=parked.center_m + np.array([0.2, 0.3, 0]))
    i, j = match_by_covariance(seen(parked), seen(moved.take([2, 0, 3])))
    assert dict(zip(i.tolist(), j.tolist())) == {2: 0, 0: 1, 3: 2}


@pytest.fixture(scope="module")
def both_ends():
    return tiny_log(lidar=[tiny_table()["lidar"][0], POST])[0]


def sweeps_at(log, index=3):
    return {name: log.streams[name].read(index) for name in log.lidars}


def test_clouds_of_both_ends_keep_their_viewpoints(both_ends) -> None:
    sweeps = sweeps_at(both_ends)
    cloud = assemble_views(both_ends, sweeps, origin=np.zeros(3), ground_z=0.0, max_range_m=80.0)
    assert [view.end for view in cloud.views] == ["vehicle", "road"]
    assert len(cloud.xyz) == sum(len(view.xyz) for view in cloud.views)
    assert cloud.views[1].sensor == pytest.approx([32, 7, 3.5], abs=1e-3)
    assert cloud.sensor == pytest.approx(cloud.views[0].sensor)
    # Times are absolute, whatever the stamps of the sweeps.
    stamps = np.concatenate([view.stamp_ns + (view.t_s * 1e9).astype(np.int64) for view in cloud.views])
    assert cloud.stamp_ns + (cloud.t_s * 1e9).astype(np.int64) == pytest.approx(stamps, abs=2000)
    # Positions of sensors are those at the stamp of the whole.
    sensor = CloudSensor(1, np.array([20.0, 5, 3]), np.array([10.0, 0, 0]), "road")
    later = replace(cloud.views[1], stamp_ns=cloud.stamp_ns + 50_000_000, sensors=(sensor,))
    assert join_parts([cloud.views[0], later]).sensors[-1].position.tolist() == [19.5, 5, 3]
    index = np.array([0, len(cloud.views[0].xyz), len(cloud.xyz) - 1])
    split = cloud.split(index)
    assert [(view.end, rows.tolist()) for view, rows in split] == [
        ("road", [0, len(cloud.views[1].xyz) - 1]), ("vehicle", [0]),
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("level", ["points", "boxes"])
def test_every_level_finds_every_object_once(both_ends, level) -> None:
    chosen = Config.load(
        settings=["detect.name=lidar:labels", f"cooperation.fusion={level}", "cooperation.register_road=false"],
        **AGENTS_ALONE,
    )
    result = reconstruct(both_ends, chosen)
    agents = [a for a in result.scenario.agents if a.id != "ego"]
    assert sorted(a.category for a in agents) == ["car", "car", "pedestrian"]
    assert all(set(a.observed_by) == {"vehicle", "road"} for a in agents)
    # Neither end sees both ends of the parked car 4.2 m long: alone they take it for 4.0 m and 3.8 m.
    parked = min(agents, key=lambda a: abs(a.waypoints.y_m[0] + 4))
    assert parked.size_m[0] == pytest.approx(4.2, abs=0.08)
    assert (parked.waypoints.x_m[0], parked.waypoints.y_m[0]) == pytest.approx((14, -4), abs=0.06)
    (entry,) = [e for e in result.scenario.stages if e["stage"] == "fusion of vehicle and road"]
    assert entry["kept"]
    assert entry["reason"].startswith(level)


def test_levels_fall_back_where_an_end_has_no_lidar(both_ends) -> None:
    config = Config.load(settings=["detect.name=lidar:vehicle", "cooperation.fusion=boxes"])
    assert fusion_level(both_ends, config)[0] is FusionLevel.BOXES
    images = config.changed(detect={"name": "labels"})
    level, reason = fusion_level(both_ends, images)
    assert level is FusionLevel.POINTS
    assert "images alone" in reason
    alone = both_ends.changed(lidars={"post": both_ends.lidars["post"]})
    level, reason = fusion_level(alone, config)
    assert level is None
    assert "no LiDAR of vehicle" in reason
    vehicle = both_ends.changed(lidars={"top": both_ends.lidars["top"]})
    assert fusion_level(vehicle, config)[1] == ""


def test_a_row_keeps_the_view_of_the_other_end(both_ends) -> None:
    cloud = assemble_views(both_ends, sweeps_at(both_ends), origin=np.zeros(3), ground_z=0.0, max_range_m=80.0)
    rows = measure([], boxes_at((14.0, -4.0, 0.75, 4.2, 1.8, 1.5, np.deg2rad(10))), cloud)
    (other,) = rows.others
    assert rows.seen_by.tolist() == [[True, True]]
    places = [view.sensor + view.origin for view in cloud.views]
    seen_from = sorted(([*rows.sensor_m, other.sensor_m]), key=lambda p: p[0])
    assert np.array(seen_from) == pytest.approx(np.array(places), abs=1e-4)
    local = np.concatenate([rows.cluster[0], other.cluster])[:, :2] - [14.0, -4.0]
    assert np.abs(local).max() < 2.5
    kept = rows.take([0, 0])
    assert [v is other for v in kept.others] == [True, True]
    joined = Measurements.join([rows_at([[0, 0]]), rows])
    assert joined.others == (None, other)
    assert rows_at([[0, 0]]).take([0]).others == ()


def outline_points(x, y, length=4.5, width=1.8, step=0.1):
    """Points on all sides of a car, 0.3 to 1.3 m above the ground."""
    along, across = np.arange(-length / 2, length / 2 + 1e-9, step), np.arange(-width / 2, width / 2 + 1e-9, step)
    sides = [np.column_stack([along, np.full(len(along), s * width / 2)]) for s in (-1, 1)]
    sides += [np.column_stack([np.full(len(across), s * length / 2), across]) for s in (-1, 1)]
    flat = np.concatenate(sides) + np.array([x, y])
    return np.concatenate([np.column_stack([flat, np.full(len(flat), z)]) for z in (0.3, 0.8, 1.3)])


def view_of(xyz, sensor, *, end="vehicle", stamp_ns=0):
    of = (CloudSensor(len(xyz), np.array(sensor, float), np.zeros(3), end),)
    return cloud_at(xyz, stamp_ns=stamp_ns, sensor=sensor, ground=np.zeros(len(xyz), bool), sensors=of)


def test_boxes_are_sought_where_the_other_end_sees_them_later() -> None:
    box = boxes_at((0, 0, 0.75, 4.5, 1.8, 1.5, 0))
    # At 15 m/s, 0.05 s later.
    later = view_of(outline_points(0.75, 0.0), [20, 5, 3], end="road", stamp_ns=50_000_000)
    moved = follow_box(box, later)
    assert moved.center_m[0, :2] == pytest.approx([0.75, 0.0], abs=0.15)
    same_time = view_of(outline_points(0.75, 0.0), [20, 5, 3], end="road")
    assert np.array_equal(follow_box(box, same_time).center_m, box.center_m)
    nothing = view_of(outline_points(30.0, 0.0), [20, 5, 3], end="road", stamp_ns=50_000_000)
    assert np.array_equal(follow_box(box, nothing).center_m, box.center_m)
    cloud = join_parts([view_of(outline_points(0.0, 0.0), [-15, -5, 2]), later])
    rows = measure([], box, cloud)
    assert rows.points[0] == len(cloud.xyz)


def test_what_a_viewpoint_sees_is_judged_from_there() -> None:
    parts = [view_of(outline_points(-5, 0), [-15, -5, 2]), view_of(outline_points(5, 0), [20, 5, 3], end="road")]
    cloud = join_parts(parts)
    obstacles = obstacles_of(cloud)
    for x, sensor in ((-5, [-15, -5, 2]), (5, [20, 5, 3])):
        near = np.flatnonzero(np.abs(obstacles.xyz[:, 0] - x) < 3)
        assert obstacles.sensor_of(near).tolist() == sensor
    assert obstacles_of(parts[0]).sensor_of(np.arange(3)).tolist() == [-15, -5, 2]
    starts = {tuple(p) for p in obstacles.free.start.tolist()}
    assert starts == {(-15, -5, 2), (20, 5, 3)}


def test_sides_of_boxes_in_the_points_of_both_ends_are_where_those_who_see_them_see_them() -> None:
    # Each end sees two sides of a car that moves on by 0.2 m in between; the network's box is off.
    outline = outline_points(0.0, 0.0)
    rear, front = outline[(outline[:, 0] < -2.2) | (outline[:, 1] < -0.85)], outline[outline[:, 0] > -2.0]
    front = front[(front[:, 0] > 2.2) | (front[:, 1] > 0.85)] + [0.2, 0, 0]
    views = [view_of(rear, [-15, -8, 2]), view_of(front, [20, 9, 3], end="road", stamp_ns=20_000_000)]
    guessed = boxes_at((-0.2, 0.15, 0.8, 4.5, 1.8, 1.5, 0.04), (30, 0, 0.8, 4.5, 1.8, 1.5, 0))
    refined = refine_by_views(guessed, views)
    assert refined.size_m[0, :2] == pytest.approx([4.5, 1.8], abs=0.05)
    assert refined.center_m[0, 1] == pytest.approx(0.0, abs=0.05)
    assert refined.yaw_rad[0] == pytest.approx(0.0, abs=0.01)
    assert guessed.center_m[0, 0] + 0.05 < refined.center_m[0, 0] < 0.2
    # Where nobody sees points, and without viewpoints, boxes stay.
    assert refined.take(np.array([1])).center_m.tolist() == guessed.take(np.array([1])).center_m.tolist()
    assert refine_by_views(guessed, ()) is guessed


@pytest.mark.parametrize("yaw", [0.0, np.pi, 0.7])
@pytest.mark.parametrize("sensor", [[0.5, -12.0, 2.0], [12.0, -9.0, 2.0], [-12.0, 9.0, 2.0]])
def test_a_flank_that_is_seen_from_end_to_end_says_how_long_a_vehicle_is(yaw, sensor) -> None:
    # What the sensor sees of a car of 4.5 m with rounded corners, and a wall behind it all around; the network takes it for 5.2 m.
    outline = outline_points(0.0, 0.0, length=4.35, step=0.05)
    towards = np.sign(sensor[:2])
    seen_by = outline[
        (outline[:, 1] * towards[1] > 0.85) | ((outline[:, 0] * towards[0] > 2.1) & (abs(sensor[0]) > 2.5))
    ]
    angle = np.deg2rad(np.arange(0, 360, 0.2))
    wall = np.column_stack([40 * np.cos(angle), 40 * np.sin(angle)])
    wall = np.concatenate([np.column_stack([wall, np.full(len(wall), z)]) for z in np.arange(-4.0, 3.0, 0.5)])

    def length_of(points, category="car", guess=5.2):
        guessed = boxes_at((0.2, 0.0, 0.8, guess, 1.8, 1.5, 0.0 if yaw < 1 else np.pi), category=category)
        c, s = np.cos(yaw % np.pi), np.sin(yaw % np.pi)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        guessed = replace(guessed, center_m=guessed.center_m @ turn, yaw_rad=guessed.yaw_rad + yaw % np.pi)
        of = (CloudSensor(len(points), np.array(sensor) @ turn, np.zeros(3), "vehicle"),)
        cloud = cloud_at(points @ turn, sensor=np.array(sensor) @ turn, ground=np.zeros(len(points), bool), sensors=of)
        found = refine_boxes(guessed, cloud)
        return found.size_m[0, 0], float((found.center_m @ turn.T)[0, 0])

    length, x = length_of(np.concatenate([seen_by, wall]))
    assert length == pytest.approx(4.5, abs=0.1)
    assert x == pytest.approx(0.0, abs=0.12)
    # The points of wheels, of a body that gives none, are not its length.
    flank = seen_by[(seen_by[:, 2] == 0.3) & (seen_by[:, 1] * towards[1] > 0.85)] + [0.0, 0.0, 0.2]
    wheels = flank[np.abs(np.abs(flank[:, 0]) - 1.5) < 0.35]
    assert length_of(np.concatenate([seen_by, flank, wall]))[0] == pytest.approx(4.5, abs=0.1)
    assert length_of(np.concatenate([seen_by, wheels, wall]))[0] == pytest.approx(5.2)
    # With nothing behind it, it may go on; nor is it believed that a bus of 12 m ends there.
    assert length_of(seen_by)[0] == pytest.approx(5.2)
    assert length_of(np.concatenate([seen_by, wall]), "bus", 12.0)[0] == pytest.approx(12.0)


def test_points_of_a_moving_car_are_put_to_one_time() -> None:
    # 15 m/s; the vehicle sees its rear, the road its front 0.05 s later. Beside it stands another.
    outline = outline_points(0.0, 0.0)
    rear, front = outline[outline[:, 0] < 0], outline[outline[:, 0] > 0.5] + [0.75, 0, 0]
    parked = outline_points(0.0, 5.0)
    parts = [
        view_of(np.concatenate([rear, parked]), [-15, -5, 2]),
        view_of(np.concatenate([front, parked]), [20, 5, 3], end="road", stamp_ns=50_000_000),
    ]
    cloud = join_parts(parts)
    stands = (0.0, 5.0, 0.75, 4.5, 1.8, 1.5, 0)
    before = [
        boxes_at((-3.0, 0.1, 0.75, 4.5, 1.8, 1.5, 0.02), stands, t_ns=-200_000_000),
        boxes_at((-1.5, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0), stands, t_ns=-100_000_000),
    ]
    aligned = align_parts(cloud, before)
    own = np.abs(aligned.xyz[:, 1]) < 1.5
    assert np.ptp(cloud.xyz[own, 0]) == pytest.approx(5.25, abs=0.01)
    assert np.ptp(aligned.xyz[own, 0]) == pytest.approx(4.5, abs=0.01)
    assert np.ptp(aligned.t_s[own]) == 0
    assert np.array_equal(aligned.xyz[~own], cloud.xyz[~own])
    assert np.array_equal(aligned.t_s[~own], cloud.t_s[~own])
    for few in ([], before[:1], [before[0], Boxes3D.empty()]):
        assert align_parts(cloud, few) is cloud
    assert align_parts(parts[0], before) is parts[0]


def test_only_what_drives_along_its_axis_is_moved() -> None:
    at = (0.0, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0)
    earlier = boxes_at(at, t_ns=0)

    def speed_of(x, y, **columns):
        _, speed = moving_boxes(replace(earlier, **columns), boxes_at((x, y, *at[2:]), t_ns=100_000_000))
        return speed.tolist()

    assert speed_of(1.5, 0.1) == pytest.approx([15.0])
    assert speed_of(-1.5, 0.1) == pytest.approx([-15.0])
    assert speed_of(0.3, 0.0) == []
    assert speed_of(0.6, 0.8) == []
    assert speed_of(8.0, 0.0) == []
    assert speed_of(1.5, 0.0, score=np.array([0.1])) == []
    assert speed_of(1.5, 0.0, category=np.array(["truck"])) == []


def street(count=8):
    """Vehicles in both directions along two streets, as x, y, z, length, width, height, yaw."""
    along = [(8.0 * k - 20, 3.0 * (-1) ** k, 0.8, 4.5, 1.8, 1.6, np.pi * (k % 2)) for k in range(count)]
    return along + [(25.0, 8.0 * k - 20, 0.8, 4.5, 1.8, 1.6, np.pi / 2) for k in range(count)]


def turned(boxes, pivot, shift, turn_rad):
    """Boxes as a sensor reports them whose pose is off."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    center = boxes.center_m.copy()
    center[:, :2] = (center[:, :2] - pivot[:2]) @ np.array([[c, s], [-s, c]]) + pivot[:2] + shift
    return replace(boxes, center_m=center, yaw_rad=boxes.yaw_rad + turn_rad)


def test_what_many_pairs_agree_on_is_taken_off() -> None:
    true, pivot = boxes_at(*street()), np.array([10.0, 5.0, 4.0])
    off = turned(true, pivot, [0.25, -0.15], np.deg2rad(1.0))
    # One pair is of two objects.
    off.center_m[3] += [1.0, 1.0, 0.0]
    a, b = seen(true), replace(seen(off), sensor_m=pivot)
    moved = take_off_offset(a, b, b).boxes
    good = np.arange(len(true)) != 3
    before, after = (np.abs(x.center_m - true.center_m)[good].max() for x in (off, moved))
    assert after < 0.2 * before
    assert moved.yaw_rad == pytest.approx(true.yaw_rad, abs=np.deg2rad(0.25))
    # A single pair moves them by a part, and nothing without a pair or a place of the sensor.
    one = take_off_offset(a.take([0]), b.take([0]), b).boxes
    assert np.hypot(*(one.center_m - off.center_m)[0, :2]) < 0.7 * np.hypot(*(off.center_m - true.center_m)[0, :2])
    assert take_off_offset(a.take([]), b.take([]), b) is b
    assert take_off_offset(a, seen(off), seen(off)).boxes is off


def test_the_ego_that_the_road_sees_is_no_detection(both_ends) -> None:
    t_ns = int(both_ends.streams["post"].t_ns[2])
    center = both_ends.ego_centers(both_ends.ego.at(t_ns)[0])[0]
    found = boxes_at((*center, 4.5, 1.8, 1.5, 0.0), (*(center + np.array([9, 3, 0])), 4.5, 1.8, 1.5, 0.0), t_ns=t_ns)
    assert drop_ego(both_ends, found).center_m.tolist() == found.center_m[1:].tolist()
    vehicle = both_ends.changed(lidars={"top": both_ends.lidars["top"]})
    assert drop_ego(vehicle, found) is found
