"""Oriented boxes from LiDAR points: yaw by L-shape search, extents, and completion of the sides that were not seen."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, wrap_angle
from log2sim.types import TYPICAL_SIZE_M

SEARCH_STEP_RAD = np.deg2rad(2.0)
NEAREST_EDGE_M = 0.03
MOST_POINTS = 256
SENSOR_SIGMA_M = 0.08
# A side longer than this many typical widths is no width.
LONGEST_WIDTH = 1.15
# A completed side may be anywhere between nothing hidden and all of the slack hidden: a uniform spread.
SLACK_SIGMA = 12.0**-0.5


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
    points = subsample(xy_m, MOST_POINTS)
    angles = np.arange(0.0, np.pi / 2, SEARCH_STEP_RAD)
    c, s = np.cos(angles), np.sin(angles)
    directions = np.concatenate([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)])  # (2K, 2): along, then across
    distance = _edge_distance(directions @ points.T)
    closeness = np.minimum(distance[: len(angles)], distance[len(angles) :])
    score = (1.0 / np.maximum(closeness, NEAREST_EDGE_M)).mean(axis=1)
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


def rotate(xy: Array, angle_rad: float) -> Array:
    """Rotate points (..., 2) counter-clockwise."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack([xy[..., 0] * c - xy[..., 1] * s, xy[..., 0] * s + xy[..., 1] * c], axis=-1)


def complete_box(low: Array, high: Array, size_m: Array, sensor: Array) -> tuple[Array, Array]:
    """Place a box of known size over what was seen of it; everything in axes along and across the box.

    Parameters
    ----------
    low, high : (2,) ends of the seen points
    size_m : (2,) length and width of the whole box
    sensor : (2,) where the points were seen from

    Returns
    -------
    center : (2,)
    slack_m : (2,) >= 0
        How far the center could still move along each axis with the points inside the box.

    Notes
    -----
    The side that faces the sensor is the one that was seen, so the box starts there and reaches away from it. A sensor
    beside the box sees that side from end to end, so the box is centered on it.
    """
    seen = high - low
    slack = np.maximum(size_m - seen, 0.0)
    middle = (low + high) / 2
    # +1: the sensor lies beyond the upper end, so the upper end is real and the box reaches down from it
    beyond = np.where(sensor > high, 1.0, np.where(sensor < low, -1.0, 0.0))
    return middle - beyond * slack / 2, slack


def box_of_cluster(
    cluster: Array, sensor: Array, category: str, ground_z: float, *, yaw_rad: float | None = None, size_m: Any = None
) -> tuple[Array, Array, float, Array]:
    """Center (3,), size (3,), yaw and covariance (2, 2) of the box around a cluster (n, 3) seen from `sensor` (3,).

    Without `yaw_rad` the yaw is fitted, up to quarter turns; without `size_m` the typical size completes what was not seen.
    """
    typical = np.array(TYPICAL_SIZE_M[category])
    if yaw_rad is not None:
        low, high = extents(cluster[:, :2], yaw_rad)
    else:
        yaw_rad, _ = fit_yaw(cluster[:, :2])
        low, high = extents(cluster[:, :2], yaw_rad)
        if _runs_across(low, high, rotate(sensor[:2], -yaw_rad), typical):
            yaw_rad += np.pi / 2
            low, high = np.array([low[1], -high[0]]), np.array([high[1], -low[0]])
    top = float(quantile_of_sorted(np.sort(cluster[:, 2]), 0.98)) - ground_z
    size = (
        np.asarray(size_m, dtype=np.float64)
        if size_m is not None
        else np.maximum([*(high - low), top], [*typical[:2], top])
    )
    sensor_local = rotate(sensor[:2], -yaw_rad)
    center_local, slack = complete_box(low, high, size[:2], sensor_local)
    center = np.append(rotate(center_local, yaw_rad), ground_z + size[2] / 2)
    sigma = np.hypot(SENSOR_SIGMA_M, SLACK_SIGMA * slack)
    axes = rotate(np.eye(2), yaw_rad)
    return center, size, float(yaw_rad), axes.T @ np.diag(sigma**2) @ axes


def _runs_across(low: Array, high: Array, sensor: Array, typical: Array) -> bool:
    """Whether the length lies across the yaw that was fitted; everything in axes along and across that yaw.

    A side too long for a width is the length. Where both are short, what faces the sensor flat-on is front or rear: an
    object seen from straight behind must not turn with the last digit of its yaw.
    """
    along, across = high - low
    if max(along, across) > LONGEST_WIDTH * typical[1]:
        return bool(across > along)
    away = np.abs(sensor - (low + high) / 2)
    return bool(away[1] > away[0])


def align_to(yaw_rad: float, toward_rad: float, period_rad: float) -> float:
    """The yaw equal to `yaw_rad` up to multiples of `period_rad` that is nearest to another one."""
    turns = round(float(wrap_angle(toward_rad - yaw_rad)) / period_rad)
    return float(wrap_angle(yaw_rad + turns * period_rad))
