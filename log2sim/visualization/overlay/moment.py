"""What all sensors of a log recorded at one moment: images, the LiDAR points in them, and labeled boxes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels, Log, Sweep
from log2sim.errors import ConfigError, RecordError
from log2sim.geometry import (
    NS_PER_S,
    Array,
    Camera,
    PoseTrack,
    apply,
    box_corners,
    box_lines,
    line_time_s,
    project_moving,
)
from log2sim.perception.detect.label_motion import MAX_AGE_S, LabelBoxes, interpolate_pairs, window_ns
from log2sim.perception.lidar.cloud import compensation_of, sweep_to_map
from log2sim.perception.lidar.projection import poses_around, project_boxes_in_view, view_of
from log2sim.perception.sync import Schedule, synchronize

# Stamps of labels and frames of one moment differ by rounding in some logs.
STAMP_TOLERANCE_NS = 1_000_000


@dataclass(frozen=True, eq=False)
class SweepInMap:
    """One sweep in the map frame.

    Attributes
    ----------
    name : str
        Of the LiDAR.
    xyz : (N, 3) float64, m, map frame
    middle_ns : int
        Middle of its point times; its stamp where it has none.
    motion : str
        How the motion of the sensor during the sweep was compensated.
    """

    name: str
    xyz: Array
    middle_ns: int
    motion: str


@dataclass(frozen=True, eq=False)
class Shot:
    """The image of one camera with what was projected into it.

    Attributes
    ----------
    camera : Camera
    t_ns : int
        Stamp of the image.
    image : (H, W, 3) uint8 BGR or None
        None where it cannot be read.
    uv_px, depth_m : (N, 2), (N,) float64
        LiDAR points in the image.
    boxes : tuple of ((E, 2, 2) float64, str)
        Edges of each 3D box in px, and its category.
    image_boxes_px : (M, 4) float64
        Labeled 2D boxes.
    residuals_s : mapping of LiDAR to float
        Middle of the sweep less the stamp of the image.
    problem : str
        Why a part is missing; empty where nothing is.
    """

    camera: Camera
    t_ns: int
    image: NDArray[np.uint8] | None
    uv_px: Array
    depth_m: Array
    boxes: tuple[tuple[Array, str], ...]
    image_boxes_px: Array
    residuals_s: dict[str, float]
    problem: str = ""


@dataclass(frozen=True, eq=False)
class Moment:
    """All sensors at one tick.

    Attributes
    ----------
    log : Log
        With standing poses where it has none.
    t_ns : int
    at_s : float
        Since the first tick.
    shots : tuple of Shot
    sweeps : tuple of SweepInMap
        Those nearest to the tick.
    boxes : LabelBoxes
        Labels at the tick.
    notes : tuple of str
        What is missing.
    """

    log: Log
    t_ns: int
    at_s: float
    shots: tuple[Shot, ...]
    sweeps: tuple[SweepInMap, ...]
    boxes: LabelBoxes
    notes: tuple[str, ...]


def read_moment(
    log: Log,
    cameras: Sequence[str] = (),
    at_s: float | None = None,
    *,
    t_ns: int | None = None,
    labels: Callable[[int], Labels] | None = None,
) -> Moment:
    """Read the records of one tick.

    Parameters
    ----------
    log : Log
    cameras : sequence of str
        All of the log where it is empty.
    at_s : float, optional
        Time of the tick since the first one, s; by default in the middle of those with the most records.
    t_ns : int, optional
        Absolute stamp; the tick nearest to it is read, whatever `at_s` says.
    labels : callable, optional
        Returns for the stamp of the tick the 3D boxes that are drawn in place of those of the log.

    Raises
    ------
    ConfigError
        For an unknown camera, and for a time outside the log.
    """
    unknown = [name for name in cameras if name not in log.cameras]
    if unknown:
        there = ", ".join(log.cameras) or "none"
        raise ConfigError(f"--cameras: no camera '{unknown[0]}'; the log has: {there}")
    notes = []
    mounts = {*(c.mount for c in log.cameras.values()), *(lidar.mount for lidar in log.lidars.values())}
    if log.ego is None and "ego" in mounts:
        notes.append("the log has no poses: drawn as if the ego stood still")
        log = _standing(log)
    schedule = synchronize(log, tuple(cameras) or tuple(log.cameras))
    tick = _find_tick(schedule, at_s) if t_ns is None else int(np.argmin(np.abs(schedule.t_ns - t_ns)))
    t_ns = int(schedule.t_ns[tick])
    if labels is not None:
        log = log.changed(labels=labels(t_ns), image_labels={})
    reader = _SweepReader(log)
    shots = tuple(_shot(log, schedule, reader, row, tick) for row in range(len(schedule.frames)))
    sweeps = reader.at(schedule, schedule.reference_row, tick)
    boxes = labels_at(log.labels, t_ns)
    at = float(t_ns - schedule.t_ns[0]) / NS_PER_S
    return Moment(log, t_ns, at, shots, sweeps, boxes, (*notes, *reader.problems))


def labels_at(labels: Labels | None, t_ns: int) -> LabelBoxes:
    """Interpolate the labels of every track to a stamp; a track that begins or ends there is kept up to `MAX_AGE_S`."""
    if labels is None:
        none = np.zeros(0)
        return LabelBoxes(np.zeros(0, np.int64), np.zeros(0, "<U16"), np.zeros((0, 3)), np.zeros((0, 3)), none)
    everything = LabelBoxes(labels.t_ns, labels.category, labels.center_m, labels.size_m, labels.yaw_rad)
    near = np.flatnonzero(np.abs(labels.t_ns - t_ns) <= window_ns(labels.t_ns))
    near = near[np.argsort(labels.t_ns[near], kind="stable")]
    before, after = [], []
    for track in np.unique(labels.track_id[near]):
        rows = near[labels.track_id[near] == track]
        earlier, later = rows[labels.t_ns[rows] <= t_ns], rows[labels.t_ns[rows] > t_ns]
        ends = [*earlier[-1:], *later[:1]]
        if len(ends) == 2 or abs(int(labels.t_ns[ends[0]]) - t_ns) <= MAX_AGE_S * NS_PER_S:
            before.append(ends[0])
            after.append(ends[-1])
    first, second = np.array(before, dtype=np.intp), np.array(after, dtype=np.intp)
    alone = first == second
    pairs = interpolate_pairs(everything.take(first[~alone]), everything.take(second[~alone]), t_ns)
    singles = everything.take(first[alone])
    joined = [np.concatenate(p) for p in zip(_columns(pairs), _columns(singles))]
    return LabelBoxes(np.full(len(joined[0]), t_ns, dtype=np.int64), *joined)


def _columns(boxes: LabelBoxes) -> tuple[NDArray[np.str_], Array, Array, Array]:
    return boxes.category, boxes.center_m, boxes.size_m, boxes.yaw_rad


def _standing(log: Log) -> Log:
    """Give a log without poses an ego that stands in the origin of the map."""
    ends = [int(t) for stream in log.streams.values() for t in (stream.t_ns[0], stream.t_ns[-1])]
    stamps = np.array([min(ends), max(ends) + 1], dtype=np.int64)
    return log.changed(ego=PoseTrack(stamps, np.repeat(np.eye(4)[None], 2, axis=0), max_gap_s=np.inf))


def _find_tick(schedule: Schedule, at_s: float | None) -> int:
    if at_s is None:
        rows = [*schedule.frames.values(), *(index[schedule.reference_row] for index in schedule.sweeps.values())]
        records = np.sum([index >= 0 for index in rows], axis=0)
        fullest = np.flatnonzero(records == records.max())
        return int(fullest[len(fullest) // 2])
    seconds = (schedule.t_ns - schedule.t_ns[0]) / NS_PER_S
    slack = 0.5 * float(np.diff(seconds).max(initial=0.0)) + 1e-9
    if not -slack <= at_s <= seconds[-1] + slack:
        raise ConfigError(f"--at {at_s:g}: the log has ticks from 0 to {seconds[-1]:.3f} s; choose a time between them")
    return int(np.argmin(np.abs(seconds - at_s)))


class _SweepReader:
    """Reads sweeps once, in the map frame, and collects what cannot be read."""

    def __init__(self, log: Log) -> None:
        self.log = log
        self.problems: list[str] = []
        self._known: dict[tuple[str, int], SweepInMap | None] = {}

    def at(self, schedule: Schedule, row: int, tick: int) -> tuple[SweepInMap, ...]:
        """Return the sweeps of a row of the schedule at a tick."""
        found = [self._read(name, int(index[row, tick])) for name, index in schedule.sweeps.items()]
        return tuple(sweep for sweep in found if sweep is not None)

    def _read(self, name: str, index: int) -> SweepInMap | None:
        if index >= 0 and (name, index) not in self._known:
            self._known[name, index] = self._load(name, index)
        return self._known.get((name, index))

    def _load(self, name: str, index: int) -> SweepInMap | None:
        try:
            sweep: Sweep = self.log.streams[name].read(index)
        except RecordError as error:
            self.problems.append(str(error))
            return None
        mapped = sweep_to_map(self.log, name, sweep, compensate=True)
        if mapped is None:
            self.problems.append(f"{name}: no ego pose at stamp {sweep.stamp_ns}")
            return None
        middle = sweep.stamp_ns
        if sweep.t_ns is not None and len(sweep.t_ns):
            middle = (int(sweep.t_ns.min()) + int(sweep.t_ns.max())) // 2
        return SweepInMap(name, mapped[0], middle, compensation_of(self.log, name, sweep))


def _shot(log: Log, schedule: Schedule, reader: _SweepReader, row: int, tick: int) -> Shot:
    name = list(schedule.frames)[row]
    camera, index = log.cameras[name], int(schedule.frames[name][tick])
    empty = Shot(camera, 0, None, np.zeros((0, 2)), np.zeros(0), (), np.zeros((0, 4)), {})
    if index < 0:
        return replace(empty, problem="no image near this tick")
    t_ns = int(log.streams[name].t_ns[index])
    shot = replace(empty, t_ns=t_ns, image_boxes_px=_image_boxes(log, name, t_ns))
    try:
        shot = replace(shot, image=log.streams[name].read(index))
    except RecordError as error:
        shot = replace(shot, problem=str(error))
    if not log.map_T_sensor(name, t_ns)[1][0]:
        return replace(shot, problem="no ego pose at the stamp of the image")
    sweeps = reader.at(schedule, row, tick)
    points = np.concatenate([s.xyz for s in sweeps]) if sweeps else np.zeros((0, 3))
    uv, depth, valid = project_moving(camera, points, poses_around(log, name, t_ns))
    return replace(
        shot,
        uv_px=uv[valid],
        depth_m=depth[valid],
        boxes=_wireframes(log, camera, t_ns),
        residuals_s={s.name: (s.middle_ns - t_ns) / NS_PER_S for s in sweeps},
    )


def _wireframes(log: Log, camera: Camera, t_ns: int) -> tuple[tuple[Array, str], ...]:
    """Project the edges of the labels at a stamp; each box takes the pose of the line that shows its center."""
    boxes = labels_at(log.labels, t_ns)
    cam_T_map_at = poses_around(log, camera.name, t_ns)
    view = view_of(log, camera.name, t_ns)
    if view is None:
        return ()
    projected = project_boxes_in_view(view, boxes.center_m, boxes.size_m, boxes.yaw_rad)
    out = []
    for i in np.flatnonzero(projected.valid):
        middle_px = projected.box_px[i].reshape(2, 2).mean(axis=0)[None]
        cam_T_map = cam_T_map_at(line_time_s(camera, middle_px))[0]
        corners = box_corners(boxes.center_m[i], boxes.size_m[i], boxes.yaw_rad[i])[0]
        out.append((box_lines(camera, apply(cam_T_map, corners)), str(boxes.category[i])))
    return tuple(out)


def _image_boxes(log: Log, name: str, t_ns: int) -> Array:
    labels = log.image_labels.get(name)
    if labels is None:
        return np.zeros((0, 4))
    return np.asarray(labels.box_px[np.abs(labels.t_ns - t_ns) <= STAMP_TOLERANCE_NS], dtype=np.float64)
