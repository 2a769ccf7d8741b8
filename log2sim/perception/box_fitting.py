"""Oriented boxes from LiDAR points: yaw by L-shape search, extents, and completion of the unobserved sides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import TYPICAL_SIZE_M
from log2sim.geometry import Array, wrap_angle

SEARCH_STEP_RAD = np.deg2rad(2.0)
MIN_EDGE_DISTANCE_M = 0.03
MAX_FIT_POINTS = 256
SENSOR_SIGMA_M = 0.08
SIZE_SIGMA_SHARE = 0.05
# Kinds of observed ends, see `real_ends`.
SIDE_END, FACING_END = 1, 2
# Corners are rounded: the outermost point seen from the side is inside the box by about this share of the width.
CORNER_ROUNDING_SHARE = 0.08
# A side seen at a smaller angle than this (sine) shows its near end only.
MIN_VIEW_SINE = 0.5
# A side longer than this multiple of the typical width is not a front or rear.
MAX_WIDTH_FACTOR = 1.2
# Share of length minus width by which a center is uncertain when its short side may be a front or a part of a flank.
AXIS_AMBIGUITY_SHARE = 0.25
# Standard deviation of a uniform error, as a share of its range: a completed side may be wrong by all that was added.
UNIFORM_SIGMA = 12.0**-0.5


def fit_yaw(xy_m: Array) -> tuple[float, float]:
    """Find the yaw of the rectangle whose sides are nearest to the points (N, 2), up to quarter turns.

    Returns
    -------
    yaw_rad : float
        In [0, pi/2).
    contrast : float
        Score of the best direction over the median score, less 1: 0 for a round or shapeless cluster; below about 0.1 the
        yaw carries no information.

    Notes
    -----
    Closeness criterion of Zhang, Xu, Dong & Dolan, "Efficient L-Shape Fitting for Vehicle Detection Using Laser
    Scanners" (IV 2017), section III-B: a point scores the inverse of its distance to the nearer side. Cost O(45 N), with N
    limited to `MAX_FIT_POINTS` by an even subsample.
    """
    points = subsample(xy_m, MAX_FIT_POINTS)
    angles = np.arange(0.0, np.pi / 2, SEARCH_STEP_RAD)
    c, s = np.cos(angles), np.sin(angles)
    directions = np.concatenate(
        [np.stack([c, s], axis=1), np.stack([-s, c], axis=1)]
    )  # (2K, 2): length axes, then width axes
    distance = _edge_distance(directions @ points.T)
    closeness = np.minimum(distance[: len(angles)], distance[len(angles) :])
    score = (1.0 / np.maximum(closeness, MIN_EDGE_DISTANCE_M)).mean(axis=1)
    best = int(np.argmax(score))
    contrast = float(score[best] / np.median(score) - 1.0)
    return float(_parabolic_peak(score, best) * SEARCH_STEP_RAD % (np.pi / 2)), contrast


def _edge_distance(offsets: Array) -> Array:
    """Measure the distance (K, N) of every value to the nearer end of its row, ignoring one stray value at each end."""
    low, high = _lower_end(offsets)[:, None], -_lower_end(-offsets)[:, None]
    return np.minimum(np.abs(offsets - low), np.abs(high - offsets))


def _lower_end(offsets: Array) -> Array:
    """Return the second lowest value of every row (K, N), or the lowest of fewer than 8."""
    if offsets.shape[1] < 8:
        return np.asarray(offsets.min(axis=1))
    others = offsets.copy()
    others[np.arange(len(others)), others.argmin(axis=1)] = np.inf
    return np.asarray(others.min(axis=1))


def _parabolic_peak(score: Array, best: int) -> float:
    """Refine the index of the best of cyclic scores (K,) by the parabola through it and its neighbors."""
    left, mid, right = score[best - 1], score[best], score[(best + 1) % len(score)]
    curvature = left - 2 * mid + right
    return best + (0.5 * (left - right) / curvature if curvature < 0 else 0.0)


def subsample(points: NDArray[Any], max_count: int) -> NDArray[Any]:
    """Take at most `max_count` rows, evenly spaced in their order, so that the choice is deterministic."""
    if len(points) <= max_count:
        return points
    return points[np.linspace(0, len(points) - 1, max_count).round().astype(np.int64)]


def extents(xy_m: Array, yaw_rad: float, trim: float = 0.01, max_trim_m: float = np.inf) -> tuple[Array, Array]:
    """Measure the lower and upper ends (2,), (2,) of points (N, 2) along the length and width axes of a yaw.

    The ends are the quantiles `trim` and 1 - `trim`, so that a few stray points do not stretch a box, but at most
    `max_trim_m` inside the third outermost point: the far ends of a long object close by hold few of its points.
    """
    local = np.sort(rotate(xy_m, -yaw_rad), axis=0)
    third = min(2, (len(local) - 1) // 2)
    low = np.minimum(quantile_of_sorted(local, trim), local[third] + max_trim_m)
    high = np.maximum(quantile_of_sorted(local, 1 - trim), local[-1 - third] - max_trim_m)
    return low, high


def quantile_of_sorted(ordered: Array, share: float) -> Array:
    """Interpolate a quantile along the first axis of sorted values (N, ...).

    Equal to `np.quantile`, whose overhead dominates for the few points of a cluster.
    """
    place = share * (len(ordered) - 1)
    below = int(place)
    above = min(below + 1, len(ordered) - 1)
    return np.asarray(ordered[below] + (place - below) * (ordered[above] - ordered[below]), dtype=np.float64)


def upper_median(values: NDArray[Any]) -> float:
    """Return the upper median of values (N,), N > 0; ten times as fast as `np.median` for a few hundred values."""
    k = len(values) // 2
    return float(np.partition(values, k)[k])


def rotate(xy: Array, angle_rad: float) -> Array:
    """Rotate points (..., 2) counter-clockwise."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack([xy[..., 0] * c - xy[..., 1] * s, xy[..., 0] * s + xy[..., 1] * c], axis=-1)


