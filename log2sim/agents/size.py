"""Size and final positions of a track from the evidence of all its measurements.

A single sweep sees two sides of an object at best. Over a track each side may be seen from end to end at some time; these
lengths give one constant size, and the position at each measurement follows by aligning the whole box with the observed
ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import CATEGORY, GROUP_OF, MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M, BoxEvidence, Track
from log2sim.files.arrays import Columns
from log2sim.geometry import Array, weighted_quantile
from log2sim.perception import boxes
from log2sim.perception.boxes import box_sigma
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS

# Errors of one detector about one object are alike at neighboring ticks: correlation between any two of them.
TICK_CORRELATION = 0.5


def independent(count: int) -> float:
    """Return how many independent ticks are worth as much as `count` correlated ones, at most 1 / `TICK_CORRELATION`."""
    return count / (1 + (count - 1) * TICK_CORRELATION) if count else 0.0


def independent_along(xy_m: Array, length_m: float) -> float:
    """Return how many independent ticks are worth as much as those at which an object of a length was at places (n, 2).

    What a detector mistakes for a road user stays where it is. Something that moves on is seen from other sides and before other
    things, so that errors at two places are the less alike the more lengths they are from each other.
    """
    if not len(xy_m):
        return 0.0
    apart_m = np.hypot(*(xy_m[:, None] - xy_m[None]).transpose(2, 0, 1))
    alike = TICK_CORRELATION * np.exp(-apart_m / length_m)
    np.fill_diagonal(alike, 1.0)
    return float(len(xy_m) ** 2 / alike.sum())


def typical_box_size(m: BoxEvidence) -> Array | None:
    """Return the size (3,) of the boxes of a track, the median weighted by their points; None without boxes."""
    rows = np.flatnonzero(np.isfinite(m.box_yaw_rad))
    if len(rows) == 0:
        return None
    weight = box_sigma(m.points[rows], m.category[rows])[:, 0] ** -2
    return np.array([weighted_quantile(m.box_size_m[rows, axis], weight, 0.5) for axis in range(3)])


def mean_box_axis(m: BoxEvidence) -> float | None:
    """Return the mean yaw of the boxes of a track, in rad up to half turns; None without boxes."""
    rows = np.flatnonzero(np.isfinite(m.box_yaw_rad))
    if len(rows) == 0:
        return None
    weight, doubled = box_sigma(m.points[rows], m.category[rows])[:, 0] ** -2, 2 * m.box_yaw_rad[rows]
    return float(np.arctan2(weight @ np.sin(doubled), weight @ np.cos(doubled))) / 2


# Points of a static object are persistent if so many of the ticks have points in their cell.
VOXEL_M = 0.15
MIN_PERSISTENT_SHARE = 0.15
MAX_POINTS_PER_TICK = 150
# A side seen at a smaller angle than this (sine) shows its near end only: its far end rests on few rays, and the low hood of a
# car on none. Trucks and buses are as high at the one end as at the other.
MIN_SIDE_SINE, MIN_BOX_SIDE_SINE = 0.35, 0.15
BOXES = ("truck", "bus")


@dataclass(frozen=True, eq=False)
class Ends(Columns):
    """Ends of the points of an object along its length and width in n views."""

    low: Array  # `low`, `high`: (n, 2), m
    high: Array
    real: NDArray[np.int64]  # (n, 2, 2): kinds of the ends, see `boxes.real_ends`
    gap_m: Array  # (n, 2, 2): distances between rays there, see `boxes.end_gaps`

    def swapped(self) -> Ends:
        """Return the ends along axes that are turned by a quarter turn."""
        low = np.stack([self.low[:, 1], -self.high[:, 0]], axis=1)
        high = np.stack([self.high[:, 1], -self.low[:, 0]], axis=1)
        real = np.stack([self.real[:, 1], self.real[:, 0, ::-1]], axis=1)
        gap_m = np.stack([self.gap_m[:, 1], self.gap_m[:, 0, ::-1]], axis=1)
        return Ends(low, high, real, gap_m)


def persistent_points(clusters: list[NDArray[np.float64]]) -> Array:
    """Keep the points (n, 3) of cells with points at several ticks, without those that belong to a neighbor at a single one."""
    clusters = [boxes.subsample(c, MAX_POINTS_PER_TICK) for c in clusters if len(c)]
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


def static_ends(track: Track, xy: Array, origin: Array) -> tuple[float, Ends]:
    """Fit the yaw of the points (n, 2) of a static track and find the ends (one view) of all its views together."""
    m = track.measurements
    axis = mean_box_axis(m)
    if axis is None:
        yaw = boxes.fit_yaw(xy)[0]
    else:
        yaw = float(boxes.correct_yaws(xy, np.array([len(xy)]), np.array([axis]))[0])
    low, high = boxes.extents(xy, yaw)
    rows = np.flatnonzero(m.kept_points >= MIN_CLUSTER_POINTS)
    if track.category in BOXES and len(rows):
        # Points that persist in their cells are widened to where those of enough views reach: at the far end of a long side, rays
        # are so far apart that they never meet a cell twice. Errors of poses widen it too, which short vehicles cannot afford.
        each = [boxes.extents(m.points_of(k)[:, :2] - origin, yaw) for k in rows.tolist()]
        lows, highs = (np.sort(np.array(e), axis=0) for e in zip(*each))
        enough = min(max(math.ceil(MIN_PERSISTENT_SHARE * len(rows)), 2), len(rows))
        low, high = np.minimum(low, lows[enough - 1]), np.maximum(high, highs[-enough])
    every = [view for _, view in m.views_of(rows)]
    sensor = boxes.rotate(np.array([v.sensor_m[:2] for v in every]).reshape(-1, 2) - origin, -yaw)
    visible = np.array([v.ends_visible for v in every], dtype=bool).reshape(-1, 2)
    views = boxes.real_ends(low, high, sensor, visible, min_sine=_min_sine(track.category))
    shown = [v.cluster[:, :2] - v.sensor_m[:2] for v in every]
    steps = boxes.azimuth_steps(np.concatenate(shown), np.array([len(xy) for xy in shown])) if shown else np.zeros(0)
    gaps = boxes.end_gaps(steps, low - sensor, high - sensor, views)
    # An end that is real from one viewpoint is real, and known as well as from the best one.
    real = views.max(axis=0)
    gap = np.where(views == real, gaps, np.inf).min(axis=0)
    ends = Ends(low[None], high[None], real[None], gap[None])
    if axis is not None:
        return yaw, ends
    # Without boxes it is by the sides whether the length is the second axis.
    typical = np.array(TYPICAL_SIZE_M[track.category])
    corners = boxes.corner_correction(ends.low, ends.high, ends.real, typical[1:2], gap_m=ends.gap_m)
    size = (corners[1] - corners[0])[0]
    doubt_m = boxes.UNIFORM_SIGMA * gap.sum(axis=-1)
    log_odds = boxes.swapped_log_odds(size, np.all(real, axis=-1), doubt_m, track.category)
    return (yaw + np.pi / 2, ends.swapped()) if log_odds > 0 else (yaw, ends)


def ends_of(track: Track, rows: NDArray[np.intp], yaw_rad: Array, velocity_mps: Array) -> Ends:
    """Find the ends of the points of measurements `rows` (n,), each relative to its viewpoint.

    Of an end that is seen from two viewpoints counts the better view.

    `yaw_rad`: (n,): of the object at each of them. `velocity_mps`: (n, 2): by which points are moved to where they were at the
    time of the measurement.
    """
    views = track.measurements.views_of(rows)
    count, place = len(rows), {k: i for i, k in enumerate(rows.tolist())}
    of = np.array([place[k] for k, _ in views], dtype=np.intp)
    moved = [
        v.cluster[:, :2] - v.sensor_m[:2] - (v.cluster[:, 3:] * velocity if v.cluster.shape[1] > 3 else 0.0)
        for (_, v), velocity in zip(views, velocity_mps[of])
    ]
    xy, size = np.concatenate(moved), np.array([len(xy) for xy in moved])
    low, high = boxes.extents_of_clusters(xy, size, yaw_rad[of])
    step = boxes.azimuth_steps(xy, size)
    visible = np.array([view.ends_visible for _, view in views], dtype=bool).reshape(-1, 2)
    real = boxes.real_ends(low, high, np.zeros(2), visible, min_sine=_min_sine(track.category))
    seen = Ends(low, high, real, boxes.end_gaps(step, low, high, real))
    out = seen.take(slice(count))
    if len(views) > count:
        second, sensor = of[count:], np.array([view.sensor_m[:2] for _, view in views])
        apart = boxes.rotate(sensor[count:] - sensor[second], -yaw_rad[second])
        one, other = out.take(second), seen.take(slice(count, None))
        other = replace(other, low=other.low + apart, high=other.high + apart)
        # Each end is taken from the view that knows it better; of two that do not, the outer one.
        outer = np.stack([other.low < one.low, other.high > one.high], axis=-1)
        takes = (other.real > one.real) | ((other.real == one.real) & (other.gap_m < one.gap_m))
        takes = np.where((one.real == 0) & (other.real == 0), outer, takes)
        out.low[second] = np.where(takes[..., 0], other.low, one.low)
        out.high[second] = np.where(takes[..., 1], other.high, one.high)
        out.real[second] = np.where(takes, other.real, one.real)
        out.gap_m[second] = np.where(takes, other.gap_m, one.gap_m)
    return out


def _min_sine(category: str) -> float:
    return MIN_BOX_SIDE_SINE if category in BOXES else MIN_SIDE_SINE


# Quantile of the lengths of fully observed sides that is taken for the size: stray points lengthen some, sparse points
# shorten most.
SIZE_QUANTILE = 0.85
# The same where the gaps between rays are taken into account: what is left is that parts were too dark or too low to be hit.
WHOLE_SIDE_QUANTILE = 0.7
# Fewer persistent points do not show a shape.
MIN_STATIC_POINTS = 5
# Standard deviation of a side observed from end to end: stray points lengthen it, gaps between rays shorten it.
WHOLE_SIDE_SIGMA_M = 0.15
# Scale of the logarithms of sizes about the expected ones, as a share of what the limits of their category make of it; degrees of
# freedom, as detectors estimate neither small cars nor long ones; probability that only a part of a side was observed though both
# ends seem to be, as a low hood gives no points, which trucks and buses lack. On 110 simulated logs .1 to 1.1 (lengths of cars .5),
# 4 to 10, .3 (.65 where points are few) and .1. Spreads of .35 to .7, freedoms of 2 to 30 and probabilities of .2 to .5 change the
# share of wrong sizes by less than .01 there.
SIZE_SPREAD, SIZE_FREEDOM, PARTIAL_SHARE, BOX_PARTIAL_SHARE = 0.5, 4.0, 0.35, 0.1
POSSIBLE_SIDES = 96  # lengths between the smallest and the largest that are compared: 1 to 2 % apart
# Directive 96/53/EC, Annex I: 2.55 m, refrigerated vehicles 2.6 m; the United States allow 102 inches. What is beyond are mirrors.
MAX_ROAD_WIDTH_M = 2.6


@dataclass(frozen=True, eq=False)
class TrackGeometry:
    """Size of a track, and the center of its box at each of its n measurements."""

    size_m: Array  # (3,): length, width, height
    xy_m: Array  # (n, 2)
    covariance: Array  # (n, 2, 2): of `xy_m`, m2
    z_m: Array  # (n,)
    yaw_rad: float | None = None  # of a static track, up to half turns
    is_likely: bool = True  # whether the observed size is one of its category


def static_geometry(track: Track) -> TrackGeometry:
    """Estimate one pose and size of a static track from all its points together."""
    m = track.measurements
    origin = np.append(np.median(m.center_m[:, :2], axis=0), 0.0)
    cloud = persistent_points([m.points_of(k) - origin for k in range(len(m))])
    if len(cloud) < MIN_STATIC_POINTS:
        # The mean by the covariances; errors of one object are alike.
        geometry, n = _geometry_without_points(track), len(m)
        information = np.linalg.inv(geometry.covariance)
        covariance = np.linalg.inv(information.sum(axis=0))
        mean = covariance @ np.einsum("nij,nj->i", information, geometry.xy_m)
        covariance = covariance * n / independent(n)
        return replace(geometry, xy_m=np.tile(mean, (n, 1)), covariance=np.tile(covariance, (n, 1, 1)))
    yaw, ends = static_ends(track, cloud[:, :2], origin[:2])
    known = typical_box_size(m)
    height, z = _height(track)
    size, is_likely = _estimate_size(ends, track.category, known)
    low, high, real, gap = (column[0] for column in (ends.low, ends.high, ends.real, ends.gap_m))
    center, sigma = boxes.complete_box(low, high, size, real, known is not None, gap_m=gap)
    # The robust mean of the box centers of a 3D detector and its standard deviation; NaN without boxes.
    rows = np.flatnonzero(np.isfinite(m.box_yaw_rad))
    box_xy, box_sigma_m = np.full(2, np.nan), np.full(2, np.nan)
    if len(rows):
        sigmas = box_sigma(m.points[rows], m.category[rows])
        box_xy = np.array([weighted_quantile(m.box_center_m[rows, axis], sigmas[:, 0] ** -2, 0.5) for axis in range(2)])
        box_sigma_m = np.median(sigmas, axis=0) / np.sqrt(independent(len(rows)))
    center, sigma = boxes.weighted_center(
        center, sigma, boxes.rotate(box_xy - origin[:2], -yaw), _with_size_error(box_sigma_m, known, size)
    )
    n = len(m)
    return TrackGeometry(
        np.append(size, height),
        np.tile(boxes.rotate(center, yaw) + origin[:2], (n, 1)),
        np.tile(boxes.oriented_covariance(sigma, yaw), (n, 1, 1)),
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

    `yaw_rad`: (n,): heading at every measurement. `velocity_mps`: (n, 2): velocity there, by which its points are moved to
    where they were at the time of the measurement: a LiDAR takes 20 ms to sweep over a truck beside it, in which that goes on
    by 0.6 m at 30 m/s. Without it they stay.
    """
    m = track.measurements
    rows = np.flatnonzero(m.kept_points >= MIN_CLUSTER_POINTS)
    if len(rows) == 0:
        return _geometry_without_points(track)
    yaw, sensor = yaw_rad[rows], m.sensor_m[rows, :2]
    moved = np.zeros((len(m), 2)) if velocity_mps is None else velocity_mps
    ends = ends_of(track, rows, yaw, moved[rows])
    height, z = _height(track)
    size, is_likely = _estimate_size(ends, track.category, typical_box_size(m))
    has_box = np.isfinite(m.box_yaw_rad[rows])
    center, sigma = boxes.complete_box(ends.low, ends.high, size, ends.real, has_box, gap_m=ends.gap_m)
    center, sigma = boxes.weighted_center(
        center,
        sigma,
        boxes.rotate(m.box_center_m[rows, :2] - sensor, -yaw),
        _with_size_error(boxes.box_sigma(m.points[rows], m.category[rows]), m.box_size_m[rows], size),
    )
    xy, covariance = m.center_m[:, :2].copy(), m.covariance.copy()
    xy[rows] = boxes.rotate(center, yaw) + sensor
    covariance[rows] = boxes.oriented_covariance(sigma, yaw)
    is_likely = is_likely and height > MIN_SIZE_M[track.category][2]
    is_likely = is_likely and _is_likely_height(size, height, track.category)
    return TrackGeometry(np.append(size, height), xy, covariance, z, None, is_likely)


