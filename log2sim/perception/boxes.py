"""Oriented boxes of LiDAR points: yaw, extents, and the completion of partly observed ones.

All functions work in the length and width axes of the boxes; leading dimensions (...) are boxes. Points of several clusters are
rows (N, ...), those of the first cluster, then those of the next; `count` (R,) is the number of each, at least 1.
"""

from __future__ import annotations

import math
from dataclasses import fields
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M, BoxEvidence, Measurements
from log2sim.geometry import Array

SEARCH_STEP_RAD = np.deg2rad(2.0)
# Distances to an edge below the noise of a LiDAR score alike.
MIN_EDGE_DISTANCE_M = 0.03
MAX_FIT_POINTS = 256
MIN_CONTRAST = 0.1
# A yaw known from elsewhere is corrected by at least so many points, and by no more than it can be wrong.
MIN_YAW_POINTS, MAX_CORRECTION_POINTS = 30, 128
CORRECTIONS_RAD = np.arange(-7, 8) * SEARCH_STEP_RAD
# The outermost point of fewer than these is taken as it is; of more, one may be stray.
MIN_POINTS_WITH_STRAY = 8
# Offsets that are worked on at a time, few enough for a processor's cache.
MAX_OFFSETS = 1 << 18


def fit_yaws(xy_m: Array, count: NDArray[np.intp]) -> tuple[Array, Array]:
    """Find the yaw of the rectangle whose sides are nearest to the points (N, 2), m, of each of R clusters, up to quarter turns.

    Returns `yaw_rad`: (R,): in [0, pi/2); `contrast`: (R,): score of the best direction over the median score, less 1: 0
    for a round or shapeless cluster; below about `MIN_CONTRAST` the yaw carries no information.

    Closeness criterion of Zhang, Xu, Dong & Dolan, "Efficient L-Shape Fitting for Vehicle Detection Using Laser
    Scanners" (IV 2017), section III-B: a point scores the inverse of its distance to the nearer side. Cost O(45 N), with
    the points of a cluster limited to `MAX_FIT_POINTS` by an even subsample.
    """
    angles = np.arange(0.0, np.pi / 2, SEARCH_STEP_RAD)
    score = _closeness(xy_m, count, np.broadcast_to(angles, (len(count), len(angles))), MAX_FIT_POINTS)
    best = score.argmax(axis=1)
    return _parabolic_peak(score, best) * SEARCH_STEP_RAD % (np.pi / 2), _contrast(score, best)


def correct_yaws(xy_m: Array, count: NDArray[np.intp], yaw_rad: Array) -> Array:
    """Correct yaws (R,) that are known roughly by the direction of the sides of R clusters, where these show it."""
    out = yaw_rad.copy()
    enough = np.flatnonzero(count >= MIN_YAW_POINTS)
    if len(enough):
        xy_m = xy_m[np.repeat(count >= MIN_YAW_POINTS, count)]
        angles = yaw_rad[enough, None] + CORRECTIONS_RAD
        score = _closeness(xy_m, count[enough], angles, MAX_CORRECTION_POINTS)
        best = score.argmax(axis=1)
        shown = (best > 0) & (best < len(CORRECTIONS_RAD) - 1) & (_contrast(score, best) >= MIN_CONTRAST)
        corrected = angles[:, 0] + _parabolic_peak(score, best) * SEARCH_STEP_RAD
        out[enough[shown]] = corrected[shown]
    return out


