"""Where objects were placed, by their LiDAR points or by a homography alone, against where they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.bench.figures import CUT_M
from log2sim.detect.projection import project_boxes
from log2sim.geometry import NS_PER_S, Array, box_iou, inverse
from log2sim.ground_plane import CameraGround, locate_the_rest
from log2sim.metrics.align import Side, truth_side
from log2sim.observe import Observed
from log2sim.scenario import Scenario
from log2sim.sync import Schedule
from log2sim.topdown import FARTHEST_M, Correspondences, pinhole
from log2sim.types import GROUP_OF, Log, Measurements

LEAST_IOU = 0.5
NEAR_M = 25.0
HELD_OUT = 0.25
"""Part of the measured obstacles that homographies are not fitted to, so that they can be judged by them."""

LEAST_POINTS = 20
SAME_FOOT_PX = 0.01


def true_places(
    log: Log, schedule: Schedule, seen: Observed, truth: Scenario, *, when: Literal["measured", "imaged"] = "measured"
) -> list[Array]:
    """For every tick the true centers (M, 2) of the objects in the boxes of its measurements; NaN where none is known.

    They are those at the measurements' own times, or at the stamps of the images. Objects are recognized in the image, by
    the overlap of boxes, so that a wrong place cannot hide itself.
    """
    shift_m = np.array(truth.map.offset_m) - np.array(log.map.offset_m)
    out = [np.full((len(m), 2), np.nan) for m in seen.measurements]
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
                out[ticks[k]][rows] = _true_xy(side, int(k), pairs, later_s)
    return out


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


def measured_figures(seen: Observed, true_xy: Sequence[Array]) -> dict[str, Any]:
    """How far measured centers lie from the true ones; `error_m` as in `scenario_figures`, without false objects."""
    measured = np.concatenate([m.center_m[:, :2] for m in seen.measurements])
    distance = np.hypot(*(measured - np.concatenate(list(true_xy))).T)
    has_truth = np.isfinite(np.concatenate([t[:, 0] for t in true_xy]))
    placed = np.isfinite(measured[:, 0])
    known, asked = distance[has_truth & placed], int(has_truth.sum())
    if not asked:
        return {"objects": 0, "error_m": None}
    cut = np.concatenate([np.minimum(known, CUT_M), np.full(asked - len(known), CUT_M)])
    return {
        "objects": asked,
        "placed_share": len(known) / asked,
        "error_m": float(np.sqrt(np.mean(cut**2))),
        "median_m": float(np.median(known)) if len(known) else None,
        "farther_than_2_m_share": float(np.mean(cut >= CUT_M)),
    }


@dataclass(frozen=True, eq=False)
class Held:
    """Measured obstacles kept from the homographies.

    `seen` is what is left to fit to. `asked` holds by camera the obstacles of every tick, their LiDAR place taken away,
    and `known_xy` where they are, (M, 2) in the map.
    """

    seen: Observed
    asked: dict[str, list[Measurements]]
    known_xy: dict[str, list[Array]]

    def __len__(self) -> int:
        return sum(len(m) for rows in self.asked.values() for m in rows)


def hold_out(
    log: Log, schedule: Schedule, seen: Observed, true_xy: Sequence[Array] | None, rng: np.random.Generator
) -> Held:
    """Set a part of the measured obstacles within 60 m aside, with their true places, or those of the LiDAR without truth."""
    asked: dict[str, list[Measurements]] = {camera: [] for camera in seen.feet}
    known: dict[str, list[Array]] = {camera: [] for camera in seen.feet}
    for tick, m in enumerate(seen.measurements):
        xy = m.center_m[:, :2] if true_xy is None else true_xy[tick]
        near = np.hypot(*(m.center_m - m.sensor_m)[:, :2].T) <= FARTHEST_M
        good = (m.source == "lidar") & ~m.truncated & (m.points >= LEAST_POINTS) & near & np.isfinite(xy[:, 0])
        good &= rng.random(len(m)) < HELD_OUT
        for camera in asked:
            rows = np.flatnonzero(good & (m.camera == camera))
            stamp = log.streams[camera].t_ns[schedule.frames[camera][tick]]
            asked[camera].append(_without_place(m.take(rows), int(stamp)))
            known[camera].append(xy[rows])
    feet = {camera: [_without_feet(log, camera, parts, asked[camera])] for camera, parts in seen.feet.items()}
    return Held(replace(seen, feet=feet), asked, known)


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


def _without_feet(
    log: Log, camera: str, parts: Sequence[Correspondences], asked: Sequence[Measurements]
) -> Correspondences:
    """The correspondences of a camera but those of the obstacles that were set aside."""
    feet = Correspondences.join(parts)
    tick = np.concatenate([np.full(len(m), k) for k, m in enumerate(asked)])
    box = np.concatenate([m.box_px for m in asked])
    if not len(box) or not len(feet.uv):
        return feet
    uv = pinhole(log.cameras[camera], np.column_stack([(box[:, 0] + box[:, 2]) / 2, box[:, 3]]))
    same = (feet.tick[:, None] == tick) & (np.abs(feet.uv[:, None] - uv).max(axis=2) < SAME_FOOT_PX)
    kept = ~same.any(axis=1)
    return Correspondences(feet.uv[kept], feet.xy_ego[kept], feet.tick[kept])


def placed_figures(log: Log, schedule: Schedule, held: Held, grounds: Mapping[str, CameraGround]) -> dict[str, Any]:
    """How far the homographies alone put the obstacles that were set aside; one that gets no place is infinitely far."""
    distance, range_m = [np.zeros(0)], [np.zeros(0)]
    for camera, rows in held.asked.items():
        if camera not in grounds:
            continue
        for m, placed, xy in zip(
            rows, _places(log, schedule, rows, grounds[camera]), held.known_xy[camera], strict=True
        ):
            distance.append(np.nan_to_num(np.hypot(*(placed - xy).T), nan=np.inf))
            range_m.append(np.hypot(*(xy - m.sensor_m[:, :2]).T))
    d, r = np.concatenate(distance), np.concatenate(range_m)
    near = r < NEAR_M
    return {
        "objects": len(d),
        "placed_share": float(np.isfinite(d).mean()) if len(d) else None,
        "median_m": _median(d),
        "near_median_m": _median(d[near]),
        "far_median_m": _median(d[~near]),
    }


def _median(distance: Array) -> float | None:
    """Median, None of nothing and where half of it is infinite."""
    value = float(np.median(distance)) if len(distance) else np.inf
    return value if np.isfinite(value) else None


def _places(log: Log, schedule: Schedule, rows: Sequence[Measurements], ground: CameraGround) -> list[Array]:
    """Places (M, 2) in the map of the rows of every tick by the homography, that of the tick where it has one of its own."""
    out = []
    for tick, m in enumerate(rows):
        grounds = {ground.camera.name: at_tick(ground, tick)}
        found = locate_the_rest(log, schedule, Observed(measurements=[m], obstacles=[None]), grounds)[0]
        out.append(_in_order(m, found))
    return out


def at_tick(ground: CameraGround, tick: int) -> CameraGround:
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
