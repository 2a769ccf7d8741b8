"""Rotations, poses over time and boxes against SciPy, OpenCV and closed forms."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from log2sim.geometry import (
    PoseTrack,
    apply,
    bev_iou,
    box_corners,
    box_corners_bev,
    box_iou,
    inverse,
    points_in_box,
    polygon_area,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
    slerp,
    transform,
    wrap_angle,
    yaw_of,
)


def random_rotations(count: int, seed: int = 0) -> Rotation:
    return Rotation.random(count, rng=np.random.default_rng(seed))


def test_angles_are_wrapped_into_the_half_open_circle() -> None:
    angle = np.concatenate([np.random.default_rng(0).uniform(-1e3, 1e3, 1000), [np.pi, -np.pi, 3 * np.pi, 0.0, -1e-17]])
    wrapped = wrap_angle(angle)
    assert (wrapped >= -np.pi).all()
    assert (wrapped < np.pi).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-12)
    assert wrap_angle(np.pi) == -np.pi
    # One step of rounding below -pi: adding pi gives a tiny negative number, whose `mod` is the modulus itself.
    assert -np.pi <= wrap_angle(np.nextafter(-np.pi, -4.0)) < np.pi


def test_quaternions_are_scipys() -> None:
    rotation = random_rotations(500)
    np.testing.assert_allclose(
        rotation_from_quaternion(rotation.as_quat(scalar_first=True)), rotation.as_matrix(), atol=1e-14
    )
    expected = rotation.as_quat(canonical=True, scalar_first=True)
    np.testing.assert_allclose(quaternion_from_rotation(rotation.as_matrix()), expected, atol=1e-14)


def test_quaternions_need_not_be_normalized() -> None:
    q = random_rotations(5).as_quat(scalar_first=True)
    np.testing.assert_allclose(rotation_from_quaternion(-7.0 * q), rotation_from_quaternion(q), atol=1e-14)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0]], [[1e-9, 1.0, 0.0]]]).tolist())
def test_half_turns_come_back_exactly(axis: list[float]) -> None:
    # w is zero there and a formula that divides by it fails.
    for angle in (np.pi, np.pi - 1e-9, np.pi + 1e-9, 1e-9, 0.0):
        matrix = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
        q = quaternion_from_rotation(matrix)
        assert q[0] >= 0
        np.testing.assert_allclose(rotation_from_quaternion(q), matrix, atol=1e-14)


def test_roll_pitch_yaw_are_scipys() -> None:
    rpy = np.random.default_rng(1).uniform(-3, 3, (300, 3))
    expected = Rotation.from_euler("ZYX", rpy[:, ::-1]).as_matrix()
    np.testing.assert_allclose(rotation_from_rpy(*rpy.T), expected, atol=1e-14)
    assert rotation_from_rpy(0.1, np.zeros((2, 5)), 0.2).shape == (2, 5, 3, 3)


def test_yaw_comes_back_from_rotations_and_transforms() -> None:
    roll, pitch, yaw = np.random.default_rng(2).uniform(-1.2, 1.2, (3, 100)) * [[1.0], [1.0], [2.6]]
    rotation = rotation_from_rpy(roll, pitch, yaw)
    np.testing.assert_allclose(yaw_of(rotation), yaw, atol=1e-12)
    np.testing.assert_allclose(yaw_of(transform(rotation, np.ones((100, 3)))), yaw, atol=1e-12)


def test_transforms_compose_and_invert() -> None:
    rng = np.random.default_rng(3)
    a_T_b = transform(random_rotations(50, 1).as_matrix(), rng.uniform(-1e3, 1e3, (50, 3)))
    b_T_c = transform(random_rotations(50, 2).as_matrix(), rng.uniform(-1e3, 1e3, (50, 3)))
    points = rng.normal(0, 100, (50, 3))
    np.testing.assert_allclose(apply(a_T_b @ b_T_c, points), apply(a_T_b, apply(b_T_c, points)), atol=1e-10)
    np.testing.assert_allclose(inverse(a_T_b), np.linalg.inv(a_T_b), atol=1e-10)
    np.testing.assert_allclose(apply(inverse(a_T_b[0]), apply(a_T_b[0], points)), points, atol=1e-10)
    homogeneous = np.column_stack([points, np.ones(50)])
    np.testing.assert_allclose(apply(a_T_b[0], points), (homogeneous @ a_T_b[0].T)[:, :3], atol=1e-10)
    assert apply(a_T_b[0], np.zeros((0, 3))).shape == (0, 3)


def test_interpolated_quaternions_are_scipys() -> None:
    rotation, fraction = random_rotations(200, 4), np.random.default_rng(4).uniform(0, 1, 199)
    q = rotation.as_quat(scalar_first=True)
    q[::3] *= -1  # the same rotations, the longer way round if the sign were taken at its word
    expected = Slerp(np.arange(200.0), rotation)(np.arange(199) + fraction)
    found = Rotation.from_quat(slerp(q[:-1], q[1:], fraction), scalar_first=True)
    assert (found * expected.inv()).magnitude().max() < 1e-7


def test_between_equal_rotations_there_is_none() -> None:
    # Rounding carries the product of a unit quaternion with itself above 1 now and then.
    q = random_rotations(1000, 7).as_quat(scalar_first=True)
    assert (np.sum(q * q, axis=1) > 1).any()
    np.testing.assert_allclose(slerp(q, q, np.full(1000, 0.3)), q, atol=1e-14)


def test_small_turns_and_extrapolation() -> None:
    for angle in (0.0, 1e-12, 1e-7, 1e-5, 1.0):
        q0, q1 = (Rotation.from_euler("z", a).as_quat(scalar_first=True)[None] for a in (0.0, angle))
        for fraction in (-0.5, 0.25, 2.0):
            q = slerp(q0, q1, np.array([fraction]))
            assert yaw_of(rotation_from_quaternion(q))[0] == pytest.approx(angle * fraction, abs=1e-13), (
                angle,
                fraction,
            )


def pose_track(t_s: list[float], **options: float) -> PoseTrack:
    """An ego that drives 10 m/s along x and turns 0.4 rad/s, at an epoch that seconds as floats cannot hold."""
    t = np.array(t_s)
    rotation = rotation_from_rpy(0.0, 0.0, 0.4 * t)
    position = np.column_stack([10.0 * t, 0 * t, 0 * t])
    return PoseTrack(EPOCH_NS + np.rint(t * 1e9).astype(np.int64), transform(rotation, position), **options)


EPOCH_NS = 1_700_000_000_123_456_789


def at_s(track: PoseTrack, t_s: list[float]) -> tuple[np.ndarray, np.ndarray]:
    return track.at(EPOCH_NS + np.rint(np.array(t_s) * 1e9).astype(np.int64))


def test_poses_between_stamps_lie_on_the_way() -> None:
    track, asked = pose_track([0.0, 0.1, 0.25, 1.0]), [-0.1, 0.0, 0.05, 0.1, 0.2, 0.7, 1.0, 1.2]
    poses, valid = at_s(track, asked)
    assert valid.all()
    np.testing.assert_allclose(poses[:, 0, 3], 10.0 * np.array(asked), atol=1e-9)
    np.testing.assert_allclose(yaw_of(poses), 0.4 * np.array(asked), atol=1e-9)
    np.testing.assert_allclose(
        poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), np.tile(np.eye(3), (8, 1, 1)), atol=1e-14
    )


def test_poses_keep_nanoseconds_at_a_large_epoch() -> None:
    track = pose_track([0.0, 1.0])
    poses, _ = track.at(EPOCH_NS + np.array([0, 1, 100], dtype=np.int64))
    np.testing.assert_allclose(poses[:, 0, 3], [0.0, 1e-8, 1e-6], rtol=1e-6, atol=1e-15)


def test_gaps_and_ends_of_a_pose_track_are_not_valid() -> None:
    track = pose_track([0.0, 0.5, 2.0], max_gap_s=1.0, extrapolate_s=0.2)
    asked = [-0.21, -0.2, 0.3, 0.5, 0.51, 1.99, 2.0, 2.01, 2.21]
    # Extrapolation from a pair that spans a gap is no better than the gap.
    assert at_s(track, asked)[1].tolist() == [False, True, True, True, False, False, True, False, False]


def test_beyond_its_ends_a_pose_track_goes_on_at_the_speed_of_poses_some_time_apart() -> None:
    """The last two poses are 1 ns apart, and so are the first two; their places differ by a tenth of a millimeter."""
    track = pose_track([0.0, 1e-9, 0.02, 0.1, 0.2, 0.2 + 1e-9])
    track.map_T_ego[[1, -1], 0, 3] += 1e-4
    asked = [-0.1, 0.05, 0.2, 0.3]
    poses, valid = at_s(track, asked)
    assert valid.all()
    np.testing.assert_allclose(poses[:, 0, 3], 10.0 * np.array(asked), atol=1e-3)
    np.testing.assert_allclose(yaw_of(poses), 0.4 * np.array(asked), atol=1e-4)


def test_a_single_pose_holds_for_a_moment() -> None:
    poses, valid = at_s(pose_track([1.0]), [0.79, 0.8, 1.0, 1.2, 1.21])
    assert valid.tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(poses[:, 0, 3], 10.0)


@pytest.mark.parametrize("t_s", [[], [0.0, 0.0], [0.0, 1.0, 0.5]])
def test_pose_tracks_need_increasing_stamps(t_s: list[float]) -> None:
    with pytest.raises(ValueError, match="pose track"):
        pose_track(t_s)


def test_a_pose_track_needs_a_pose_per_stamp() -> None:
    with pytest.raises(ValueError, match="one pose per stamp"):
        PoseTrack(np.array([1, 2]), np.eye(4)[None])


def test_corners_of_a_box_in_their_order() -> None:
    corners = box_corners_bev([[10.0, 5.0]], 4.0, 2.0, np.pi / 2)[0]
    # It points along +y: front-left is at smaller x.
    np.testing.assert_allclose(corners, [[9, 7], [9, 3], [11, 3], [11, 7]], atol=1e-12)
    d = np.roll(corners, -1, axis=0) - corners
    assert (
        np.cross(np.column_stack([d, np.zeros(4)]), np.column_stack([np.roll(d, -1, 0), np.zeros(4)]))[:, 2] > 0
    ).all()
    three = box_corners([[10.0, 5.0, 1.0]], [[4.0, 2.0, 1.6]], [np.pi / 2])[0]
    np.testing.assert_allclose(three[:4, :2], corners)
    np.testing.assert_allclose(three[4:, :2], corners)
    np.testing.assert_allclose(three[:, 2], [0.2] * 4 + [1.8] * 4)


def test_points_in_a_box_are_those_that_its_own_frame_says() -> None:
    rng = np.random.default_rng(5)
    points, center, size, yaw = (
        rng.uniform(-4, 4, (5000, 3)),
        np.array([0.5, -0.7, 0.2]),
        np.array([4.0, 2.0, 1.5]),
        0.7,
    )
    local = apply(inverse(transform(rotation_from_rpy(0, 0, yaw), center)), points)
    for margin in (0.0, 0.3):
        expected = (np.abs(local) <= size / 2 + margin).all(axis=1)
        assert 50 < expected.sum() < 2000
        np.testing.assert_array_equal(points_in_box(points, center, size, yaw, margin), expected)
    assert points_in_box(np.full((1, 3), np.nan), center, size, yaw).tolist() == [False]


def test_image_boxes_overlap_by_what_they_share() -> None:
    a = [[0, 0, 10, 10], [0, 0, 0, 0], [20, 20, 30, 40]]
    b = [[0, 0, 10, 10], [5, 0, 15, 10], [10, 0, 20, 10], [25, 30, 35, 50], [9, 9, 8, 8]]
    expected = [[1.0, 50 / 150, 0, 0, 0], [0, 0, 0, 0, 0], [0, 0, 0, 50 / 350, 0]]
    np.testing.assert_allclose(box_iou(a, b), expected)
    assert box_iou(np.zeros((0, 4)), b).shape == (0, 5)


def test_overlap_of_oriented_boxes_is_opencvs() -> None:
    rng, some = np.random.default_rng(6), 0
    for _ in range(200):
        xy, size, yaw = rng.uniform(-2, 2, (2, 2)), rng.uniform(0.5, 5.0, (2, 2)), rng.uniform(-4, 4, 2)
        a, b = box_corners_bev(xy, size[:, 0], size[:, 1], yaw)
        shared, _ = cv2.intersectConvexConvex(a.astype(np.float32), b.astype(np.float32))
        expected = shared / (size.prod(axis=1).sum() - shared)
        some += 0.05 < expected < 0.95
        assert bev_iou(a, b) == pytest.approx(expected, abs=2e-5)
        assert bev_iou(b, a) == pytest.approx(bev_iou(a, b), abs=1e-10)
        far = np.array([4.5e5, 5.4e6])
        assert bev_iou(a + far, b + far) == pytest.approx(bev_iou(a, b), abs=1e-6)
    assert some > 50


def test_overlap_of_boxes_in_special_places() -> None:
    box = box_corners_bev([[0.0, 0.0]], 4.0, 2.0, 0.3)[0]
    assert 1 - 1e-10 <= bev_iou(box, box) <= 1
    inner = box_corners_bev([[0.0, 0.0]], 2.0, 1.0, 0.3)[0]
    assert bev_iou(inner, box) == pytest.approx(0.25, abs=1e-10)
    upright = [box_corners_bev([[x, 0.0]], 4.0, 2.0, 0.0)[0] for x in (0.0, 4.0, 2.0, 9.0)]
    assert [bev_iou(upright[0], other) for other in upright[1:]] == [0.0, pytest.approx(1 / 3, abs=1e-10), 0.0]
    assert bev_iou(np.zeros((4, 2)), np.zeros((4, 2))) == 0.0


def test_areas_of_polygons_near_and_far() -> None:
    triangle = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])
    assert polygon_area(triangle) == 6.0
    assert polygon_area(triangle[::-1]) == 6.0
    assert polygon_area(np.add(triangle, [5e6, -4e6])) == 6.0
    angle = 2 * np.pi * np.arange(60) / 60
    assert polygon_area(np.column_stack([np.cos(angle), np.sin(angle)])) == pytest.approx(30 * np.sin(2 * np.pi / 60))
