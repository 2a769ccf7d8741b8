"""Scores of a reconstructed scenario, and localization errors of its measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, Log, Measurements, Scenario
from log2sim.errors import ConfigError
from log2sim.evaluation.bench.settings import ErrorSums, Point, error_of
from log2sim.evaluation.metrics.comparison import truth_states
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import MIN_POINTS
from log2sim.geometry import NS_PER_S, Array, Camera, apply_homography, box_iou, inverse, line_stamps_ns, project_boxes
from log2sim.perception.first_pass import Observations, base_poses
from log2sim.perception.homography.correspondences import (
    Correspondences,
    feet_of_boxes,
    foot_points,
    undistorted_pixels,
)
from log2sim.perception.homography.place import MAX_RANGE_M
from log2sim.perception.homography_stage import CameraHomography, place_by_homography
from log2sim.perception.sync import Schedule

CUTOFF_M = 2.0  # cutoff distance of GOSPA, m; the metrics match objects up to it
HORIZON_S = 1.0
# Figures of `evaluate` that a score keeps.
EVALUATE_KEYS = (
    "recall", "precision", "position_rmse_m", "position_median_m", "speed_rmse_mps", "yaw_median_deg", "hota", "id_switches",
)  # fmt: skip


@dataclass(frozen=True)
class ScoreScope:
    """Which objects are compared with the truth: within `max_range_m` of the ego, of these `categories`; None for all."""

    max_range_m: float | None = None
    categories: tuple[str, ...] | None = None


EVERYTHING = ScoreScope()


def check_scope(truth: Scenario | None, scope: ScoreScope) -> None:
    """Raise `ConfigError` for an invalid scope before any work is done."""
    if truth is not None:
        evaluate(truth, truth, max_range_m=scope.max_range_m, categories=scope.categories)
    elif scope != EVERYTHING:
        raise ConfigError("a range or categories are given, but without truth nothing is compared; give --truth")


@dataclass(frozen=True)
class Score:
    """Figures of a run."""

    figures: dict[str, Any]
    # Contributions of single objects, for figures that are errors.
    by_object: Mapping[str, ErrorSums] = field(default_factory=dict)

    def point(self, name: str, present: bool, ms: float, error: str, **more: Any) -> Point:
        """Return a setting's point, whose error is the figure of this name, with more figures."""
        return Point(name, present, ms, self.figures.get(error), self.figures | more, self.by_object.get(error, {}))


def score_scenario(scenario: Scenario, truth: Scenario | None, tick_s: float, scope: ScoreScope = EVERYTHING) -> Score:
    """Score a scenario; without truth only by figures that need none.

    - `error_m`: root mean square position error; a missed and a false object together count as one at `CUTOFF_M`.
    - `state_error_m`: position error after extrapolation by `HORIZON_S`, from the errors of position and speed.
    - `jitter_m`: see `jitter`.
    - `gap_share`: fraction of the agents' ticks without a detection.
    - `smoothing_residual_m`: median over agents of the distance of measurements from the smoothed trajectory.
    """
    known = [a.quality.get("smoothing_residual_rms_m") for a in scenario.others]
    values = [v for v in known if v is not None]
    counted = [a for a in scenario.others if "detections" in a.quality] if tick_s > 0 else []
    ticks = sum((a.waypoints.t_s[-1] - a.waypoints.t_s[0]) / tick_s + 1 for a in counted)
    found_share = sum(a.quality["detections"] for a in counted) / ticks if counted else None
    out: dict[str, Any] = {
        "agents": len(scenario.others),
        "jitter_m": jitter(scenario, tick_s),
        "gap_share": None if found_share is None else float(np.clip(1 - found_share, 0.0, 1.0)),
        "smoothing_residual_m": (float(np.median(values)) if values else None),
    }
    if truth is None:
        return Score(out)
    found = evaluate(scenario, truth, max_range_m=scope.max_range_m, categories=scope.categories)
    # What each object contributes. The error is GOSPA (Rahmathullah et al., 2017) with p = 2 and alpha = 2, divided by the number of
    # objects so that it is a distance: 0 for a perfect result, the cutoff for one without a match.
    errors, states = dict[str, tuple[float, float]](), dict[str, tuple[float, float]]()
    for row in found["agents"]:
        n, lost = row["matched"], (row["ticks"] - row["matched"]) / 2
        errors[row["id"]] = n * (row["position_rmse_m"] or 0.0) ** 2 + CUTOFF_M**2 * lost, n + lost
        if n:
            states[row["id"]] = n * (row["position_rmse_m"] ** 2 + (HORIZON_S * row["speed_rmse_mps"]) ** 2), n
    for row in found["false_agents"]:
        errors[f"false {row['id']}"] = CUTOFF_M**2 * row["false_ticks"] / 2, row["false_ticks"] / 2
    parts: dict[str, ErrorSums] = {"error_m": errors, "state_error_m": states}
    out |= {key: found[key] for key in EVALUATE_KEYS} | {key: error_of(p) for key, p in parts.items()}
    return Score(out, parts)


