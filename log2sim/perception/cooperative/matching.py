"""Which boxes of two ends are the same object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, Boxes3D
from log2sim.geometry import NS_PER_S, Array, rectangle_iou
from log2sim.perception.box_completion import oriented_covariance
from log2sim.perception.cooperative.box_errors import BoxErrors, estimate_errors
from log2sim.tracking.gates import CHI2_2DOF_99
from log2sim.tracking.motion import FIRST_SPEED_MPS

# Boxes of one class with such an IoU are one object (Chen, "Vehicle-Road Cooperation", gives no value; half of what is
# asked of a detection is usual for boxes of two detectors).
MIN_CLASS_IOU = 0.3
# Road users do not share ground: boxes of one group that overlap by more are one object, whatever their errors.
MIN_GROUP_IOU = 0.1
# Standard deviation of where the road's sensors are after registration, m, and of how they are turned, rad.
POSE_SIGMA_M, POSE_SIGMA_RAD = 0.1, np.deg2rad(0.3)
NOT_ALLOWED = 1e6


@dataclass(frozen=True, eq=False)
class SeenBoxes:
    """Boxes with their errors.

    Attributes
    ----------
    boxes : M Boxes3D
    errors : BoxErrors
    sensor_m : (3,) float64, optional
        Where they are all seen from, m, map frame.
    """

    boxes: Boxes3D
    errors: BoxErrors
    sensor_m: Array | None = None

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.boxes)

    @classmethod
    def of(cls, boxes: Boxes3D, sensor_m: Array) -> Self:
        """Estimate the errors of boxes (M,) that were seen from a sensor at (3,), m, map frame."""
        return cls(boxes, estimate_errors(boxes, sensor_m), sensor_m)

    def take(self, index: NDArray[Any]) -> SeenBoxes:
        """Take the boxes at `index`, integers or a mask."""
        errors = BoxErrors(self.errors.side_m[index], self.errors.yaw_rad[index])
        return SeenBoxes(self.boxes.take(index), errors, self.sensor_m)

    @property
    def rectangles(self) -> Array:
        """The boxes in the plane (M, 5): x, y, length, width, yaw."""
        b = self.boxes
        return np.column_stack([b.center_m[:, :2], b.size_m[:, :2], b.yaw_rad])


Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Rows of the one and of the other end that belong together."""


def match_by_overlap(a: SeenBoxes, b: SeenBoxes) -> Pairs:
    """Match boxes of one class by their IoU in the ground plane, the pairs with the greatest sum."""
    iou = _iou_of_all(a, b)
    allowed = (iou >= MIN_CLASS_IOU) & (a.boxes.category[:, None] == b.boxes.category)
    return _assign(1 - iou, allowed)


def match_by_covariance(a: SeenBoxes, b: SeenBoxes) -> Pairs:
    """Match boxes of one group by the distance of their centers in relation to its standard deviation.

    Boxes that hardly overlap are matched if they are as near as their errors, those of the poses, and the motion between
    their times allow; never those whose centers are farther apart than they are long.
    """
    group_a, group_b = (np.array([GROUP_OF[str(c)] for c in seen.boxes.category], dtype="<U16") for seen in (a, b))
    away = a.boxes.center_m[:, None, :2] - b.boxes.center_m[:, :2]
    c = center_covariance(a)[:, None] + center_covariance(b) + POSE_SIGMA_M**2 * np.eye(2) + motion_covariance(a, b)
    squared = np.einsum("abi,abi->ab", away, np.linalg.solve(c, away[..., None])[..., 0])
    reach = (a.boxes.size_m[:, None, 0] + b.boxes.size_m[:, 0]) / 2
    near = (squared <= CHI2_2DOF_99) & (np.hypot(away[..., 0], away[..., 1]) <= reach)
    allowed = (near | (_iou_of_all(a, b) >= MIN_GROUP_IOU)) & (group_a[:, None] == group_b)
    return _assign(np.minimum(squared, CHI2_2DOF_99), allowed)


def _iou_of_all(a: SeenBoxes, b: SeenBoxes) -> Array:
    """Compute the IoU (M, N) in the ground plane of every box of the one with every box of the other end."""
    one, other = np.repeat(a.rectangles, len(b), axis=0), np.tile(b.rectangles, (len(a), 1))
    return rectangle_iou(one, other).reshape(len(a), len(b))


def center_covariance(seen: SeenBoxes) -> Array:
    """Return the covariances (M, 2, 2) of the centers of boxes, m2, map frame."""
    return oriented_covariance(seen.errors.center_m, seen.boxes.yaw_rad)


def motion_covariance(a: SeenBoxes, b: SeenBoxes) -> Array:
    """Return the covariance (M, N, 2, 2) of what objects move between the times of their boxes: road users move along their axis."""
    apart_s = (a.boxes.t_ns[:, None] - b.boxes.t_ns) / NS_PER_S
    speed = first_speeds(a.boxes)[:, None] * np.abs(apart_s)
    across = np.where(is_walking(a.boxes)[:, None], speed, 0.0)
    yaw = np.broadcast_to(a.boxes.yaw_rad[:, None], speed.shape)
    return oriented_covariance(np.stack([speed, across], axis=-1), yaw)


def first_speeds(boxes: Boxes3D) -> Array:
    """Return the standard deviations (M,) of the speeds of objects of which no more is known than their group, m/s."""
    return np.array([FIRST_SPEED_MPS[GROUP_OF[str(c)]] for c in boxes.category], dtype=np.float64)


def is_walking(boxes: Boxes3D) -> NDArray[np.bool_]:
    """Mark the boxes (M,) of objects that move in any direction, and whose axes tell little."""
    return np.array([GROUP_OF[str(c)] in ("pedestrian", "other") for c in boxes.category], dtype=bool)


def _assign(cost: Array, allowed: NDArray[np.bool_]) -> Pairs:
    """Choose the allowed pairs with the least sum of costs (M, N)."""
    from scipy.optimize import linear_sum_assignment

    i, j = linear_sum_assignment(np.where(allowed, cost, NOT_ALLOWED))
    kept = allowed[i, j]
    return i[kept], j[kept]
