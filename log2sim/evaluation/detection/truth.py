"""True boxes of the sweeps in which a detector searched, from the labels of a log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import Labels, Log
from log2sim.errors import LogError
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.label_tracks import MAX_LAG_NS, MAX_PERIODS, LabelTracks
from log2sim.evaluation.detection.sweep_clouds import clouds, middle_ns, only_ticks, stamps_of
from log2sim.geometry import NS_PER_S, Array, nearest_index, period_of
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.frames import RecordReader
from log2sim.perception.lidar.cloud import Cloud, cloud_origin
from log2sim.pipeline import Run, start

MAX_STAMP_ERROR_NS = 1_000_000
"""Stamps of one sweep differ by rounding at most this much."""


@dataclass(frozen=True, eq=False)
class SweepTruth:
    """Labels by sweep; L rows.

    Attributes
    ----------
    labeled : (F,) bool
        Whether each of the sweeps asked for is labeled.
    boxes : SceneBoxes
        Their scenes are indices of sweeps; points are None for a log without LiDAR.
    origin_m : (F, 3) float64
        From where ranges are measured, map frame: the ego, or the middle of the sensors.
    kind : (L,) str
        The log's own word for the category, "" where it has none.
    occlusion : (L,) int64
        As the log states it; 0 where it states nothing.
    """

    labeled: NDArray[np.bool_]
    boxes: SceneBoxes
    origin_m: Array
    kind: NDArray[np.str_]
    occlusion: NDArray[np.int64]


def truth_of_sweeps(
    log: Log, t_ns: NDArray[np.int64], *, progress: Callable[[int, int], None] | None = None
) -> SweepTruth:
    """Assign the labels of a log to sweeps and count the points in each.

    Parameters
    ----------
    log : Log
    t_ns : (F,) int64
        Stamps of the sweeps, absolute, increasing.
    progress : callable, optional
        Called with (sweeps done, all sweeps); every sweep is read once.

    Raises
    ------
    LogError
        When the log has no labels, or none of these sweeps.

    Notes
    -----
    A turning LiDAR sees objects at different times of a sweep, and labels may have the stamps of cameras. Each label is moved
    along its track to the mean time of the points in it, which is where a detector finds the object: at 15 m/s and 10 Hz it
    is up to 0.75 m off otherwise.
    """
    labels = log.labels
    if labels is None or len(labels.t_ns) == 0:
        raise LogError(f"{log.name}: the log has no labeled 3D boxes; name a log with labels as truth")
    run = _run_of(log)
    middle = t_ns + (0 if run is None else middle_ns(run))
    tracks = LabelTracks.of(labels)
    labeled = labeled_sweeps(labels, middle, tracks.period_s)
    if not labeled.any():
        raise LogError(_nothing_in_common(log, labels, t_ns))
    sweep, track = tracks.present(middle)
    sweep, track = sweep[labeled[sweep]], track[labeled[sweep]]
    seen = Sightings(sweep, track, middle[sweep], None)
    if run is not None:
        seen = _seen_by_lidar(run, t_ns, tracks, seen, progress)
    pose, rows = tracks.at(track, seen.t_ns)
    origin = np.array([cloud_origin(log, int(t))[0] for t in t_ns])
    box = np.column_stack([pose[:, :3], labels.size_m[rows], pose[:, 3]])
    away = np.hypot(*(box[:, :2] - origin[sweep, :2]).T)
    return SweepTruth(
        labeled,
        SceneBoxes.of(box, labels.category[rows], scene=sweep, points=seen.points, range_m=away),
        origin,
        np.full(len(rows), "") if labels.kind is None else labels.kind[rows],
        np.zeros(len(rows), dtype=np.int64) if labels.occlusion is None else labels.occlusion[rows],
    )


def _nothing_in_common(log: Log, labels: Labels, t_ns: NDArray[np.int64]) -> str:
    times = ((v.min() / NS_PER_S, v.max() / NS_PER_S) for v in (t_ns, labels.t_ns))
    (first, last), (first_label, last_label) = times
    return (
        f"{log.name}: none of the {len(t_ns)} sweeps is labeled; they last from {first:.3f} to {last:.3f} s, the labels "
        f"from {first_label:.3f} to {last_label:.3f} s; are both of one log?"
    )


def _run_of(log: Log) -> Run | None:
    """Plan to read all sweeps of a log; None without a LiDAR."""
    if not any(len(log.streams[name].t_ns) for name in log.lidars if name in log.streams):
        return None
    return start(log, Config().changed(detect={"name": "lidar:labels"}, measure={"max_range_m": 200.0}))


def labeled_sweeps(labels: Labels, middle_ns: NDArray[np.int64], period_s: float) -> NDArray[np.bool_]:
    """Mark (F,) the sweeps that are labeled: those near a label and, where every sweep is labeled, all between labels.

    Parameters
    ----------
    labels : Labels
        At least one; where they tell what was labeled, only sweeps near that are.
    middle_ns : (F,) int64
        Middles of the sweeps.
    period_s : float
        Time between labels of one object.
    """
    stamps = np.sort(labels.t_ns) if labels.labeled_ns is None else labels.labeled_ns
    near = np.abs(stamps[nearest_index(stamps, middle_ns)] - middle_ns) <= MAX_LAG_NS
    if labels.labeled_ns is not None or period_s > MAX_PERIODS * period_of(middle_ns):
        return np.asarray(near)
    return np.asarray(near | ((middle_ns >= stamps[0]) & (middle_ns <= stamps[-1])))


@dataclass(frozen=True, eq=False)
class Sightings:
    """Labeled objects in sweeps; L rows.

    Attributes
    ----------
    sweep, track : (L,) int64
        Indices of both.
    t_ns : (L,) int64
        When the LiDARs saw the object, the middle of the sweep where they did not.
    points : (L,) int64 or None
        Points above the ground in its box.
    """

    sweep: NDArray[np.int64]
    track: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    points: NDArray[np.int64] | None


def _seen_by_lidar(
    run: Run,
    t_ns: NDArray[np.int64],
    tracks: LabelTracks,
    asked: Sightings,
    progress: Callable[[int, int], None] | None,
) -> Sightings:
    """Read the sweeps with stamps (F,) to find when objects were seen and with how many points."""
    stamps = stamps_of(run)
    tick = nearest_index(stamps, t_ns)
    known = np.flatnonzero(np.abs(stamps[tick] - t_ns) <= MAX_STAMP_ERROR_NS)
    seen_ns, points = asked.t_ns.copy(), np.zeros(len(asked.sweep), dtype=np.int64)
    needed = known[np.isin(known, asked.sweep)]
    for done, searched in enumerate(clouds(only_ticks(run, tick[needed]), RecordReader(run.log), None), start=1):
        mine = np.flatnonzero(asked.sweep == needed[searched.tick])
        if searched.cloud is not None:
            for _ in range(2):  # where objects are in the middle of the sweep, then where they were seen
                pose, rows = tracks.at(asked.track[mine], seen_ns[mine])
                points[mine], mean_ns = points_above_ground(searched.cloud, pose, tracks.size_m[rows])
                seen_ns[mine] = np.where(points[mine] > 0, mean_ns, seen_ns[mine])
        if progress is not None:
            progress(done, len(needed))
    return Sightings(asked.sweep, asked.track, seen_ns, points)


def points_above_ground(cloud: Cloud, pose: Array, size_m: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Count the points (M,) above the ground in boxes with poses (M, 4), x, y, z, yaw, and average their stamps (M,), ns."""
    above = ~cloud.ground
    inside = points_of_boxes(cloud.xyz[above], pose[:, :3] - cloud.origin, size_m, pose[:, 3])
    return inside.count, cloud.stamp_ns + np.round(inside.mean(cloud.t_s[above]) * NS_PER_S).astype(np.int64)
