"""One constant size for every track, and its positions measured anew against it.

A single sweep sees two sides of an object at best. Over a track every side shows at some time, so lengths that were seen
whole are kept, and each position is found again by laying the whole box against the sides that were seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, TYPICAL_SIZE_M, Track
from log2sim.geometry import NS_PER_S, Array, wrap_angle
from log2sim.perception import box_fitting

# Share of the whole sides that are longer: stray points lengthen some, sparse points shorten most.
SIZE_QUANTILE = 0.85
# Farther to the left of a path than this is the oncoming side of the road.
ONCOMING_OFFSET_M = 1.8
VOXEL_M = 0.15
MIN_PERSISTENT_SHARE = 0.15
MAX_POINTS_PER_TICK = 150
# Sizes that exist, as factors of the typical one; what looks smaller than the likely ones (length, width, height) was
# hardly seen whole, or is something else.
MIN_SIZE_FACTOR, MAX_SIZE_FACTOR = 0.6, 1.6
MIN_WHOLE_SIDE_FACTOR = 0.75
MIN_LIKELY_FACTORS = np.array([0.65, 0.72, 0.75])

MAX_STATIC_SPEED_MPS = {"vehicle": 0.35, "two_wheeler": 0.3, "pedestrian": 0.2, "other": 0.35}
MAX_STATIC_DRIFT_M = {"vehicle": 1.2, "two_wheeler": 0.8, "pedestrian": 0.5, "other": 1.2}


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


def is_static(track: Track) -> bool:
    """Whether a track never moves: its robust mean velocity and its drift stay within what changing views explain."""
    m, group = track.measurements, GROUP_OF[track.category]
    if len(m) < 3:
        return group == "vehicle"
    t = (m.t_ns - m.t_ns[0]) / NS_PER_S
    xy = m.center_m[:, :2]
    third = max(len(m) // 3, 1)
    drift = np.median(xy[-third:], axis=0) - np.median(xy[:third], axis=0)
    span = np.median(t[-third:]) - np.median(t[:third])
    # Where little of it shows its center is a guess, so what the covariance explains is no motion.
    guess = 2 * np.sqrt(np.linalg.eigvalsh(m.covariance)[:, -1])
    spread = np.quantile(np.hypot(*(xy - np.median(xy, axis=0)).T) - guess, 0.9)
    moved = float(np.hypot(*drift))
    slow = moved < MAX_STATIC_SPEED_MPS[group] * max(float(span), 1e-9) or moved < 0.35
    return bool(slow and moved < MAX_STATIC_DRIFT_M[group] and spread < 1.5 * MAX_STATIC_DRIFT_M[group])


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
    low, high = box_fitting.extents(cloud[:, :2], yaw)
    if box_fitting.axes_swapped(high - low, box_fitting.rotate(sensor, -yaw), typical):
        yaw += np.pi / 2
        low, high = box_fitting.extents(cloud[:, :2], yaw)
    local = box_fitting.rotate(sensor, -yaw)
    with_points = [k for k, c in enumerate(m.cluster) if len(c)]
    shown = np.array([box_fitting.real_ends(low, high, local[k], m.ends_visible[k]) for k in with_points]).max(axis=0)
    size, fits = _estimate_size(low[None], high[None], shown[None], typical[:2])
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
        lows[k], highs[k] = box_fitting.extents(m.cluster[k][:, :2] - origin, yaw)
        sensors[k] = box_fitting.rotate(m.sensor_m[k, :2] - origin, -yaw)
        shown[k] = box_fitting.real_ends(lows[k], highs[k], sensors[k], m.ends_visible[k])
    size, fits = _estimate_size(lows[with_points], highs[with_points], shown[with_points], typical[:2])
    xy, covariance = m.center_m[:, :2].copy(), m.covariance.copy()
    for k in with_points:
        yaw = float(yaw_rad[k])
        center, sigma = box_fitting.place_box(lows[k], highs[k], size, shown[k])
        xy[k] = box_fitting.rotate(center, yaw) + m.center_m[k, :2]
        covariance[k] = box_fitting.oriented_covariance(sigma, yaw)
    height, z = _height(track)
    return TrackGeometry(np.append(size, height), xy, covariance, z, None, fits and _is_tall_enough(height, typical))


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


def _estimate_size(low: Array, high: Array, shown: NDArray[np.int64], typical: Array) -> tuple[Array, bool]:
    """Length and width (2,) from ends (n, 2), (n, 2) of which some are real (n, 2, 2), and whether such an object exists."""
    low, high = box_fitting.corner_correction(low, high, shown, typical[1])
    seen = high - low
    whole: NDArray[np.bool_] = np.all(shown, axis=2)
    size, raw = np.empty(2), np.empty(2)
    for axis in range(2):
        every = seen[:, axis]
        ends = every[whole[:, axis]]
        raw[axis] = np.quantile(ends if len(ends) else np.maximum(every, typical[axis]), SIZE_QUANTILE)
        # A side shorter than any such object's was not seen from end to end after all.
        ends = ends[ends >= MIN_WHOLE_SIDE_FACTOR * typical[axis]]
        size[axis] = (
            np.quantile(ends, SIZE_QUANTILE) if len(ends) else max(typical[axis], np.quantile(every, SIZE_QUANTILE))
        )
    likely = bool(((raw >= MIN_LIKELY_FACTORS[:2] * typical) & (raw <= MAX_SIZE_FACTOR * typical)).all())
    return np.clip(size, MIN_SIZE_FACTOR * typical, MAX_SIZE_FACTOR * typical), likely


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
    height = float(np.clip(height, MIN_SIZE_FACTOR * typical, MAX_SIZE_FACTOR * typical))
    return height, bottom + height / 2


def _is_tall_enough(height: float, typical: Array) -> bool:
    return bool(height >= MIN_LIKELY_FACTORS[2] * typical[2])


def _geometry_without_points(track: Track, typical: Array) -> TrackGeometry:
    m = track.measurements
    height, z = _height(track)
    yaw = float(np.nanmedian(m.yaw_rad)) if np.isfinite(m.yaw_rad).any() else None
    return TrackGeometry(np.append(typical[:2], height), m.center_m[:, :2], m.covariance, z, yaw)


def parked_heading(yaw_rad: float, xy: Array, flow: Array, *, reach_m: float = 40.0) -> float:
    """Choose between the two directions of a standing vehicle: it points the way the traffic of its side goes.

    `flow` (K, 3) holds x, y and heading of vehicles that moved; without any near enough the yaw stays as it is.

    Notes
    -----
    Traffic keeps right: what stands to the right of a moving vehicle's path points along it, what stands clearly to its
    left points against it. Each moment of each path votes, the nearer to the side the more.
    """
    if len(flow) == 0:
        return float(wrap_angle(yaw_rad))
    to = xy - flow[:, :2]
    c, s = np.cos(flow[:, 2]), np.sin(flow[:, 2])
    along, left = to[:, 0] * c + to[:, 1] * s, -to[:, 0] * s + to[:, 1] * c
    near = (np.abs(np.cos(flow[:, 2] - yaw_rad)) > 0.7) & (np.abs(along) < reach_m) & (np.abs(left) < reach_m / 3)
    if not near.any():
        return float(wrap_angle(yaw_rad))
    side = np.where(left[near] > ONCOMING_OFFSET_M, -1.0, 1.0)
    weight = 1.0 / (1.0 + np.abs(left[near]) / 2 + np.abs(along[near]) / 10) ** 2
    vote = np.sum(weight * side * np.sign(np.cos(flow[near, 2] - yaw_rad)))
    return float(wrap_angle(yaw_rad if vote >= 0 else yaw_rad + np.pi))
