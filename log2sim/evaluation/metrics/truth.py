"""The truth scenario of a log: labels, visibility, and where labels are incomplete."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from log2sim.datatypes import Agent, AgentTable, IgnoreRegions, Labels, LabelView, Log, Scenario, Waypoints
from log2sim.errors import ConfigError, LogError, MissingExtra
from log2sim.files.plugins import nearest
from log2sim.geometry import (
    MIN_DEPTH_M,
    NS_PER_S,
    Array,
    Camera,
    apply,
    box_corners,
    inverse,
    nearest_index,
    outline,
    project,
    quaternion_from_rotation,
    wrap_angle,
    yaw_of,
)
from log2sim.localization.choice import localize_like
from log2sim.logs.opening import is_log_file, open_log
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.lidar.cloud import sweep_to_map
from log2sim.perception.records import RecordSource

SAMPLES_PER_SIDE = 32


def image_shares(camera: Camera, cam_T_map: Array, center_m: Array, size_m: Array, yaw_rad: Array) -> Array:
    """Compute the share (M,) of the outline of each box of the map frame that lies inside the image.

    The outline is the convex hull of the part of the box in front of the camera on the plane at depth 1, where edges are
    straight for any lens. The share is that of a grid of samples, accurate to 1 or 2 %: exact clipping would need the
    image border on that plane, which does not exist for every strong distortion.
    """
    in_cam = apply(cam_T_map, box_corners(center_m, size_m, yaw_rad).reshape(-1, 3))
    whole = project(camera, in_cam)[1].reshape(-1, 8).all(axis=1)
    in_cam = in_cam.reshape(-1, 8, 3)
    shares = np.where(whole, 1.0, 0.0)
    for k in np.flatnonzero(~whole & (in_cam[..., 2] > MIN_DEPTH_M).any(axis=1)):
        samples = _samples(outline(in_cam[k]))
        if len(samples):
            _, inside = project(camera, np.column_stack([samples, np.ones(len(samples))]))
            shares[k] = inside.mean()
    return shares


def image_samples(camera: Camera, cam_T_map: Array, center_m: Array, size_m: Array, yaw_rad: Array) -> list[Array]:
    """Sample pixels (S, 2) evenly over the part of each box's outline inside the image; none for a box outside.

    As in `image_shares`, but with a grid over the view only: next to the camera an outline on the plane at depth 1 can be
    so wide that a grid over all of it has no sample inside the image.
    """
    corners = apply(cam_T_map, box_corners(center_m, size_m, yaw_rad).reshape(-1, 3)).reshape(-1, 8, 3)
    size, focal = np.array([camera.width_px, camera.height_px]), np.diag(camera.K)[:2]
    low, high = -camera.K[:2, 2] / focal, (size - camera.K[:2, 2]) / focal
    # Distortion widens a view on this plane to at most three times that of a pinhole.
    low, high = (low, high) if camera.distortion_model == "none" else (3 * low, 3 * high)
    found = []
    for box in corners:
        rays = _samples(outline(box), low, high)
        uv, inside = project(camera, np.column_stack([rays, np.ones(len(rays))]))
        found.append(uv[inside])
    return found


def _samples(points: Array, lowest: Array | float = -np.inf, highest: Array | float = np.inf) -> Array:
    """Make a regular grid of points (S, 2) inside the convex hull of points (N, 2), and between two corners (2,)."""
    hull = shapely.MultiPoint(points).convex_hull
    if hull.geom_type != "Polygon":
        return np.zeros((0, 2))
    polygon = shapely.get_coordinates(shapely.geometry.polygon.orient(hull))[:-1]
    low, high = np.maximum(polygon.min(axis=0), lowest), np.minimum(polygon.max(axis=0), highest)
    if np.any(low >= high):
        return np.zeros((0, 2))
    steps = (np.arange(SAMPLES_PER_SIDE) + 0.5) / SAMPLES_PER_SIDE
    x, y = np.meshgrid(*(low + steps[:, None] * (high - low)).T)
    points = np.stack([x.ravel(), y.ravel()], -1)
    edge = np.roll(polygon, -1, axis=0) - polygon
    to = points[:, None] - polygon[None]
    return points[np.all(edge[:, 0] * to[..., 1] - edge[:, 1] * to[..., 0] >= 0, axis=1)]


MAX_STAMP_LAG_NS = 50_000_000  # a region belongs to the frame nearest to its stamp within this time


def ignore_regions_of(log: Log, t0_ns: int) -> IgnoreRegions | None:
    """Collect the ignore regions of a log; None when its labels are complete.

    `log`: its labels may be limited to the views of some cameras and to some categories, and it may have ignored
    regions. `t0_ns`: start of the truth. Raises `LogError` when labels refer to a camera that the log does not have.
    """
    only = None if log.labels is None else log.labels.cameras
    never = () if log.labels is None else log.labels.never_labeled
    if only is None and not log.ignored_regions and not never:
        return None
    names = list(log.ignored_regions) if only is None else list(only)
    for name in names:
        if name not in log.cameras:
            raise LogError(
                f"{log.name}: its labels are of camera '{name}'{nearest(name, list(log.cameras))}, which it does not "
                f"have; there are: {', '.join(log.cameras)}"
            )
    views = []
    for name in names:
        t_ns = np.unique(log.streams[name].t_ns) if name in log.streams else np.zeros(0, dtype=np.int64)
        poses, known = log.map_T_sensor(name, t_ns)
        t_ns, poses = t_ns[known], poses[known]
        frame, box = np.zeros(0, dtype=np.int64), np.zeros((0, 4))
        regions = log.ignored_regions.get(name)
        if regions is not None and len(t_ns):
            frame = nearest_index(t_ns, regions.t_ns)
            near = np.abs(t_ns[frame] - regions.t_ns) <= MAX_STAMP_LAG_NS
            frame, box = frame[near], regions.box_px[near]
        rotation = quaternion_from_rotation(poses[:, :3, :3])
        t_s = (t_ns - t0_ns) / NS_PER_S
        views.append(LabelView(log.cameras[name], t_s, poses[:, :3, 3], rotation, frame, box))
    return IgnoreRegions(tuple(views), outside_views=only is not None, categories=never)


MIN_POINTS = 20
MIN_IMAGE_SHARE = 0.5
MAX_LAG_S = 0.1  # a label is compared with the nearest sweep and frames within this time
SPEED_WINDOW_S = 0.25
MAX_STATIC_REACH_M = 0.5
MAX_STATIC_DRIFT_MPS = 0.2
Progress = Callable[[int, int], None]


def load_truth(
    source: Scenario | Log | Path | str,
    scenario: Scenario,
    *,
    sequence: str | None = None,
    labels: Path | None = None,
    points: bool = False,
    progress: Progress | None = None,
) -> Scenario:
    """Load the ground truth of a scenario for the cameras that it used; see `truth_at`."""
    used = [str(c["name"]) for c in scenario.cameras if c.get("used")]
    return truth_at(
        source, used if scenario.cameras else None, sequence, provenance=scenario.provenance, labels=labels,
        points=points, progress=progress,
    )  # fmt: skip


def truth_at(
    source: Scenario | Log | Path | str,
    used: Iterable[str] | None,
    sequence: str | None,
    *,
    provenance: Mapping[str, Any] | None = None,
    labels: Path | None = None,
    points: bool = False,
    progress: Progress | None = None,
) -> Scenario:
    """Load ground truth from a scenario or a log: its `truth.json`, else its labels in view of the sensors used.

    `used`: cameras that were used, all of the log for None. Without any camera, what the LiDARs show counts as visible.
    `sequence`: of a folder with several. `provenance`: states the poses by which labels are placed, so that they are in
    the map of what is compared. `labels`: file with the true boxes of the log; see `log2sim.logs.label_files`.
    `points`: whether LiDAR points are counted in all boxes, also where the truth states what is visible. `progress`: as
    for `truth_from_log`. Raises `LogError` when there are no labels, or they cannot be read.
    """
    if isinstance(source, Scenario):
        return source
    path = None if isinstance(source, Log) else Path(source)
    if path is not None and not (path.is_dir() or is_log_file(path)):
        if labels is not None:
            raise ConfigError(f"--labels {labels}: the labels are of a log; {path} is none")
        return Scenario.load(path)
    if path is not None and labels is None and (path / "truth.json").is_file():
        stated = Scenario.load(path / "truth.json")
        if not points:
            return stated
        try:  # by the poses of the log, in whose map its truth is
            return count_points(stated, open_log(path, sequence=sequence), progress)
        except (LogError, ConfigError, MissingExtra):  # what can be compared does not need the sweeps
            return stated
    opened = source if isinstance(source, Log) else open_log(source, sequence=sequence, labels=labels)
    log = localize_like(opened, provenance or {})
    names = None if used is None else list(used)
    known = None if names is None else [name for name in names if name in log.cameras]
    cameras = None if names and not known else known
    truth = truth_from_log(log, cameras=cameras, points=points, progress=progress)
    if labels is None:
        return truth
    notes = [note for note in log.notes if note.startswith(f"{labels.name}: ")]
    return replace(truth, provenance={**truth.provenance, "labels": labels.name, "notes": notes})


def truth_from_log(
    log: Log, *, cameras: Sequence[str] | None = None, points: bool = False, progress: Progress | None = None
) -> Scenario:
    """Make a truth scenario of a log's labeled 3D boxes and its ego poses.

    `cameras`: cameras that were used, all by default; only what they show counts as visible. `points`: whether LiDAR
    points are counted also where the log states visibility, which needs none. `progress`: called with (sweeps done, all
    sweeps); every sweep is read once. Raises `LogError` when the log has no labels. Raises `ConfigError` for a camera
    that the log does not have.

    A box is visible when at least half of its outline is inside a used camera's image and at least 20 LiDAR points are in
    it. Without cameras or without LiDAR the other condition decides; visibility that the log states takes precedence.
    """
    labels = log.labels
    if labels is None or len(labels.t_ns) == 0:
        raise LogError(f"{log.name}: the log has no labeled 3D boxes; name a truth scenario or a log with labels")
    used = list(log.cameras) if cameras is None else list(cameras)
    for name in used:
        if name not in log.cameras:
            hint = f"{nearest(name, list(log.cameras))}; known: {', '.join(log.cameras)}"
            raise ConfigError(f"unknown camera '{name}'{hint}")
    counts, unreadable = None, 0
    if log.lidars and (points or labels.visible is None):
        counts, unreadable = points_in_labels(log, labels, progress)
    if labels.visible is not None:
        visible = np.asarray(labels.visible, dtype=bool)
    else:
        visible = np.ones(len(labels.t_ns), dtype=bool) if counts is None else counts >= MIN_POINTS
        if used:
            # Mark (L,) the boxes that are at least half inside some camera's image
            found = np.zeros(len(labels.t_ns), dtype=bool)
            for name in used:
                stream = log.streams.get(name)
                if stream is None or len(stream.t_ns) == 0:
                    continue
                index, near = nearest_record(stream.t_ns, labels.t_ns)
                poses, known = log.map_T_sensor(name, stream.t_ns)
                open_rows = np.flatnonzero(visible & ~found & near & known[index])
                for i in np.unique(index[open_rows]):
                    rows = open_rows[index[open_rows] == i]
                    boxes = labels.center_m[rows], labels.size_m[rows], labels.yaw_rad[rows]
                    found[rows] = image_shares(log.cameras[name], inverse(poses[i]), *boxes) >= MIN_IMAGE_SHARE
            visible &= found
    ego_t_ns, map_T_ego = _ego_poses(log)
    t0_ns = int(min([labels.t_ns.min(), *ego_t_ns[:1]]))
    agents = []
    for rows in rows_by_track(labels):
        center, yaw = labels.center_m[rows], np.asarray(labels.yaw_rad[rows], dtype=np.float64)
        t_s = (labels.t_ns[rows] - t0_ns) / NS_PER_S
        static = is_static(t_s, center[:, :2])
        speed = np.zeros(len(rows)) if static else speed_along(t_s, center[:, :2], yaw)
        w = _waypoints(t_s, center, yaw, speed, visible[rows])
        w = replace(w, lidar_points=None if counts is None else counts[rows].astype(np.float64))
        name, size_m = str(labels.track_id[rows[0]]), tuple(np.median(labels.size_m[rows], axis=0).tolist())
        name = "label-ego" if name == "ego" else name  # "ego" is reserved
        agents.append(Agent(name, str(labels.category[rows[0]]), size_m, w, static=static))
    if len(ego_t_ns):
        vehicle, center, t_s = log.ego_vehicle, log.ego_centers(map_T_ego), (ego_t_ns - t0_ns) / NS_PER_S
        yaw, static = yaw_of(map_T_ego), is_static(t_s, center[:, :2])
        w = _waypoints(t_s, center, yaw, speed_along(t_s, center[:, :2], yaw), np.ones(len(t_s), dtype=bool))
        offset_m = vehicle.rear_axle_offset_m
        agents.insert(0, Agent("ego", "car", vehicle.size_m, w, static=static, rear_axle_offset_m=offset_m))
    computed = f"at least {MIN_IMAGE_SHARE:g} of the projected box inside a used camera and at least {MIN_POINTS} LiDAR points in the box"
    how = ("as the log states", "stated") if labels.visible is not None else (computed, "computed")
    provenance = {
        "source": "labels", "log": log.name, "format": log.format, "digest": log.digest, "cameras": used,
        "visible": how[0], "visibility": how[1], "unreadable_sweeps": unreadable,
    }  # fmt: skip
    return Scenario(
        name=log.name,
        t0_ns=t0_ns,
        duration_s=max(float(a.waypoints.t_s[-1]) for a in agents),
        agents=tuple(agents),
        map=log.map,
        provenance=provenance,
        ignore_regions=ignore_regions_of(log, t0_ns),
    )


def points_in_labels(log: Log, labels: Labels, progress: Progress | None = None) -> tuple[NDArray[np.int64], int]:
    """Count the points (L,) of all LiDARs inside each box, and the sweeps that could not be read."""
    counts, records = np.zeros(len(labels.t_ns), dtype=np.int64), RecordSource(log)
    step = _stepper(log, progress)
    for name in _lidars(log):
        boxes = labels.t_ns, labels.center_m, labels.size_m, labels.yaw_rad
        counts += _points_in_boxes(log, name, records, *boxes, step)
    return counts, sum(len(problems) for problems in records.failed.values())


def _lidars(log: Log) -> list[str]:
    return [name for name in log.lidars if name in log.streams]


def _stepper(log: Log, progress: Progress | None) -> Callable[[], None]:
    """Return what reports the next of all sweeps as done."""
    done, total = itertools.count(1), sum(len(log.streams[name].t_ns) for name in _lidars(log))
    return lambda: None if progress is None else progress(next(done), total)


def _points_in_boxes(
    log: Log,
    lidar: str,
    records: RecordSource,
    t_ns: NDArray[np.int64],
    center_m: Array,
    size_m: Array,
    yaw_rad: Array,
    step: Callable[[], None],
) -> NDArray[np.int64]:
    """Count the points (L,) of a LiDAR inside boxes (L,) at stamps (L,), each in the sweep nearest to it within `MAX_LAG_S`."""
    counts = np.zeros(len(t_ns), dtype=np.int64)
    index, near = nearest_record(log.streams[lidar].t_ns, t_ns)
    for i in range(len(log.streams[lidar].t_ns)):
        rows = np.flatnonzero((index == i) & near)
        sweep = records.get(lidar, i) if len(rows) else None
        mapped = None if sweep is None else sweep_to_map(log, lidar, sweep, compensate=True)
        if mapped is not None:
            xyz = np.asarray(mapped[0], dtype=np.float64)
            counts[rows] = points_of_boxes(xyz, center_m[rows], size_m[rows], np.asarray(yaw_rad)[rows]).count
        step()
    return counts


def nearest_record(
    stream_t_ns: NDArray[np.int64], t_ns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Find the record (L,) nearest to each stamp and whether it is within `MAX_LAG_S`; stamps may be in any order."""
    if len(stream_t_ns) == 0:
        return np.zeros(len(t_ns), dtype=np.int64), np.zeros(len(t_ns), dtype=bool)
    order = np.argsort(stream_t_ns, kind="stable")
    index = order[nearest_index(stream_t_ns[order], t_ns)]
    return index, np.abs(stream_t_ns[index] - t_ns) <= round(MAX_LAG_S * NS_PER_S)


