"""Oriented boxes from LiDAR points: yaw by L-shape search, extents, and completion of the sides that were not seen."""

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
# What an end of a box is, see `real_ends`.
SIDE_END, FACING_END = 1, 2
# Corners are rounded: the outermost point seen from the side lies inside by about this share of the width.
CORNER_ROUNDING_SHARE = 0.08
# A side seen at a flatter angle than this (sine) shows its near end only.
MIN_VIEW_SINE = 0.5
# A side longer than this share of the typical width is no front or rear.
MAX_WIDTH_FACTOR = 1.2
AXIS_AMBIGUITY_SHARE = 0.25
# A size that was completed may be wrong by all of what was added: a uniform spread. Without any real end it is worse.
UNIFORM_SIGMA = 12.0**-0.5


def fit_yaw(xy_m: Array) -> tuple[float, float]:
    """Yaw of the rectangle whose sides lie nearest to the points (N, 2), up to quarter turns.

    Returns
    -------
    yaw_rad : float
        In [0, pi/2).
    contrast : float
        How much better than the typical direction, from 0 (a round or shapeless cluster) up; below about 0.1 the yaw
        says nothing.

    Notes
    -----
    Closeness criterion of Zhang, Xu, Dong & Dolan, "Efficient L-Shape Fitting for Vehicle Detection Using Laser
    Scanners" (IV 2017), section III-B: each point counts by the inverse of its distance to the nearer side. All
    directions are scored at once; cost O(N x 45), with N bounded by an even subsample.
    """
    points = subsample(xy_m, MAX_FIT_POINTS)
    angles = np.arange(0.0, np.pi / 2, SEARCH_STEP_RAD)
    c, s = np.cos(angles), np.sin(angles)
    directions = np.concatenate([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)])  # (2K, 2): along, then across
    distance = _edge_distance(directions @ points.T)
    closeness = np.minimum(distance[: len(angles)], distance[len(angles) :])
    score = (1.0 / np.maximum(closeness, MIN_EDGE_DISTANCE_M)).mean(axis=1)
    best = int(np.argmax(score))
    contrast = float(score[best] / np.median(score) - 1.0)
    return float(_parabolic_peak(score, best) * SEARCH_STEP_RAD % (np.pi / 2)), contrast


def _edge_distance(offsets: Array) -> Array:
    """Distance (K, N) of every point to the nearer of the two ends of its row, robust to one stray point at either end."""
    low, high = _lower_end(offsets)[:, None], -_lower_end(-offsets)[:, None]
    return np.minimum(np.abs(offsets - low), np.abs(high - offsets))


def _lower_end(offsets: Array) -> Array:
    """The second lowest value of every row (K, N), of few points the lowest."""
    if offsets.shape[1] < 8:
        return offsets.min(axis=1)
    others = offsets.copy()
    others[np.arange(len(others)), others.argmin(axis=1)] = np.inf
    return others.min(axis=1)


def _parabolic_peak(score: Array, best: int) -> float:
    left, mid, right = score[best - 1], score[best], score[(best + 1) % len(score)]
    curvature = left - 2 * mid + right
    return best + (0.5 * (left - right) / curvature if curvature < 0 else 0.0)


def subsample(points: NDArray[Any], most: int) -> NDArray[Any]:
    """At most so many rows, evenly spaced in their order, so that the choice is the same in every run."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).round().astype(np.int64)]


def extents(xy_m: Array, yaw_rad: float, trim: float = 0.01) -> tuple[Array, Array]:
    """Lower and upper ends (2,), (2,) of the points (N, 2) along and across a yaw, relative to the map's origin.

    A share `trim` of the points is cut at each end, so that a few stray ones do not stretch a box.
    """
    local = np.sort(rotate(xy_m, -yaw_rad), axis=0)
    return quantile_of_sorted(local, trim), quantile_of_sorted(local, 1 - trim)


def quantile_of_sorted(ordered: Array, share: float) -> Array:
    """The quantile along the first axis of values in rising order (N, ...), linear between neighbors.

    `np.quantile` gives the same, but on the few points of a cluster its own overhead is most of its time.
    """
    place = share * (len(ordered) - 1)
    below = int(place)
    above = min(below + 1, len(ordered) - 1)
    return np.asarray(ordered[below] + (place - below) * (ordered[above] - ordered[below]), dtype=np.float64)


def upper_median(values: NDArray[Any]) -> float:
    """The upper median of values (N,), N > 0; ten times as quick as NumPy's median for a few hundred of them."""
    k = len(values) // 2
    return float(np.partition(values, k)[k])


