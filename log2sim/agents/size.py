"""One constant size for every track, and its positions measured anew against it.

A single sweep sees two sides of an object at best. Over a track every side shows at some time, so lengths that were seen
whole are kept, and each position is found again by laying the whole box against the sides that were seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M, Track
from log2sim.geometry import Array
from log2sim.perception import box_fitting

# Share of the whole sides that are longer: stray points lengthen some, sparse points shorten most.
SIZE_QUANTILE = 0.85
# Stray points lie outside an object by less than this.
MAX_TRIM_M = 0.1
VOXEL_M = 0.15
MIN_PERSISTENT_SHARE = 0.15
MAX_POINTS_PER_TICK = 150
# A side shorter than this share of the typical one was hardly seen from end to end.
MIN_WHOLE_SIDE_FACTOR = 0.75


@dataclass(frozen=True, eq=False)
class TrackGeometry:
    """What a track looks like: `size_m` (3,), and at each of its measurements `xy_m` (n, 2), `covariance` (n, 2, 2),
    `z_m` (n,) of the center, and for a standing one `yaw_rad`, up to half turns. `typical` False: what was seen of it is
    smaller or larger than its category can be, so that it hardly is one.
    """

    size_m: Array
    xy_m: Array
    covariance: Array
    z_m: Array
    yaw_rad: float | None = None
    typical: bool = True


def static_geometry(track: Track) -> TrackGeometry:
    """One pose and size of a track that stands still, from all its points together."""
    m = track.measurements
    origin = np.append(np.median(m.center_m[:, :2], axis=0), 0.0)
    cloud = _persistent_points([c - origin for c in m.cluster])
    sensor = m.sensor_m[:, :2] - origin[:2]
    typical = np.array(TYPICAL_SIZE_M[track.category])
    if len(cloud) < 5:
        return _geometry_without_points(track, typical)
    yaw, _ = box_fitting.fit_yaw(cloud[:, :2])
    low, high = box_fitting.extents(cloud[:, :2], yaw, max_trim_m=MAX_TRIM_M)
    if box_fitting.axes_swapped(high - low, box_fitting.rotate(sensor, -yaw), typical):
        yaw += np.pi / 2
        low, high = box_fitting.extents(cloud[:, :2], yaw, max_trim_m=MAX_TRIM_M)
    local = box_fitting.rotate(sensor, -yaw)
    with_points = [k for k, c in enumerate(m.cluster) if len(c)]
    shown = np.array([box_fitting.real_ends(low, high, local[k], m.ends_visible[k]) for k in with_points]).max(axis=0)
    size, fits = _estimate_size(low[None], high[None], shown[None], track.category)
    centers, sigmas = box_fitting.place_box(low, high, size, shown)
    center = box_fitting.rotate(centers, yaw) + origin[:2]
    height, z = _height(track)
    covariance = box_fitting.oriented_covariance(sigmas, yaw)
    n = len(m)
    covariance = np.tile(covariance, (n, 1, 1))
    return TrackGeometry(
        np.append(size, height), np.tile(center, (n, 1)), covariance, np.full(n, np.median(z)), float(yaw), fits
    )


def moving_geometry(track: Track, yaw_rad: Array) -> TrackGeometry:
    """Size of a moving track and its center at every measurement, given its heading (n,) there."""
    m = track.measurements
    typical = np.array(TYPICAL_SIZE_M[track.category])
    with_points = np.flatnonzero([len(c) >= 4 for c in m.cluster])
    if len(with_points) == 0:
        return _geometry_without_points(track, typical)
    lows, highs, sensors = np.zeros((len(m), 2)), np.zeros((len(m), 2)), np.zeros((len(m), 2))
    shown = np.zeros((len(m), 2, 2), dtype=np.int64)
    for k in with_points:
        yaw, origin = float(yaw_rad[k]), m.center_m[k, :2]
        lows[k], highs[k] = box_fitting.extents(m.cluster[k][:, :2] - origin, yaw, max_trim_m=MAX_TRIM_M)
        sensors[k] = box_fitting.rotate(m.sensor_m[k, :2] - origin, -yaw)
        shown[k] = box_fitting.real_ends(lows[k], highs[k], sensors[k], m.ends_visible[k])
    size, fits = _estimate_size(lows[with_points], highs[with_points], shown[with_points], track.category)
    xy, covariance = m.center_m[:, :2].copy(), m.covariance.copy()
    for k in with_points:
        yaw = float(yaw_rad[k])
        center, sigma = box_fitting.place_box(lows[k], highs[k], size, shown[k])
        xy[k] = box_fitting.rotate(center, yaw) + m.center_m[k, :2]
        covariance[k] = box_fitting.oriented_covariance(sigma, yaw)
    height, z = _height(track)
    return TrackGeometry(
        np.append(size, height), xy, covariance, z, None, fits and height > MIN_SIZE_M[track.category][2]
    )


def _persistent_points(clusters: list[NDArray[np.float64]]) -> Array:
    """Points (n, 3) of cells that several ticks saw, so that what a neighbor lent to one tick falls out."""
    clusters = [box_fitting.subsample(c, MAX_POINTS_PER_TICK) for c in clusters if len(c)]
    if not clusters:
        return np.zeros((0, 3))
    points = np.concatenate(clusters)
    tick = np.repeat(np.arange(len(clusters)), [len(c) for c in clusters])
    cell = np.floor(points[:, :2] / VOXEL_M).astype(np.int64)
    _, key = np.unique(cell, axis=0, return_inverse=True)
    seen = np.unique(np.stack([key.ravel(), tick], axis=1), axis=0)
    count = np.bincount(seen[:, 0])
    return points[count[key.ravel()] >= max(MIN_PERSISTENT_SHARE * len(clusters), min(2, len(clusters)))]


def _estimate_size(low: Array, high: Array, shown: NDArray[np.int64], category: str) -> tuple[Array, bool]:
    """Length and width (2,) from ends (n, 2), (n, 2) of which some are real (n, 2, 2), and whether such an object exists."""
    typical, smallest, largest = (np.array(t[category][:2]) for t in (TYPICAL_SIZE_M, MIN_SIZE_M, MAX_SIZE_M))
    low, high = box_fitting.corner_correction(low, high, shown, typical[1])
    seen = high - low
    whole: NDArray[np.bool_] = np.all(shown, axis=2)
    size, raw = np.empty(2), np.empty(2)
    for axis in range(2):
        every = seen[:, axis]
        ends = every[whole[:, axis]]
        raw[axis] = np.quantile(ends if len(ends) else np.maximum(every, typical[axis]), SIZE_QUANTILE)
        ends = ends[ends >= MIN_WHOLE_SIDE_FACTOR * typical[axis]]
        size[axis] = (
            np.quantile(ends, SIZE_QUANTILE) if len(ends) else max(typical[axis], np.quantile(every, SIZE_QUANTILE))
        )
    likely = bool(((raw >= smallest) & (raw <= largest)).all())
    return np.clip(size, smallest, largest), likely


def _height(track: Track) -> tuple[float, Array]:
    """Height of the object and z (n,) of its center: points reach its top where the LiDAR looks that high."""
    m = track.measurements
    bottom = m.center_m[:, 2] - m.size_m[:, 2] / 2
    tops = np.array(
        [float(np.quantile(c[:, 2], 0.98)) - b if len(c) >= 4 else np.nan for c, b in zip(m.cluster, bottom)]
    )
    images = np.where(m.truncated, np.nan, m.height_px_m)
    typical = TYPICAL_SIZE_M[track.category][2]
    by_lidar = float(np.nanquantile(tops, SIZE_QUANTILE)) if np.isfinite(tops).any() else typical
    by_image = float(np.nanmedian(images)) if np.isfinite(images).any() else typical
    height = max(by_lidar, min(by_image, 1.15 * by_lidar))
    height = float(np.clip(height, MIN_SIZE_M[track.category][2], MAX_SIZE_M[track.category][2]))
    return height, bottom + height / 2


def _geometry_without_points(track: Track, typical: Array) -> TrackGeometry:
    m = track.measurements
    height, z = _height(track)
    yaw = float(np.nanmedian(m.yaw_rad)) if np.isfinite(m.yaw_rad).any() else None
    return TrackGeometry(np.append(typical[:2], height), m.center_m[:, :2], m.covariance, z, yaw)
