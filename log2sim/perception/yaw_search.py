"""Yaws of clusters of points, many at once: the rectangle whose sides are nearest to the points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

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
    """Find the yaw of the rectangle whose sides are nearest to the points of each of M clusters, up to quarter turns.

    Parameters
    ----------
    xy_m : (N, 2) float64, m
        Points of the first cluster, then those of the next.
    count : (M,) int
        Number of points of each cluster, at least 1.

    Returns
    -------
    yaw_rad : (M,) float64
        In [0, pi/2).
    contrast : (M,) float64
        Score of the best direction over the median score, less 1: 0 for a round or shapeless cluster; below about
        `MIN_CONTRAST` the yaw carries no information.

    Notes
    -----
    Closeness criterion of Zhang, Xu, Dong & Dolan, "Efficient L-Shape Fitting for Vehicle Detection Using Laser
    Scanners" (IV 2017), section III-B: a point scores the inverse of its distance to the nearer side. Cost O(45 N), with
    the points of a cluster limited to `MAX_FIT_POINTS` by an even subsample.
    """
    angles = np.arange(0.0, np.pi / 2, SEARCH_STEP_RAD)
    score = _closeness(xy_m, count, np.broadcast_to(angles, (len(count), len(angles))), MAX_FIT_POINTS)
    best = score.argmax(axis=1)
    return _parabolic_peak(score, best) * SEARCH_STEP_RAD % (np.pi / 2), _contrast(score, best)


def correct_yaws(xy_m: Array, count: NDArray[np.intp], yaw_rad: Array) -> Array:
    """Correct yaws (M,) that are known roughly by the direction of the sides of M clusters, where these show it.

    Parameters are those of `fit_yaws`.
    """
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
    out = np.empty(angles.shape)
    for rows, points, valid in _chunks(xy, count, most, 2 * angles.shape[1]):
        c, s = np.cos(angles[rows]), np.sin(angles[rows])
        # Length axes, then width axes: (m, 2 K, 2).
        directions = np.concatenate([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=1, dtype=np.float32)
        distance = _edge_distance(directions @ points, valid)
        nearer = np.minimum(distance[:, : angles.shape[1]], distance[:, angles.shape[1] :])
        score = np.reciprocal(np.maximum(nearer, np.float32(MIN_EDGE_DISTANCE_M))) * valid[:, None]
        out[rows] = score.sum(axis=2) / valid.sum(axis=1)[:, None]
    return out


def _chunks(
    xy: Array, count: NDArray[np.intp], most: int, directions: int
) -> Iterator[tuple[slice, NDArray[np.float32], NDArray[np.bool_]]]:
    """Divide clusters so that each part fits into a cache: rows, points (m, 2, W), and which of these are points (m, W).

    Points are evenly spaced in their order, at most `most` of a cluster.
    """
    start, place = np.cumsum(count) - count, np.arange(most)
    # Single precision does for distances within a cluster, which directions tell whatever point they are measured from.
    columns = np.ascontiguousarray((xy - np.repeat(xy[start], count, axis=0)).T, dtype=np.float32)
    first = 0
    while first < len(count):
        size = max(MAX_OFFSETS // (directions * min(int(count[first:].max()), most)), 1)
        rows = slice(first, first + size)
        width = min(int(count[rows].max()), most)
        spaced = np.round(place[:width] * ((count[rows, None] - 1) / (most - 1))).astype(np.intp)
        chosen = np.where(count[rows, None] > most, spaced, place[:width])
        valid = place[:width] < count[rows, None]
        yield rows, columns[:, start[rows, None] + np.where(valid, chosen, 0)].transpose(1, 0, 2), valid
        first += size


def _edge_distance(offsets: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Measure the distance (M, K, W) of every valid value (M, W) to the nearer end of its row, without one stray value at each."""
    low = _lower_end(offsets, valid)[:, :, None]
    high = -_lower_end(-offsets, valid)[:, :, None]
    return np.asarray(np.minimum(np.abs(offsets - low), np.abs(high - offsets)))


def _lower_end(offsets: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the second lowest valid value (M, K) of every row, or the lowest of fewer than `MIN_POINTS_WITH_STRAY`."""
    values = offsets.copy() if valid.all() else np.where(valid[:, None], offsets, np.float32(np.inf))
    place = values.argmin(axis=2)[:, :, None]
    lowest = np.take_along_axis(values, place, axis=2)[:, :, 0]
    np.put_along_axis(values, place, np.inf, axis=2)
    return np.where(valid.sum(axis=1)[:, None] < MIN_POINTS_WITH_STRAY, lowest, values.min(axis=2))


def _parabolic_peak(score: Array, best: NDArray[np.intp]) -> Array:
    """Refine the index (M,) of the best of cyclic scores (M, K) by the parabola through it and its neighbors."""
    rows = np.arange(len(best))
    left, mid, right = (score[rows, (best + step) % score.shape[1]] for step in (-1, 0, 1))
    curvature = left - 2 * mid + right
    return np.asarray(best + np.divide(0.5 * (left - right), curvature, out=np.zeros(len(best)), where=curvature < 0))
