"""The fused bird's-eye view against a ground whose every point is known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from log2sim.errors import ConfigError
from log2sim.geometry import (
    Array,
    Camera,
    fold_radius,
    ground_homography,
    inverse,
    rotation_from_rpy,
    transform,
    undistort,
)
from log2sim.road.mosaic import Mosaic, render_birdseye, write_image
from log2sim.road.pictures import GroundView

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
    """Render the ground by casting 3 x 3 rays a pixel; a second way that knows no homography."""
    fine = (np.arange(3) - 1) / 3
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
            total += np.where(down, ground_of(ground) * gain, 255.0).reshape(u.shape) / 9
    return np.repeat(np.rint(total).astype(np.uint8)[..., None], 3, axis=2)


def cell_centers(picture: object) -> tuple[Array, Array]:
    x0, x1, y0, y1 = picture.extent_m  # type: ignore[attr-defined]
    d = picture.resolution_m  # type: ignore[attr-defined]
    return np.meshgrid(np.arange(x0 + d / 2, x1, d), np.arange(y1 - d / 2, y0, -d))


def wrong_cells(picture: object, edge_m: float) -> float:
    """Share of covered cells on the wrong side of mid-gray, cells nearer than `edge_m` to a line left out."""
    x, y = cell_centers(picture)
    clear = np.minimum(np.abs(x - np.rint(x)), np.abs(y - np.rint(y))) > edge_m
    chosen = clear & (picture.alpha > 128)  # type: ignore[attr-defined]
    assert chosen.sum() > 1000
    bright = checker(np.column_stack([x[chosen], y[chosen]])) > 130
    return float(np.mean(bright != (picture.image_bgr[..., 1][chosen] > 130)))  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def two_cameras() -> list[GroundView]:
    camera = make_camera()
    return [GroundView.from_pose(shoot(camera, p), camera, p) for p in (pose(30, 0, 0.5), pose(-30, 0, -0.5))]


def test_two_cameras_reproduce_the_checkerboard_within_5_cm(two_cameras: list[GroundView]) -> None:
    picture = render_birdseye(two_cameras, extent_m=(0, 10, -8, 8), resolution_m=0.05)
    assert picture.coverage.mean() > 0.6
    assert wrong_cells(picture, edge_m=0.05) == 0.0


def test_a_shift_of_15_cm_would_be_noticed(two_cameras: list[GroundView]) -> None:
    shift = np.array([[1, 0, 0.15], [0, 1, 0], [0, 0, 1.0]])
    moved = [GroundView(v.image_bgr, shift @ v.ground_H_image, v.camera, signed=True) for v in two_cameras]
    assert wrong_cells(render_birdseye(moved, extent_m=(0, 10, -8, 8)), edge_m=0.05) > 0.02


@pytest.mark.matrix
@pytest.mark.parametrize("axis", [0, 1])
def test_cells_show_their_own_center(axis: int) -> None:
    """On ground that brightens by 30 a meter, a shift of half a cell would show as 0.75."""
    camera = make_camera()
    view = GroundView.from_pose(
        shoot(camera, pose(0), ground_of=lambda xy: 20 + 30 * (xy[:, axis] % 7.5)), camera, pose(0)
    )
    picture = render_birdseye([view], extent_m=(4.5, 7.2, 0.3, 2.0) if axis == 0 else (4.5, 7.2, 0.3, 1.6))
    expected = 20 + 30 * cell_centers(picture)[axis]
    assert picture.coverage.all()
    assert abs(float(np.mean(picture.image_bgr[..., 0] - expected))) < 0.2


def test_far_map_coordinates_and_another_ground_height_change_nothing(two_cameras: list[GroundView]) -> None:
    near = render_birdseye(two_cameras, extent_m=(0, 10, -8, 8))
    offset = np.array([5e5, 5e6, 300.0])
    far_views = []
    for view, p in zip(two_cameras, (pose(30, 0, 0.5), pose(-30, 0, -0.5))):
        far = p.copy()
        far[:3, 3] += offset
        far_views.append(GroundView.from_pose(view.image_bgr, make_camera(), far, 300.0))
    extent = (offset[0], offset[0] + 10, offset[1] - 8, offset[1] + 8)
    far_picture = render_birdseye(far_views, extent_m=extent)
    assert np.mean(np.abs(near.image_bgr.astype(int) - far_picture.image_bgr.astype(int)) > 8) < 0.002


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "distortion"), [("brown", (-0.25, 0.08, 0.001, -0.0005, -0.01)), ("fisheye", (-0.02, 0.003, 0.0, 0.0))]
)
def test_distorted_cameras_are_straightened(model: str, distortion: tuple[float, ...]) -> None:
    camera = make_camera(model, distortion, halved=2)
    view = GroundView.from_pose(shoot(camera, pose(0)), camera, pose(0))
    picture = render_birdseye([view], extent_m=(0, 7, -5, 5))
    assert wrong_cells(picture, edge_m=0.06) == 0.0


def test_a_lens_model_that_folds_back_is_cut_where_it_turns() -> None:
    # r (1 - 0.1 r^2) rises until 1 = 0.3 r^2.
    assert fold_radius(make_camera("brown", (-0.1, 0.0, 0.0, 0.0))) == pytest.approx(np.sqrt(1 / 0.3))
    assert fold_radius(make_camera("fisheye", (0.0, 0.0, 0.0, 0.0))) == np.inf


def test_nothing_above_the_horizon_or_behind_the_camera_is_covered() -> None:
    white = np.full((720, 1280, 3), 255, dtype=np.uint8)
    picture = render_birdseye(
        [GroundView.from_pose(white, make_camera(), pose(0))], extent_m=(-30, 30, -30, 30), resolution_m=0.1
    )
    x, _ = cell_centers(picture)
    assert picture.coverage[x > 0].any()
    assert not picture.coverage[x < 0].any()
    up = GroundView.from_pose(white, make_camera(), pose(0, pitch_deg=-40.0))
    assert not render_birdseye([up], extent_m=(-30, 30, -30, 30), resolution_m=0.1).coverage.any()


@pytest.mark.parametrize("scale", [1.0, -1.0, 1e-6])
def test_a_homography_of_any_scale_and_sign_gives_the_same_picture(two_cameras: list[GroundView], scale: float) -> None:
    unsigned = [GroundView(v.image_bgr, v.ground_H_image * scale) for v in two_cameras]
    a = render_birdseye(two_cameras, extent_m=(0, 10, -8, 8))
    b = render_birdseye(unsigned, extent_m=(0, 10, -8, 8))
    np.testing.assert_array_equal(a.coverage, b.coverage)
    assert np.abs(a.image_bgr.astype(int) - b.image_bgr.astype(int)).max() <= 2


def test_a_ground_homography_agrees_with_the_projection_of_3d_points() -> None:
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(4, 40, 50), rng.uniform(-8, 8, 50), np.full(50, 0.7)])
    points_cam = ground @ inverse(pose(5))[:3, :3].T + inverse(pose(5))[:3, 3]
    uv = points_cam @ K.T
    uv = uv / uv[:, 2:]
    back = uv @ ground_homography(make_camera(), pose(5), 0.7).T
    assert (back[:, 2] > 0).all()
    np.testing.assert_allclose(back[:, :2] / back[:, 2:], ground[:, :2], atol=1e-8)


def test_a_camera_in_the_ground_plane_is_refused() -> None:
    with pytest.raises(ValueError, match="ground plane"):
        ground_homography(make_camera(), pose(0, z=0.0))


@pytest.mark.slow
def test_exposures_are_leveled_where_cameras_overlap() -> None:
    camera = make_camera()
    poses = (pose(12), pose(-12))
    views = [GroundView.from_pose(shoot(camera, p, gain=g), camera, p) for p, g in zip(poses, (1.0, 0.7))]
    picture = render_birdseye(views, extent_m=(3, 9, -5, 5))
    x, y = cell_centers(picture)
    bright = (checker(np.column_stack([x.ravel(), y.ravel()])) > 130).reshape(x.shape)
    inner = np.minimum(np.abs(x - np.rint(x)), np.abs(y - np.rint(y))) > 0.2
    left, right = (
        float(picture.image_bgr[..., 0][bright & inner & side & (picture.alpha > 200)].mean())
        for side in (y > 2.5, y < -2.5)
    )
    assert 0.93 < left / right < 1.07  # 1.43 before


def test_a_picture_without_views_is_empty() -> None:
    picture = render_birdseye([], extent_m=(0, 1, 0, 2), resolution_m=0.1)
    assert picture.image_bgr.shape == (20, 10, 3)
    assert not picture.coverage.any()


@pytest.mark.parametrize(
    "extent", [(0.0, 0.0, 0.0, 1.0), (0.0, np.nan, 0.0, 1.0), (0.0, 1e5, 0.0, 1e5), (0.0, 1e9, 0.0, 0.05)]
)
def test_an_extent_without_area_or_too_large_is_refused(extent: tuple[float, float, float, float]) -> None:
    with pytest.raises(ConfigError, match="bird's-eye view"):
        Mosaic(extent_m=extent)


def test_a_written_png_carries_coverage_and_other_names_are_refused(
    tmp_path: Path, two_cameras: list[GroundView]
) -> None:
    picture = render_birdseye(two_cameras, extent_m=(0, 10, -8, 8), resolution_m=0.1)
    write_image(picture, tmp_path / "a.png")
    image = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image[..., 3], picture.alpha)
    np.testing.assert_array_equal(image[..., :3], picture.image_bgr)
    write_image(picture, tmp_path / "a.jpg")
    with pytest.raises(ConfigError, match=r"\.png"):
        write_image(picture, tmp_path / "a.gif")
    with pytest.raises(ConfigError, match="--overwrite"):
        write_image(picture, tmp_path / "a.png")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.jpg", "a.png"]
