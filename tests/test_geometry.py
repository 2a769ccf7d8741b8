"""Rotations, poses over time and boxes against SciPy, OpenCV and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from log2sim.geometry import (
    PoseTrack,
    apply,
    box_iou,
    inverse,
    points_in_box,
    quaternion_from_rotation,
    rectangle_iou,
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


def test_interpolated_quaternions_are_scipys() -> None:
    rotation, fraction = random_rotations(200, 4), np.random.default_rng(4).uniform(0, 1, 199)
    q = rotation.as_quat(scalar_first=True)
    q[::3] *= -1  # the same rotations, the longer way round if the sign were taken at its word
    expected = Slerp(np.arange(200.0), rotation)(np.arange(199) + fraction)
    found = Rotation.from_quat(slerp(q[:-1], q[1:], fraction), scalar_first=True)
    assert (found * expected.inv()).magnitude().max() < 1e-7


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


def test_poses_between_stamps_lie_on_the_way() -> None:
    track, asked = pose_track([0.0, 0.1, 0.25, 1.0]), [-0.1, 0.0, 0.05, 0.1, 0.2, 0.7, 1.0, 1.2]
    poses, valid = track.at(EPOCH_NS + np.rint(np.array(asked) * 1e9).astype(np.int64))
    assert valid.all()
    np.testing.assert_allclose(poses[:, 0, 3], 10.0 * np.array(asked), atol=1e-9)
    np.testing.assert_allclose(yaw_of(poses), 0.4 * np.array(asked), atol=1e-9)
    np.testing.assert_allclose(
        poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), np.tile(np.eye(3), (8, 1, 1)), atol=1e-14
    )


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


def test_overlap_of_boxes_in_special_places() -> None:
    box = [0.0, 0.0, 4.0, 2.0, 0.3]
    assert 1 - 1e-10 <= rectangle_iou(box, box) <= 1
    assert rectangle_iou([0.0, 0.0, 2.0, 1.0, 0.3], box) == pytest.approx(0.25, abs=1e-10)
    upright = [[x, 0.0, 4.0, 2.0, 0.0] for x in (0.0, 4.0, 2.0, 9.0)]
    assert rectangle_iou(upright[:1] * 3, upright[1:]).tolist() == [0.0, pytest.approx(1 / 3, abs=1e-10), 0.0]
    assert rectangle_iou(np.zeros(5), np.zeros(5)) == 0.0