def jitter(scenario: Scenario, tick_s: float) -> float | None:
    """Estimate the noise of waypoints, m: median over moving agents; None when none moves for long enough.

    Third differences vanish for constant acceleration; of white noise with variance s^2 they have variance 20 s^2. Between
    waypoints farther apart than a tick, motion is the cubic Hermite spline through their positions and velocities.
    """
    if tick_s <= 0:
        return None
    from scipy.interpolate import CubicHermiteSpline

    known = []
    for w in (a.waypoints for a in scenario.others if not a.static and len(a.waypoints) > 1):
        ticks = round((w.t_s[-1] - w.t_s[0]) / tick_s) + 1
        if ticks >= 5:
            xy = np.column_stack([w.x_m, w.y_m])
            velocity = w.speed_mps[:, None] * np.column_stack([np.cos(w.yaw_rad), np.sin(w.yaw_rad)])
            at = CubicHermiteSpline(w.t_s, xy, velocity)(np.linspace(w.t_s[0], w.t_s[-1], ticks))
            known.append(float(np.sqrt(np.mean(np.diff(at, n=3, axis=0) ** 2) / 20)))
    return float(np.median(known)) if known else None


MIN_IOU = 0.5
NEAR_M = 25.0
HOLDOUT_FRACTION = 0.25  # fraction of the measured obstacles that homographies are not fitted to and are scored by
MAX_SAME_FOOT_PX = 0.01
BLOCK_S = 0.5


@dataclass(frozen=True, eq=False)
class KnownPositions:
    """Known positions of the objects of one tick's measurements."""

    xy: Array  # (M, 2), m map frame; NaN where unknown
    object_id: NDArray[np.int64]  # (M,) which object each measurement is of, -1 where unknown


def true_positions(
    log: Log,
    schedule: Schedule,
    observations: Observations,
    truth: Scenario,
    *,
    when: Literal["measured", "imaged"] = "measured",
) -> list[KnownPositions]:
    """Find, for each tick, the true centers of the objects that its measurements are of.

    `when`: at the times of the measurements, or at the stamps of the images.

    Measurements are matched with objects by IoU of their boxes in the image, independently of the measured position.
    """
    shift_m = np.array(truth.map.offset_m) - np.array(log.map.offset_m)
    out = [KnownPositions(np.full((len(m), 2), np.nan), np.full(len(m), -1)) for m in observations.measurements]
    for camera, index in schedule.frames.items():
        ticks = np.flatnonzero(index >= 0)
        stamps = log.streams[camera].t_ns[index[ticks]]
        table = truth_states(truth.others, (stamps - truth.t0_ns) / NS_PER_S, shift_m, None)
        map_T_cam, known = log.map_T_sensor(camera, stamps)
        for k in np.flatnonzero(known):
            m = observations.measurements[ticks[k]]
            rows = np.flatnonzero(m.camera == camera)
            if len(rows) and len(table.agents):
                # The truth agents that count at the frame; mutually best IoU within a group of categories.
                boxes = np.full((len(table.agents), 4), np.nan)
                there = np.flatnonzero(table.present[:, k] & table.visible[:, k])
                solids = table.center_m[there, k], table.size_m[there], table.yaw_rad[there, k]
                boxes[there] = project_boxes(*solids, log.cameras[camera], inverse(map_T_cam[k])).box_px
                group = np.array([GROUP_OF[str(c)] for c in m.category[rows]])
                overlap = np.nan_to_num(box_iou(m.box_px[rows], boxes))
                overlap = np.where(group[:, None] == table.group, overlap, 0.0)
                best, back = overlap.argmax(axis=1), overlap.argmax(axis=0)
                own = np.arange(len(rows))
                pairs = np.where((overlap[own, best] >= MIN_IOU) & (back[best] == own), best, -1)
                later_s = (m.t_ns[rows] - stamps[k]) / NS_PER_S if when == "measured" else np.zeros(len(rows))
                # A few hundredths of a second at most.
                yaw, way_m = table.yaw_rad[pairs, k], (table.speed_mps[pairs, k] * later_s)[:, None]
                xy = table.xy_m[pairs, k] + way_m * np.column_stack([np.cos(yaw), np.sin(yaw)])
                out[ticks[k]].xy[rows] = np.where((pairs >= 0)[:, None], xy, np.nan)
                out[ticks[k]].object_id[rows] = pairs
    return out


