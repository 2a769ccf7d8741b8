"""Ends of an object along its length and width, in one view or in several: which are real, and how precisely rays locate them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.box_votes import mean_box_axis
from log2sim.datatypes import TYPICAL_SIZE_M, OtherView, Track
from log2sim.geometry import Array
from log2sim.perception import box_completion, box_fitting
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS

# Points of a static object are persistent if so many of the ticks have points in their cell.
VOXEL_M = 0.15
MIN_PERSISTENT_SHARE = 0.15
MAX_POINTS_PER_TICK = 150
# A side seen at a smaller angle than this (sine) shows its near end only: its far end rests on few rays, and the low hood of a
# car on none. Trucks and buses are as high at the one end as at the other.
MIN_SIDE_SINE, MIN_BOX_SIDE_SINE = 0.35, 0.15
BOXES = ("truck", "bus")
# A length axis is told by the lengths of the sides if the odds are e to one.
CLEAR_LOG_ODDS = 1.0


@dataclass(frozen=True, eq=False)
class Ends:
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

    def take(self, rows: slice) -> Ends:
        """Return the ends of some of the views."""
        return Ends(self.low[rows], self.high[rows], self.real[rows], self.gap_m[rows])

    def swapped(self) -> Ends:
        """Return the ends along axes that are turned by a quarter turn."""
        low = np.stack([self.low[:, 1], -self.high[:, 0]], axis=1)
        high = np.stack([self.high[:, 1], -self.low[:, 0]], axis=1)
        real = np.stack([self.real[:, 1], self.real[:, 0, ::-1]], axis=1)
        gap_m = np.stack([self.gap_m[:, 1], self.gap_m[:, 0, ::-1]], axis=1)
        return Ends(low, high, real, gap_m)


def persistent_points(clusters: list[NDArray[np.float64]]) -> Array:
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


def static_ends(track: Track, xy: Array, origin: Array) -> tuple[float, Ends]:
    """Fit the yaw of the points (n, 2) of a static track and find the ends (one view) of all its views together."""
    m = track.measurements
    axis = mean_box_axis(m)
    yaw = box_fitting.fit_yaw(xy)[0] if axis is None else box_fitting.corrected_yaw(xy, axis)
    low, high = box_fitting.extents(xy, yaw, max_trim_m=box_fitting.MAX_TRIM_M)
    rows = np.flatnonzero([len(c) >= MIN_CLUSTER_POINTS for c in m.cluster])
    if track.category in BOXES:
        low, high = _reached(low, high, [m.points_of(k)[:, :2] - origin for k in rows.tolist()], yaw)
    seen = [view for _, view in m.views_of(rows)]
    sensor = box_fitting.rotate(np.array([v.sensor_m[:2] for v in seen]).reshape(-1, 2) - origin, -yaw)
    visible = np.array([v.ends_visible for v in seen], dtype=bool).reshape(-1, 2)
    views = box_completion.real_ends(low, high, sensor, visible, min_sine=_min_sine(track.category))
    steps = [box_fitting.azimuth_step_rad(box_fitting.rotate(v.cluster[:, :2] - v.sensor_m[:2], -yaw)) for v in seen]
    gaps = box_completion.end_gaps(np.array(steps), low - sensor, high - sensor, views)
    # An end that is real from one viewpoint is real, and known as well as from the best one.
    real = views.max(axis=0)
    gap = np.where(views == real, gaps, np.inf).min(axis=0)
    ends = Ends(low[None], high[None], real[None], gap[None])
    if axis is None and _is_length_across(ends, box_fitting.rotate(m.sensor_m[:, :2] - origin, -yaw), track.category):
        return yaw + np.pi / 2, ends.swapped()
    return yaw, ends


def _reached(low: Array, high: Array, views: list[Array], yaw_rad: float) -> tuple[Array, Array]:
    """Widen ends (2,), (2,) of points that persist in their cells to where the points of enough views (n, 2) reach.

    At the far end of a long side, rays are so far apart that they never meet a cell twice. Errors of poses widen it too,
    which short vehicles cannot afford.
    """
    if not views:
        return low, high
    each = [box_fitting.extents(xy, yaw_rad, max_trim_m=box_fitting.MAX_TRIM_M) for xy in views]
    lows, highs = (np.sort(np.array(e), axis=0) for e in zip(*each))
    enough = min(max(math.ceil(MIN_PERSISTENT_SHARE * len(views)), 2), len(views))
    return np.minimum(low, lows[enough - 1]), np.maximum(high, highs[-enough])


def _is_length_across(ends: Ends, sensor: Array, category: str) -> bool:
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


def ends_of(track: Track, rows: NDArray[np.intp], yaw_rad: Array, velocity_mps: Array) -> Ends:
    """Find the ends of the points of measurements `rows` (n,), each relative to its viewpoint.

    Of an end that is seen from two viewpoints counts the better view.

    Parameters
    ----------
    yaw_rad : (n,) float64
        Of the object at each of them.
    velocity_mps : (n, 2) float64
        By which points are moved to where they were at the time of the measurement.
    """
    views = track.measurements.views_of(rows)
    count, place = len(rows), {k: i for i, k in enumerate(rows.tolist())}
    of = np.array([place[k] for k, _ in views], dtype=np.intp)
    seen = _ends_in_views([view for _, view in views], yaw_rad[of], velocity_mps[of], track.category)
    out = seen.take(slice(count))
    if len(views) == count:
        return out
    parts = [out.take(slice(i, i + 1)) for i in range(count)]
    for j, i in enumerate(of[count:].tolist(), start=count):
        ends = seen.take(slice(j, j + 1))
        apart = box_fitting.rotate((views[j][1].sensor_m - views[i][1].sensor_m)[:2], -yaw_rad[i])
        parts[i] = _better_ends(parts[i], replace(ends, low=ends.low + apart, high=ends.high + apart))
    return join_ends(parts)


def _ends_in_views(views: list[OtherView], yaw_rad: Array, velocity_mps: Array, category: str) -> Ends:
    """Find the ends of the points of viewpoints (n,), relative to them, for yaws (n,) and velocities (n, 2)."""
    low, high, step = np.zeros((len(views), 2)), np.zeros((len(views), 2)), np.zeros(len(views))
    for k, view in enumerate(views):
        xy = view.cluster[:, :2] - view.sensor_m[:2]
        if view.cluster.shape[1] > 3:
            xy = xy - view.cluster[:, 3:] * velocity_mps[k]
        local = box_fitting.rotate(xy, -yaw_rad[k])
        low[k], high[k] = box_fitting.extents_of_rotated(local, max_trim_m=box_fitting.MAX_TRIM_M)
        step[k] = box_fitting.azimuth_step_rad(local)
    visible = np.array([view.ends_visible for view in views], dtype=bool).reshape(-1, 2)
    real = box_completion.real_ends(low, high, np.zeros(2), visible, min_sine=_min_sine(category))
    return Ends(low, high, real, box_completion.end_gaps(step, low, high, real))


def _better_ends(one: Ends, other: Ends) -> Ends:
    """Take each end from the view that knows it better; of two that do not, the outer one."""
    outer = np.stack([other.low < one.low, other.high > one.high], axis=-1)
    takes = (other.real > one.real) | ((other.real == one.real) & (other.gap_m < one.gap_m))
    takes = np.where((one.real == 0) & (other.real == 0), outer, takes)
    return Ends(
        np.where(takes[..., 0], other.low, one.low),
        np.where(takes[..., 1], other.high, one.high),
        np.where(takes, other.real, one.real),
        np.where(takes, other.gap_m, one.gap_m),
    )


def _min_sine(category: str) -> float:
    return MIN_BOX_SIDE_SINE if category in BOXES else MIN_SIDE_SINE


def join_ends(parts: list[Ends]) -> Ends:
    """Join the ends of several views."""
    return Ends(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Ends)))
