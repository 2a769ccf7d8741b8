"""What a track is: one object that stands or moves, starts or stops, or several, one after the other.

Whichever explains all measurements of the track over the whole log best, by marginal likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.size import Ends, ends_of
from log2sim.agents.smooth.fixed_interval import (
    OUTLIER_LOG,
    PLACE_SIGMA_M,
    REPEATED_SHARE,
    STANDING,
    MotionPriorSigmas,
    Positions,
    marginal_likelihood,
    noise_of,
)
from log2sim.datatypes import FIRST_SPEED_MPS, GROUP_OF, MIN_SIZE_M, TYPICAL_SIZE_M, Track
from log2sim.geometry import CHI2_2DOF_99, NS_PER_S, Array, wrap_angle
from log2sim.perception.boxes import UNIFORM_SIGMA, rotate
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS
from log2sim.tracking.forward import ACCELERATION_MPS2, CENTER_SIGMA_M

# Error of an observed end: rounded corners, gaps between rays.
END_SIGMA_M = 0.25
# More measurements of a track are not looked at one by one: in 10 s at 10 Hz errors repeat for twice their distance. Fewer of an
# end show no motion.
MAX_ROWS, MIN_START_ROWS = 40, 5
# Times at which a vehicle may start or stop; a shorter motion may be a neighbor that joins its points for some ticks.
TIMES, MIN_MOTION_S = 24, 1.0
# One vehicle in fifty that seems to stand starts or stops.
STARTS_LOG = float(np.log(0.02))


def motion_of_ends(track: Track) -> tuple[float, float]:
    """Return the log-odds that a vehicle drives on, and that it starts or stops, over standing, by the ends of its length.

    They are 0 and minus infinity where its ends do not tell.

    Compared are the marginal likelihoods of ends that stay, of ends that move evenly, and of ends that move with a constant
    acceleration from or until an unknown time, both together since the object is rigid. Errors of an end repeat while the view
    stays the same. An end that moves because more of the object comes into view moves alone.
    """
    m = track.measurements
    rows = np.flatnonzero(np.isfinite(m.yaw_rad) & (m.kept_points >= MIN_CLUSTER_POINTS))
    if GROUP_OF[track.category] != "vehicle" or len(rows) < MIN_START_ROWS:
        return 0.0, -np.inf
    rows = rows[_spread(len(rows))]
    # The length axis of most of the yaws, which are known up to quarter turns.
    yaw_rad = m.yaw_rad[rows]
    yaw = float(np.angle(np.exp(4j * yaw_rad).sum())) / 4
    off = wrap_angle(4 * (yaw_rad - yaw)) / 4
    is_across = np.abs(np.sin(yaw_rad - yaw)) > np.abs(np.cos(yaw_rad - yaw))
    yaw += np.pi / 2 if is_across.mean() > 0.5 else 0.0
    turned_m = TYPICAL_SIZE_M[track.category][1] * float(np.sqrt(np.mean(off**2)))
    ends = ends_of(track, rows, np.full(len(rows), yaw), np.zeros((len(rows), 2)))
    origin = rotate(m.sensor_m[rows, :2] - m.center_m[rows[0], :2], -yaw)
    # Frames that share a sweep measure the same points at the same time.
    t = (m.t_ns[rows] - m.t_ns[rows[0]]) / NS_PER_S + 1e-4 * np.arange(len(rows))
    along, across = (_observed_ends(t, ends, origin, axis, turned_m) for axis in range(2))
    if len(along) < 2:  # a single end may be that of a neighbor that joins the points
        return 0.0, -np.inf
    drives, starts = _log_odds(along)
    # Ends that move across, too, are those of something else.
    return drives, starts if not across or _log_odds(across)[1] <= 0 else -np.inf


def _observed_ends(t: Array, ends: Ends, origin: Array, axis: int, sigma_m: float) -> list[Positions]:
    """Return the positions of the lower and the upper end along an axis where they are observed, without outliers."""
    variance = END_SIGMA_M**2 + sigma_m**2 + (UNIFORM_SIGMA * ends.gap_m) ** 2
    found = []
    for side, along in enumerate((ends.low, ends.high)):
        seen = np.flatnonzero(ends.real[:, axis, side] > 0)
        if len(seen) < MIN_START_ROWS:
            continue
        place = np.column_stack([(along + origin)[seen, axis], np.zeros(len(seen))])
        positions = Positions(t[seen], place, variance[seen, axis, side, None].repeat(2, axis=1))
        # What no motion of a vehicle explains is an outlier of each hypothesis.
        motion = MotionPriorSigmas(FIRST_SPEED_MPS["vehicle"], ACCELERATION_MPS2["vehicle"])
        p = positions.take(marginal_likelihood(positions, motion)[1])
        if len(p) < MIN_START_ROWS:
            continue
        # Variances of positions that scatter more about those next to them than they say are enlarged (Birge, 1932).
        share = np.diff(p.t_s)[:-1] / (p.t_s[2:] - p.t_s[:-2])
        off = p.xy_m[1:-1, 0] - p.xy_m[:-2, 0] * (1 - share) - p.xy_m[2:, 0] * share
        weights, rows = np.zeros((len(off), len(p))), np.arange(len(off))
        weights[rows, rows], weights[rows, rows + 1], weights[rows, rows + 2] = share - 1, 1.0, -share
        expected = np.einsum("ij,jk,ik->i", weights, noise_of(p)[0], weights)
        found.append(Positions(p.t_s, p.xy_m, p.variance * max(1.0, float(np.mean(off**2 / expected)))))
    return found


def _log_odds(ends: list[Positions]) -> tuple[float, float]:
    """Return the log-likelihoods of ends of a vehicle that move evenly, and that start or stop, less that of ends that stay.

    Each is the least of all ends together and of each one: what moves at one end only grows.
    """
    first, last = min(p.t_s[0] for p in ends), max(p.t_s[-1] for p in ends)
    times = np.linspace(first, last, TIMES)
    starts, stops = times[times <= last - MIN_MOTION_S], times[times >= first + MIN_MOTION_S]
    count = len(starts) + len(stops)
    known, pulled = np.zeros((len(ends), count + 1)), np.zeros((len(ends), count + 1))
    for k, p in enumerate(ends):
        t = p.t_s[:, None]
        moved = [t - (first + last) / 2, np.maximum(t - starts, 0.0) ** 2 / 2, np.maximum(stops - t, 0.0) ** 2 / 2]
        way = np.concatenate(moved, axis=1)
        weight = np.linalg.inv(noise_of(p)[0] + PLACE_SIGMA_M**2)
        known[k] = ((weight @ way) * way).sum(axis=0)
        pulled[k] = way.T @ weight @ (p.xy_m[:, 0] - np.median(p.xy_m[:, 0]))
    known, pulled = np.vstack([known, known.sum(axis=0)]), np.vstack([pulled, pulled.sum(axis=0)])
    # The speed or the acceleration is integrated out: a covariance of rank one joins that of ends that stay.
    sigma = np.array([FIRST_SPEED_MPS["vehicle"], *[ACCELERATION_MPS2["vehicle"]] * count])
    each = 0.5 * (sigma**2 * pulled**2 / (1 + sigma**2 * known) - np.log1p(sigma**2 * known))
    drives, *accelerates = each.min(axis=0).tolist()
    return drives, float(np.logaddexp.reduce(accelerates) - np.log(count)) if count else -np.inf


# Fewer measurements show no object, and fewer show no motion: two more than place, velocity and acceleration need.
MIN_ROWS, MIN_MOVING_ROWS = 3, 5
# Two positions are at one place within the 99 % quantile of chi-square with two degrees of freedom, in standard deviations of
# the errors that do not repeat.
PLACE_GATE = CHI2_2DOF_99 * 2 * (1 - REPEATED_SHARE)
# A track changes its object once in fifty tracks, and between two that it has shown already with one measurement in ten.
NEXT_OBJECT_LOG, CHANGE_LOG = float(np.log(0.02)), float(np.log(0.1))
# One object stays what it is unless several are e^3 = 20 times as likely.
MIN_LOG_ODDS = 3.0
# A track is split where that is best out of so many times.
MAX_SPLITS = 24


@dataclass(frozen=True, eq=False)
class Part:
    """Measurements of one object."""

    track: Track
    static: bool  # whether it stands
    # The measurements that agree on the place of an object that stands; those of the track without any that do not
    at_place: Track | None = None


def explain_track(track: Track) -> list[Part]:
    """Decide which objects a track shows, and which of them stand.

    Compared are one object that moves as its kind does, one that stands, standing objects of which each measurement shows one or
    none, and two objects of which the second is seen after the first.
    """
    if len(track) < MIN_ROWS:
        return [Part(track, static=GROUP_OF[track.category] == "vehicle")]
    rows = _spread(len(track))
    positions = _positions_of(track, rows)
    group = GROUP_OF[track.category]
    expected = MotionPriorSigmas(FIRST_SPEED_MPS[group], ACCELERATION_MPS2[group])
    (moving, inlier), (at_rest, _) = (marginal_likelihood(positions, motion) for motion in (expected, STANDING))
    log, parts = _standing_parts(track, positions)
    drives, starts = motion_of_ends(track)
    # The center of a long vehicle wanders while more of it comes into view; its ends do not.
    is_at_rest = at_rest >= moving or drives < -MIN_LOG_ODDS
    if is_at_rest and log <= at_rest + MIN_LOG_ODDS:
        return [Part(track, static=starts + STARTS_LOG <= MIN_LOG_ODDS)]
    if len(track) == MIN_ROWS:
        return [Part(track, static=False)]
    if parts and log > moving:
        return [replace(p, static=motion_of_ends(p.track)[1] + STARTS_LOG <= MIN_LOG_ODDS) for p in parts]
    if not inlier.all() and len(positions) >= 2 * MIN_ROWS:
        # Two objects, of which the second is seen after the first.
        count = min(len(positions) - 2 * MIN_ROWS + 1, MAX_SPLITS)
        cuts = np.unique(np.linspace(MIN_ROWS, len(positions) - MIN_ROWS, count).astype(np.intp))
        halves = [(positions.take(slice(k)), positions.take(slice(k, None))) for k in cuts]
        logs = [sum(marginal_likelihood(half, expected)[0] for half in both) for both in halves]
        best = int(np.argmax(logs))
        if logs[best] + NEXT_OBJECT_LOG > moving + MIN_LOG_ODDS:
            first = rows[cuts[best]]
            parts = [p for part in (slice(first), slice(first, None)) for p in explain_track(_taken(track, part))]
            return [p for p in parts if p.static or len(p.track) >= MIN_MOVING_ROWS]
    return [Part(track, static=False)]


def main_place(track: Track) -> Track | None:
    """Return the measurements of a track at the place of most of them; None if there is no such place."""
    positions = _positions_of(track, np.arange(len(track)))
    places = _places(positions)
    rows = _labels(positions, places[:1], np.zeros(1, dtype=np.intp)) == 0 if len(places) else np.zeros(0, dtype=bool)
    return _taken(track, rows) if rows.sum() > len(track) / 2 else None


def _taken(track: Track, rows: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Track:
    return replace(track, tick=track.tick[rows], measurements=track.measurements.take(rows))


def _spread(count: int) -> NDArray[np.intp]:
    """Choose at most `MAX_ROWS` of so many rows."""
    return np.unique(np.linspace(0, count - 1, min(count, MAX_ROWS)).round().astype(np.intp))


def _positions_of(track: Track, rows: NDArray[np.intp]) -> Positions:
    m = track.measurements
    t = (m.t_ns[rows] - m.t_ns[0]) / NS_PER_S
    axes = _axes(track)
    variance = np.einsum("ia,nij,ja->na", axes, m.covariance[rows], axes)
    # Frames that share a sweep measure the same points at the same time.
    t = t + 1e-4 * np.arange(len(t))
    return Positions(t, m.center_m[rows, :2] @ axes, variance + CENTER_SIGMA_M[GROUP_OF[track.category]] ** 2)


def _axes(track: Track) -> Array:
    """Return the axes (2, 2), in columns, along and across the mean ray from the sensors to a track: errors differ along them."""
    m = track.measurements
    along, across = np.median(m.center_m[:, :2] - m.sensor_m[:, :2], axis=0)
    yaw = np.arctan2(across, along)
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def _standing_parts(track: Track, few: Positions) -> tuple[float, list[Part]]:
    """Return the evidence of standing objects and the parts of these."""
    places = _places(few)
    if len(places) == 0:
        return -np.inf, []
    axis = track.measurements.yaw_rad[np.isfinite(track.measurements.yaw_rad)]
    yaw = float(np.median(axis)) if len(axis) else 0.0
    # From the axes of the errors to shares of half the length and half the width of the smallest object of its kind.
    body = _axes(track).T @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    body = body / (np.array(MIN_SIZE_M[track.category][:2]) / 2)
    # Places nearer than a length and a width, 2 each, are those of one object.
    at, objects = places @ body, np.arange(len(places))
    for k in range(1, len(places)):
        shared = np.flatnonzero(np.all(np.abs(at[:k] - at[k]) < 2, axis=1))
        if len(shared):
            objects[k] = objects[shared[0]]
    objects = np.unique(objects, return_inverse=True)[1]
    label, count = _labels(few, places, objects, body), int(objects.max()) + 1
    seen = label[label >= 0]
    log = OUTLIER_LOG * int((label < 0).sum()) + NEXT_OBJECT_LOG * (count - 1)
    log += CHANGE_LOG * int((np.diff(seen) != 0).sum())
    log += sum(marginal_likelihood(few.take(label == k), STANDING)[0] for k in range(count) if (label == k).any())
    label = _labels(_positions_of(track, np.arange(len(track))), places, objects, body)
    # Objects are seen one after the other: what is shown in between by fewer measurements are other points of the same
    # detections. Such measurements belong to the object that is seen next to them.
    by_size = sorted(set(label[label >= 0].tolist()), key=lambda k: -int((label == k).sum()))
    kept: list[NDArray[np.intp]] = []
    for rows in (np.flatnonzero(label == k) for k in by_size):
        between = [np.mean((rows > other[0]) & (rows < other[-1])) for other in kept]
        if len(rows) >= MIN_ROWS and max(between, default=0.0) < 0.5:
            kept.append(rows)
    if not kept:
        return log, []
    row = np.arange(len(label))
    distance = np.array([np.abs(row[:, None] - rows).min(axis=1) for rows in kept])
    nearest = np.argmin(distance, axis=0)
    return log, [Part(_taken(track, nearest == k), True, _taken(track, rows)) for k, rows in enumerate(kept)]


def _places(p: Positions) -> Array:
    """Find the places (K, 2) at which most positions are, one after the other."""
    left, places = np.arange(len(p)), []
    while len(left) >= MIN_ROWS:
        q = p.take(left)
        variance = np.minimum(q.variance[:, None], q.variance[None])
        squared = ((q.xy_m[:, None] - q.xy_m[None]) ** 2 / variance).sum(axis=2)
        near = squared[np.argmax((squared < PLACE_GATE).sum(axis=1))] < PLACE_GATE
        if near.sum() < MIN_ROWS:
            break
        places.append(np.median(q.xy_m[near], axis=0))
        left = left[~near]
    return np.array(places).reshape(-1, 2)


def _labels(p: Positions, places: Array, objects: NDArray[np.intp], body: Array | None = None) -> NDArray[np.intp]:
    """Return the index (n,) of the object at whose place each position is, -1 for none.

    In its `body` are the centers of what shows while the rest of it is hidden.
    """
    offset = p.xy_m[:, None] - places[None]
    squared = (offset**2 / p.variance[:, None]).sum(axis=2)
    at_place = squared < PLACE_GATE
    if body is not None:
        at_place |= np.all(np.abs(offset @ body) < 1, axis=2)
    nearest = np.argmin(np.where(at_place, squared, np.inf), axis=1)
    return np.where(at_place.any(axis=1), objects[nearest], -1)
