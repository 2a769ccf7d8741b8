"""Size and final positions of a track from the evidence of all its measurements.

A single sweep sees two sides of an object at best. Over a track each side may be seen from end to end at some time; these
lengths give one constant size, and the position at each measurement follows by aligning the whole box with the observed
ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.box_votes import mean_box_axis, mean_box_center, typical_box_size
from log2sim.datatypes import CATEGORY, MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M, Track
from log2sim.geometry import Array
from log2sim.perception import box_completion, box_fitting
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS

# Quantile of the lengths of fully observed sides that is taken for the size: stray points lengthen some, sparse points
# shorten most.
SIZE_QUANTILE = 0.85
# Stray points are outside an object by less than this.
MAX_TRIM_M = 0.1
# Points of a static object are persistent if so many of the ticks have points in their cell.
VOXEL_M = 0.15
MIN_PERSISTENT_SHARE = 0.15
MAX_POINTS_PER_TICK = 150
# Fewer persistent points do not show a shape.
MIN_STATIC_POINTS = 5
# Standard deviations of a side observed from end to end (stray points lengthen it, gaps between rays shorten it), and of the
# sizes that a 3D detector estimates, as a share.
WHOLE_SIDE_SIGMA_M, BOX_SIZE_SIGMA_SHARE = 0.15, 0.07
# A side shorter than this share of the typical one was not observed from end to end.
MIN_WHOLE_SIDE_FACTOR = 0.75


@dataclass(frozen=True, eq=False)
class TrackGeometry:
    """Size of a track, and the center of its box at each of its n measurements.

    Attributes
    ----------
    size_m : (3,) float64
        Length, width, height.
    xy_m : (n, 2) float64
    covariance : (n, 2, 2) float64
        Of `xy_m`, m2.
    z_m : (n,) float64
    yaw_rad : float, optional
        Of a static track, up to half turns.
    is_likely : bool
        Whether the observed size is one of its category.
    """

    size_m: Array
    xy_m: Array
    covariance: Array
    z_m: Array
    yaw_rad: float | None = None
    is_likely: bool = True


def static_geometry(track: Track) -> TrackGeometry:
    """Estimate one pose and size of a static track from all its points together."""
    m = track.measurements
    origin = np.append(np.median(m.center_m[:, :2], axis=0), 0.0)
    cloud = _persistent_points([c - origin for c in m.cluster])
    if len(cloud) < MIN_STATIC_POINTS:
        return _geometry_without_points(track)
    sensor = m.sensor_m[:, :2] - origin[:2]
    yaw, low, high = _static_extents(track, cloud[:, :2], sensor)
    with_points = np.array([len(c) > 0 for c in m.cluster])
    views = box_fitting.rotate(sensor[with_points], -yaw)
    # An end that is real from one viewpoint is real.
    real = box_completion.real_ends(low, high, views, m.ends_visible[with_points]).max(axis=0)
    known = typical_box_size(m)
    size, is_likely = _estimate_size(low[None], high[None], real[None], track.category, known)
    center, sigma = box_completion.complete_box(low, high, size, real, known is not None)
    box_xy, box_sigma_m = mean_box_center(m)
    center, sigma = box_completion.weighted_center(
        center, sigma, box_fitting.rotate(box_xy - origin[:2], -yaw), _with_size_error(box_sigma_m, known, size)
    )
    height, z = _height(track)
    n = len(m)
    return TrackGeometry(
        np.append(size, height),
        np.tile(box_fitting.rotate(center, yaw) + origin[:2], (n, 1)),
        np.tile(box_completion.oriented_covariance(sigma, yaw), (n, 1, 1)),
        np.full(n, np.median(z)),
        float(yaw),
        is_likely and _is_likely_height(size, height, track.category),
    )


def _static_extents(track: Track, xy: Array, sensor: Array) -> tuple[float, Array, Array]:
    """Fit yaw and ends (2,), (2,) of the points (n, 2) of a static track, seen from sensors (K, 2)."""
    axis = mean_box_axis(track.measurements)
    yaw = box_fitting.fit_yaw(xy)[0] if axis is None else box_fitting.corrected_yaw(xy, axis)
    low, high = box_fitting.extents(xy, yaw, max_trim_m=MAX_TRIM_M)
    typical = np.array(TYPICAL_SIZE_M[track.category])
    if axis is None and box_fitting.axes_swapped(high - low, box_fitting.rotate(sensor, -yaw), typical):
        yaw += np.pi / 2
        low, high = box_fitting.extents(xy, yaw, max_trim_m=MAX_TRIM_M)
    return yaw, low, high


def _with_size_error(sigma_m: Array | float, box_size_m: Array | None, size_m: Array) -> Array:
    """Widen standard deviations of box centers by half the error of the box sizes (..., 3), given the true size (2,).

    A box of the wrong size has one end in its place at best.
    """
    error = np.zeros(2) if box_size_m is None else (box_size_m[..., :2] - size_m) / 2
    return np.hypot(sigma_m, error)


def moving_geometry(track: Track, yaw_rad: Array) -> TrackGeometry:
    """Estimate the size of a moving track, and its center at every measurement, given its heading (n,) there."""
    m = track.measurements
    rows = np.flatnonzero([len(c) >= MIN_CLUSTER_POINTS for c in m.cluster])
    if len(rows) == 0:
        return _geometry_without_points(track)
    yaw, sensor = yaw_rad[rows], m.sensor_m[rows, :2]
    xy_of = {k: m.cluster[k][:, :2] - m.sensor_m[k, :2] for k in rows}
    ends = [box_fitting.extents(xy_of[k], float(yaw_rad[k]), max_trim_m=MAX_TRIM_M) for k in rows]
    low, high = (np.array(e) for e in zip(*ends))
    real = box_completion.real_ends(low, high, np.zeros_like(low), m.ends_visible[rows])
    size, is_likely = _estimate_size(low, high, real, track.category, typical_box_size(m))
    has_box = np.isfinite(m.box_yaw_rad[rows])
    center, sigma = box_completion.complete_box(low, high, size, real, has_box)
    center, sigma = box_completion.weighted_center(
        center,
        sigma,
        box_fitting.rotate(m.box_center_m[rows, :2] - sensor, -yaw),
        _with_size_error(box_completion.box_sigma(m.points[rows])[:, None], m.box_size_m[rows], size),
    )
    xy, covariance = m.center_m[:, :2].copy(), m.covariance.copy()
    xy[rows] = box_fitting.rotate(center, yaw) + sensor
    covariance[rows] = box_completion.oriented_covariance(sigma, yaw)
    height, z = _height(track)
    is_likely = is_likely and height > MIN_SIZE_M[track.category][2]
    is_likely = is_likely and _is_likely_height(size, height, track.category)
    return TrackGeometry(np.append(size, height), xy, covariance, z, None, is_likely)


def _is_likely_height(size_m: Array, height_m: float, category: str) -> bool:
    """Return whether the height fits the category and the length (2,) and width of the object."""
    return bool(size_m.max() <= CATEGORY[category].max_length_per_height * height_m)


def _persistent_points(clusters: list[NDArray[np.float64]]) -> Array:
    """Keep the points (n, 3) of cells with points at several ticks, without those that belong to a neighbor at a single one."""
    clusters = [box_fitting.subsample(c, MAX_POINTS_PER_TICK) for c in clusters if len(c)]
    if not clusters:
        return np.zeros((0, 3))
    points = np.concatenate(clusters)
    tick = np.repeat(np.arange(len(clusters)), [len(c) for c in clusters])
    cell = np.floor(points[:, :2] / VOXEL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    # Cell and tick in one number: sorting numbers is ten times as fast as sorting rows.
    _, key = np.unique(cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1], return_inverse=True)
    count = np.bincount(np.unique(key * len(clusters) + tick) // len(clusters))
    return points[count[key] >= max(MIN_PERSISTENT_SHARE * len(clusters), min(2, len(clusters)))]


def _estimate_size(
    low: Array, high: Array, real: NDArray[np.int64], category: str, known: Array | None
) -> tuple[Array, bool]:
    """Estimate length and width (2,) from ends (n, 2), (n, 2) of which some are real (n, 2, 2), and whether they are likely.

    A side of which never both ends were observed is `known` (3,) from a 3D detector, or typical of the category. What
    was observed and what is known are averaged by their variances.
    """
    typical, smallest, largest = (np.array(t[category][:2]) for t in (TYPICAL_SIZE_M, MIN_SIZE_M, MAX_SIZE_M))
    typical = typical if known is None else known[:2]
    low, high = box_completion.corner_correction(low, high, real, typical[1])
    seen = high - low
    whole: NDArray[np.bool_] = np.all(real, axis=2)
    size, raw = np.empty(2), np.empty(2)
    for axis in range(2):
        every = seen[:, axis]
        ends = every[whole[:, axis]]
        raw[axis] = np.quantile(ends if len(ends) else np.maximum(every, typical[axis]), SIZE_QUANTILE)
        ends = ends[ends >= MIN_WHOLE_SIDE_FACTOR * typical[axis]]
        size[axis] = (
            np.quantile(ends, SIZE_QUANTILE) if len(ends) else max(typical[axis], np.quantile(every, SIZE_QUANTILE))
        )
        if known is not None:
            known_variance = (BOX_SIZE_SIGMA_SHARE * known[axis]) ** 2
            share = WHOLE_SIDE_SIGMA_M**2 / (WHOLE_SIDE_SIGMA_M**2 + known_variance)
            size[axis] += share * (known[axis] - size[axis])
    least = CATEGORY[category].min_seen_m
    if least is None:
        large_enough = bool((raw >= smallest).all())
    else:
        large_enough = raw.max(where=whole.any(axis=0), initial=0.0) >= least or not whole.any()
    likely = bool(large_enough and (raw <= largest).all())
    return np.clip(size, smallest, largest), likely


def _height(track: Track) -> tuple[float, Array]:
    """Estimate the height of the object and z (n,) of its center: points reach its top where the LiDAR sees that high."""
    m = track.measurements
    by_lidar_m = (m.top_m - m.bottom_m)[[len(c) >= MIN_CLUSTER_POINTS for c in m.cluster]]
    by_image_m = np.where(m.truncated, np.nan, m.height_px_m)
    known = typical_box_size(m)
    typical = TYPICAL_SIZE_M[track.category][2] if known is None else float(known[2])
    by_lidar = float(np.quantile(by_lidar_m, SIZE_QUANTILE)) if len(by_lidar_m) else typical
    by_image = float(np.nanmedian(by_image_m)) if np.isfinite(by_image_m).any() else typical
    height = max(by_lidar, min(by_image, 1.15 * by_lidar))
    height = float(np.clip(height, MIN_SIZE_M[track.category][2], MAX_SIZE_M[track.category][2]))
    return height, m.bottom_m + height / 2


def _geometry_without_points(track: Track) -> TrackGeometry:
    """Take the size of a 3D detector or the typical one, and the provisional positions."""
    m, typical = track.measurements, np.array(TYPICAL_SIZE_M[track.category])
    known, yaw = typical_box_size(m), mean_box_axis(m)
    typical = typical if known is None else known
    height, z = _height(track)
    if yaw is None and np.isfinite(m.yaw_rad).any():
        yaw = float(np.nanmedian(m.yaw_rad))
    return TrackGeometry(np.append(typical[:2], height), m.center_m[:, :2], m.covariance, z, yaw)
