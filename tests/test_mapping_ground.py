"""The map of the ground against a road whose height, paint and reflectivity are known everywhere, and pictures laid on flat ground."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from ground_worlds import World, empty_scenario, height_at, is_paint, world_log
from worlds import waypoints

from log2sim.config import MapConfig
from log2sim.datatypes import Agent, Stream, Sweep
from log2sim.geometry import Array, Camera, apply, rotation_from_rpy, transform, undistort
from log2sim.road.builder import map_ground
from log2sim.road.ground_map import GroundMap, Raster
from log2sim.road.pictures import ColorRaster, View, Warp, warp_onto
from log2sim.road.road_users import RoadUsers, draw_outlines
from log2sim.road.surface import MAX_POINTS, Surface, take_sweep

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


EGO_R_CAM = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
K = np.array([[800.0, 0, 640], [0, 800.0, 360], [0, 0, 1]])


def make_camera(model: str = "none", distortion: tuple[float, ...] = (), halved: int = 1) -> Camera:
    intrinsics = np.diag([1 / halved, 1 / halved, 1]) @ K
    return Camera("c", 1280 // halved, 720 // halved, intrinsics, "ego", np.eye(4), model, distortion)


def pose(yaw_deg: float, x: float = 0.0, y: float = 0.0, z: float = 2.0, pitch_deg: float = 12.0) -> Array:
    """A camera at x, y, z that looks along yaw, tilted down by pitch."""
    rotation = rotation_from_rpy(0.0, np.radians(pitch_deg), np.radians(yaw_deg)) @ EGO_R_CAM
    return transform(rotation, [x, y, z])


def checker(xy: Array, side_m: float = 1.0) -> Array:
    """Brightness of the ground at points (N, 2): squares of 1 m, bright or dark."""
    odd = (np.floor(xy[:, 0] / side_m) + np.floor(xy[:, 1] / side_m)) % 2
    return np.where(odd > 0, 200.0, 60.0)


def shoot(
    camera: Camera,
    map_T_cam: Array,
    ground_z_m: float = 0.0,
    gain: float = 1.0,
    ground_of: Callable[[Array], Array] = checker,
) -> np.ndarray:
    """Render the ground by casting 2 x 2 rays a pixel; a second way that knows no homography."""
    fine = (-0.25, 0.25)
    total = np.zeros((camera.height_px, camera.width_px))
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    for du in fine:
        for dv in fine:
            rays = np.column_stack(
                [undistort(camera, np.column_stack([(u + du).ravel(), (v + dv).ravel()])), np.ones(u.size)]
            )
            rays = rays @ map_T_cam[:3, :3].T
            down = rays[:, 2] < -1e-9
            distance = np.where(down, (ground_z_m - map_T_cam[2, 3]) / np.where(down, rays[:, 2], 1.0), 0.0)
            ground = map_T_cam[:2, 3] + distance[:, None] * rays[:, :2]
            total += np.where(down, ground_of(ground) * gain, 255.0).reshape(u.shape) / 4
    return np.repeat(np.rint(total).astype(np.uint8)[..., None], 3, axis=2)


def lay(
    pictures: list[tuple[np.ndarray, View]], extent_m: tuple[float, ...], cell_m: float = 0.05, z_m: float = 0.0
) -> GroundMap:
    raster = Raster.covering(extent_m, cell_m)  # type: ignore[arg-type]
    flat = Surface(raster, np.zeros(raster.shape, np.float32), np.ones(raster.shape, bool))
    colors, unknown = ColorRaster(raster), np.full(raster.shape, np.nan, np.float32)
    for image, view in pictures:
        warp = warp_onto(view, flat, z_m, raster)
        if warp is not None:
            colors.add(view.camera.name, image, warp)
    return GroundMap(*colors.image(), unknown, unknown, raster.resolution_m, raster.extent_m)


def test_pictures_that_are_brighter_ahead_do_not_brighten_the_map_more_and_more() -> None:
    raster = Raster.covering((0.0, 40.0, 0.0, 10.0), 0.1)
    colors, cells = ColorRaster(raster), np.arange(raster.shape[0] * raster.shape[1])
    column, one = cells % raster.shape[1], np.ones(4000, np.float32)
    for k in range(37):  # each shows 4 m, of which the half ahead is a fifth brighter than it will be from nearby
        chosen = cells[(column >= 10 * k) & (column < 10 * k + 40)]
        ahead = chosen % raster.shape[1] >= 10 * k + 20
        image = np.repeat(np.where(ahead, 72, 60).astype(np.uint8)[None, :, None], 3, axis=2)
        scale = np.where(ahead, 0.5, 1.0).astype(np.float32)
        colors.add("front", image, Warp(chosen, np.arange(4000, dtype=np.float32), 0 * one, scale, one, one))
    assert colors.image()[0].max() < 90


def cell_centers(picture: GroundMap) -> tuple[Array, Array]:
    x0, x1, y0, y1 = picture.extent_m
    d = picture.resolution_m
    return np.meshgrid(np.arange(x0 + d / 2, x1, d), np.arange(y1 - d / 2, y0, -d))


def wrong_cells(picture: GroundMap, edge_m: float) -> float:
    """Share of covered cells on the wrong side of mid-gray, cells nearer than `edge_m` to a line left out."""
    x, y = cell_centers(picture)
    clear = np.minimum(np.abs(x - np.rint(x)), np.abs(y - np.rint(y))) > edge_m
    chosen = clear & (picture.alpha > 128)
    assert chosen.sum() > 1000
    bright = checker(np.column_stack([x[chosen], y[chosen]])) > 130
    return float(np.mean(bright != (picture.color_bgr[..., 1][chosen] > 130)))


@pytest.fixture(scope="module")
def two_cameras() -> list[tuple[np.ndarray, View]]:
    camera = make_camera()
    return [(shoot(camera, p), View(camera, p)) for p in (pose(30, 0, 0.5), pose(-30, 0, -0.5))]


def test_two_cameras_reproduce_the_checkerboard_within_5_cm(two_cameras: list[tuple[np.ndarray, View]]) -> None:
    picture = lay(two_cameras, (0, 10, -8, 8))
    assert picture.coverage.mean() > 0.6
    assert wrong_cells(picture, edge_m=0.05) == 0.0


@pytest.mark.matrix
@pytest.mark.parametrize("axis", [0, 1])
def test_cells_show_their_own_center(axis: int) -> None:
    """On ground that brightens by 30 a meter, a shift of half a cell would show as 0.75."""
    camera = make_camera()
    image = shoot(camera, pose(0), ground_of=lambda xy: 20 + 30 * (xy[:, axis] % 7.5))
    picture = lay([(image, View(camera, pose(0)))], (4, 7.5, 0, 2.2))
    inner = (slice(10, -10), slice(10, -10))
    expected = (20 + 30 * cell_centers(picture)[axis])[inner]
    assert picture.coverage[inner].all()
    assert abs(float(np.mean(picture.color_bgr[..., 0][inner] - expected))) < 0.2


def test_nothing_above_the_horizon_or_behind_the_camera_is_covered() -> None:
    white = np.full((720, 1280, 3), 255, dtype=np.uint8)
    picture = lay([(white, View(make_camera(), pose(0)))], (-30, 30, -30, 30), 0.1)
    x, _ = cell_centers(picture)
    assert picture.coverage[x > 0].any()
    assert not picture.coverage[x < 0].any()
    up = View(make_camera(), pose(0, pitch_deg=-40.0))
    assert not lay([(white, up)], (-30, 30, -30, 30), 0.1).coverage.any()
