"""Properties of transforms, overlaps, stamps and projections that hold for all inputs."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from log2sim.geometry import (
    Array,
    Camera,
    apply,
    box_corners,
    inverse,
    nearest_index,
    outline,
    overlap_of_smaller,
    project,
    project_boxes,
    rectangle_iou,
    rectangle_overlap,
    rotation_from_rpy,
    transform,
)

ANGLE = st.floats(-10.0, 10.0)
METERS = st.floats(-1e4, 1e4)
TRANSFORMS = st.builds(
    lambda rpy, xyz: transform(rotation_from_rpy(*rpy), xyz),
    st.tuples(ANGLE, ANGLE, ANGLE),
    st.tuples(METERS, METERS, METERS),
)
POINTS = arrays(np.float64, (5, 3), elements=METERS)
RECTANGLES = st.builds(
    lambda *values: np.array(values),
    st.floats(-4, 4), st.floats(-4, 4), st.floats(0.3, 9), st.floats(0.3, 4), ANGLE,
)  # fmt: skip


@given(TRANSFORMS, TRANSFORMS, POINTS)
def test_transforms_compose_and_their_inverse_undoes_them(a_T_b: Array, b_T_c: Array, points: Array) -> None:
    np.testing.assert_allclose(apply(a_T_b @ b_T_c, points), apply(a_T_b, apply(b_T_c, points)), atol=1e-7)
    np.testing.assert_allclose(apply(a_T_b, points), (np.c_[points, np.ones(5)] @ a_T_b.T)[:, :3], atol=1e-9)
    np.testing.assert_allclose(inverse(a_T_b), np.linalg.inv(a_T_b), atol=1e-7)
    np.testing.assert_allclose(inverse(a_T_b @ b_T_c), inverse(b_T_c) @ inverse(a_T_b), atol=1e-7)
    each = apply(np.stack([a_T_b] * len(points)), points)
    np.testing.assert_allclose(each, apply(a_T_b, points), atol=1e-7)


@given(RECTANGLES, RECTANGLES)
def test_overlap_is_symmetric_and_bounded(a: Array, b: Array) -> None:
    shared, iou, part = (float(of(a, b)[0]) for of in (rectangle_overlap, rectangle_iou, overlap_of_smaller))
    assert part * min(a[2:4].prod(), b[2:4].prod()) == pytest.approx(shared, abs=1e-6)
    assert 0 <= iou <= part + 1e-6
    assert part <= 1 + 1e-12
    assert shared == pytest.approx(float(rectangle_overlap(b, a)[0]), abs=1e-8)
    assert rectangle_overlap(a, a)[0] == pytest.approx(a[2:4].prod(), rel=1e-9)


@given(RECTANGLES, RECTANGLES, ANGLE, METERS, METERS)
def test_overlap_does_not_change_under_rigid_motion(
    a: Array, b: Array, yaw: float, east_m: float, north_m: float
) -> None:
    turn, away = rotation_from_rpy(0.0, 0.0, yaw)[:2, :2], np.array([100 * east_m, 100 * north_m])
    moved = [np.array([*(turn @ r[:2] + away), *r[2:4], r[4] + yaw]) for r in (a, b)]
    assert rectangle_overlap(*moved)[0] == pytest.approx(rectangle_overlap(a, b)[0], abs=1e-6)


@given(st.lists(st.integers(-(10**9), 10**9), min_size=1, max_size=30), st.lists(st.integers(-(2 * 10**9), 2 * 10**9)))
def test_the_nearest_stamp_is_that_of_a_full_search(stamps: list[int], asked: list[int]) -> None:
    epoch = 1_700_000_000_123_456_789
    have, t = np.unique(np.array(stamps, dtype=np.int64)) + epoch, np.array(asked, dtype=np.int64) + epoch
    expected = [int(np.argmin([abs(int(s) - int(x)) for s in have])) for x in t]
    assert nearest_index(have, t).tolist() == expected


K = np.array([[900.0, 0.0, 655.0], [0.0, 880.0, 350.0], [0.0, 0.0, 1.0]])


@settings(deadline=None)
@given(
    st.tuples(st.floats(-15, 15), st.floats(-4, 4), st.floats(-3, 40)),
    st.tuples(st.floats(0.5, 8), st.floats(0.5, 3), st.floats(0.5, 4)),
    ANGLE,
)
def test_the_image_box_of_a_box_holds_all_of_it_that_the_image_shows(
    place: tuple[float, float, float], size: tuple[float, float, float], yaw: float
) -> None:
    camera = Camera("front", 1280, 720, K, "map", np.eye(4))
    cam_T_map = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    center = np.array([[place[2], -place[0], -place[1]]])
    box = project_boxes(center, np.array([size]), np.array([yaw]), camera, cam_T_map)
    inside = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 9)] * 3), -1).reshape(-1, 3) * size
    points = apply(cam_T_map, apply(transform(rotation_from_rpy(0, 0, yaw), center[0]), inside))
    uv, seen = project(camera, points)
    if np.any(np.abs(apply(inverse(transform(rotation_from_rpy(0, 0, yaw), center[0])), np.zeros((1, 3)))) * 2 > size):
        assert box.valid[0] or not seen.any()
    if box.valid[0] and seen.any():
        low, high = box.box_px[0, :2], box.box_px[0, 2:]
        assert np.all(uv[seen] >= low - 1e-6)
        assert np.all(uv[seen] <= high + 1e-6)
    hull = outline(apply(cam_T_map, box_corners(center, size, yaw)[0]))
    ahead = points[:, 2] > 0.2
    if ahead.any():
        flat = points[ahead, :2] / points[ahead, 2:]
        assert np.all(flat.min(axis=0) >= hull.min(axis=0) - 1e-6)
        assert np.all(flat.max(axis=0) <= hull.max(axis=0) + 1e-6)
