"""Tracks become agents: standing ones get one pose, moving ones a smoothed trajectory, and both are followed by LiDAR."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.confirmation import SAME_MOMENT_S, is_credible
from log2sim.agents.lidar_tracking import BoxState, LidarMatch, track_with_lidar
from log2sim.agents.size import TrackGeometry, moving_geometry, static_geometry
from log2sim.agents.smooth.smoother import MotionModel, SmoothedTrack, signed_speed, smooth_track
from log2sim.agents.standing import Side, is_static, parked_heading, side_of_traffic
from log2sim.datatypes import GROUP_OF, STANDSTILL_MPS, TYPICAL_SIZE_M, Agent, Obstacles, Track, Waypoints
from log2sim.geometry import NS_PER_S, Array, wrap_angle
from log2sim.perception import box_fitting

# How fast the acceleration changes of those whose own track is not asked: spectral density of the jerk, m2/s5.
JERK_DENSITY = {"pedestrian": 2.0}
CENTER_SIGMA_M = {"vehicle": 0.12, "two_wheeler": 0.1, "pedestrian": 0.08, "other": 0.15}
# Rear axle to box center, as a share of the length: BMW 320i of CommonRoad's vehicle models, b - overhang, rounded.
REAR_AXLE_SHARE = {"vehicle": 0.28, "two_wheeler": 0.3}
MIN_RIDER_SPEED_MPS, RIDER_SPEED_BASELINE_S = 3.0, 0.6


@dataclass(frozen=True, eq=False)
class Timeline:
    """The ticks of a run: stamps `t_ns` (T,) and the scenario's start `t0_ns`."""

    t_ns: NDArray[np.int64]
    t0_ns: int

    def seconds(self, t_ns: NDArray[np.int64]) -> Array:
        return np.asarray((t_ns - self.t0_ns) / NS_PER_S, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class AgentCandidate:
    """An agent, how much evidence it has, and whether that is enough to believe in it."""

    agent: Agent
    evidence: float
    credible: bool


def estimate_agents(
    tracks: Sequence[Track],
    obstacles: Sequence[Obstacles | None],
    timeline: Timeline,
    flow: Array,
    *,
    smooth: bool,
) -> list[AgentCandidate]:
    """Agents of all tracks, moving ones first, since the way they go tells which way parked cars point.

    `flow` (K, 3) is x, y and heading of the ego's path.
    """
    standing = [is_static(t) for t in tracks]
    moving = [as_rider_if_fast(t) for t, s in zip(tracks, standing) if not s]
    built = [_moving_agent(track, obstacles, timeline, smooth=smooth) for track in moving]
    built = [b for b in built if b.credible]
    flows = [flow] + [_flow_of_agent(b.agent) for b in built if GROUP_OF[b.agent.category] == "vehicle"]
    everything, side = np.concatenate(flows), side_of_traffic(flows)
    built += [_static_agent(t, obstacles, timeline, everything, side) for t, s in zip(tracks, standing) if s]
    return [b for b in built if b.credible]


def as_rider_if_fast(track: Track) -> Track:
    """A person who goes faster than people run is a cyclist whose bicycle the detector missed."""
    m = track.measurements
    t = (m.t_ns - m.t_ns[0]) / NS_PER_S
    if track.category != "pedestrian" or t[-1] < RIDER_SPEED_BASELINE_S:
        return track
    later = np.searchsorted(t, t + RIDER_SPEED_BASELINE_S)
    start = np.flatnonzero(later < len(t))
    later = later[start]
    pace = np.hypot(*(m.center_m[later, :2] - m.center_m[start, :2]).T) / (t[later] - t[start])
    speed = float(np.quantile(pace, 0.75)) if len(pace) else 0.0
    return replace(track, category="cyclist") if speed > MIN_RIDER_SPEED_MPS else track


def _flow_of_agent(agent: Agent) -> Array:
    w = agent.waypoints
    moving = np.abs(w.speed_mps) > 1.5
    return np.stack([w.x_m[moving], w.y_m[moving], w.yaw_rad[moving]], axis=1)


def _static_agent(
    track: Track, obstacles: Sequence[Obstacles | None], timeline: Timeline, flow: Array, side: Side
) -> AgentCandidate:
    shape = static_geometry(track)
    group = GROUP_OF[track.category]
    xy = shape.xy_m[0]
    yaw = float(np.nan_to_num(shape.yaw_rad)) if shape.yaw_rad is not None else 0.0
    steers = group in ("vehicle", "two_wheeler")
    yaw = parked_heading(yaw, xy, flow, side=side) if steers else float(wrap_angle(yaw))
    z = float(np.median(shape.z_m))
    others = [k for k in range(len(timeline.t_ns)) if k not in set(track.tick.tolist())]
    sightings = _match_lidar(
        obstacles, others, timeline, xy, np.zeros(2), yaw, shape, z, int(timeline.t_ns[track.tick[0]])
    )
    seen = np.unique(np.r_[track.tick, np.array([s.tick for s in sightings], dtype=np.int64)])
    life = np.array([seen[0], seen[-1]]) if seen[-1] > seen[0] else seen[:1]
    n = len(life)
    sigma = float(np.sqrt(np.trace(np.median(shape.covariance, axis=0)) / 2))
    waypoints = Waypoints(
        t_s=timeline.seconds(timeline.t_ns[life]),
        x_m=np.full(n, xy[0]),
        y_m=np.full(n, xy[1]),
        z_m=np.full(n, z),
        yaw_rad=np.full(n, yaw),
        speed_mps=np.zeros(n),
        observed=np.ones(n, dtype=bool),
        sigma_xy_m=np.full(n, sigma),
    )
    share = len(seen) / (seen[-1] - seen[0] + 1)
    quality = _quality(track, len(sightings)) | {"observed_share": round(float(share), 3), "flags": []}
    return _agent(track, shape, waypoints, quality, static=True)


def _match_lidar(
    obstacles: Sequence[Obstacles | None],
    ticks: Sequence[int],
    timeline: Timeline,
    xy: Array,
    velocity: Array,
    yaw: float,
    shape: TrackGeometry,
    z: float,
    start_ns: int,
) -> list[LidarMatch]:
    if not ticks:
        return []
    start = BoxState(
        start_ns, np.array(xy, float), np.array(velocity, float), yaw, shape.size_m, z - shape.size_m[2] / 2
    )
    return track_with_lidar(obstacles, ticks, timeline.t_ns, start)


def _moving_agent(
    track: Track, obstacles: Sequence[Obstacles | None], timeline: Timeline, *, smooth: bool
) -> AgentCandidate:
    m, group = track.measurements, GROUP_OF[track.category]
    t = timeline.seconds(m.t_ns)
    order = np.flatnonzero(np.r_[True, np.diff(t) > SAME_MOMENT_S])
    track, t = Track(track.category, track.tick[order], m.take(order)), t[order]
    extra = CENTER_SIGMA_M[group] ** 2 * np.eye(2)
    hint = _first_heading(track, t)
    motion = MotionModel(JERK_DENSITY.get(group), holonomic=group == "pedestrian", heading_rad=hint)
    xy, covariance = track.measurements.center_m[:, :2], track.measurements.covariance + extra
    rough = smooth_track(t, xy, covariance=covariance, at_s=t, motion=motion)
    shape = moving_geometry(track, _headings(rough, group))
    for _ in range(2):
        rough = smooth_track(t, shape.xy_m, covariance=shape.covariance + extra, at_s=t, motion=motion)
        shape = moving_geometry(track, _headings(rough, group))
    sightings = _match_moving(track, rough, shape, obstacles, timeline)
    t_all = np.concatenate([t, timeline.seconds(np.array([s.t_ns for s in sightings], dtype=np.int64))])
    xy_all = np.concatenate([shape.xy_m, np.array([s.xy_m for s in sightings]).reshape(-1, 2)])
    covariance_all = (
        np.concatenate([shape.covariance, np.array([s.covariance for s in sightings]).reshape(-1, 2, 2)]) + extra
    )
    ticks_all = np.concatenate([track.tick, np.array([s.tick for s in sightings], dtype=np.int64)])
    first = np.argsort(t_all, kind="stable")
    first = first[np.r_[True, np.diff(t_all[first]) > SAME_MOMENT_S]]
    life = np.arange(ticks_all.min(), ticks_all.max() + 1)
    at = timeline.seconds(timeline.t_ns[life])
    if not smooth:
        motion = replace(motion, jerk_density=1e4)
    path = smooth_track(t_all[first], xy_all[first], covariance=covariance_all[first], at_s=at, motion=motion)
    waypoints = _waypoints(path, _headings(path, group), shape, t, at, np.isin(life, ticks_all))
    quality = _quality(track, len(sightings)) | {
        "observed_share": round(float(np.isin(life, ticks_all).mean()), 3),
        "smoothing_residual_rms_m": round(float(np.sqrt(np.nanmean(path.residual_m[path.inlier] ** 2))), 4)
        if path.inlier.any()
        else None,
        "flags": list(path.flags),
    }
    return _agent(track, shape, waypoints, quality, static=False)


def _headings(path: SmoothedTrack, group: str) -> Array:
    """Heading (T,) of the body: the course of its center, less the angle by which a turning center slips outward.

    The center of a vehicle that turns about a point level with its rear axle moves at atan(offset x curvature) to it.
    """
    if group not in REAR_AXLE_SHARE:
        return path.yaw_rad
    offset = REAR_AXLE_SHARE[group] * TYPICAL_SIZE_M["car" if group == "vehicle" else "cyclist"][0]
    return wrap_angle(path.yaw_rad - np.arcsin(np.clip(offset * path.curvature_1pm, -0.5, 0.5)))


def _first_heading(track: Track, t: Array) -> float | None:
    """Where a track points before it moves: along the boxes' own axes, on the side toward which it goes."""
    xy = track.measurements.center_m[:, :2]
    way = np.median(xy[-max(len(xy) // 4, 1) :], axis=0) - np.median(xy[: max(len(xy) // 4, 1)], axis=0)
    yaws = track.measurements.yaw_rad[np.isfinite(track.measurements.yaw_rad)]
    course = float(np.arctan2(way[1], way[0]))
    if np.hypot(*way) < 0.3:
        return box_fitting.align_to(float(yaws[0]), 0.0, np.pi) if len(yaws) else None
    return course


def _match_moving(
    track: Track, path: SmoothedTrack, shape: TrackGeometry, obstacles: Sequence[Obstacles | None], timeline: Timeline
) -> list[LidarMatch]:
    """Sightings before, after and in the gaps of a moving track."""
    z = float(np.median(shape.z_m))
    headings = _headings(path, GROUP_OF[track.category])
    found: list[LidarMatch] = []
    ticks, total = track.tick, len(timeline.t_ns)
    spans = [(0, list(range(int(ticks[0]) - 1, -1, -1))), (len(ticks) - 1, list(range(int(ticks[-1]) + 1, total)))]
    spans += [(k, list(range(a + 1, b))) for k, (a, b) in enumerate(pairwise(ticks.tolist())) if b > a + 1]
    for k, wanted in spans:
        found += _match_lidar(
            obstacles, wanted, timeline, path.xy_m[k], path.velocity_mps[k], float(headings[k]), shape, z,
            int(track.measurements.t_ns[k]),
        )  # fmt: skip
    return found


def _waypoints(
    path: SmoothedTrack, yaw: Array, shape: TrackGeometry, t: Array, at: Array, observed: NDArray[np.bool_]
) -> Waypoints:
    speed = signed_speed(path.velocity_mps, yaw)
    return Waypoints(
        t_s=at,
        x_m=path.xy_m[:, 0],
        y_m=path.xy_m[:, 1],
        z_m=np.interp(at, t, _running_median(shape.z_m)),
        yaw_rad=yaw,
        speed_mps=np.where(np.abs(speed) < STANDSTILL_MPS, 0.0, speed),
        observed=observed,
        sigma_xy_m=np.sqrt(np.trace(path.covariance, axis1=1, axis2=2) / 2),
    )


def _running_median(values: Array, half: int = 4) -> Array:
    padded = np.pad(values, half, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1), axis=1)


def _quality(track: Track, sightings: int) -> dict[str, Any]:
    m = track.measurements
    return {
        "detections": len(m),
        "lidar_only": sightings,
        "without_lidar": int((m.source != "lidar").sum()),
        "points_median": float(np.median(m.points)),
        "score_max": round(float(m.score.max()), 4),
    }


def _agent(
    track: Track, shape: TrackGeometry, waypoints: Waypoints, quality: dict[str, Any], *, static: bool
) -> AgentCandidate:
    m = track.measurements
    size = tuple(float(v) for v in shape.size_m)
    group = GROUP_OF[track.category]
    # Independent looks would multiply; those of a video are not, so the confidence saturates with the strongest few.
    strongest = np.sort(m.score)[-5:]
    agent = Agent(
        id="",
        category=track.category,
        size_m=(size[0], size[1], size[2]),
        waypoints=waypoints,
        static=static,
        rear_axle_offset_m=round(REAR_AXLE_SHARE.get(group, 0.0) * size[0], 3),
        confidence=float(np.clip(strongest.mean(), 0.0, 1.0)),
        quality=quality,
    )
    return AgentCandidate(
        agent,
        float(m.score.sum()),
        is_credible(track, strongest, typical=shape.typical),
    )