def rows_by_track(labels: Labels) -> list[NDArray[np.int64]]:
    """List the rows of each track in order of time; of two rows of one track at one stamp the first."""
    _, track = np.unique(labels.track_id, return_inverse=True)
    order = np.lexsort((labels.t_ns, track))
    t, k = labels.t_ns[order], track[order]
    order = order[np.r_[True, (np.diff(t) > 0) | (np.diff(k) != 0)]]
    return np.split(order, np.flatnonzero(np.diff(track[order])) + 1)


def count_points(truth: Scenario, log: Log, progress: Progress | None = None) -> Scenario:
    """Return a truth with the LiDAR points of a log in its boxes, which are put where they were at the time of the sweep.

    A waypoint gets the points of the sweeps nearest to it within `MAX_LAG_S`; where the log has no LiDAR, nothing changes.
    """
    if not _lidars(log):
        return truth
    records, step = RecordSource(log), _stepper(log, progress)
    totals = [np.zeros(len(agent.waypoints)) for agent in truth.others]
    for name in _lidars(log):
        stamps = log.streams[name].t_ns
        table = AgentTable.of(truth.others, (stamps - truth.t0_ns) / NS_PER_S)
        k, i = np.nonzero(table.present)
        counts = np.zeros(table.present.shape, dtype=np.int64)
        boxes = table.center_m[k, i], table.size_m[k], table.yaw_rad[k, i]
        counts[k, i] = _points_in_boxes(log, name, records, stamps[i], *boxes, step)
        for row, agent in enumerate(truth.others):
            t_ns = truth.t0_ns + np.round(agent.waypoints.t_s * NS_PER_S).astype(np.int64)
            index, near = nearest_record(stamps, t_ns)
            totals[row] += np.where(near, counts[row, index], 0) if len(stamps) else 0
    agents = [replace(a, waypoints=replace(a.waypoints, lidar_points=n)) for a, n in zip(truth.others, totals)]
    return replace(truth, agents=(*([truth.ego] if truth.ego is not None else []), *agents))


