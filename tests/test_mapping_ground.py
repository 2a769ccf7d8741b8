"""The map of the ground against a road whose height, paint and reflectivity are known everywhere."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from ground_worlds import World, empty_scenario, height_at, is_paint, world_log
from worlds import waypoints

from log2sim.config import MapConfig
from log2sim.datatypes import Agent, Stream, Sweep
from log2sim.geometry import Array, apply
from log2sim.road.builder import map_ground
from log2sim.road.ground_map import GroundMap, Raster
from log2sim.road.road_users import RoadUsers, draw_outlines
from log2sim.road.surface import MAX_POINTS, take_sweep

SETTINGS = MapConfig(cell_m=0.1)


@pytest.fixture(scope="module")
def ground() -> GroundMap:
    log = world_log(World(gains=(1.0, 0.7), lidars=2))
    return map_ground(log, empty_scenario(log), SETTINGS)


def positions(ground: GroundMap) -> Array:
    rows, columns = np.mgrid[: ground.alpha.shape[0], : ground.alpha.shape[1]]
    return ground.raster.xy_of(rows, columns)


def near_path(xy: Array, reach_m: float) -> Array:
    along = np.clip(xy[..., 0], 0, 10)
    return np.hypot(xy[..., 0] - along, xy[..., 1]) < reach_m


def clear_of_edges(xy: Array, margin_m: float) -> Array:
    off = np.abs(xy - np.rint(xy))
    return (off > margin_m).all(axis=-1)


def test_cells_and_positions_are_inverse(ground: GroundMap) -> None:
    rows, columns = ground.raster.cells_of([[1.234, -2.345]])
    np.testing.assert_allclose(ground.raster.xy_of(rows, columns), [[1.234, -2.345]], atol=1e-9)
    x0, _, _, y1 = ground.extent_m
    np.testing.assert_allclose(ground.raster.xy_of(0, 0), [x0 + 0.05, y1 - 0.05])
    np.testing.assert_allclose(np.array(ground.extent_m) / 0.1, np.rint(np.array(ground.extent_m) / 0.1), atol=1e-6)


def test_heights_are_those_of_the_road_and_of_the_curb(ground: GroundMap) -> None:
    xy = positions(ground)
    known = np.isfinite(ground.height_m) & near_path(xy, 12.0) & (np.abs(xy[..., 1] - 6.0) > 0.3)
    error = ground.height_m[known] - height_at(xy[known])
    assert known.sum() > 12_500
    assert abs(np.median(error)) < 0.01
    assert np.percentile(np.abs(error), 95) < 0.03


def test_paint_stands_out_in_intensity_at_any_range_and_on_any_scale(ground: GroundMap) -> None:
    xy = positions(ground)
    known = np.isfinite(ground.intensity) & clear_of_edges(xy, 0.15) & (xy[..., 1] < 5.5)
    for low, high in ((0, 6), (6, 12), (12, 20)):
        ring = known & near_path(xy, high) & ~near_path(xy, low)
        paint, road = (ground.intensity[ring & (is_paint(xy) == kind)] for kind in (True, False))
        assert min(len(paint), len(road)) > 500
        assert np.percentile(paint, 10) > np.percentile(road, 90)


def test_colors_lie_where_the_paint_is_on_a_slope(ground: GroundMap) -> None:
    xy = positions(ground)
    seen = (ground.alpha > 200) & clear_of_edges(xy, 0.06) & near_path(xy, 8.0) & (np.abs(xy[..., 1]) < 5)
    value = ground.color_bgr[..., 1][seen]
    wrong = (value > 120) != is_paint(xy[seen])
    assert seen.sum() > 5_000
    assert wrong.mean() < 0.002


def test_cameras_alone_lie_on_the_ground_under_the_ego() -> None:
    log = world_log(World(lidars=0))
    ground = map_ground(log, empty_scenario(log), SETTINGS)
    xy = positions(ground)
    assert not np.isfinite(ground.height_m).any()
    assert not np.isfinite(ground.intensity).any()
    assert any("no height" in note for note in ground.notes)
    seen = (ground.alpha > 200) & clear_of_edges(xy, 0.15) & near_path(xy, 3.0) & (xy[..., 0] < 9)
    assert seen.sum() > 1250
    assert ((ground.color_bgr[..., 1][seen] > 120) != is_paint(xy[seen])).mean() < 0.02


def moving_car(speed_mps: float = 5.0) -> Agent:
    """A car that drives along beside the ego, ahead of it."""
    t = np.linspace(0, 2, 5)
    x = 8.0 + speed_mps * t
    z = height_at(np.column_stack([x, np.full(5, -2.5)])) + 0.75
    return Agent("car", "car", (4.5, 1.8, 1.5), waypoints(t, x, -2.5, z, 0.0, speed_mps))


def test_pictures_and_points_of_moving_agents_are_left_out() -> None:
    """A mark on every picture and bright returns where the car is would show in the map."""
    log, car = world_log(), moving_car()
    scenario = empty_scenario(log, car)
    users = RoadUsers(log, scenario, log.streams["c0"].t_ns)
    read, sweeps, camera = log.streams["c0"].read, log.streams["l0"].read, log.cameras["c0"]

    def painted(i: int) -> np.ndarray:
        t_ns = int(log.streams["c0"].t_ns[i])
        mask = draw_outlines(users.at(t_ns), camera, log.map_T_sensor("c0", t_ns)[0][0])
        mask = cv2.resize(mask, (camera.width_px, camera.height_px), interpolation=cv2.INTER_NEAREST)
        return np.where(cv2.erode(mask, np.ones((5, 5), np.uint8))[..., None] > 0, [0, 0, 255], read(i)).astype(
            np.uint8
        )

    def bright(i: int) -> Sweep:
        sweep = sweeps(i)
        xyz = apply(log.map_T_sensor("l0", sweep.stamp_ns)[0][0], sweep.xyz_m.astype(float))
        x = 8.0 + 5.0 * (sweep.stamp_ns - 10**18) / 1e9
        under = (np.abs(xyz[:, 0] - x) < 2.3) & (np.abs(xyz[:, 1] + 2.5) < 1.0)
        raised = sweep.xyz_m + np.where(under, 0.3, 0.0)[:, None] * np.array([0, 0, 1], np.float32)
        return dataclasses.replace(sweep, xyz_m=raised.astype(np.float32))

    streams = {"c0": Stream("c0", log.streams["c0"].t_ns, painted), "l0": Stream("l0", log.streams["l0"].t_ns, bright)}
    spoiled = log.changed(streams=streams)
    coarse, both = MapConfig(cell_m=0.1), (scenario, empty_scenario(log))
    with_car, _ = maps = [map_ground(spoiled, s, coarse, refine=False) for s in both]
    red = [int(((g.color_bgr[..., 2] > 120) & (g.color_bgr[..., 0] < 60) & (g.alpha > 0)).sum()) for g in maps]
    assert red[1] > 500
    assert red[0] < 0.01 * red[1]
    error = with_car.height_m - height_at(positions(with_car))
    lane = np.abs(positions(with_car)[..., 1] + 2.5) < 0.8
    assert np.nanpercentile(np.abs(error[lane & near_path(positions(with_car), 10.0)]), 95) < 0.05


def test_what_the_lowest_beam_meets_hides_the_ground_from_its_foot_on_and_a_sign_over_the_road_does_not() -> None:
    """The side of a vehicle next to the ego that a LiDAR on the roof meets at 1 m alone is in no track and yet no ground."""
    log = world_log(World(lidars=1))
    raster = Raster.covering((-20.0, 30.0, -20.0, 20.0), 0.1)
    sweep = log.streams["l0"].read(0)
    map_T_lidar = log.map_T_sensor("l0", sweep.stamp_ns)[0][0]
    xyz = apply(map_T_lidar, sweep.xyz_m.astype(float))
    sensor = map_T_lidar[:3, 3]
    left = (xyz[:, 1] - sensor[1] > np.abs(xyz[:, 0] - sensor[0])) & (xyz[:, 1] > 2.0)
    along = np.linspace(-1.5, 1.5, 400) + sensor[0]
    lowest, highest = (
        np.column_stack([along, np.full(400, y), height_at(np.column_stack([along, np.full(400, y)])) + above])
        for y, above in ((sensor[1] + 2.0, 1.0), (sensor[1] - 12.0, 2.2))
    )
    points = apply(np.linalg.inv(map_T_lidar), np.concatenate([xyz[~left], lowest, highest])).astype(np.float32)
    shown = dataclasses.replace(sweep, xyz_m=points, intensity=None)
    taken = take_sweep(log, "l0", shown, raster, [], most=MAX_POINTS, z0_m=0.0, hides=True)
    assert taken is not None
    hiding = taken[1]
    above = hiding[:, 2] - height_at(hiding[:, :2])
    beside, over = (np.abs(hiding[:, 1] - y) < 0.01 for y in (lowest[0, 1], highest[0, 1]))
    assert above[beside].min() < 0.1
    assert np.diff(np.unique(above[beside].round(2))).max() < 0.15
    assert above[over].min() > 2.0