def rotate(xy: Array, angle_rad: float) -> Array:
    """Rotate points (..., 2) counter-clockwise."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack([xy[..., 0] * c - xy[..., 1] * s, xy[..., 0] * s + xy[..., 1] * c], axis=-1)


def real_ends(
    low: Array, high: Array, sensor: Array, ends_visible: Sequence[bool] | NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Which ends of what was seen of a box are ends of the box; everything in axes along and across it.

    Parameters
    ----------
    low, high : (2,) ends of the seen points along each axis
    sensor : (2,) where the points were seen from
    ends_visible : (2,) bool
        Whether the right and the left end of the points, as the sensor sees them, are ends of the object.

    Returns
    -------
    shown : (2, 2) int
        For each axis, what its lower and its upper end are: `FACING_END` the sensor, `SIDE_END` from the side, or 0 where the box
        may go on.

    Notes
    -----
    A side that faces the sensor is real. A side seen at a flat angle shows its near end only; one seen better shows the
    ends that the sensor sees as right and left.
    """
    above, below = sensor > high, sensor < low
    shown = np.where(np.stack([below, above], axis=1), FACING_END, 0)
    toward = np.abs(sensor - (low + high) / 2)
    for axis in range(2):
        other = 1 - axis
        if not (above[other] or below[other]) or toward[other] < MIN_VIEW_SINE * np.hypot(*toward):
            continue
        face = high[other] if above[other] else low[other]
        # Seen from below the length, or from beyond the upper end of it for the width, the lower end is on the left.
        low_is_left = (face > sensor[other]) if axis == 0 else (face < sensor[other])
        right, left = ends_visible
        seen = np.array([left, right] if low_is_left else [right, left], dtype=bool)
        shown[axis] = np.maximum(shown[axis], np.where(seen, SIDE_END, 0))
    return shown


def complete_box(
    low: Array,
    high: Array,
    size_m: Array,
    sensor: Array,
    ends_visible: Sequence[bool] | NDArray[np.bool_] = (False, False),
) -> tuple[Array, Array]:
    """Place a box of known size over what was seen of it; everything in axes along and across the box.

    Parameters
    ----------
    low, high, sensor, ends_visible
        See `real_ends`.
    size_m : (2,) length and width of the whole box

    Returns
    -------
    center : (2,)
    sigma_m : (2,)
        Its standard deviation along each axis.

    Notes
    -----
    The box reaches from its best end to where it was not seen; between two equally good ones, or without any, it is
    centered on the points.
    """
    return place_box(low, high, size_m, real_ends(low, high, sensor, ends_visible))


def place_box(low: Array, high: Array, size_m: Array, shown: NDArray[np.int64]) -> tuple[Array, Array]:
    """As `complete_box`, with the real ends (2, 2) that `real_ends` tells."""
    low, high = corner_correction(low, high, shown, size_m[1])
    slack = size_m - (high - low)
    reach = np.sign(shown[:, 1] - shown[:, 0])
    doubt = np.where(shown.any(axis=1), UNIFORM_SIGMA, 1.0) * np.maximum(slack, 0.0)
    # Objects of one category differ in size, so what is believed of an end that was not seen is never exact.
    spread = np.where(shown.all(axis=1), 0.0, SIZE_SIGMA_SHARE * size_m)
    return (low + high) / 2 - reach * slack / 2, np.sqrt(SENSOR_SIGMA_M**2 + doubt**2 + spread**2)


def corner_correction(low: Array, high: Array, shown: NDArray[np.int64], width_m: float) -> tuple[Array, Array]:
    """The ends (..., 2), moved out to the corners that are too round for a ray to touch where an end is seen from the side."""
    outward = np.where(shown == SIDE_END, CORNER_ROUNDING_SHARE * width_m, 0.0)
    return low - outward[..., 0], high + outward[..., 1]


def fit_box(
    cluster: Array,
    sensor: Array,
    category: str,
    ground_z: float,
    ends_visible: Sequence[bool] | NDArray[np.bool_] = (False, False),
) -> tuple[Array, Array, float, Array]:
    """Center (3,), size (3,), yaw and covariance (2, 2) of the box around a cluster (n, 3) seen from `sensor` (3,).

    The yaw is known up to half turns at best. The typical size completes what was not seen; `ends_visible` as in
    `real_ends`.
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
        # So short a side may be a front or what shows of a flank; the two put the center in different places.
        sigma = np.hypot(sigma, AXIS_AMBIGUITY_SHARE * (size[0] - size[1]))
    return center, size, float(yaw_rad), oriented_covariance(sigma, yaw_rad)


def oriented_covariance(sigma_m: Array, yaw_rad: float) -> Array:
    """Covariance (2, 2) of a place with standard deviations (2,) along and across a yaw."""
    axes = rotate(np.eye(2), yaw_rad)
    return axes.T @ np.diag(sigma_m**2) @ axes


def axes_swapped(seen_m: Array, sensor: Array, typical: Array) -> bool:
    """Whether a fitted yaw runs across the object, from the extents (2,) along and across it.

    `sensor` is one place (2,) or several (K, 2) that it was seen from, along and across from its middle; `typical` the
    category's size.
    """
    # Too long for a width: that side is the length. Both short: what faces the sensor flat-on is front or rear.
    if seen_m.max() > MAX_WIDTH_FACTOR * typical[1]:
        return bool(seen_m[1] > seen_m[0])
    ahead, aside = np.median(np.abs(np.atleast_2d(sensor)), axis=0)
    return bool(aside > ahead)


def align_to(yaw_rad: float, toward_rad: float, period_rad: float) -> float:
    """The yaw equal to `yaw_rad` up to multiples of `period_rad` that is nearest to another one."""
    turns = round(float(wrap_angle(toward_rad - yaw_rad)) / period_rad)
    return float(wrap_angle(yaw_rad + turns * period_rad))
