"""How far each side of a detected box is off: by its points, distance and score, and the angle at which the side is seen.

A detector sees the near sides of an object and guesses where the far ones are. So the sides, not the center, have errors of
their own; those of center and size follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import GROUP_OF, Boxes3D
from log2sim.geometry import Array
from log2sim.log_odds import log_odds_of
from log2sim.perception.box_fitting import rotate

# Weights of `side_terms` in the logarithm of the standard deviation of a side, m, and of `yaw_terms` in that of the yaw, rad.
# Fitted by `tools/fit_box_errors.py` to what lidar:vehicle and lidar:roadside find in random scenes with exact truth.
SIDE_WEIGHTS: dict[str, Array] = {
    "vehicle": np.array([-1.9, -0.12, -0.05, -0.33, 1.42, -0.51, 0.47]),
    "two_wheeler": np.array([-1.21, -0.21, -0.13, -0.13, 1.09, -0.1, 0.47]),
    "pedestrian": np.array([-1.16, -0.13, -0.11, -0.03, 1.5, 0.05, 0.31]),
}
YAW_WEIGHTS: dict[str, Array] = {
    "vehicle": np.array([-0.37, -0.37, -0.22, -0.45]),
    "two_wheeler": np.array([-1.28, -0.07, 0.04, 0.01]),
}
# Scores nearer to 0 or 1 say no more.
MIN_SCORE, MAX_SCORE = 0.02, 0.98
# No side is known better than the noise of a LiDAR's ranges and the roundness of bodies allow, and no yaw worse than any.
MIN_SIDE_SIGMA_M, MAX_YAW_SIGMA_RAD = 0.03, np.pi / np.sqrt(12)


@dataclass(frozen=True, eq=False)
class BoxErrors:
    """Standard deviations of M boxes.

    Attributes
    ----------
    side_m : (M, 2, 2) float64
        Of the lower and the upper end along the length and the width, m.
    yaw_rad : (M,) float64
        Up to half turns.
    """

    side_m: Array
    yaw_rad: Array

    @property
    def center_m(self) -> Array:
        """Standard deviations (M, 2) of the centers along the length and the width, m."""
        return np.asarray(np.hypot(self.side_m[..., 0], self.side_m[..., 1]) / 2)


def estimate_errors(boxes: Boxes3D, sensor_m: Array) -> BoxErrors:
    """Estimate the errors of boxes (M,) seen from a sensor at (2,) or (3,), m, map frame."""
    group = [GROUP_OF[str(c)] for c in boxes.category]
    of_sides = np.array([SIDE_WEIGHTS.get(g, SIDE_WEIGHTS["vehicle"]) for g in group]).reshape(-1, 1, 1, 7)
    of_yaw = np.array([YAW_WEIGHTS.get(g, np.zeros(4)) for g in group]).reshape(-1, 4)
    side = np.exp((of_sides * side_terms(boxes, sensor_m)).sum(axis=-1))
    yaw = np.exp((of_yaw * yaw_terms(boxes, sensor_m)).sum(axis=-1))
    return BoxErrors(np.maximum(side, MIN_SIDE_SIGMA_M), np.minimum(yaw, MAX_YAW_SIGMA_RAD))


def yaw_terms(boxes: Boxes3D, sensor_m: Array) -> Array:
    """Return 1, log(1 + points), distance in units of 10 m, and the log-odds of the score (M, 4) of boxes."""
    range_m = np.hypot(*(boxes.center_m[:, :2] - sensor_m[:2]).T)
    sure = log_odds_of(np.clip(boxes.score, MIN_SCORE, MAX_SCORE))
    return np.column_stack([np.ones(len(boxes)), np.log1p(boxes.points), range_m / 10.0, sure])


def side_terms(boxes: Boxes3D, sensor_m: Array) -> Array:
    """Return the terms (M, 2, 2, 7) of the errors of the lower and upper ends of boxes along length and width.

    Those of `yaw_terms`, the logarithm of the extent along the axis in m, and the sine of the angle at which the side is seen:
    from the front, else 0, and from behind, else 0.
    """
    half = boxes.size_m[:, :2] / 2
    sensor = rotate(sensor_m[:2] - boxes.center_m[:, :2], -boxes.yaw_rad)
    facing = np.zeros((len(boxes), 2, 2))
    for end, sign in enumerate((-1.0, 1.0)):
        beyond = sign * sensor - half
        facing[..., end] = beyond / np.hypot(beyond, sensor[:, ::-1])
    shared = np.broadcast_to(yaw_terms(boxes, sensor_m)[:, None, None], (len(boxes), 2, 2, 4))
    extent = np.broadcast_to(np.log(2 * half)[..., None], facing.shape)
    seen = [extent, np.maximum(facing, 0.0), np.maximum(-facing, 0.0)]
    return np.concatenate([shared, np.stack(seen, axis=-1)], axis=-1)
