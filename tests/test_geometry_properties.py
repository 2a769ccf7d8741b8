"""Properties of transforms, overlaps, stamps and projections that hold for all inputs."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis.extra.numpy import arrays

from log2sim.geometry import (
    Array,
    Camera,
    apply,
    bev_iou,
    box_corners,
    box_corners_bev,
    inverse,
    nearest_index,
    outline,
    overlap_area,
    overlap_of_smaller,
    polygon_area,
    project,
    project_boxes,
    quaternion_from_rotation,
    rectangles_overlap,
    rotation_from_quaternion,
    rotation_from_rpy,
    slerp,
    transform,
    undistort,
    wrap_angle,
    yaw_of,
)

ANGLE = st.floats(-10.0, 10.0)
METERS = st.floats(-1e4, 1e4)
TRANSFORMS = st.builds(
    lambda rpy, xyz: transform(rotation_from_rpy(*rpy), xyz),
    st.tuples(ANGLE, ANGLE, ANGLE),
    st.tuples(METERS, METERS, METERS),
)
POINTS = arrays(np.float64, (5, 3), elements=METERS)
QUATERNIONS = arrays(np.float64, (4,), elements=st.floats(-1.0, 1.0)).filter(lambda q: np.linalg.norm(q) > 1e-3)
RECTANGLES = st.builds(
    lambda x, y, length, width, yaw: (np.array([x, y]), np.array([length, width]), yaw),
    st.floats(-4, 4), st.floats(-4, 4), st.floats(0.3, 9), st.floats(0.3, 4), ANGLE,
)  # fmt: skip
Rectangle = tuple[Array, Array, float]


def corners(rectangle: Rectangle) -> Array:
    xy, size, yaw = rectangle
    return box_corners_bev(xy, size[0], size[1], yaw)[0]


@given(TRANSFORMS, TRANSFORMS, POINTS)
def test_transforms_compose_and_their_inverse_undoes_them(a_T_b: Array, b_T_c: Array, points: Array) -> None:
    np.testing.assert_allclose(apply(a_T_b @ b_T_c, points), apply(a_T_b, apply(b_T_c, points)), atol=1e-7)
    np.testing.assert_allclose(apply(inverse(a_T_b), apply(a_T_b, points)), points, atol=1e-7)
    np.testing.assert_allclose(inverse(a_T_b @ b_T_c), inverse(b_T_c) @ inverse(a_T_b), atol=1e-7)
    each = apply(np.stack([a_T_b] * len(points)), points)
    np.testing.assert_allclose(each, apply(a_T_b, points), atol=1e-7)


@given(QUATERNIONS)
def test_a_rotation_keeps_its_quaternion_up_to_the_sign(q: Array) -> None:
    rotation = rotation_from_quaternion(q)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    again, unit = quaternion_from_rotation(rotation), q / np.linalg.norm(q)
    assert again[0] >= 0
    assert abs(abs(again @ unit) - 1) < 1e-12
    np.testing.assert_allclose(rotation_from_quaternion(again), rotation, atol=1e-12)


@given(QUATERNIONS, QUATERNIONS, st.floats(0.0, 1.0))
def test_slerp_turns_at_a_constant_rate_and_the_same_way_from_both_ends(p: Array, q: Array, fraction: float) -> None:
    p, q = p / np.linalg.norm(p), q / np.linalg.norm(q)
    assume(abs(p @ q) > 1e-3)  # two half turns apart, both arcs are the shorter one
    there = slerp(p[None], q[None], np.array([fraction]))[0]
    back = slerp(q[None], p[None], np.array([1 - fraction]))[0]
    assert abs(there @ back) == pytest.approx(1.0, abs=1e-9)
    whole, part = (2 * np.arccos(min(abs(p @ other), 1.0)) for other in (q, there))
    assert part == pytest.approx(fraction * whole, abs=1e-6)


@given(st.floats(-1e6, 1e6), st.integers(-1000, 1000))
def test_a_wrapped_angle_is_the_same_direction_within_half_a_turn(angle: float, turns: int) -> None:
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle), abs=1e-9)
    assert np.exp(1j * float(wrap_angle(angle + 2 * np.pi * turns))) == pytest.approx(np.exp(1j * angle), abs=1e-8)


@given(RECTANGLES, RECTANGLES)
def test_overlap_is_symmetric_and_bounded(a: Rectangle, b: Rectangle) -> None:
    p, q = corners(a), corners(b)
    shared, iou = float(overlap_area(p, q)), float(bev_iou(p, q))
    part = float(overlap_of_smaller(*(np.array([*r[0], *r[1], r[2]]) for r in (a, b)))[0])
    assert part * min(a[1].prod(), b[1].prod()) == pytest.approx(shared, abs=1e-6)
    assert 0 <= iou <= part + 1e-6
    assert part <= 1 + 1e-12
    assert shared == pytest.approx(float(overlap_area(q, p)), abs=1e-8)
    assert iou == pytest.approx(float(bev_iou(q, p)), abs=1e-8)
    assert polygon_area(p) == pytest.approx(a[1].prod(), rel=1e-9)
    assert float(bev_iou(p, p)) == pytest.approx(1.0)


def test_overlap_of_boxes_with_collinear_edges_is_that_of_their_intervals() -> None:
    rng, n = np.random.default_rng(0), 3000
    xy, yaw, width = rng.uniform(-2, 2, (n, 2)), rng.uniform(-4, 4, n), rng.uniform(0.3, 5, n)
    length, ahead = rng.uniform(0.3, 8, (2, n)), rng.uniform(-5, 5, n)
    a = box_corners_bev(xy, length[0], width, yaw)
    b = box_corners_bev(xy + ahead[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)]), length[1], width, yaw)
    along = np.minimum(length[0] / 2, ahead + length[1] / 2) - np.maximum(-length[0] / 2, ahead - length[1] / 2)
    np.testing.assert_allclose(overlap_area(a, b), np.maximum(along, 0.0) * width, atol=1e-9)


@given(RECTANGLES, RECTANGLES, ANGLE, METERS, METERS)
def test_overlap_does_not_change_under_rigid_motion(
    a: Rectangle, b: Rectangle, yaw: float, east_m: float, north_m: float
) -> None:
    p, q = corners(a), corners(b)
    turn = rotation_from_rpy(0.0, 0.0, yaw)[:2, :2]
    moved = [c @ turn.T + [100 * east_m, 100 * north_m] for c in (p, q)]
    assert float(overlap_area(*moved)) == pytest.approx(float(overlap_area(p, q)), abs=1e-6)


@given(RECTANGLES, RECTANGLES)
def test_separating_axes_agree_with_the_shared_area(a: Rectangle, b: Rectangle) -> None:
    (dx, dy), size_a, size_b = b[0] - a[0], a[1][None], b[1][None]
    yaw_a, yaw_b = np.array([a[2]]), np.array([b[2]])
    overlap = rectangles_overlap(np.array([dx]), np.array([dy]), yaw_a, yaw_b, size_a, size_b)[0]
    shared = float(overlap_area(corners(a), corners(b)))
    assert overlap or shared < 1e-8
    bigger = rectangles_overlap(np.array([dx]), np.array([dy]), yaw_a, yaw_b, size_a + 1e-3, size_b + 1e-3)[0]
    assert bigger or not overlap


def test_overlap_broadcasts_and_ignores_what_has_no_area() -> None:
    square = box_corners_bev([[0.0, 0.0]], 2.0, 2.0, 0.0)[0]
    many = box_corners_bev([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [np.nan, 0.0]], 2.0, 2.0, 0.0)
    np.testing.assert_allclose(overlap_area(square, many), [4.0, 2.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(overlap_area(square[None], many), overlap_area(many, square))
    assert overlap_area(many[:0], many[:0]).shape == (0,)
    assert overlap_area(many[:3, None], many[None, :3]).shape == (3, 3)


@given(st.lists(st.integers(-(10**9), 10**9), min_size=1, max_size=30), st.lists(st.integers(-(2 * 10**9), 2 * 10**9)))
def test_the_nearest_stamp_is_that_of_a_full_search(stamps: list[int], asked: list[int]) -> None:
    epoch = 1_700_000_000_123_456_789
    have, t = np.unique(np.array(stamps, dtype=np.int64)) + epoch, np.array(asked, dtype=np.int64) + epoch
    expected = [int(np.argmin([abs(int(s) - int(x)) for s in have])) for x in t]
    assert nearest_index(have, t).tolist() == expected


K = np.array([[900.0, 0.0, 655.0], [0.0, 880.0, 350.0], [0.0, 0.0, 1.0]])
LENSES = st.sampled_from([
    ("none", ()), ("brown", (-0.25, 0.08, 0.001, -0.0005)), ("brown", (-0.5894, 0.66, 0.0011, -0.001, -1.0088)),
    ("fisheye", (-0.02, 0.003, -0.001, 0.0004)),
])  # fmt: skip


@given(LENSES, arrays(np.float64, (7, 2), elements=st.floats(-2.0, 2.0)), st.floats(0.2, 500.0))
def test_a_projected_point_lies_on_the_ray_of_its_pixel(
    lens: tuple[str, tuple[float, ...]], rays: Array, depth_m: float
) -> None:
    camera = Camera("front", 1280, 720, K, "ego", np.eye(4), *lens)
    uv, valid = project(camera, np.column_stack([rays, np.ones(7)]) * depth_m)
    np.testing.assert_allclose(undistort(camera, uv[valid]), rays[valid], atol=1e-6)


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


@given(TRANSFORMS)
def test_yaw_turns_with_the_frame(a_T_b: Array) -> None:
    turned = transform(rotation_from_rpy(0.0, 0.0, 0.5), np.zeros(3)) @ a_T_b
    assume(np.hypot(*a_T_b[:2, 0]) > 1e-6)  # x axis not vertical, else there is no yaw
    assert float(wrap_angle(yaw_of(turned) - yaw_of(a_T_b) - 0.5)) == pytest.approx(0.0, abs=1e-6)
