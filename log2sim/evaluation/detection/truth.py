"""True boxes of sweeps from the labels of a log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import Labels, Log
from log2sim.errors import LogError
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.detect_log import clouds, middle_ns, take_ticks
from log2sim.evaluation.metrics.truth import MAX_STAMP_LAG_NS, image_shares, rows_by_track
from log2sim.files.arrays import Columns
from log2sim.geometry import NS_PER_S, Array, inverse, nearest_index, period_of, project_boxes, wrap_angle
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.lidar.cloud import cloud_origin
from log2sim.perception.records import RecordSource
from log2sim.pipeline import start
from log2sim.report import Run

MAX_LAG_NS = 60_000_000  # a label holds for this time around its stamp: half a period at 10 Hz, and jitter
# Between labels of a track that are farther apart than this many periods the object was not labeled.
MAX_PERIODS = 1.5


@dataclass(frozen=True, eq=False)
class LabelTracks:
    """Labels in the order of their tracks and stamps."""

    t_ns: NDArray[np.int64]  # (L,)
    pose: Array  # (L, 4) center x, y, z and yaw
    size_m: Array  # (rows of the log's labels, 3) in the order of the log
    row: NDArray[np.int64]  # (L,) index in the log's labels
    first: NDArray[np.int64]  # (K + 1,) where each of K tracks begins, and L
    period_s: float  # median time between labels of a track; 0 where no track has two

    @classmethod
    def of(cls, labels: Labels) -> LabelTracks:
        """Sort labels; of two of one object at one stamp the first is kept."""
        rows = rows_by_track(labels)
        order = np.concatenate(rows)
        steps = np.concatenate([np.diff(labels.t_ns[r]) for r in rows])
        pose = np.column_stack([labels.center_m[order], labels.yaw_rad[order]])
        period_s = float(np.median(steps)) / NS_PER_S if len(steps) else 0.0
        return cls(labels.t_ns[order], pose, labels.size_m, order, np.cumsum([0, *map(len, rows)]), period_s)

    def present(self, t_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """List the moments (P,), indices into `t_ns` (F,), and tracks (P,) labeled at them, in the order of moments."""
        moments, tracks = [], []
        for k, (begin, end) in enumerate(zip(self.first[:-1], self.first[1:], strict=True)):
            stamps = self.t_ns[begin:end]
            after = np.searchsorted(stamps, t_ns)
            before_ns = t_ns - stamps[np.maximum(after - 1, 0)]
            after_ns = stamps[np.minimum(after, len(stamps) - 1)] - t_ns
            near = np.minimum(np.abs(before_ns), np.abs(after_ns)) <= MAX_LAG_NS
            gap_s = (before_ns + after_ns) / NS_PER_S
            between = (after > 0) & (after < len(stamps)) & (gap_s <= MAX_PERIODS * self.period_s)
            found = np.flatnonzero(near | between)
            moments.append(found)
            tracks.append(np.full(len(found), k))
        moment, track = np.concatenate(moments), np.concatenate(tracks)
        order = np.argsort(moment, kind="stable")
        return moment[order].astype(np.int64), track[order].astype(np.int64)

    def at(self, track: NDArray[np.int64], t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
        """Interpolate tracks (P,) at stamps (P,); return poses (P, 4), x, y, z, yaw, and the nearest labels (P,) in the log's.

        On the line through the labels before and after; beyond the ends, and next to a gap, through the two nearest ones.
        """
        pose, row = np.empty((len(track), 4)), np.empty(len(track), dtype=np.int64)
        for k in np.unique(track):
            mine = np.flatnonzero(track == k)
            part = slice(self.first[k], self.first[k + 1])
            pose[mine], nearest = _along(self.t_ns[part], self.pose[part], t_ns[mine], self.period_s)
            row[mine] = self.row[part][nearest]
        return pose, row


def _along(
    stamps: NDArray[np.int64], pose: Array, t_ns: NDArray[np.int64], period_s: float
) -> tuple[Array, NDArray[np.intp]]:
    """Interpolate one track with stamps (K,) and poses (K, 4) at times (P,); also the index (P,) of the nearest stamp."""
    nearest = np.abs(stamps - t_ns[:, None]).argmin(axis=1)
    toward = np.where(t_ns >= stamps[nearest], 1, -1)
    linked = np.append(np.diff(stamps) / NS_PER_S <= MAX_PERIODS * period_s, False)
    partner = nearest.copy()
    for step in (-toward, toward):  # the last one that can be had is taken
        there = nearest + step
        usable = (there >= 0) & (there < len(stamps)) & linked[np.minimum(nearest, there)]
        partner = np.where(usable, there, partner)
    span = stamps[partner] - stamps[nearest]
    share = np.divide(t_ns - stamps[nearest], span, out=np.zeros(len(t_ns)), where=span != 0)
    way = pose[partner] - pose[nearest]
    way[:, 3] = wrap_angle(way[:, 3])
    return pose[nearest] + share[:, None] * way, nearest


@dataclass(frozen=True, eq=False)
class ImageViews(Columns):
    """M boxes in the images of one camera."""

    shown: NDArray[np.bool_]  # (M,) whether the image shows a part of the box
    height_px: Array  # (M,) height of the box in the image, clipped to it; 0 where it is not shown
    truncation: Array  # (M,) share of the outline outside the image; 1 where it is not shown
    region_share: Array  # (M,) greatest share of the image box in one region left without labels


def image_views(
    log: Log, camera: str, t_ns: NDArray[np.int64], boxes: SceneBoxes, *, truncation: bool = False
) -> ImageViews:
    """Project boxes into the images of a camera.

    `t_ns` (F,): stamps of the scenes, absolute; the camera is taken where it was then. `boxes`: their scenes are
    indices into `t_ns`, the boxes are in the map frame. `truncation`: whether to compute it, which takes a millisecond
    a box at the border of the image; 0 for all shown boxes otherwise.
    """
    count = len(boxes)
    shown, height, share = np.zeros(count, dtype=bool), np.zeros(count), np.zeros(count)
    outside = np.ones(count)
    poses, known = log.map_T_sensor(camera, t_ns)
    for scene in np.unique(boxes.scene):
        if not known[scene]:
            continue
        rows = np.flatnonzero(boxes.scene == scene)
        solid = boxes.box[rows, :3], boxes.box[rows, 3:6], boxes.box[rows, 6]
        seen = project_boxes(*solid, log.cameras[camera], inverse(poses[scene]))
        shown[rows] = seen.valid
        height[rows] = np.where(seen.valid, seen.box_px[:, 3] - seen.box_px[:, 1], 0)
        inside = image_shares(log.cameras[camera], inverse(poses[scene]), *solid) if truncation else 1.0
        outside[rows] = np.where(seen.valid, 1 - inside, 1.0)
        # The regions (R, 4) without labels of the image nearest to the stamp, and the greatest share of a box in one of them.
        regions = log.ignored_regions.get(camera)
        lag = np.zeros(0) if regions is None else np.abs(regions.t_ns - t_ns[scene])
        if regions is not None and len(lag) and lag.min() <= MAX_STAMP_LAG_NS:
            region_px = regions.box_px[lag == lag.min()]
            low = np.maximum(seen.box_px[:, None, :2], region_px[None, :, :2])
            high = np.minimum(seen.box_px[:, None, 2:], region_px[None, :, 2:])
            shared = np.clip(high - low, 0, None).prod(axis=2).max(axis=1)
            area = (seen.box_px[:, 2:] - seen.box_px[:, :2]).prod(axis=1)
            share[rows] = np.divide(shared, area, out=np.zeros_like(area), where=area > 0)
    return ImageViews(shown, height, outside, np.where(shown, share, 0))


MAX_STAMP_ERROR_NS = 1_000_000  # stamps of one sweep differ by rounding at most this much


@dataclass(frozen=True, eq=False)
class SweepTruth:
    """Labels by sweep; L rows."""

    labeled: NDArray[np.bool_]  # (F,) whether each of the sweeps asked for is labeled
    boxes: SceneBoxes  # their scenes are indices of sweeps; points are None for a log without LiDAR
    origin_m: Array  # (F, 3) from where ranges are measured, map frame: the ego, or the middle of the sensors
    kind: NDArray[np.str_]  # (L,) the log's own word for the category, "" where it has none
    occlusion: NDArray[np.int64]  # (L,) as the log states it; 0 where it states nothing


def truth_of_sweeps(
    log: Log, t_ns: NDArray[np.int64], *, progress: Callable[[int, int], None] | None = None
) -> SweepTruth:
    """Assign the labels of a log to sweeps and count the points in each.

    `t_ns` (F,): stamps of the sweeps, absolute, increasing. `progress`: called with (sweeps done, all sweeps); every
    sweep is read once. Raises `LogError` when the log has no labels, or none of these sweeps.

    A turning LiDAR sees objects at different times of a sweep, and labels may have the stamps of cameras. Each label is moved
    along its track to the mean time of the points in it, which is where a detector finds the object: at 15 m/s and 10 Hz it
    is up to 0.75 m off otherwise.
    """
    labels = log.labels
    if labels is None or len(labels.t_ns) == 0:
        raise LogError(f"{log.name}: the log has no labeled 3D boxes; name a log with labels as truth")
    run = None
    if any(len(log.streams[name].t_ns) for name in log.lidars if name in log.streams):
        run = start(log, Config().changed(detect={"name": "lidar:labels"}, measure={"max_range_m": 200.0}))
    middle = t_ns + (0 if run is None else middle_ns(run))
    tracks = LabelTracks.of(labels)
    labeled = labeled_sweeps(labels, middle, tracks.period_s)
    if not labeled.any():
        (first, last), (first_label, last_label) = (
            (v.min() / NS_PER_S, v.max() / NS_PER_S) for v in (t_ns, labels.t_ns)
        )
        raise LogError(
            f"{log.name}: none of the {len(t_ns)} sweeps is labeled; they last from {first:.3f} to {last:.3f} s, the labels "
            f"from {first_label:.3f} to {last_label:.3f} s; are both of one log?"
        )
    sweep, track = tracks.present(middle)
    sweep, track = sweep[labeled[sweep]], track[labeled[sweep]]
    seen_ns, points = middle[sweep], None
    if run is not None:
        seen_ns, points = _seen_by_lidar(run, t_ns, tracks, sweep, track, progress)
    pose, rows = tracks.at(track, seen_ns)
    origin = np.array([cloud_origin(log, int(t))[0] for t in t_ns])
    box = np.column_stack([pose[:, :3], labels.size_m[rows], pose[:, 3]])
    away = np.hypot(*(box[:, :2] - origin[sweep, :2]).T)
    return SweepTruth(
        labeled,
        SceneBoxes.of(box, labels.category[rows], scene=sweep, points=points, range_m=away),
        origin,
        np.full(len(rows), "") if labels.kind is None else labels.kind[rows],
        np.zeros(len(rows), dtype=np.int64) if labels.occlusion is None else labels.occlusion[rows],
    )


def labeled_sweeps(labels: Labels, middle_ns: NDArray[np.int64], period_s: float) -> NDArray[np.bool_]:
    """Mark (F,) the sweeps that are labeled: those near a label and, where every sweep is labeled, all between labels.

    `labels`: at least one; where they tell what was labeled, only sweeps near that are. `middle_ns` (F,): middles of
    the sweeps. `period_s`: time between labels of one object.
    """
    stamps = np.sort(labels.t_ns) if labels.labeled_ns is None else labels.labeled_ns
    near = np.abs(stamps[nearest_index(stamps, middle_ns)] - middle_ns) <= MAX_LAG_NS
    if labels.labeled_ns is not None or period_s > MAX_PERIODS * period_of(middle_ns):
        return np.asarray(near)
    return np.asarray(near | ((middle_ns >= stamps[0]) & (middle_ns <= stamps[-1])))


def _seen_by_lidar(
    run: Run,
    t_ns: NDArray[np.int64],
    tracks: LabelTracks,
    sweep: NDArray[np.int64],
    track: NDArray[np.int64],
    progress: Callable[[int, int], None] | None,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Read the sweeps with stamps (F,) that labels (L,) of tracks are in.

    Returns (L,) each: when the LiDARs saw the object, ns, the middle of the sweep where they did not, and the points above the ground in its box.
    """
    stamps = run.schedule.t_ns - middle_ns(run)
    tick = nearest_index(stamps, t_ns)
    known = np.flatnonzero(np.abs(stamps[tick] - t_ns) <= MAX_STAMP_ERROR_NS)
    seen_ns, points = (t_ns + middle_ns(run))[sweep], np.zeros(len(sweep), dtype=np.int64)
    needed = known[np.isin(known, sweep)]
    run = replace(run, schedule=take_ticks(run.schedule, tick[needed]))
    for k, cloud, _ in clouds(run, RecordSource(run.log), None):
        mine = np.flatnonzero(sweep == needed[k])
        if cloud is not None:
            for _ in range(2):  # where objects are in the middle of the sweep, then where they were seen
                pose, rows = tracks.at(track[mine], seen_ns[mine])
                above = ~cloud.ground
                inside = points_of_boxes(cloud.xyz[above], pose[:, :3] - cloud.origin, tracks.size_m[rows], pose[:, 3])
                points[mine] = inside.count
                mean_ns = cloud.stamp_ns + np.round(inside.mean(cloud.t_s[above]) * NS_PER_S).astype(np.int64)
                seen_ns[mine] = np.where(points[mine] > 0, mean_ns, seen_ns[mine])
        if progress is not None:
            progress(k + 1, len(needed))
    return seen_ns, points
