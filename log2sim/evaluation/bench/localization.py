"""Where objects were placed, by their LiDAR points or by a homography alone, against where they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, Log, Measurements, Scenario
from log2sim.evaluation.bench.bootstrap import error_of
from log2sim.evaluation.bench.scores import CUT_M, Judged
from log2sim.evaluation.metrics.align import Side, truth_side
from log2sim.geometry import NS_PER_S, Array, Camera, apply_homography, box_iou, inverse, project_boxes
from log2sim.perception.first_pass import Observations, base_pose
from log2sim.perception.homography.correspondences import Correspondences, foot_points, undistorted_pixels
from log2sim.perception.homography.placement import MAX_RANGE_M
from log2sim.perception.homography_stage import CameraHomography, place_by_homography
from log2sim.perception.sync import Schedule

LEAST_IOU = 0.5
NEAR_M = 25.0
HELD_OUT = 0.25
"""Part of the measured obstacles that homographies are not fitted to, so that they can be judged by them."""

LEAST_POINTS = 20
SAME_FOOT_PX = 0.01
BLOCK_S = 0.5


@dataclass(frozen=True, eq=False)
class Known:
    """Where the objects of a tick's measurements are: `xy` (M, 2) in the map, NaN where not known, and `who` (M,) each is."""

    xy: Array
    who: NDArray[np.int64]


def true_places(
    log: Log,
    schedule: Schedule,
    seen: Observations,
    truth: Scenario,
    *,
    when: Literal["measured", "imaged"] = "measured",
) -> list[Known]:
    """For every tick the true centers of the objects in the boxes of its measurements.

    They are those at the measurements' own times, or at the stamps of the images. Objects are recognized in the image, by
    the overlap of boxes, so that a wrong place cannot hide itself.
    """
    shift_m = np.array(truth.map.offset_m) - np.array(log.map.offset_m)
    out = [Known(np.full((len(m), 2), np.nan), np.full(len(m), -1)) for m in seen.measurements]
    for camera, index in schedule.frames.items():
        ticks = np.flatnonzero(index >= 0)
        stamps = log.streams[camera].t_ns[index[ticks]]
        side = truth_side(truth.others, (stamps - truth.t0_ns) / NS_PER_S, shift_m, None)
        map_T_cam, known = log.map_T_sensor(camera, stamps)
        for k in np.flatnonzero(known):
            m = seen.measurements[ticks[k]]
            rows = np.flatnonzero(m.camera == camera)
            if len(rows) and len(side.ids):
                boxes = _boxes_in_image(log, camera, side, int(k), inverse(map_T_cam[k]))
                pairs = _recognized(m.take(rows), side, boxes)
                later_s = (m.t_ns[rows] - stamps[k]) / NS_PER_S if when == "measured" else np.zeros(len(rows))
                out[ticks[k]].xy[rows] = _true_xy(side, int(k), pairs, later_s)
                out[ticks[k]].who[rows] = pairs
    return out


def lidar_places(seen: Observations, tick_s: float) -> list[Known]:
    """Where LiDAR has the objects of every tick's measurements; those of half a second are taken for one."""
    return [
        Known(m.center_m[:, :2], np.full(len(m), int(tick * tick_s / BLOCK_S)))
        for tick, m in enumerate(seen.measurements)
    ]


def _boxes_in_image(log: Log, camera: str, side: Side, k: int, cam_T_map: Array) -> Array:
    """Boxes (A, 4) of all truth agents that count at a frame, NaN for the others."""
    boxes = np.full((len(side.ids), 4), np.nan)
    rows = np.flatnonzero(side.there[:, k] & side.visible[:, k])
    center = np.column_stack([side.xy_m[rows, k], side.z_m[rows, k]])
    seen = project_boxes(center, side.size_m[rows], side.yaw_rad[rows, k], log.cameras[camera], cam_T_map)
    boxes[rows] = seen.box_px
    return boxes


def _recognized(m: Measurements, side: Side, boxes: Array) -> NDArray[np.intp]:
    """Index (M,) of the truth agent in each measured box, -1 for none: boxes of one group that overlap each other best."""
    group = np.array([GROUP_OF[str(c)] for c in m.category])
    overlap = np.nan_to_num(box_iou(m.box_px, boxes))
    overlap = np.where(group[:, None] == side.group, overlap, 0.0)
    best, back = overlap.argmax(axis=1), overlap.argmax(axis=0)
    rows = np.arange(len(m))
    return np.where((overlap[rows, best] >= LEAST_IOU) & (back[best] == rows), best, -1)


