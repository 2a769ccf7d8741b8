"""Projection and its inverse against OpenCV, and where lens models stop being true."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from log2sim.geometry import MIN_DEPTH_M, Camera, fold_radius, project, undistort

K = np.array([[900.0, 0.0, 655.0], [0.0, 880.0, 350.0], [0.0, 0.0, 1.0]])

LENSES = [
    ("none", ()),
    ("brown", (-0.25, 0.08, 0.001, -0.0005)),
    ("brown", (-0.16, -0.06, 0.0012, -0.0008, 0.035)),
    ("brown", (2.1, 1.3, 0.0004, -0.0003, 0.09, 2.4, 1.6, 0.3)),
    ("brown", (0.3, 0.2, 0.001, -0.002, 0.1)),  # pincushion
    ("fisheye", (-0.02, 0.003, -0.001, 0.0004)),
]
FOLDING = [
    ("brown", (-0.5894, 0.66, 0.0011, -0.001, -1.0088)),  # a strong lens whose fit turns back inside of the corners
    ("brown", (-0.1, 0.0, 0.0, 0.0)),
    ("brown", (-0.3, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0)),  # a pole
    ("fisheye", (0.1, -0.2, 0.05, -0.03)),
]


def make_camera(model: str, distortion: tuple[float, ...], f_scale: float = 1.0) -> Camera:
    k = K * np.array([[f_scale], [f_scale], [1.0]])
    k[:2, 2] = K[:2, 2]
    return Camera("front", 1280, 720, k, "ego", np.eye(4), model, distortion)


def view_points(rng: np.random.Generator, count: int = 4000) -> np.ndarray:
    """Points in and somewhat around the view of `make_camera`, a third of them behind it."""
    depth = rng.uniform(-20.0, 40.0, count)
    return np.column_stack([rng.uniform(-1.0, 1.0, count) * depth, rng.uniform(-0.6, 0.6, count) * depth, depth])


def reference_pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    """OpenCV's answer for points in front."""
    none = np.zeros(3)
    if camera.distortion_model == "fisheye":
        return cv2.fisheye.projectPoints(points[:, None], none, none, camera.K, np.array(camera.distortion))[0][:, 0]
    return cv2.projectPoints(points[:, None], none, none, camera.K, np.array(camera.distortion) * 1.0)[0][:, 0]


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_pixels_are_opencvs(model: str, distortion: tuple[float, ...]) -> None:
    camera, points = make_camera(model, distortion), view_points(np.random.default_rng(1))
    uv, valid = project(camera, points)
    front = points[:, 2] > MIN_DEPTH_M
    expected = reference_pixels(camera, points[front])
    np.testing.assert_allclose(uv[front], expected, atol=1e-7)
    assert np.isnan(uv[~front]).all()
    inside = np.zeros(len(points), dtype=bool)
    inside[front] = ((expected >= 0) & (expected < [1280, 720])).all(axis=1)
    assert 100 < inside.sum() < front.sum()
    np.testing.assert_array_equal(valid, inside)


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_rays_of_pixels_are_opencvs(model: str, distortion: tuple[float, ...]) -> None:
    camera = make_camera(model, distortion)
    uv = np.random.default_rng(2).uniform([0, 0], [1280, 720], (500, 2))
    d = np.array(distortion) * 1.0
    if model == "fisheye":
        expected = cv2.fisheye.undistortPoints(uv[:, None], camera.K, d)[:, 0]
    else:
        stop = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 500, 1e-13)
        expected = cv2.undistortPoints(uv[:, None], camera.K, d, criteria=stop)[:, 0]
    np.testing.assert_allclose(undistort(camera, uv), expected, atol=1e-7)


@pytest.mark.parametrize(("model", "distortion"), LENSES + FOLDING)
def test_what_is_seen_comes_back_along_its_ray(model: str, distortion: tuple[float, ...]) -> None:
    camera, rng = make_camera(model, distortion, f_scale=0.6), np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-4, 4, (20000, 2)), rng.uniform(0.5, 3.0, 20000)])
    uv, valid = project(camera, points)
    assert valid.sum() > 500
    rays = undistort(camera, uv[valid])
    assert np.abs(rays - points[valid, :2] / points[valid, 2:]).max() < 1e-7