def _contrast(score: Array, best: NDArray[np.intp]) -> Array:
    """Return the best of scores (M, K) over their median, less 1: (M,)."""
    ordered = np.sort(score, axis=1)
    middle = (ordered[:, (score.shape[1] - 1) // 2] + ordered[:, score.shape[1] // 2]) / 2
    return np.asarray(score[np.arange(len(best)), best] / middle - 1.0)


def _closeness(xy: Array, count: NDArray[np.intp], angles: Array, most: int) -> Array:
    """Score (M, K) directions of a rectangle's sides, K for each cluster, by how near its points, at most so many, are to them."""
    out, directions_count = np.empty(angles.shape), 2 * angles.shape[1]
    start, place, first = np.cumsum(count) - count, np.arange(most), 0
    # Single precision does for distances within a cluster, which directions tell whatever point they are measured from.
    columns = np.ascontiguousarray((xy - np.repeat(xy[start], count, axis=0)).T, dtype=np.float32)
    while first < len(count):
        # So many clusters at a time that they fit into a cache: points (m, 2, W), evenly spaced in their order.
        size = max(MAX_OFFSETS // (directions_count * min(int(count[first:].max()), most)), 1)
        rows = slice(first, first + size)
        first, width = first + size, min(int(count[rows].max()), most)
        spaced = np.round(place[:width] * ((count[rows, None] - 1) / (most - 1))).astype(np.intp)
        chosen = np.where(count[rows, None] > most, spaced, place[:width])
        valid = place[:width] < count[rows, None]
        points = columns[:, start[rows, None] + np.where(valid, chosen, 0)].transpose(1, 0, 2)
        c, s = np.cos(angles[rows]), np.sin(angles[rows])
        # Length axes, then width axes: (m, 2 K, 2).
        directions = np.concatenate([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=1, dtype=np.float32)
        # Distance of every point to the nearer end of all, without one stray point at each.
        offsets = directions @ points
        low, high = _outer_ends(offsets, valid)
        distance = np.minimum(np.abs(offsets - low), np.abs(high - offsets))
        nearer = np.minimum(distance[:, : angles.shape[1]], distance[:, angles.shape[1] :])
        score = np.reciprocal(np.maximum(nearer, np.float32(MIN_EDGE_DISTANCE_M))) * valid[:, None]
        out[rows] = score.sum(axis=2) / valid.sum(axis=1)[:, None]
    return out


def _outer_ends(
    offsets: NDArray[np.float32], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the second lowest and second highest valid values (M, K, 1) of every row, or the outermost of fewer than `MIN_POINTS_WITH_STRAY`."""
    ordered = np.sort(np.where(valid[:, None], offsets, np.float32(np.inf)), axis=2)
    count, rows = valid.sum(axis=1), np.arange(len(valid))
    stray = count >= MIN_POINTS_WITH_STRAY
    return ordered[rows, :, stray.astype(np.intp), None], ordered[rows, :, count - 1 - stray, None]


def _parabolic_peak(score: Array, best: NDArray[np.intp]) -> Array:
    """Refine the index (M,) of the best of cyclic scores (M, K) by the parabola through it and its neighbors."""
    rows = np.arange(len(best))
    left, mid, right = (score[rows, (best + step) % score.shape[1]] for step in (-1, 0, 1))
    curvature = left - 2 * mid + right
    return np.asarray(best + np.divide(0.5 * (left - right), curvature, out=np.zeros(len(best)), where=curvature < 0))


# A side longer than this multiple of the typical width is not a front or rear.
MAX_WIDTH_FACTOR = 1.2
# Smallest and largest size of a category are so many standard deviations of the logarithm apart.
LIMIT_SIGMAS = 4.0
# Nearer azimuths are of one column of a LiDAR, or of several lines; successive firings are 0.1 to 0.4 degrees apart.
MIN_AZIMUTH_STEP_RAD = np.deg2rad(0.04)
# Smallest extent and probability of which a logarithm is taken.
MIN_EXTENT_M, MIN_PROBABILITY = 0.05, 1e-6
# Stray points are outside an object by less than this.
MAX_TRIM_M = 0.1
# Share of the points beyond either end of the extents.
TRIM = 0.01
# Quantile of the points' heights that is taken for the top, robust to stray points.
TOP_QUANTILE = 0.98


def fit_extents(points: Array, typical: Array, known_yaw_rad: float = np.nan) -> tuple[float, Array, Array]:
    """Fit the length axis and the extents of points seen from the origin.

    `points`: (n, 2), m: relative to the viewpoint. `typical`: (3,), m: size of the category, to tell the length from the
    width. `known_yaw_rad`: rough yaw from elsewhere, used instead; NaN where there is none.

    Returns `yaw_rad`: up to half turns at best without a known one; `low`, `high`: (2,), m: ends along the length and the
    width axis, relative to the viewpoint.
    """
    count, known = np.array([len(points)]), np.array([known_yaw_rad])
    yaw, low, high = fit_extents_of_clusters(points, count, typical[None], known)
    return float(yaw[0]), low[0], high[0]


def fit_extents_of_clusters(
    xy_m: Array, count: NDArray[np.intp], typical: Array, known_yaw_rad: Array
) -> tuple[Array, Array, Array]:
    """Fit the length axes and the extents of several clusters, as `fit_extents` does for one.

    `known_yaw_rad`: (R,): NaN where it is not known. Returns `yaw_rad`: (R,); `low`, `high`: (R, 2), m.
    """
    known = np.isfinite(known_yaw_rad)
    yaw, of_known = known_yaw_rad.copy(), np.repeat(known, count)
    if known.any():
        yaw[known] = correct_yaws(xy_m[of_known], count[known], yaw[known])
    if not known.all():
        yaw[~known] = fit_yaws(xy_m[~of_known], count[~known])[0]
    low, high = extents_of_clusters(xy_m, count, yaw)
    # A side too long for a width is the length. If both are short, the side that faces the sensor is a front or rear.
    size, middle = high - low, np.abs(low + high)
    is_long = size.max(axis=1) > MAX_WIDTH_FACTOR * typical[:, 1]
    swapped = ~known & np.where(is_long, size[:, 1] > size[:, 0], middle[:, 1] > middle[:, 0])
    yaw[swapped] += np.pi / 2
    low[swapped], high[swapped] = (
        np.column_stack([low[swapped, 1], -high[swapped, 0]]),
        np.column_stack([high[swapped, 1], -low[swapped, 0]]),
    )
    return yaw, low, high


def extents_of_clusters(xy_m: Array, count: NDArray[np.intp], yaw_rad: Array) -> tuple[Array, Array]:
    """Measure the lower and upper ends (R, 2), (R, 2), m, of clusters along the length and width axes of their yaws (R,).

    The ends are quantiles, so that a few stray points do not stretch a box, but at most `MAX_TRIM_M` inside the third outermost
    point: the far ends of a long object close by hold few of its points.
    """
    (x, y), (c, s) = xy_m.T, (np.repeat(of(-yaw_rad), count) for of in (np.cos, np.sin))
    local = np.stack([x * c - y * s, x * s + y * c])
    sort_clusters(local, count)
    start, third = np.cumsum(count) - count, np.minimum(2, (count - 1) // 2)
    low = np.minimum(quantile_of_clusters(local, count, TRIM), local[:, start + third] + MAX_TRIM_M)
    last = start + count - 1
    high = np.maximum(quantile_of_clusters(local, count, 1 - TRIM), local[:, last - third] - MAX_TRIM_M)
    return low.T, high.T


def extents(xy_m: Array, yaw_rad: float) -> tuple[Array, Array]:
    """Measure the lower and upper ends (2,), (2,) of points (N, 2), N > 0, along the axes of a yaw, as `extents_of_clusters`."""
    low, high = extents_of_clusters(xy_m, np.array([len(xy_m)]), np.array([yaw_rad]))
    return low[0], high[0]


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


def fit_yaw(xy_m: Array) -> tuple[float, float]:
    """Find the yaw of the rectangle whose sides are nearest to the points (N, 2), and its contrast, see `fit_yaws`."""
    yaw_rad, contrast = fit_yaws(xy_m, np.array([len(xy_m)]))
    return float(yaw_rad[0]), float(contrast[0])


def subsample(points: NDArray[Any], max_count: int) -> NDArray[Any]:
    """Take at most `max_count` rows, evenly spaced in their order, so that the choice is deterministic."""
    if len(points) <= max_count:
        return points
    return points[np.linspace(0, len(points) - 1, max_count).round().astype(np.int64)]


def azimuth_steps(xy_m: Array, count: NDArray[np.intp]) -> Array:
    """Return the angles (R,), rad, between neighboring columns of clusters seen from the origin; 0 for one that is one column."""
    start = np.cumsum(count) - count
    place = np.ascontiguousarray(xy_m, dtype=np.float64).view(np.complex128)[:, 0]
    turned = place * np.repeat(np.add.reduceat(place, start).conj(), count)
    azimuth = np.arctan2(turned.imag, turned.real)[None]
    sort_clusters(azimuth, count)
    steps = np.diff(azimuth, append=np.inf)
    steps[0, start[1:] - 1] = np.inf
    steps[steps <= MIN_AZIMUTH_STEP_RAD] = np.inf
    sort_clusters(steps, count)
    columns = np.add.reduceat(np.isfinite(steps[0]).astype(np.intp), start)
    low, high = (steps[0, start + np.maximum(columns - of, 0) // 2] for of in (1, 0))
    return np.where(columns > 0, (low + high) / 2, 0.0)


# Points of a cluster that are kept as evidence; its extents are those of all, since ends are told by their outermost points.
MAX_KEPT_POINTS = 400


def sample_surfaces(range_m: NDArray[np.floating[Any]], count: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the indices of at most `MAX_KEPT_POINTS` points of each cluster, at distances (N,), m, evenly spread over its surface.

    A ray stands for a surface that grows with the square of the distance. Of every n-th point hardly one would be on
    the far end of a long vehicle beside the sensor.
    """
    kept = np.repeat(count <= MAX_KEPT_POINTS, count)
    many = np.flatnonzero(count > MAX_KEPT_POINTS)
    if len(many):
        area = np.concatenate([[0.0], np.cumsum(range_m.astype(np.float64) ** 2)])
        first = (np.cumsum(count) - count)[many]
        low, high = area[first], area[first + count[many]]
        share = (np.arange(MAX_KEPT_POINTS) + 0.5) / MAX_KEPT_POINTS
        wanted = low[:, None] + share * (high - low)[:, None]
        kept[np.searchsorted(area[1:], wanted.ravel())] = True
    return np.flatnonzero(kept)


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


def swapped_log_odds(extents_m: Array, whole: NDArray[np.bool_], sigma_m: Array, category: str) -> float:
    """Return the log-odds that the second of two axes is the length of an object, by the sizes of its category.

    `extents_m`: (2,): of what was seen along both axes. `whole`: (2,): whether that is the whole side; else the side may be
    longer. `sigma_m`: (2,): standard deviation of the extents.

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


# Standard deviation of an observed end: range noise of a LiDAR and the spacing of its rays.
SENSOR_SIGMA_M = 0.08
# Standard deviation of sizes within a category, as a share of the size.
SIZE_SIGMA_SHARE = 0.05
# Kinds of observed ends, see `real_ends`.
SIDE_END, FACING_END = 1, 2
# Corners are rounded: the outermost point seen from the side is inside the box by about this share of the width; trucks and
# buses, which are wider than any car is without its mirrors, are boxes.
CORNER_ROUNDING_SHARE, BOX_CORNER_ROUNDING_SHARE, MIN_BOX_WIDTH_M = 0.05, 0.02, 2.1
# Points nearer than this to the plane of a side that is not seen do not tell how far rays on it are apart.
MIN_SIDE_DISTANCE_M = 0.3
# Standard deviations of a center that a 3D detector estimates, along and across its box: with many points, and the number of points
# with which the variances are twice that. Root mean squares of the shipped detectors on simulated sweeps; vehicles are off by 0.1 m
# across there, but by more where their sides are not those of the simulation.
BOX_SIGMA_M = {"vehicle": (0.2, 0.2), "two_wheeler": (0.12, 0.06), "pedestrian": (0.08, 0.08), "other": (0.2, 0.2)}
BOX_SIGMA_POINTS = 20.0
# A side seen at a smaller angle than this (sine) shows its near end only.
MIN_VIEW_SINE = 0.5
# A side does not face a sensor that is less than this before its plane, and sees it at less than this angle (tangent): a
# sensor moves on by that while it sweeps, half of 0.1 s at 10 m/s.
SENSOR_MOTION_M, MIN_FACE_TANGENT = 0.5, 0.25
# Share of length minus width by which a center is uncertain when its short side may be a front or a part of a flank.
AXIS_AMBIGUITY_SHARE = 0.25
# Standard deviation of a uniform error, as a share of its range: a completed side may be wrong by all that was added.
UNIFORM_SIGMA = 12.0**-0.5


def real_ends(
    low: Array, high: Array, sensor: Array, ends_visible: NDArray[np.bool_], *, min_sine: float = MIN_VIEW_SINE
) -> NDArray[np.int64]:
    """Decide which ends of the observed extents are ends of the box.

    `low`, `high`: (..., 2), m: ends of the observed points along each axis. `sensor`: (..., 2), m: viewpoint, in the same
    axes. `ends_visible`: (..., 2): whether the right and the left end of the points, as seen from the sensor, are ends of
    the object. `min_sine`: of the angle at which a side is seen: below it only the near end is taken for one; lower where
    the distances between rays are taken into account (`end_gaps`).

    Returns `real`: (..., 2, 2): for each axis, the kind of its lower and upper end: `FACING_END` for a side that faces the
    sensor, `SIDE_END` for one observed from the side, 0 where the box may extend beyond the points.

    A side that faces the sensor is real. A side seen at a flat angle shows its near end only; otherwise its ends are the
    right and left ends of the points.
    """
    above, below = sensor > high, sensor < low
    real = facing_ends(low, high, sensor)
    offset = np.abs(sensor - (low + high) / 2)
    distance = np.hypot(offset[..., 0], offset[..., 1])
    right, left = np.asarray(ends_visible)[..., 0], np.asarray(ends_visible)[..., 1]
    for axis in range(2):
        other = 1 - axis
        is_side = (above[..., other] | below[..., other]) & (offset[..., other] >= min_sine * distance)
        # The lower end of the length is on the left when the sensor is on the lower side of the box, that of the width when
        # the sensor is beyond the upper end of the length.
        low_is_left = below[..., other] if axis == 0 else above[..., other]
        visible = np.stack([np.where(low_is_left, left, right), np.where(low_is_left, right, left)], axis=-1)
        side = np.where(is_side[..., None] & visible, SIDE_END, 0)
        real[..., axis, :] = np.maximum(real[..., axis, :], side)
    return real


def facing_ends(low: Array, high: Array, sensor: Array) -> NDArray[np.int64]:
    """Return the `real_ends` (..., 2, 2) of which no other than those of sides that face the sensor are ends of the object."""
    beyond = np.stack([low - sensor, sensor - high], axis=-1)
    # Of a flank that leaves the field of view level with the sensor, the last point may be ahead of it or behind it.
    flat = MIN_FACE_TANGENT * np.maximum(beyond.max(axis=-1), 0.0)[..., ::-1, None]
    return np.where(beyond > np.minimum(flat, SENSOR_MOTION_M), FACING_END, 0)


def end_gaps(step_rad: Array | float, low: Array, high: Array, real: NDArray[np.int64]) -> Array:
    """Compute how far the rays of a LiDAR are apart at the ends (..., 2, 2) of the extents of points, m.

    An end seen from the side is up to one such distance beyond the outermost point. One that faces the sensor is hit.

    `step_rad`: (...), rad: angle between neighboring rays, from `azimuth_steps`. `low`, `high`: (..., 2), m:
    ends of the extents along the length and the width, relative to the sensor. `real`: (..., 2, 2): from `real_ends`.

    Rays that are a small angle apart meet a side at distance d from the sensor's foot point on it, which is c away, at
    points angle x (c^2 + d^2) / c apart.
    """
    nearer_m = np.where(np.abs(low) < np.abs(high), np.abs(low), np.abs(high))
    side_m = np.maximum(nearer_m[..., ::-1], MIN_SIDE_DISTANCE_M)[..., None]
    end_m = np.stack([low, high], axis=-1)
    gap = np.asarray(step_rad)[..., None, None] * (side_m**2 + end_m**2) / side_m
    return np.asarray(np.where(real == FACING_END, 0.0, gap))


def complete_box(
    low: Array,
    high: Array,
    size_m: Array,
    real: NDArray[np.int64],
    known: NDArray[np.bool_] | bool = False,
    *,
    gap_m: Array | float = 0.0,
) -> tuple[Array, Array]:
    """Place a box of known size over its observed extents.

    `low`, `high`: (..., 2), m: ends of the observed points along each axis. `size_m`: (2,) or (..., 2), m: length and width
    of the whole box. `real`: (..., 2, 2): kinds of the ends, see `real_ends`. `known`: (...): whether a 3D detector gives
    the size, so that what is added to the points beyond a real end is no guess. `gap_m`: (..., 2, 2), m: from `end_gaps`.

    Returns `center`: (..., 2), m; `sigma_m`: (..., 2): its standard deviation along each axis.

    The box is aligned with its better real end; between two equally good ones it is centered, nearer to the one where rays
    are closer together, and without any it is centered on the points.
    """
    best = (real > 0) & (real == real.max(axis=-1, keepdims=True))
    weight = np.where(best, 1.0 / (SENSOR_SIGMA_M**2 + (UNIFORM_SIGMA * np.asarray(gap_m)) ** 2), 0.0)
    low, high = corner_correction(low, high, real, size_m[..., 1], gap_m=gap_m)
    slack = size_m - (high - low)
    total = weight.sum(axis=-1)
    better = (weight[..., 1] - weight[..., 0]) / np.where(total > 0, total, 1.0)
    one_end = np.where(np.asarray(known)[..., None], 0.0, UNIFORM_SIGMA)
    doubt = np.where(real.any(axis=-1), one_end, 1.0) * np.maximum(slack, 0.0)
    # Objects of one category differ in size, so the position of an unobserved end is never exact.
    # A box that is laid against one end is off by half of what its size is.
    spread = np.where(real.all(axis=-1), np.abs(better) / 2 * (slack > 0), 1.0) * SIZE_SIGMA_SHARE * size_m
    return (low + high) / 2 - better * slack / 2, np.sqrt(SENSOR_SIGMA_M**2 + doubt**2 + spread**2)


def corner_correction(
    low: Array, high: Array, real: NDArray[np.int64], width_m: Array | float, *, gap_m: Array | float = 0.0
) -> tuple[Array, Array]:
    """Move ends (..., 2) observed from the side outward to the corner of the box.

    The corner is too round to be hit, and on average it is half the distance `gap_m` between two rays beyond the last one.
    """
    width = np.asarray(width_m)[..., None, None]
    rounding = np.where(width < MIN_BOX_WIDTH_M, CORNER_ROUNDING_SHARE, BOX_CORNER_ROUNDING_SHARE) * width
    outward = np.where(real == SIDE_END, rounding + np.asarray(gap_m) / 2, 0.0)
    return np.asarray(low - outward[..., 0]), np.asarray(high + outward[..., 1])


def oriented_covariance(sigma_m: Array, yaw_rad: Array | float) -> Array:
    """Build covariances (..., 2, 2) of positions with standard deviations (..., 2) along the axes of yaws (...)."""
    axes = np.stack([rotate(np.array([1.0, 0.0]), yaw_rad), rotate(np.array([0.0, 1.0]), yaw_rad)], axis=-1)
    return np.asarray(axes * (sigma_m**2)[..., None, :] @ np.swapaxes(axes, -1, -2))


def box_sigma(points: NDArray[np.int64], category: NDArray[np.str_]) -> Array:
    """Return the standard deviations (M, 2), m, along and across, of centers that a 3D detector estimates from so many points (M,)."""
    least = np.array([BOX_SIGMA_M[GROUP_OF[str(c)]] for c in category]).reshape(-1, 2)
    return np.asarray(least * np.sqrt(1 + BOX_SIGMA_POINTS / np.maximum(points, 1))[:, None])


def weighted_center(local: Array, sigma_m: Array, box_local: Array, box_sigma_m: Array) -> tuple[Array, Array]:
    """Average centers (..., 2) of completed boxes with those of a 3D detector by their variances along each axis.

    Where one of the two is NaN the other is taken.

    Returns `center`: (..., 2), m; `sigma_m`: (..., 2).
    """
    missing, unseen = np.isnan(box_local), np.isnan(local)
    share = np.where(missing, 0.0, np.where(unseen, 1.0, sigma_m**2 / (sigma_m**2 + box_sigma_m**2)))
    center = np.where(missing, local, np.where(unseen, box_local, local + share * (box_local - local)))
    return center, np.where(missing, sigma_m, np.sqrt(share) * box_sigma_m)


def provisional_sizes(evidence: BoxEvidence) -> Array:
    """Return length and width (M, 2) of a 3D detector, else the typical ones, or the observed extents where these are larger."""
    typical = np.array([TYPICAL_SIZE_M[str(c)][:2] for c in evidence.category]).reshape(-1, 2)
    known = np.where(np.isnan(evidence.box_size_m[:, :2]), typical, evidence.box_size_m[:, :2])
    return np.asarray(np.fmax(known, evidence.high_m - evidence.low_m))


def place_boxes(evidence: BoxEvidence) -> Measurements:
    """Place every row (M,) with LiDAR extents by completing its box with the typical size of its category.

    A box of a 3D detector gives the size instead, and its center is averaged with that of the completed box. Rows with
    neither extents nor box get no position. The position is provisional: see `Measurements`.
    """
    has_box = np.isfinite(evidence.box_yaw_rad)
    placed = np.isfinite(evidence.low_m[:, 0]) | has_box
    low, high, yaw, size = evidence.low_m, evidence.high_m, evidence.yaw_rad, provisional_sizes(evidence)
    real = real_ends(low, high, np.zeros_like(low), evidence.ends_visible)
    local, sigma = complete_box(low, high, size, real, has_box)
    width = np.array([TYPICAL_SIZE_M[str(c)][1] for c in evidence.category])
    # So short a side may be a front or a visible part of a flank, for which the centers differ.
    ambiguous = ((high - low).max(axis=1) <= MAX_WIDTH_FACTOR * width) & ~evidence.ends_visible.all(axis=1) & ~has_box
    extra = np.where(ambiguous, AXIS_AMBIGUITY_SHARE * (size[:, 0] - size[:, 1]), 0.0)
    box_local = rotate(evidence.box_center_m[:, :2] - evidence.sensor_m[:, :2], -yaw)
    local, sigma = weighted_center(local, sigma, box_local, box_sigma(evidence.points, evidence.category))
    xy = evidence.sensor_m[:, :2] + rotate(local, yaw)
    z = (evidence.bottom_m + evidence.top_m) / 2
    return Measurements(
        **{f.name: getattr(evidence, f.name) for f in fields(BoxEvidence)},
        center_m=np.column_stack([xy, z]),
        covariance=oriented_covariance(np.hypot(sigma, extra[:, None]), yaw),
        source=np.where(placed, "lidar", "").astype("<U16"),
    )
