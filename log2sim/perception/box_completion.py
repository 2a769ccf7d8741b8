"""Completion of partly observed boxes: which ends are real, and where the whole box is.

All functions work in the length and width axes of the boxes; leading dimensions (...) are boxes.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import TYPICAL_SIZE_M, BoxEvidence, Measurements
from log2sim.geometry import Array
from log2sim.perception.box_fitting import MAX_WIDTH_FACTOR, rotate

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
# Standard deviation of a center that a 3D detector estimates, per axis: with many points, and the number of points with which
# its variance is twice that.
BOX_SIGMA_M, BOX_SIGMA_POINTS = 0.2, 20.0
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

    Parameters
    ----------
    low, high : (..., 2) float64, m
        Ends of the observed points along each axis.
    sensor : (..., 2) float64, m
        Viewpoint, in the same axes.
    ends_visible : (..., 2) bool
        Whether the right and the left end of the points, as seen from the sensor, are ends of the object.
    min_sine : float
        Of the angle at which a side is seen: below it only the near end is taken for one; lower where the distances
        between rays are taken into account (`end_gaps`).

    Returns
    -------
    real : (..., 2, 2) int
        For each axis, the kind of its lower and upper end: `FACING_END` for a side that faces the sensor, `SIDE_END` for
        one observed from the side, 0 where the box may extend beyond the points.

    Notes
    -----
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

    Parameters
    ----------
    step_rad : (...) float64, rad
        Angle between neighboring rays, from `box_fitting.azimuth_step_rad`.
    low, high : (..., 2) float64, m
        Ends of the extents along the length and the width, relative to the sensor.
    real : (..., 2, 2) int
        From `real_ends`.

    Notes
    -----
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

    Parameters
    ----------
    low, high : (..., 2) float64, m
        Ends of the observed points along each axis.
    size_m : (2,) or (..., 2) float64, m
        Length and width of the whole box.
    real : (..., 2, 2) int
        Kinds of the ends, see `real_ends`.
    known : (...) bool
        Whether a 3D detector gives the size, so that what is added to the points beyond a real end is no guess.
    gap_m : (..., 2, 2) float64, m
        From `end_gaps`.

    Returns
    -------
    center : (..., 2) float64, m
    sigma_m : (..., 2) float64
        Its standard deviation along each axis.

    Notes
    -----
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
    outward = np.where(real == SIDE_END, _rounding(width_m) + np.asarray(gap_m) / 2, 0.0)
    return np.asarray(low - outward[..., 0]), np.asarray(high + outward[..., 1])


def _rounding(width_m: Array | float) -> Array:
    """Return how far inside the corner of a box of a width (...) its outermost point is: (..., 1, 1), m."""
    width = np.asarray(width_m)[..., None, None]
    return np.asarray(np.where(width < MIN_BOX_WIDTH_M, CORNER_ROUNDING_SHARE, BOX_CORNER_ROUNDING_SHARE) * width)


def oriented_covariance(sigma_m: Array, yaw_rad: Array | float) -> Array:
    """Build covariances (..., 2, 2) of positions with standard deviations (..., 2) along the axes of yaws (...)."""
    axes = np.stack([rotate(np.array([1.0, 0.0]), yaw_rad), rotate(np.array([0.0, 1.0]), yaw_rad)], axis=-1)
    return np.asarray(axes * (sigma_m**2)[..., None, :] @ np.swapaxes(axes, -1, -2))


def box_sigma(points: NDArray[np.int64]) -> Array:
    """Return the standard deviations (M,), m, of centers that a 3D detector estimates from so many points (M,)."""
    return np.asarray(BOX_SIGMA_M * np.sqrt(1 + BOX_SIGMA_POINTS / np.maximum(points, 1)))


def weighted_center(local: Array, sigma_m: Array, box_local: Array, box_sigma_m: Array) -> tuple[Array, Array]:
    """Average centers (..., 2) of completed boxes with those of a 3D detector by their variances along each axis.

    Where one of the two is NaN the other is taken.

    Returns
    -------
    center : (..., 2) float64, m
    sigma_m : (..., 2) float64
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
    local, sigma = weighted_center(local, sigma, box_local, box_sigma(evidence.points)[:, None])
    xy = evidence.sensor_m[:, :2] + rotate(local, yaw)
    z = (evidence.bottom_m + evidence.top_m) / 2
    return Measurements(
        **{f.name: getattr(evidence, f.name) for f in fields(BoxEvidence)},
        center_m=np.column_stack([xy, z]),
        covariance=oriented_covariance(np.hypot(sigma, extra[:, None]), yaw),
        source=np.where(placed, "lidar", "").astype("<U16"),
    )