def real_ends(
    low: Array, high: Array, sensor: Array, ends_visible: Sequence[bool] | NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Decide which ends of the observed extents are ends of the box, in its length and width axes.

    Parameters
    ----------
    low, high : (2,) float64, m
        Ends of the observed points along each axis.
    sensor : (2,) float64, m
        Viewpoint, in the same axes.
    ends_visible : (2,) bool
        Whether the right and the left end of the points, as seen from the sensor, are ends of the object.

    Returns
    -------
    real : (2, 2) int
        For each axis, the kind of its lower and upper end: `FACING_END` for a side that faces the sensor, `SIDE_END` for
        one observed from the side, 0 where the box may extend beyond the points.

    Notes
    -----
    A side that faces the sensor is real. A side seen at a flat angle shows its near end only; otherwise its ends are the
    right and left ends of the points.
    """
    above, below = sensor > high, sensor < low
    real = np.where(np.stack([below, above], axis=1), FACING_END, 0)
    toward = np.abs(sensor - (low + high) / 2)
    for axis in range(2):
        other = 1 - axis
        if not (above[other] or below[other]) or toward[other] < MIN_VIEW_SINE * np.hypot(*toward):
            continue
        face = high[other] if above[other] else low[other]
        # The lower end of the length is on the left when the sensor is on the lower side of the box, that of the width when the
        # sensor is beyond the upper end of the length.
        low_is_left = (face > sensor[other]) if axis == 0 else (face < sensor[other])
        right, left = ends_visible
        visible = np.array([left, right] if low_is_left else [right, left], dtype=bool)
        real[axis] = np.maximum(real[axis], np.where(visible, SIDE_END, 0))
    return real


def complete_box(
    low: Array,
    high: Array,
    size_m: Array,
    sensor: Array,
    ends_visible: Sequence[bool] | NDArray[np.bool_] = (False, False),
) -> tuple[Array, Array]:
    """Place a box of known size over its observed extents, in its length and width axes.

    Parameters
    ----------
    low, high, sensor, ends_visible
        See `real_ends`.
    size_m : (2,) float64, m
        Length and width of the whole box.

    Returns
    -------
    center : (2,) float64, m
    sigma_m : (2,) float64
        Its standard deviation along each axis.

    Notes
    -----
    The box is aligned with its better real end; between two equally good ends, or without any, it is centered on the
    points.
    """
    return place_box(low, high, size_m, real_ends(low, high, sensor, ends_visible))


def place_box(low: Array, high: Array, size_m: Array, real: NDArray[np.int64]) -> tuple[Array, Array]:
    """Place a box as `complete_box` does, with its real ends (2, 2) known from `real_ends`."""
    low, high = corner_correction(low, high, real, size_m[1])
    slack = size_m - (high - low)
    better = np.sign(real[:, 1] - real[:, 0])
    doubt = np.where(real.any(axis=1), UNIFORM_SIGMA, 1.0) * np.maximum(slack, 0.0)
    # Objects of one category differ in size, so the position of an unobserved end is never exact.
    spread = np.where(real.all(axis=1), 0.0, SIZE_SIGMA_SHARE * size_m)
    return (low + high) / 2 - better * slack / 2, np.sqrt(SENSOR_SIGMA_M**2 + doubt**2 + spread**2)


def corner_correction(low: Array, high: Array, real: NDArray[np.int64], width_m: float) -> tuple[Array, Array]:
    """Move ends (..., 2) observed from the side outward to the corner of the box, which is too round to be hit there."""
    outward = np.where(real == SIDE_END, CORNER_ROUNDING_SHARE * width_m, 0.0)
    return low - outward[..., 0], high + outward[..., 1]


def fit_box(
    cluster: Array,
    sensor: Array,
    category: str,
    ground_z: float,
    ends_visible: Sequence[bool] | NDArray[np.bool_] = (False, False),
) -> tuple[Array, Array, float, Array]:
    """Fit a box to a cluster and complete its unobserved sides with the typical size of the category.

    Parameters
    ----------
    cluster : (n, 3) float64, m
    sensor : (3,) float64, m
        Viewpoint, in the frame of the cluster.
    category : str
    ground_z : float
        m, in the frame of the cluster.
    ends_visible : (2,) bool
        See `real_ends`.

    Returns
    -------
    center : (3,) float64, m
    size : (3,) float64, m
    yaw_rad : float
        Up to half turns at best.
    covariance : (2, 2) float64, m2
        Of the center's x, y.
    """
    typical = np.array(TYPICAL_SIZE_M[category])
    yaw_rad, _ = fit_yaw(cluster[:, :2])
    low, high = extents(cluster[:, :2], yaw_rad)
    if axes_swapped(high - low, rotate(sensor[:2], -yaw_rad) - (low + high) / 2, typical):
        yaw_rad += np.pi / 2
        low, high = np.array([low[1], -high[0]]), np.array([high[1], -low[0]])
    top = float(quantile_of_sorted(np.sort(cluster[:, 2]), 0.98)) - ground_z
    size = np.maximum([*(high - low), top], [*typical[:2], top])
    center_local, sigma = complete_box(low, high, size[:2], rotate(sensor[:2], -yaw_rad), ends_visible)
    center = np.append(rotate(center_local, yaw_rad), ground_z + size[2] / 2)
    if (high - low).max() <= MAX_WIDTH_FACTOR * typical[1] and not all(ends_visible):
        # So short a side may be a front or a visible part of a flank, for which the centers differ.
        sigma = np.hypot(sigma, AXIS_AMBIGUITY_SHARE * (size[0] - size[1]))
    return center, size, float(yaw_rad), oriented_covariance(sigma, yaw_rad)


def oriented_covariance(sigma_m: Array, yaw_rad: float) -> Array:
    """Build the covariance (2, 2) of a position with standard deviations (2,) along the length and width axes of a yaw."""
    axes = rotate(np.eye(2), yaw_rad)
    return axes.T @ np.diag(sigma_m**2) @ axes


def axes_swapped(extents_m: Array, sensor: Array, typical: Array) -> bool:
    """Decide whether a fitted yaw is along the width of the object instead of its length.

    Parameters
    ----------
    extents_m : (2,) float64
        Along and across the fitted yaw.
    sensor : (2,) or (K, 2) float64, m
        Viewpoints along and across the yaw, relative to the middle of the extents.
    typical : (3,) float64, m
        Size of the category.
    """
    # A side too long for a width is the length. If both are short, the side that faces the sensor is a front or rear.
    if extents_m.max() > MAX_WIDTH_FACTOR * typical[1]:
        return bool(extents_m[1] > extents_m[0])
    along, across = np.median(np.abs(np.atleast_2d(sensor)), axis=0)
    return bool(across > along)


def align_to(yaw_rad: float, toward_rad: float, period_rad: float) -> float:
    """Return the yaw nearest to `toward_rad` that equals `yaw_rad` up to multiples of `period_rad`."""
    turns = round(float(wrap_angle(toward_rad - yaw_rad)) / period_rad)
    return float(wrap_angle(yaw_rad + turns * period_rad))