def _ego_poses(log: Log) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (T,) and the ego poses (T, 4, 4) known there.

    The stamps are those of the reference camera, without cameras of the LiDAR with the most sweeps, else of the poses.
    """
    if log.ego is None:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 4, 4))
    name = log.reference_camera or next(iter(log.cameras), None)
    if name is None:
        name = max(log.lidars, key=lambda lidar: len(log.streams[lidar].t_ns), default=None)
    stream = None if name is None else log.streams.get(name)
    t_ns = log.ego.t_ns if stream is None or len(stream.t_ns) == 0 else np.unique(stream.t_ns)
    poses, known = log.ego.at(t_ns)
    return t_ns[known], poses[known]


def _waypoints(t_s: Array, center: Array, yaw: Array, speed: Array, visible: NDArray[np.bool_]) -> Waypoints:
    observed, sigma = np.ones(len(t_s), dtype=bool), np.zeros(len(t_s))
    x, y, z = center.T
    return Waypoints(t_s, x, y, z, wrap_angle(yaw), speed, observed, sigma, visible=visible)


def is_static(t_s: Array, xy_m: Array) -> bool:
    """Tell whether positions (T, 2) stay within half a meter of their mean without drift."""
    if len(t_s) < 2:
        return False
    away = xy_m - xy_m.mean(axis=0)
    since = t_s - t_s.mean()
    drift_mps = np.hypot(*(since @ away / (since @ since)))
    return bool(np.hypot(away[:, 0], away[:, 1]).max() <= MAX_STATIC_REACH_M and drift_mps <= MAX_STATIC_DRIFT_MPS)


def speed_along(t_s: Array, xy_m: Array, yaw_rad: Array) -> Array:
    """Estimate the speed (T,), m/s, along the heading by a line fitted to positions (T, 2) within a quarter second.

    5 cm of label noise give 0.7 m/s in differences of neighbors, 0.16 m/s in the fit at 10 Hz. A waypoint with no neighbor
    within the window takes the slope to its neighbors, a single one has speed 0.
    """
    if len(t_s) < 2:
        return np.zeros(len(t_s))
    first = np.searchsorted(t_s, t_s - SPEED_WINDOW_S - 1e-6)
    last = np.searchsorted(t_s, t_s + SPEED_WINDOW_S + 1e-6, side="right") - 1
    alone = first == last
    first = np.where(alone, np.maximum(first - 1, 0), first)
    last = np.where(alone, np.minimum(last + 1, len(t_s) - 1), last)
    velocity = np.empty((len(t_s), 2))
    for k, (a, b) in enumerate(zip(first, last)):
        t, xy = t_s[a : b + 1], xy_m[a : b + 1]
        since = t - t.mean()
        velocity[k] = since @ (xy - xy.mean(axis=0)) / (since @ since)
    return velocity[:, 0] * np.cos(yaw_rad) + velocity[:, 1] * np.sin(yaw_rad)