def lidar_positions(observations: Observations, tick_s: float) -> list[KnownPositions]:
    """Take LiDAR positions of each tick's measurements as known; those within `BLOCK_S` count as one object."""
    return [
        KnownPositions(m.center_m[:, :2], np.full(len(m), int(tick * tick_s / BLOCK_S)))
        for tick, m in enumerate(observations.measurements)
    ]


def score_measurements(observations: Observations, known: Sequence[KnownPositions]) -> Score:
    """Score measured centers by their distance from the true ones, capped at `CUTOFF_M`; a missing position counts as that."""
    measured = np.concatenate([m.center_m[:, :2] for m in observations.measurements])
    true, object_id = np.concatenate([k.xy for k in known]), np.concatenate([k.object_id for k in known])
    known_rows = np.isfinite(true[:, 0])
    return _score_of_distances(np.hypot(*(measured - true)[known_rows].T), object_id[known_rows])


def _score_of_distances(distance: Array, object_id: NDArray[np.int64]) -> Score:
    """Compute the score of distances (K,), m, NaN for missing positions, of objects (K,)."""
    cut = np.where(distance < CUTOFF_M, distance, CUTOFF_M)
    squares, count = np.bincount(object_id, cut**2), np.bincount(object_id)
    parts = {str(k): (float(squares[k]), float(count[k])) for k in np.flatnonzero(count)}
    placed = np.isfinite(distance)
    figures = {
        "objects": len(distance),
        "placed_share": float(placed.mean()) if len(distance) else None,
        "error_m": error_of(parts),
        "median_m": float(np.median(distance[placed])) if placed.any() else None,
        "farther_than_2_m_share": float(np.mean(cut >= CUTOFF_M)) if len(distance) else None,
    }
    return Score(figures, {"error_m": parts})


@dataclass(frozen=True, eq=False)
class Holdout:
    """Measured obstacles that homographies are not fitted to, by camera, one entry for each tick."""

    observations: Observations  # what is left to fit to
    obstacles: dict[str, list[Measurements]]  # the held-out obstacles without their LiDAR positions
    known: dict[str, list[KnownPositions]]  # of their centers
    feet: dict[str, list[Correspondences]]  # their foot points by LiDAR

    def __len__(self) -> int:
        """Return the number of held-out obstacles."""
        return sum(len(m) for rows in self.obstacles.values() for m in rows)


def split_holdout(
    log: Log, schedule: Schedule, observations: Observations, known: Sequence[KnownPositions], rng: np.random.Generator
) -> Holdout:
    """Hold out a random part of the measured obstacles within 60 m, with their known positions at the images' stamps."""
    cameras = observations.feet
    obstacles: dict[str, list[Measurements]] = {camera: [] for camera in cameras}
    places: dict[str, list[KnownPositions]] = {camera: [] for camera in cameras}
    holdout: dict[str, list[Correspondences]] = {camera: [] for camera in cameras}
    for tick, m in enumerate(observations.measurements):
        xy, object_id = known[tick].xy, known[tick].object_id
        near = np.hypot(*(m.center_m - m.sensor_m)[:, :2].T) <= MAX_RANGE_M
        good = (m.source == "lidar") & ~m.truncated & (m.points >= MIN_POINTS) & near & np.isfinite(xy[:, 0])
        good &= m.kept_points > 0
        good &= rng.random(len(m)) < HOLDOUT_FRACTION
        for camera in obstacles:
            rows = np.flatnonzero(good & (m.camera == camera))
            stamp = int(log.streams[camera].t_ns[schedule.frames[camera][tick]])
            at_ns = line_stamps_ns(log.cameras[camera], stamp, feet_of_boxes(m.box_px[rows]))
            ego_T_map = inverse(base_poses(log, at_ns))
            holdout[camera].append(foot_points(log.cameras[camera], m.take(rows), ego_T_map, tick))
            # As detections in the image of that stamp, without LiDAR evidence.
            n, nowhere = len(rows), np.full((len(rows), 3), np.nan)
            obstacles[camera].append(replace(
                m.take(rows), t_ns=np.full(n, stamp), source=np.full(n, "", dtype="<U16"), center_m=nowhere,
                covariance=np.full((n, 2, 2), np.nan), cluster=tuple(np.zeros((0, 3)) for _ in range(n)),
            ))  # fmt: skip
            places[camera].append(KnownPositions(xy[rows], object_id[rows]))
    feet = {name: [_drop_feet(log.cameras[name], parts, obstacles[name])] for name, parts in cameras.items()}
    return Holdout(replace(observations, feet=feet), obstacles, places, holdout)