def _is_likely_height(size_m: Array, height_m: float, category: str) -> bool:
    """Return whether the height fits the category and the length (2,) and width of the object."""
    return bool(size_m.max() <= CATEGORY[category].max_length_per_height * height_m)


def _estimate_size(ends: Ends, category: str, known: Array | None) -> tuple[Array, bool]:
    """Estimate length and width (2,) from the ends in n views, and whether they are likely.

    What seems to be observed from end to end is weighed against what is expected, `known` (3,) from a 3D detector or typical of the
    category. A side that never was is as long as expected, or as the longest part that was observed.
    """
    typical = np.array(TYPICAL_SIZE_M[category][:2])
    smallest, limit = (np.array(t[category][:2]) for t in (MIN_SIZE_M, MAX_SIZE_M))
    is_vehicle = GROUP_OF[category] == "vehicle"
    largest = np.minimum(limit, [np.inf, MAX_ROAD_WIDTH_M]) if is_vehicle else limit
    expected = np.minimum(typical if known is None else known[:2], largest)
    if GROUP_OF[category] == "two_wheeler":
        # Boxes in sweeps are no better an estimate of the length than the category: of 133 riders on 150 simulated logs they are 0.25 m
        # too short in the mean and correlate by 0.2 with the true ones. So both count half, in logarithms.
        expected = np.sqrt(expected * typical)
    elif category == "pedestrian":
        # Likewise of the length alone: boxes of 268 people on 150 simulated logs correlate by .04 with the true lengths.
        expected[0] = np.sqrt(expected[0] * typical[0])
    spread = SIZE_SPREAD * np.log(limit / smallest) / boxes.LIMIT_SIGMAS
    low, high = boxes.corner_correction(ends.low, ends.high, ends.real, expected[1], gap_m=ends.gap_m)
    seen, whole = high - low, np.all(ends.real, axis=2)
    variance = WHOLE_SIDE_SIGMA_M**2 + (boxes.UNIFORM_SIGMA * ends.gap_m).sum(axis=2) ** 2
    least = np.quantile(ends.high - ends.low, SIZE_QUANTILE, axis=0)
    # What is shorter than a part that was seen at other times was not seen from end to end.
    used = whole & (seen + 2 * np.sqrt(variance) >= least)
    size, partial = expected.copy(), BOX_PARTIAL_SHARE if category in BOXES else PARTIAL_SHARE
    for axis in np.flatnonzero(used.any(axis=0))[::-1]:  # the width first
        sides, error = seen[used[:, axis], axis], variance[used[:, axis], axis]
        observed = weighted_quantile(sides, 1.0 / error, WHOLE_SIDE_QUANTILE)
        error_of_all = error.min() / independent(len(sides))
        # The logarithm of the length is distributed about the expected one by Student's t. Any part of the side may have been observed,
        # else all of it. The median of what that leaves of possible lengths, m.
        side = np.geomspace(smallest[axis], largest[axis], POSSIBLE_SIDES)
        log_ratio = np.log(side / expected[axis]) / spread[axis]
        prior = (1 + log_ratio**2 / SIZE_FREEDOM) ** (-(SIZE_FREEDOM + 1) / 2)
        squared = (observed - side) ** 2 / error_of_all
        likelihood = (1 - partial) * np.exp(-squared / 2) / np.sqrt(2 * np.pi * error_of_all)
        weight = prior * (likelihood + partial * (side > observed) / side)
        size[axis] = np.interp(weight.sum() / 2, np.cumsum(weight) - weight / 2, side)
        if axis == 1 and category == "car":
            # Wider cars are longer, by 1.9 % for each percent of those in the simulated logs; of observed widths, which err, half is left.
            expected[0] = size[0] = min(expected[0] * (size[1] / expected[1]), largest[0])
    # What lies between two rays is no evidence.
    between = np.where(ends.real == boxes.SIDE_END, ends.gap_m / 2, 0.0).sum(axis=2)
    sides = np.maximum(expected, least)
    for a in np.flatnonzero(whole.any(axis=0)):
        sides[a] = np.quantile((seen - between)[whole[:, a], a], SIZE_QUANTILE)
    is_likely, body_m = bool((sides <= limit).all()), CATEGORY[category].min_seen_m
    if body_m is None:
        is_likely = is_likely and bool((sides >= smallest).all())
    elif whole.any():
        # The longer of the sides that were observed, with half the gaps beside them, is no less than a body's.
        most = [np.quantile(seen[whole[:, a], a], SIZE_QUANTILE) for a in range(2) if whole[:, a].any()]
        is_likely = is_likely and bool(max(most) >= body_m)
    if category == "pedestrian":
        # So short that a hand, a sway or an error of the poses makes the points reach much farther.
        least = least - np.sqrt(np.median(variance, axis=0))
    return np.clip(np.maximum(size, least), smallest, largest), is_likely


def _height(track: Track) -> tuple[float, Array]:
    """Estimate the height of the object and z (n,) of its center: points reach its top where the LiDAR sees that high."""
    m = track.measurements
    by_lidar_m = (m.top_m - m.bottom_m)[m.kept_points >= MIN_CLUSTER_POINTS]
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
