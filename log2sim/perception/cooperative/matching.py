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
    i, j = _touching(a, b)
    iou = rectangle_iou(a.take(i).rectangles, b.take(j).rectangles)
    allowed = (iou >= MIN_CLASS_IOU) & (a.boxes.category[i] == b.boxes.category[j])
    return _assign((len(a), len(b)), (i[allowed], j[allowed]), 1 - iou[allowed])


def match_by_covariance(a: SeenBoxes, b: SeenBoxes) -> Pairs:
    """Match boxes of one group by the distance of their centers in relation to its standard deviation.

    Boxes that hardly overlap are matched if they are as near as their errors, those of the poses, and the motion between
    their times allow; never those whose centers are farther apart than they are long.
    """
    i, j = _touching(a, b)
    one, other = a.take(i), b.take(j)
    away = one.boxes.center_m[:, :2] - other.boxes.center_m[:, :2]
    c = center_covariance(one) + center_covariance(other) + POSE_SIGMA_M**2 * np.eye(2) + motion_covariance(one, other)
    squared = np.einsum("pi,pi->p", away, np.linalg.solve(c, away[..., None])[..., 0])
    reach = (one.boxes.size_m[:, 0] + other.boxes.size_m[:, 0]) / 2
    near = (squared <= CHI2_2DOF_99) & (np.hypot(away[:, 0], away[:, 1]) <= reach)
    overlap = rectangle_iou(one.rectangles, other.rectangles) >= MIN_GROUP_IOU
    allowed = (near | overlap) & (_groups(one.boxes) == _groups(other.boxes))
    return _assign((len(a), len(b)), (i[allowed], j[allowed]), np.minimum(squared, CHI2_2DOF_99)[allowed])


def _touching(a: SeenBoxes, b: SeenBoxes) -> Pairs:
    """Find the pairs of boxes that may overlap: circles around them do."""
    away = a.boxes.center_m[:, None, :2] - b.boxes.center_m[:, :2]
    radius_a, radius_b = (np.hypot(*seen.boxes.size_m[:, :2].T) / 2 for seen in (a, b))
    i, j = np.nonzero(np.hypot(away[..., 0], away[..., 1]) <= radius_a[:, None] + radius_b)
    return i, j


def _groups(boxes: Boxes3D) -> NDArray[np.str_]:
    return np.array([GROUP_OF[str(c)] for c in boxes.category], dtype="<U16")


def center_covariance(seen: SeenBoxes) -> Array:
    """Return the covariances (M, 2, 2) of the centers of boxes, m2, map frame."""
    return oriented_covariance(seen.errors.center_m, seen.boxes.yaw_rad)


def motion_covariance(a: SeenBoxes, b: SeenBoxes) -> Array:
    """Return the covariances (P, 2, 2) of what objects move between the times of boxes a and b, row by row the same objects.

    Road users move along their axis, but for those who walk.
    """
    moved_m = first_speeds(a.boxes) * np.abs(a.boxes.t_ns - b.boxes.t_ns) / NS_PER_S
    across_m = np.where(is_walking(a.boxes), moved_m, 0.0)
    return oriented_covariance(np.stack([moved_m, across_m], axis=-1), a.boxes.yaw_rad)


def first_speeds(boxes: Boxes3D) -> Array:
    """Return the standard deviations (M,) of the speeds of objects of which no more is known than their group, m/s."""
    return np.array([FIRST_SPEED_MPS[GROUP_OF[str(c)]] for c in boxes.category], dtype=np.float64)


def is_walking(boxes: Boxes3D) -> NDArray[np.bool_]:
    """Mark the boxes (M,) of objects that move in any direction, and whose axes say little."""
    return np.array([GROUP_OF[str(c)] in ("pedestrian", "other") for c in boxes.category], dtype=bool)


def _assign(shape: tuple[int, int], pairs: Pairs, cost: Array) -> Pairs:
    """Choose of allowed pairs of M and N boxes those with the least sum of costs (P,)."""
    from scipy.optimize import linear_sum_assignment

    every = np.full(shape, NOT_ALLOWED)
    every[pairs] = cost
    i, j = linear_sum_assignment(every)
    kept = every[i, j] < NOT_ALLOWED
    return i[kept], j[kept]