@pytest.mark.parametrize(
    ("distortion", "expected"),
    [
        ((-0.1, 0.0, 0.0, 0.0), np.sqrt(1 / 0.3)),  # 1 + 3 k1 r^2 = 0
        ((0.0, -0.2, 0.0, 0.0), 1.0),  # 1 + 5 k2 r^4 = 0
        ((0.0, 0.0, 0.01, 0.02), np.inf),
        ((0.1, 0.1, 0.0, 0.0), np.inf),
        ((0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0), 2.0),  # 1 - r^2 / 4 = 0, a pole
        # r (1 - s / 5) / (1 + s / 10) with s = r^2 has the slope 1 - 0.7 s - 0.02 s^2 over a square.
        ((-0.2, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0), np.sqrt((np.sqrt(0.57) - 0.7) / 0.04)),
    ],
)
def test_fold_radius_in_closed_form(distortion: tuple[float, ...], expected: float) -> None:
    assert fold_radius(make_camera("brown", distortion)) == pytest.approx(expected)


@pytest.mark.parametrize(("model", "distortion"), FOLDING)
def test_nothing_beyond_the_fold_comes_back_into_the_image(model: str, distortion: tuple[float, ...]) -> None:
    camera = make_camera(model, distortion)
    fold, angle = fold_radius(camera), np.linspace(0, 2 * np.pi, 60)
    for radius in np.geomspace(fold * 1.0001, 1e4, 400):
        ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(60)])
        uv, valid = project(camera, ring)
        assert np.isnan(uv).all()
        assert not valid.any()
    ring = np.column_stack([0.99 * fold * np.cos(angle), 0.99 * fold * np.sin(angle), np.ones(60)])
    if 0.99 * fold < 1.0:  # inside thrice the view
        assert np.isfinite(project(camera, ring)[0]).all()


def test_pixels_that_no_ray_reaches_have_none() -> None:
    # r (1 - 0.1 r^2) is at most 2/3 of its fold radius.
    camera = make_camera("brown", (-0.1, 0.0, 0.0, 0.0), f_scale=0.5)
    farthest = np.sqrt(1 / 0.3) * 2 / 3
    uv = np.array([[655 + 450 * farthest * s, 350.0] for s in (0.0, 0.5, 0.999, 1.001, 1.5, 100.0)])
    assert np.isfinite(undistort(camera, uv)).all(axis=1).tolist() == [True, True, True, False, False, False]
    # A ray just before the fold is still told exactly: 0.999 of the farthest.
    x = undistort(camera, uv)[2, 0]
    assert x * (1 - 0.1 * x * x) == pytest.approx(0.999 * farthest, abs=1e-9)
    equidistant = make_camera("fisheye", (1e-12, 0.0, 0.0, 0.0), f_scale=0.4)
    beside = undistort(equidistant, np.array([[655 + 360 * 1.5, 350.0], [655 + 360 * 1.6, 350.0]]))
    assert beside[0, 0] == pytest.approx(np.tan(1.5), rel=1e-6)
    assert np.isnan(beside[1]).all()


def test_depth_is_tested_before_it_divides() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, -5.0], [0.0, 0.0, MIN_DEPTH_M], [0.0, 0.0, 0.2], [np.nan] * 3])
    for model, distortion in LENSES:
        uv, valid = project(make_camera(model, distortion), points)
        assert valid.tolist() == [False, False, False, True, False], model
        assert np.isfinite(uv).all(axis=1).tolist() == valid.tolist(), model
        np.testing.assert_allclose(uv[3], [655.0, 350.0])


def test_the_borders_of_an_image_belong_to_it_on_one_side() -> None:
    camera = Camera("unit", 1280, 720, np.eye(3), "ego", np.eye(4))  # x, y are pixels, exactly
    corners = [[0.0, 0.0], [1279.9, 719.9], [1280.0, 300.0], [300.0, 720.0], [-1e-9, 300.0], [300.0, -1e-9]]
    _, valid = project(camera, np.column_stack([corners, np.ones(6)]))
    assert valid.tolist() == [True, True, False, False, False, False]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("model", ["brown", "fisheye"])
@pytest.mark.parametrize("last", [0.0, 1e-320, -1e-320, 1e-12, 1e-3, 1e6, 1e300, np.inf, np.nan])
def test_the_fold_of_any_coefficient_is_found(model: str, last: float) -> None:
    """A tiny last coefficient changes nothing; one that is not finite leaves no usable ray."""
    padding = (0.0,) * (2 if model == "fisheye" else 3)
    radius = fold_radius(make_camera(model, (-0.2, *padding, last)))
    angle = np.sqrt(1 / 0.6)
    alone = np.tan(angle) if model == "fisheye" else angle
    if not np.isfinite(last):
        assert radius == 0
    elif abs(last) < 1e-9:
        assert radius == pytest.approx(alone)
    else:
        assert radius > alone
