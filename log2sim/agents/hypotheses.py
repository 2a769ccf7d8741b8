"""What a track is: one object that stands or moves, or several, one seen after the other.

The hypotheses are compared by the evidence of all measurements of the track over the whole log.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.motion_evidence import (
    OUTLIER_LOG,
    REPEATED_SHARE,
    STANDING,
    MarginalLikelihood,
    MotionPriorSigmas,
    Positions,
    marginal_likelihood,
)
from log2sim.agents.standing import is_static
from log2sim.agents.starting import starts_or_stops
from log2sim.datatypes import GROUP_OF, MIN_SIZE_M, Track
from log2sim.geometry import NS_PER_S, Array
from log2sim.tracking.gates import CHI2_2DOF_99
from log2sim.tracking.motion import ACCELERATION_MPS2, CENTER_SIGMA_M, FIRST_SPEED_MPS

# More measurements of a track are not looked at one by one.
MAX_ROWS = 80
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
    """Measurements of one object.

    Attributes
    ----------
    track : Track
    static : bool
        Whether it stands.
    at_place : Track, optional
        The measurements that agree on the place of an object that stands; those of the track without any that do not.
    """

    track: Track
    static: bool
    at_place: Track | None = None


def explain_track(track: Track) -> list[Part]:
    """Decide which objects a track shows, and which of them stand.

    Notes
    -----
    Compared are one object that moves as its kind does, several standing objects of which each measurement shows one, and two
    objects of which the second is seen after the first.
    """
    if is_static(track):
        return [Part(track, static=not starts_or_stops(track))]
    if len(track) <= MIN_ROWS:
        return [Part(track, static=False)]
    positions, rows = _positions(track)
    moving = marginal_likelihood(positions, _expected_motion(track))
    standing = _standing_parts(track, positions)
    if standing is not None and standing[1]:
        log, parts = standing
        # Parts none of which drifts stand unless a motion is likelier.
        at_places = [part.at_place or part.track for part in parts]
        margin = -MIN_LOG_ODDS if all(is_static(shown) for shown in at_places) else MIN_LOG_ODDS
        if log > moving.log + margin:
            return [Part(p.track, static=False) if starts_or_stops(p.track) else p for p in parts]
    if not moving.inlier.all():
        cut = _best_cut(positions, moving, _expected_motion(track))
        if cut is not None:
            first = rows[cut]
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


def _expected_motion(track: Track) -> MotionPriorSigmas:
    group = GROUP_OF[track.category]
    return MotionPriorSigmas(FIRST_SPEED_MPS[group], ACCELERATION_MPS2[group])


def _positions(track: Track) -> tuple[Positions, NDArray[np.intp]]:
    """Return the positions of at most `MAX_ROWS` measurements, and the rows of these."""
    m = track.measurements
    rows = np.unique(np.linspace(0, len(m) - 1, min(len(m), MAX_ROWS)).round().astype(np.intp))
    return _positions_of(track, rows), rows


def _positions_of(track: Track, rows: NDArray[np.intp]) -> Positions:
    m = track.measurements
    t = (m.t_ns[rows] - m.t_ns[0]) / NS_PER_S
    variance: Array = np.trace(m.covariance[rows], axis1=1, axis2=2) / 2
    # Frames that share a sweep measure the same points at the same time.
    t = t + 1e-4 * np.arange(len(t))
    return Positions(t, m.center_m[rows, :2], variance + CENTER_SIGMA_M[GROUP_OF[track.category]] ** 2)


def _standing_parts(track: Track, few: Positions) -> tuple[float, list[Part]] | None:
    """Return the evidence of standing objects and the parts of these; None where there are none."""
    places = _places(few)
    if len(places) == 0:
        return None
    axis = track.measurements.yaw_rad[np.isfinite(track.measurements.yaw_rad)]
    objects = _objects_at(places, float(np.median(axis)) if len(axis) else 0.0, MIN_SIZE_M[track.category][:2])
    label, count = _labels(few, places, objects), int(objects.max()) + 1
    seen = label[label >= 0]
    log = OUTLIER_LOG * int((label < 0).sum()) + NEXT_OBJECT_LOG * (count - 1)
    log += CHANGE_LOG * int((np.diff(seen) != 0).sum())
    log += sum(marginal_likelihood(few.take(label == k), STANDING).log for k in range(count) if (label == k).any())
    return log, _parts_of(track, _labels(_positions_of(track, np.arange(len(track))), places, objects))


def _parts_of(track: Track, label: NDArray[np.intp]) -> list[Part]:
    """Make a part of each object, given which one each measurement (n,) shows, -1 for none.

    Objects are seen one after the other: what is shown in between by fewer measurements are other points of the same
    detections. Such measurements belong to the object that is seen next to them.
    """
    by_size = sorted(set(label[label >= 0].tolist()), key=lambda k: -int((label == k).sum()))
    kept: list[NDArray[np.intp]] = []
    for rows in (np.flatnonzero(label == k) for k in by_size):
        between = [np.mean((rows > other[0]) & (rows < other[-1])) for other in kept]
        if len(rows) >= MIN_ROWS and max(between, default=0.0) < 0.5:
            kept.append(rows)
    if not kept:
        return []
    row = np.arange(len(label))
    distance = np.array([np.abs(row[:, None] - rows).min(axis=1) for rows in kept])
    nearest = np.argmin(distance, axis=0)
    return [Part(_taken(track, nearest == k), True, _taken(track, rows)) for k, rows in enumerate(kept)]


def _places(p: Positions) -> Array:
    """Find the places (K, 2) at which most positions are, one after the other."""
    left, places = np.arange(len(p)), []
    while len(left) >= MIN_ROWS:
        q = p.take(left)
        squared = ((q.xy_m[:, None] - q.xy_m[None]) ** 2).sum(axis=2) / np.minimum(
            q.variance[:, None], q.variance[None]
        )
        near = squared[np.argmax((squared < PLACE_GATE).sum(axis=1))] < PLACE_GATE
        if near.sum() < MIN_ROWS:
            break
        places.append(np.median(q.xy_m[near], axis=0))
        left = left[~near]
    return np.array(places).reshape(-1, 2)


def _objects_at(places: Array, axis_rad: float, size_m: tuple[float, ...]) -> NDArray[np.intp]:
    """Return the index (K,) of the object at each place: places nearer than a length and a width are those of one."""
    c, s = np.cos(axis_rad), np.sin(axis_rad)
    index = np.arange(len(places))
    for k in range(1, len(places)):
        offsets = (places[:k] - places[k]) @ np.array([[c, -s], [s, c]])
        shared = np.flatnonzero(np.all(np.abs(offsets) < np.array(size_m), axis=1))
        if len(shared):
            index[k] = index[shared[0]]
    return np.unique(index, return_inverse=True)[1]


def _labels(p: Positions, places: Array, objects: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the index (n,) of the object at whose place each position is, -1 for none."""
    squared = ((p.xy_m[:, None] - places[None]) ** 2).sum(axis=2) / p.variance[:, None]
    nearest = np.argmin(squared, axis=1)
    return np.where(squared[np.arange(len(p)), nearest] < PLACE_GATE, objects[nearest], -1)


def _best_cut(p: Positions, whole: MarginalLikelihood, motion: MotionPriorSigmas) -> int | None:
    """Return the first row of the second of two objects, if two are likelier than one."""
    if len(p) < 2 * MIN_ROWS:
        return None
    cuts = np.unique(
        np.linspace(MIN_ROWS, len(p) - MIN_ROWS, min(len(p) - 2 * MIN_ROWS + 1, MAX_SPLITS)).astype(np.intp)
    )
    logs = [
        marginal_likelihood(p.take(slice(k)), motion).log + marginal_likelihood(p.take(slice(k, None)), motion).log
        for k in cuts
    ]
    best = int(np.argmax(logs))
    return int(cuts[best]) if logs[best] + NEXT_OBJECT_LOG > whole.log + MIN_LOG_ODDS else None
