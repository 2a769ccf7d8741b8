"""Oriented extents of LiDAR points: yaw by L-shape search, ends along the length and width axes."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MAX_SIZE_M, MIN_SIZE_M
from log2sim.geometry import Array, wrap_angle
from log2sim.perception.yaw_search import correct_yaws, fit_yaws

# A side longer than this multiple of the typical width is not a front or rear.
MAX_WIDTH_FACTOR = 1.2
# Smallest and largest size of a category are so many standard deviations of the logarithm apart.
LIMIT_SIGMAS = 4.0
# Azimuths nearer to each other are of one column of a LiDAR, or of several lines; those of successive firings are 0.1 to 0.4
# degrees apart.
MIN_AZIMUTH_STEP_RAD = np.deg2rad(0.04)
# Smallest extent and probability of which a logarithm is taken.
MIN_EXTENT_M, MIN_PROBABILITY = 0.05, 1e-6
# Stray points are outside an object by less than this.
MAX_TRIM_M = 0.1
# Share of the points beyond either end of the extents.
TRIM = 0.01
# Quantile of the points' heights that is taken for the top, robust to stray points.
TOP_QUANTILE = 0.98


def fit_extents(points: Array, typical: Array, known_yaw_rad: float | None = None) -> tuple[float, Array, Array]:
    """Fit the length axis and the extents of points seen from the origin.

    Parameters
    ----------
    points : (n, 2) float64, m
        Relative to the viewpoint.
    typical : (3,) float64, m
        Size of the category, to tell the length from the width.
    known_yaw_rad : float, optional
        Rough yaw from elsewhere, used instead.

    Returns
    -------
    yaw_rad : float
        Up to half turns at best without a known one.
    low, high : (2,) float64, m
        Ends along the length and the width axis, relative to the viewpoint.
    """
    known = np.array([np.nan if known_yaw_rad is None else known_yaw_rad])
    yaw, low, high = fit_extents_of_clusters(points, np.array([len(points)]), typical[None], known)
    return float(yaw[0]), low[0], high[0]


def fit_extents_of_clusters(
    xy_m: Array, count: NDArray[np.intp], typical: Array, known_yaw_rad: Array
) -> tuple[Array, Array, Array]:
    """Fit the length axes and the extents of several clusters, as `fit_extents` does for one.

    Parameters
    ----------
    xy_m : (N, 2) float64, m
        Points of the first cluster, then those of the next, relative to the viewpoint.
    count : (R,) int
        Number of points of each cluster, at least 1.
    typical : (R, 3) float64, m
    known_yaw_rad : (R,) float64
        NaN where it is not known.

    Returns
    -------
    yaw_rad : (R,) float64
    low, high : (R, 2) float64, m
    """
    known = np.isfinite(known_yaw_rad)
    yaw, of_known = known_yaw_rad.copy(), np.repeat(known, count)
    if known.any():
        yaw[known] = correct_yaws(xy_m[of_known], count[known], yaw[known])
    if not known.all():
        yaw[~known] = fit_yaws(xy_m[~of_known], count[~known])[0]
    local = np.ascontiguousarray(rotate(xy_m, -np.repeat(yaw, count)).T)
    sort_clusters(local, count)
    start, third = np.cumsum(count) - count, np.minimum(2, (count - 1) // 2)
    low = np.minimum(quantile_of_clusters(local, count, TRIM), local[:, start + third] + MAX_TRIM_M).T
    last = start + count - 1
    high = np.maximum(quantile_of_clusters(local, count, 1 - TRIM), local[:, last - third] - MAX_TRIM_M).T
    for k in np.flatnonzero(~known).tolist():
        if axes_swapped(high[k] - low[k], -(low[k] + high[k]) / 2, typical[k]):
            yaw[k] += np.pi / 2
            low[k], high[k] = [low[k, 1], -high[k, 0]], [high[k, 1], -low[k, 0]]
    return yaw, low, high


def sort_clusters(values: Array, count: NDArray[np.intp]) -> None:
    """Sort values (V, N) in place within successive clusters of so many (R,) values."""
    edges = np.concatenate([[0], np.cumsum(count)]).tolist()
    for a, b in pairwise(edges):
        values[:, a:b].sort(axis=1)


def quantile_of_clusters(ordered: Array, count: NDArray[np.intp], share: float) -> Array:
    """Interpolate a quantile (V, R) of values (V, N) that `sort_clusters` sorted."""
    start, place = np.cumsum(count) - count, share * (count - 1)
    below = place.astype(np.intp)
    first, second = ordered[:, start + below], ordered[:, start + np.minimum(below + 1, count - 1)]
    return np.asarray(first + (place - below) * (second - first))


def corrected_yaw(points: Array, yaw_rad: float) -> float:
    """Correct a yaw that is known roughly by the direction of the sides of points (n, 2), where they show it."""
    return float(correct_yaws(points, np.array([len(points)]), np.array([yaw_rad]))[0])


def fit_yaw(xy_m: Array) -> tuple[float, float]:
    """Find the yaw of the rectangle whose sides are nearest to the points (N, 2), and its contrast, see `fit_yaws`."""
    yaw_rad, contrast = fit_yaws(xy_m, np.array([len(xy_m)]))
    return float(yaw_rad[0]), float(contrast[0])


def subsample(points: NDArray[Any], max_count: int) -> NDArray[Any]:
    """Take at most `max_count` rows, evenly spaced in their order, so that the choice is deterministic."""
    if len(points) <= max_count:
        return points
    return points[np.linspace(0, len(points) - 1, max_count).round().astype(np.int64)]


def azimuth_step_rad(xy: Array) -> float:
    """Return the angle between neighboring columns of points (n, 2), seen from the origin; 0 where they are one column."""
    middle = xy.mean(axis=0)
    turned = rotate(xy, -float(np.arctan2(middle[1], middle[0])))
    steps = np.diff(np.sort(np.arctan2(turned[:, 1], turned[:, 0])))
    steps = steps[steps > MIN_AZIMUTH_STEP_RAD]
    return _median(steps) if len(steps) else 0.0


def _median(values: Array) -> float:
    """Return the median of values (N,), N > 0; `np.median` takes several times as long for a few hundred."""
    k = len(values) // 2
    ordered = np.partition(values, k)
    return float(ordered[k]) if len(values) % 2 else float((ordered[:k].max() + ordered[k]) / 2)


def sample_surface(range_m: Array, max_count: int) -> NDArray[np.intp]:
    """Return the indices of at most `max_count` points at distances (N,) from a sensor, evenly spread over their surface.

    Notes
    -----
    A ray stands for a surface that grows with the square of the distance. Of every n-th point hardly one would be on
    the far end of a long vehicle beside the sensor.
    """
    if len(range_m) <= max_count:
        return np.arange(len(range_m))
    area = np.cumsum(range_m.astype(np.float64) ** 2)
    return np.unique(np.searchsorted(area, (np.arange(max_count) + 0.5) / max_count * area[-1]))


def extents(xy_m: Array, yaw_rad: float, trim: float = TRIM, max_trim_m: float = np.inf) -> tuple[Array, Array]:
    """Measure the lower and upper ends (2,), (2,) of points (N, 2) along the length and width axes of a yaw.

    The ends are the quantiles `trim` and 1 - `trim`, so that a few stray points do not stretch a box, but at most
    `max_trim_m` inside the third outermost point: the far ends of a long object close by hold few of its points.
    """
    return extents_of_rotated(rotate(xy_m, -yaw_rad), trim, max_trim_m)


def extents_of_rotated(local_m: Array, trim: float = TRIM, max_trim_m: float = np.inf) -> tuple[Array, Array]:
    """Measure the lower and upper ends (2,), (2,) of points (N, 2) along their own axes, as `extents`."""
    local = np.sort(local_m, axis=0)
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


def top_of(z_m: Array) -> float:
    """Return the height of the highest points among heights (N,), without stray ones."""
    return float(quantile_of_sorted(np.sort(z_m), TOP_QUANTILE))


def upper_median(values: NDArray[Any]) -> float:
    """Return the upper median of values (N,), N > 0; ten times as fast as `np.median` for a few hundred values."""
    k = len(values) // 2
    return float(np.partition(values, k)[k])


def rotate(xy: Array, angle_rad: Array | float) -> Array:
    """Rotate points (..., 2) counter-clockwise by one angle or by one each (...)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y = xy[..., 0], xy[..., 1]
    first = x * c - y * s
    # Twice as fast as `np.stack`, for the few points of a cluster.
    out = np.empty((*np.shape(first), 2), dtype=np.result_type(first))
    out[..., 0], out[..., 1] = first, x * s + y * c
    return out


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