def _true_xy(side: Side, k: int, pairs: NDArray[np.intp], later_s: Array) -> Array:
    """True centers (M, 2) so many seconds (M,) after frame `k`, which are a few hundredths."""
    speed, yaw = side.speed_mps[pairs, k], side.yaw_rad[pairs, k]
    xy = side.xy_m[pairs, k] + (speed * later_s)[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return np.where((pairs >= 0)[:, None], xy, np.nan)


def judge_measured(seen: Observations, known: Sequence[Known]) -> Judged:
    """How far measured centers lie from the true ones; `error_m` cuts at 2 m, which objects without a place count as."""
    measured = np.concatenate([m.center_m[:, :2] for m in seen.measurements])
    true, who = np.concatenate([k.xy for k in known]), np.concatenate([k.who for k in known])
    asked = np.isfinite(true[:, 0])
    return _judge_distances(np.hypot(*(measured - true)[asked].T), who[asked])


def _judge_distances(distance: Array, who: NDArray[np.int64]) -> Judged:
    """Figures of distances (K,), NaN for objects without a place; `who` (K,) says which are one object's."""
    cut = np.where(distance < CUT_M, distance, CUT_M)
    squares, count = np.bincount(who, cut**2), np.bincount(who)
    parts = {str(k): (float(squares[k]), float(count[k])) for k in np.flatnonzero(count)}
    placed = np.isfinite(distance)
    figures = {
        "objects": len(distance),
        "placed_share": float(placed.mean()) if len(distance) else None,
        "error_m": error_of(parts),
        "median_m": float(np.median(distance[placed])) if placed.any() else None,
        "farther_than_2_m_share": float(np.mean(cut >= CUT_M)) if len(distance) else None,
    }
    return Judged(figures, {"error_m": parts})


@dataclass(frozen=True, eq=False)
class Held:
    """Measured obstacles kept from the homographies.

    `seen` is what is left to fit to. `asked` holds by camera the obstacles of every tick, their LiDAR place taken away,
    `known` where their centers are and `feet`, in the same order, where LiDAR has their feet.
    """

    seen: Observations
    asked: dict[str, list[Measurements]]
    known: dict[str, list[Known]]
    feet: dict[str, list[Correspondences]]

    def __len__(self) -> int:
        return sum(len(m) for rows in self.asked.values() for m in rows)


def hold_out(
    log: Log, schedule: Schedule, seen: Observations, known: Sequence[Known], rng: np.random.Generator
) -> Held:
    """Set a part of the measured obstacles within 60 m aside, with what is known of their places at the images' stamps."""
    asked: dict[str, list[Measurements]] = {camera: [] for camera in seen.feet}
    places: dict[str, list[Known]] = {camera: [] for camera in seen.feet}
    held: dict[str, list[Correspondences]] = {camera: [] for camera in seen.feet}
    for tick, m in enumerate(seen.measurements):
        xy, who = known[tick].xy, known[tick].who
        near = np.hypot(*(m.center_m - m.sensor_m)[:, :2].T) <= MAX_RANGE_M
        good = (m.source == "lidar") & ~m.truncated & (m.points >= LEAST_POINTS) & near & np.isfinite(xy[:, 0])
        good &= np.array([len(c) > 0 for c in m.cluster], dtype=bool)
        good &= rng.random(len(m)) < HELD_OUT
        for camera in asked:
            rows = np.flatnonzero(good & (m.camera == camera))
            stamp = int(log.streams[camera].t_ns[schedule.frames[camera][tick]])
            ego_T_map = inverse(base_pose(log, stamp))
            held[camera].append(foot_points(log.cameras[camera], m.take(rows), ego_T_map, tick))
            asked[camera].append(_without_place(m.take(rows), stamp))
            places[camera].append(Known(xy[rows], who[rows]))
    feet = {camera: [_without_feet(log.cameras[camera], parts, asked[camera])] for camera, parts in seen.feet.items()}
    return Held(replace(seen, feet=feet), asked, places, held)


def _without_place(m: Measurements, stamp: int) -> Measurements:
    """The rows as they were in the image of that stamp, before a LiDAR point fell on them."""
    return replace(
        m,
        t_ns=np.full(len(m), stamp),
        source=np.full(len(m), "", dtype="<U16"),
        center_m=np.full((len(m), 3), np.nan),
        covariance=np.full((len(m), 2, 2), np.nan),
        cluster=tuple(np.zeros((0, 3)) for _ in range(len(m))),
    )


def _without_feet(camera: Camera, parts: Sequence[Correspondences], asked: Sequence[Measurements]) -> Correspondences:
    """The correspondences of a camera but those of the obstacles that were set aside."""
    feet = Correspondences.join(parts)
    tick = np.concatenate([np.full(len(m), k) for k, m in enumerate(asked)])
    box = np.concatenate([m.box_px for m in asked])
    if not len(box) or not len(feet.uv):
        return feet
    uv = undistorted_pixels(camera, np.column_stack([(box[:, 0] + box[:, 2]) / 2, box[:, 3]]))
    same = (feet.tick[:, None] == tick) & (np.abs(feet.uv[:, None] - uv).max(axis=2) < SAME_FOOT_PX)
    kept = ~same.any(axis=1)
    return replace(feet, **{name: column[kept] for name, column in vars(feet).items() if column is not None})


def judge_placed(log: Log, held: Held, grounds: Mapping[str, CameraHomography]) -> Judged:
    """How far the homographies alone put the feet of the obstacles that were set aside from where LiDAR has them.

    `near_error_m` and `far_error_m` are of those within and beyond 25 m. `center_error_m` and `center_median_m` are of the
    centers against what is known of these; half of that is a guess of how deep an object is, which can cancel the error
    of a bad homography. Everything is cut at 2 m, which feet without a place count as.
    """
    feet, centers, range_m, who = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    for camera in (c for c in held.asked if c in grounds):
        for tick, (m, known) in enumerate(zip(held.asked[camera], held.known[camera], strict=True)):
            feet.append(_foot_distances(held.feet[camera][tick], at_tick(grounds[camera], tick)))
            centers.append(np.hypot(*(_places(log, tick, m, grounds[camera]) - known.xy).T))
            range_m.append(np.hypot(*(known.xy - m.sensor_m[:, :2]).T))
            who.append(known.who)
    d, near, w = np.concatenate(feet), np.concatenate(range_m) < NEAR_M, np.concatenate(who)
    judged, center = _judge_distances(d, w), _judge_distances(np.concatenate(centers), w).figures
    extra = {
        f"{name}_error_m": _judge_distances(d[rows], w[rows]).figures["error_m"]
        for name, rows in (("near", near), ("far", ~near))
    }
    extra |= {f"center_{key}": center[key] for key in ("error_m", "median_m")}
    return Judged(judged.figures | extra, judged.parts)


def _foot_distances(feet: Correspondences, ground: CameraHomography) -> Array:
    """How far (N,) a homography puts feet from where they are, m; NaN for those above its horizon."""
    if not len(feet.uv):
        return np.zeros(0)
    return np.asarray(np.hypot(*(apply_homography(ground.fit.ground_H_image, feet.uv)[0] - feet.xy_ego).T))


def _places(log: Log, tick: int, m: Measurements, ground: CameraHomography) -> Array:
    """Places (M, 2) in the map of the rows of a tick by the homography, that of the tick where it has one of its own."""
    if not len(m):
        return np.zeros((0, 2))
    seen = Observations(measurements=[m], obstacles=[None])
    found = place_by_homography(log, seen, {ground.camera.name: at_tick(ground, tick)})[0]
    return _in_order(m, found)


def at_tick(ground: CameraHomography, tick: int) -> CameraHomography:
    """A camera's homography at one tick: its own where every tick has one, and then none where that could not be fitted."""
    fit = ground.fit
    if fit.per_tick is None or not fit.ok:
        return ground
    k = np.flatnonzero(fit.ticks == tick)
    own = fit.per_tick[k[0]] if len(k) else np.full((3, 3), np.nan)
    return replace(ground, fit=replace(fit, ground_H_image=own, ok=bool(np.isfinite(own).all())))


def _in_order(asked: Measurements, found: Measurements) -> Array:
    """Centers (M, 2) of found rows in the order in which they were asked for, by their boxes; NaN for those without."""
    xy = np.full((len(asked), 2), np.nan)
    for box, center in zip(found.box_px, found.center_m):
        xy[np.all(asked.box_px == box, axis=1)] = center[:2]
    return xy