def _drop_feet(camera: Camera, parts: Sequence[Correspondences], obstacles: Sequence[Measurements]) -> Correspondences:
    """Drop the correspondences of held-out obstacles."""
    feet = Correspondences.join(parts)
    tick = np.concatenate([np.full(len(m), k) for k, m in enumerate(obstacles)])
    box = np.concatenate([m.box_px for m in obstacles])
    if not len(box) or not len(feet.uv):
        return feet
    uv = undistorted_pixels(camera, np.column_stack([(box[:, 0] + box[:, 2]) / 2, box[:, 3]]))
    same = (feet.tick[:, None] == tick) & (np.abs(feet.uv[:, None] - uv).max(axis=2) < MAX_SAME_FOOT_PX)
    kept = ~same.any(axis=1)
    return replace(feet, **{name: column[kept] for name, column in vars(feet).items() if column is not None})


def score_homographies(log: Log, holdout: Holdout, grounds: Mapping[str, CameraHomography]) -> Score:
    """Score homographies by the distance of held-out foot points from their LiDAR positions.

    Distances are capped at `CUTOFF_M`, which missing positions count as. `near_error_m` and `far_error_m` are of obstacles
    within and beyond `NEAR_M`. `center_error_m` and `center_median_m` are of box centers, which also depend on the assumed
    depth of an object.
    """
    feet, centers, range_m, object_id = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    for camera in (c for c in holdout.obstacles if c in grounds):
        for tick, (m, known) in enumerate(zip(holdout.obstacles[camera], holdout.known[camera], strict=True)):
            foot, ground = holdout.feet[camera][tick], at_tick(grounds[camera], tick)
            if len(foot.uv):  # NaN above the horizon
                feet.append(np.hypot(*(apply_homography(ground.fit.ground_H_image, foot.uv)[0] - foot.xy_ego).T))
            centers.append(np.hypot(*(_places(log, tick, m, grounds[camera]) - known.xy).T))
            range_m.append(np.hypot(*(known.xy - m.sensor_m[:, :2]).T))
            object_id.append(known.object_id)
    d, near, w = np.concatenate(feet), np.concatenate(range_m) < NEAR_M, np.concatenate(object_id)
    score, center = _score_of_distances(d, w), _score_of_distances(np.concatenate(centers), w).figures
    figures = {
        f"{name}_error_m": _score_of_distances(d[rows], w[rows]).figures["error_m"]
        for name, rows in (("near", near), ("far", ~near))
    }
    figures |= {f"center_{key}": center[key] for key in ("error_m", "median_m")}
    return Score(score.figures | figures, score.by_object)


def _places(log: Log, tick: int, m: Measurements, ground: CameraHomography) -> Array:
    """Locate the rows of a tick by the homography: positions (M, 2), m, map frame."""
    if not len(m):
        return np.zeros((0, 2))
    observations = Observations(measurements=[m], obstacles=[None])
    found = place_by_homography(log, observations, {ground.camera.name: at_tick(ground, tick)})[0]
    xy = np.full((len(m), 2), np.nan)
    for box, center in zip(found.box_px, found.center_m):
        xy[np.all(m.box_px == box, axis=1)] = center[:2]
    return xy


def at_tick(ground: CameraHomography, tick: int) -> CameraHomography:
    """Select a camera's homography of one tick; refused when the tick has none."""
    own = ground.fit.at_tick(tick)
    h = np.full((3, 3), np.nan) if own is None else own
    return replace(ground, fit=replace(ground.fit, ground_H_image=h, per_tick=None, ok=own is not None))
