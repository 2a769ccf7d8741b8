"""Size and final positions of a track from the evidence of all its measurements.

A single sweep sees two sides of an object at best. Over a track each side may be seen from end to end at some time; these
lengths give one constant size, and the position at each measurement follows by aligning the whole box with the observed
ends.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.box_votes import independent, mean_box_axis, mean_box_center, typical_box_size, weighted_quantile
from log2sim.datatypes import CATEGORY, GROUP_OF, MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M, Measurements, Track
from log2sim.geometry import Array
from log2sim.perception import box_completion, box_fitting
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS

# Quantile of the lengths of fully observed sides that is taken for the size: stray points lengthen some, sparse points
# shorten most.
SIZE_QUANTILE = 0.85
# The same where the gaps between rays are taken into account: what is left is that parts were too dark or too low to be hit.
WHOLE_SIDE_QUANTILE = 0.7
# Points of a static object are persistent if so many of the ticks have points in their cell.
VOXEL_M = 0.15
MIN_PERSISTENT_SHARE = 0.15
MAX_POINTS_PER_TICK = 150
# Fewer persistent points do not show a shape.
MIN_STATIC_POINTS = 5
# Standard deviations of a side observed from end to end (stray points lengthen it, gaps between rays shorten it), and of the
# sizes that a 3D detector estimates, as a share.
WHOLE_SIDE_SIGMA_M, BOX_SIZE_SIGMA_SHARE = 0.15, 0.07
# A side that is shorter than the typical one by more standard deviations of its logarithm lacks a hood, a limb or a wheel.
MAX_SHORT_SIGMAS = 1.5
# A side seen at a smaller angle than this (sine) shows its near end only: its far end rests on few rays.
MIN_SIDE_SINE = 0.35
# Directive 96/53/EC, Annex I: 2.55 m, refrigerated vehicles 2.6 m; the United States allow 102 inches. What is beyond are mirrors.
MAX_ROAD_WIDTH_M = 2.6
# A length axis is told by the lengths of the sides if the odds are e to one.
CLEAR_LOG_ODDS = 1.0


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
    cloud = _persistent_points([c[:, :3] - origin for c in m.cluster])
    if len(cloud) < MIN_STATIC_POINTS:
        return _geometry_without_points(track)
    yaw, ends = _static_ends(track, cloud[:, :2], origin[:2])
    known = typical_box_size(m)
    size, is_likely = _estimate_size(ends, track.category, known)
    low, high, real, gap = (column[0] for column in (ends.low, ends.high, ends.real, ends.gap_m))
    center, sigma = box_completion.complete_box(low, high, size, real, known is not None, gap_m=gap)
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


@dataclass(frozen=True, eq=False)
class _Ends:
    """Ends of the points of an object along its length and width in n views.

    Attributes
    ----------
    low, high : (n, 2) float64, m
    real : (n, 2, 2) int
        Kinds of the ends, see `box_completion.real_ends`.
    gap_m : (n, 2, 2) float64
        Distances between rays there, see `box_completion.end_gaps`.
    """

    low: Array
    high: Array
    real: NDArray[np.int64]
    gap_m: Array

    def swapped(self) -> _Ends:
        """Return the ends along axes that are turned by a quarter turn."""
        low = np.stack([self.low[:, 1], -self.high[:, 0]], axis=1)
        high = np.stack([self.high[:, 1], -self.low[:, 0]], axis=1)
        real = np.stack([self.real[:, 1], self.real[:, 0, ::-1]], axis=1)
        gap_m = np.stack([self.gap_m[:, 1], self.gap_m[:, 0, ::-1]], axis=1)
        return _Ends(low, high, real, gap_m)


def _static_ends(track: Track, xy: Array, origin: Array) -> tuple[float, _Ends]:
    """Fit the yaw of the points (n, 2) of a static track and find the ends (one view) of all its views together."""
    m = track.measurements
    axis = mean_box_axis(m)
    yaw = box_fitting.fit_yaw(xy)[0] if axis is None else box_fitting.corrected_yaw(xy, axis)
    low, high = box_fitting.extents(xy, yaw, max_trim_m=box_fitting.MAX_TRIM_M)
    rows = np.flatnonzero([len(c) >= MIN_CLUSTER_POINTS for c in m.cluster])
    sensor = box_fitting.rotate(m.sensor_m[rows, :2] - origin, -yaw)
    views = box_completion.real_ends(low, high, sensor, m.ends_visible[rows], min_sine=MIN_SIDE_SINE)
    gaps = np.array([
        box_completion.end_gaps(
            box_fitting.rotate(m.cluster[k][:, :2] - m.sensor_m[k, :2], -yaw), low - at, high - at, real
        )
        for k, at, real in zip(rows, sensor, views)
    ])  # fmt: skip
    # An end that is real from one viewpoint is real, and known as well as from the best one.
    real = views.max(axis=0)
    gap = np.where(views == real, gaps, np.inf).min(axis=0)
    ends = _Ends(low[None], high[None], real[None], gap[None])
    if axis is None and _is_length_across(ends, box_fitting.rotate(m.sensor_m[:, :2] - origin, -yaw), track.category):
        return yaw + np.pi / 2, ends.swapped()
    return yaw, ends


def _is_length_across(ends: _Ends, sensor: Array, category: str) -> bool:
    """Decide whether the length of an object is the second axis of its ends (one view), seen from sensors (K, 2)."""
    low, high = (e[0] for e in box_completion.corner_correction(
        ends.low, ends.high, ends.real, np.array([TYPICAL_SIZE_M[category][1]]), gap_m=ends.gap_m
    ))  # fmt: skip
    whole = np.all(ends.real[0], axis=-1)
    doubt_m = box_completion.UNIFORM_SIGMA * ends.gap_m[0].sum(axis=-1)
    log_odds = box_fitting.swapped_log_odds(high - low, whole, doubt_m, category)
    if abs(log_odds) >= CLEAR_LOG_ODDS:
        return log_odds > 0
    typical = np.array(TYPICAL_SIZE_M[category])
    return box_fitting.axes_swapped(ends.high[0] - ends.low[0], sensor - (ends.low + ends.high) / 2, typical)


def _with_size_error(sigma_m: Array | float, box_size_m: Array | None, size_m: Array) -> Array:
    """Widen standard deviations of box centers by half the error of the box sizes (..., 3), given the true size (2,).

    A box of the wrong size has one end in its place at best.
    """
    error = np.zeros(2) if box_size_m is None else (box_size_m[..., :2] - size_m) / 2
    return np.hypot(sigma_m, error)


def moving_geometry(track: Track, yaw_rad: Array, velocity_mps: Array | None = None) -> TrackGeometry:
    """Estimate the size of a moving track, and its center at every measurement.

    Parameters
    ----------
    yaw_rad : (n,) float64
        Heading at every measurement.
    velocity_mps : (n, 2) float64, optional
        Velocity there, by which its points are moved to where they were at the time of the measurement: a LiDAR takes
        20 ms to sweep over a truck beside it, in which that goes on by 0.6 m at 30 m/s. Without it they stay.
    """
    m = track.measurements
    rows = np.flatnonzero([len(c) >= MIN_CLUSTER_POINTS for c in m.cluster])
    if len(rows) == 0:
        return _geometry_without_points(track)
    yaw, sensor = yaw_rad[rows], m.sensor_m[rows, :2]
    moved = np.zeros((len(m), 2)) if velocity_mps is None else velocity_mps
    ends = _join_ends([_ends_of(m, k, float(yaw_rad[k]), moved[k]) for k in rows.tolist()])
    size, is_likely = _estimate_size(ends, track.category, typical_box_size(m))
    has_box = np.isfinite(m.box_yaw_rad[rows])
    center, sigma = box_completion.complete_box(ends.low, ends.high, size, ends.real, has_box, gap_m=ends.gap_m)
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


def _ends_of(m: Measurements, k: int, yaw_rad: float, velocity_mps: Array) -> _Ends:
    """Find the ends of the points of measurement `k`, relative to its viewpoint, for an object that points along a yaw."""
    xy = m.cluster[k][:, :2] - m.sensor_m[k, :2]
    if m.cluster[k].shape[1] > 3:
        xy = xy - m.cluster[k][:, 3:] * velocity_mps
    low, high = box_fitting.extents(xy, yaw_rad, max_trim_m=box_fitting.MAX_TRIM_M)
    real = box_completion.real_ends(low, high, np.zeros(2), m.ends_visible[k], min_sine=MIN_SIDE_SINE)
    gap = box_completion.end_gaps(box_fitting.rotate(xy, -yaw_rad), low, high, real)
    return _Ends(low[None], high[None], real[None], gap[None])


def _join_ends(parts: list[_Ends]) -> _Ends:
    """Join the ends of several views."""
    return _Ends(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(_Ends)))


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


def _estimate_size(ends: _Ends, category: str, known: Array | None) -> tuple[Array, bool]:
    """Estimate length and width (2,) from the ends in n views, and whether they are likely.

    What was seen from end to end and what is expected, `known` (3,) from a 3D detector or typical of the category, are
    averaged by their variances. A side that was never seen so is as long as expected, or as the longest part that was seen.
    """
    typical, smallest, limit = (np.array(t[category][:2]) for t in (TYPICAL_SIZE_M, MIN_SIZE_M, MAX_SIZE_M))
    is_vehicle = GROUP_OF[category] == "vehicle"
    largest = np.minimum(limit, [np.inf, MAX_ROAD_WIDTH_M]) if is_vehicle else limit
    expected = np.minimum(typical if known is None else known[:2], largest)
    spread = np.log(limit / smallest) / box_fitting.LIMIT_SIGMAS
    enough, share = np.exp(-MAX_SHORT_SIGMAS * spread) * typical, spread if known is None else BOX_SIZE_SIGMA_SHARE
    low, high = box_completion.corner_correction(ends.low, ends.high, ends.real, expected[1], gap_m=ends.gap_m)
    seen, whole = high - low, np.all(ends.real, axis=2)
    variance = WHOLE_SIDE_SIGMA_M**2 + (box_completion.UNIFORM_SIGMA * ends.gap_m).sum(axis=2) ** 2
    least = np.quantile(ends.high - ends.low, SIZE_QUANTILE, axis=0)
    # What is shorter than a part that was seen at other times was not seen from end to end.
    used = whole & (seen + 2 * np.sqrt(variance) >= least) & (seen >= enough)
    size = expected.copy()
    for axis in np.flatnonzero(used.any(axis=0)):
        sides, error = seen[used[:, axis], axis], variance[used[:, axis], axis]
        error_of_all = error.min() / independent(len(sides))
        observed = weighted_quantile(sides, 1.0 / error, WHOLE_SIDE_QUANTILE)
        prior = (share * expected)[axis] ** 2
        size[axis] = observed + error_of_all / (error_of_all + prior) * (expected[axis] - observed)
    # What lies between two rays is no evidence.
    between = np.where(ends.real == box_completion.SIDE_END, ends.gap_m / 2, 0.0).sum(axis=2)
    is_likely = _is_likely_size(seen - between, whole, np.maximum(expected, least), category)
    return np.clip(np.maximum(size, least), smallest, largest), is_likely


def _is_likely_size(seen: Array, whole: NDArray[np.bool_], else_m: Array, category: str) -> bool:
    """Return whether an object can be of its category by the sides (n, 2) that were seen, else by what they are thought to be."""
    smallest, largest = (np.array(t[category][:2]) for t in (MIN_SIZE_M, MAX_SIZE_M))
    raw = np.array(
        [np.quantile(seen[whole[:, a], a], SIZE_QUANTILE) if whole[:, a].any() else else_m[a] for a in range(2)]
    )
    least = CATEGORY[category].min_seen_m
    if least is None:
        large_enough = bool((raw >= smallest).all())
    else:
        large_enough = raw.max(where=whole.any(axis=0), initial=0.0) >= least or not whole.any()
    return bool(large_enough and (raw <= largest).all())


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
