"""Pictures laid on flat ground against a ground whose every point is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from log2sim.geometry import Array, Camera, rotation_from_rpy, transform, undistort
from log2sim.road.ground_map import GroundMap, Raster
from log2sim.road.pictures import ColorRaster, View, warp_onto
from log2sim.road.surface import Surface

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