def swapped_log_odds(extents_m: Array, whole: NDArray[np.bool_], sigma_m: Array, category: str) -> float:
    """Return the log-odds that the second of two axes is the length of an object, by the sizes of its category.

    Parameters
    ----------
    extents_m : (2,) float64
        Of what was seen along both axes.
    whole : (2,) bool
        Whether that is the whole side; else the side may be longer.
    sigma_m : (2,) float64
        Standard deviation of the extents.

    Notes
    -----
    The logarithm of a side is normal, with the limits of the category two standard deviations off its middle.
    """
    low, high = (np.log(np.array(t[category][:2])) for t in (MIN_SIZE_M, MAX_SIZE_M))
    extents_m = np.maximum(extents_m, MIN_EXTENT_M)
    sigma = np.hypot((high - low) / LIMIT_SIGMAS, (sigma_m / extents_m)[:, None])
    # Rows are the observed axes, columns length and width.
    z = (np.log(extents_m)[:, None] - (low + high) / 2) / sigma
    density = -(z**2) / 2 - np.log(sigma)
    longer = np.log([[max(math.erfc(v / math.sqrt(2)) / 2, MIN_PROBABILITY) for v in row] for row in z.tolist()])
    score = np.where(whole[:, None], density, longer)
    return float(score[0, 1] + score[1, 0] - score[0, 0] - score[1, 1])


def align_to(yaw_rad: float, toward_rad: float, period_rad: float) -> float:
    """Return the yaw nearest to `toward_rad` that equals `yaw_rad` up to multiples of `period_rad`."""
    turns = round(float(wrap_angle(toward_rad - yaw_rad)) / period_rad)
    return float(wrap_angle(yaw_rad + turns * period_rad))
