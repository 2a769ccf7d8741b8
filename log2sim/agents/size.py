"""Size and final positions of a track from the evidence of all its measurements.

A single sweep sees two sides of an object at best. Over a track each side may be seen from end to end at some time; these
lengths give one constant size, and the position at each measurement follows by aligning the whole box with the observed
ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.box_votes import independent, mean_box_axis, mean_box_center, typical_box_size, weighted_quantile
from log2sim.agents.ends import Ends, ends_of, persistent_points, static_ends
from log2sim.datatypes import CATEGORY, GROUP_OF, MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M, Track
from log2sim.geometry import Array
from log2sim.perception import box_completion, box_fitting
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS

# Quantile of the lengths of fully observed sides that is taken for the size: stray points lengthen some, sparse points
# shorten most.
SIZE_QUANTILE = 0.85
# The same where the gaps between rays are taken into account: what is left is that parts were too dark or too low to be hit.
WHOLE_SIDE_QUANTILE = 0.7
# Fewer persistent points do not show a shape.
MIN_STATIC_POINTS = 5
# Standard deviations of a side observed from end to end (stray points lengthen it, gaps between rays shorten it), and of the
# sizes that a 3D detector estimates, as a share.
WHOLE_SIDE_SIGMA_M, BOX_SIZE_SIGMA_SHARE = 0.15, 0.07
# A side that is shorter than the typical one by more standard deviations of its logarithm lacks a hood, a limb or a wheel.
MAX_SHORT_SIGMAS = 1.5
# Directive 96/53/EC, Annex I: 2.55 m, refrigerated vehicles 2.6 m; the United States allow 102 inches. What is beyond are mirrors.
MAX_ROAD_WIDTH_M = 2.6
# The same allows a height of 4.0 m, and lengths of 12 m for rigid and 16.5 m for articulated vehicles, between which a truck of
# that height is expected.
HIGHEST_TRUCK_M, HIGHEST_TRUCK_LENGTH_M = 4.0, 14.25


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
    cloud = persistent_points([m.points_of(k) - origin for k in range(len(m))])
    if len(cloud) < MIN_STATIC_POINTS:
        return _geometry_without_points(track)
    yaw, ends = static_ends(track, cloud[:, :2], origin[:2])
    known = typical_box_size(m)
    height, z = _height(track)
    size, is_likely = _estimate_size(ends, track.category, height, known)
    low, high, real, gap = (column[0] for column in (ends.low, ends.high, ends.real, ends.gap_m))
    center, sigma = box_completion.complete_box(low, high, size, real, known is not None, gap_m=gap)
    box_xy, box_sigma_m = mean_box_center(m)
    center, sigma = box_completion.weighted_center(
        center, sigma, box_fitting.rotate(box_xy - origin[:2], -yaw), _with_size_error(box_sigma_m, known, size)
    )
    n = len(m)
    return TrackGeometry(
        np.append(size, height),
        np.tile(box_fitting.rotate(center, yaw) + origin[:2], (n, 1)),
        np.tile(box_completion.oriented_covariance(sigma, yaw), (n, 1, 1)),
        np.full(n, np.median(z)),
        float(yaw),
        is_likely and _is_likely_height(size, height, track.category),
    )


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
    ends = ends_of(track, rows, yaw, moved[rows])
    height, z = _height(track)
    size, is_likely = _estimate_size(ends, track.category, height, typical_box_size(m))
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
    is_likely = is_likely and height > MIN_SIZE_M[track.category][2]
    is_likely = is_likely and _is_likely_height(size, height, track.category)
    return TrackGeometry(np.append(size, height), xy, covariance, z, None, is_likely)


def _is_likely_height(size_m: Array, height_m: float, category: str) -> bool:
    """Return whether the height fits the category and the length (2,) and width of the object."""
    return bool(size_m.max() <= CATEGORY[category].max_length_per_height * height_m)


def _estimate_size(ends: Ends, category: str, height_m: float, known: Array | None) -> tuple[Array, bool]:
    """Estimate length and width (2,) from the ends in n views, and whether they are likely.

    What was seen from end to end and what is expected, `known` (3,) from a 3D detector or typical of the category, are
    averaged by their variances. A side that was never seen so is as long as expected, or as the longest part that was seen.
    """
    typical = _typical_sides(category, height_m)
    smallest, limit = (np.array(t[category][:2]) for t in (MIN_SIZE_M, MAX_SIZE_M))
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
    is_likely = is_likely and not _is_too_thin(seen, whole, category)
    return np.clip(np.maximum(size, least), smallest, largest), is_likely


def _typical_sides(category: str, height_m: float) -> Array:
    """Return the typical length and width (2,) of a category; high trucks are longer."""
    length, width, height = TYPICAL_SIZE_M[category]
    if category == "truck" and height_m > height:
        exponent = np.log(HIGHEST_TRUCK_LENGTH_M / length) / np.log(HIGHEST_TRUCK_M / height)
        length = min(length * (height_m / height) ** exponent, HIGHEST_TRUCK_LENGTH_M)
    return np.array([length, width])


def _is_likely_size(seen: Array, whole: NDArray[np.bool_], else_m: Array, category: str) -> bool:
    """Return whether an object can be of its category by the sides (n, 2) that were seen, else by what they are thought to be."""
    smallest, largest = (np.array(t[category][:2]) for t in (MIN_SIZE_M, MAX_SIZE_M))
    raw = np.array(
        [np.quantile(seen[whole[:, a], a], SIZE_QUANTILE) if whole[:, a].any() else else_m[a] for a in range(2)]
    )
    if CATEGORY[category].min_seen_m is not None:
        return bool((raw <= largest).all())
    return bool(((raw >= smallest) & (raw <= largest)).all())


def _is_too_thin(seen: Array, whole: NDArray[np.bool_], category: str) -> bool:
    """Return whether the longer of the sides (n, 2) that were seen, with half the gaps beside them, is less than a body's."""
    least = CATEGORY[category].min_seen_m
    if least is None or not whole.any():
        return False
    return max(float(np.quantile(seen[whole[:, a], a], SIZE_QUANTILE)) for a in range(2) if whole[:, a].any()) < least


def _height(track: Track) -> tuple[float, Array]:
    """Estimate the height of the object and z (n,) of its center: points reach its top where the LiDAR sees that high."""
    m = track.measurements
    by_lidar_m = (m.top_m - m.bottom_m)[[len(c) >= MIN_CLUSTER_POINTS for c in m.cluster]]
    # The height of a box without points is only as right as where it was placed.
    by_image_m = np.where(m.truncated | (m.source == "topdown"), np.nan, m.height_px_m)
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
