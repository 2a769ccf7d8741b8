"""The last steps: the ego as an agent, doubles dropped, names given, everything put into a scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import log2sim
from log2sim.assemble import STANDING_SPEED_MPS, Built, Timeline
from log2sim.config import Config
from log2sim.detect import Detector
from log2sim.geometry import NS_PER_S, Array, bev_iou, box_corners_bev, polygon_area, yaw_of
from log2sim.ground_plane import CameraGround
from log2sim.plan import Plan
from log2sim.scenario import Agent, Scenario, Waypoints
from log2sim.smooth import signed_speed, smooth_track
from log2sim.sync import Schedule
from log2sim.thin import thin
from log2sim.types import GROUP_OF, Log

# Two agents that share this much of their boxes for most of the time are one.
SHARED_AREA = 0.25
SAMPLES = 12
# Boxes that share less than this of the smaller one only touch.
TOUCHING = 0.05
EGO_SIGMA_M = 0.02


def without_doubles(built: Sequence[Built], ego: Agent | None = None) -> list[Agent]:
    """Agents that are in nobody else's place, the ego's included, those with more evidence first; named by category."""
    taken = [ego] if ego is not None else []
    kept: list[Agent] = []
    for candidate in sorted(built, key=lambda b: -b.evidence):
        if not any(_same_place(candidate.agent, other) for other in (*taken, *kept)):
            kept.append(candidate.agent)
    agents = sorted(kept, key=lambda a: (float(a.waypoints.t_s[0]), float(a.waypoints.x_m[0])))
    count: dict[str, int] = {}
    named = []
    for agent in agents:
        count[agent.category] = count.get(agent.category, 0) + 1
        named.append(replace(agent, id=f"{agent.category}-{count[agent.category]}"))
    return named


def outside(agents: Sequence[Agent], ego: Agent | None) -> list[Agent]:
    """Moving agents without the beginnings and ends of their ways that lie in the ego's box, where nobody can have been.

    There an agent was followed by what little of it the sensors showed beside the ego.
    """
    return list(agents) if ego is None else [_outside(a, ego) for a in agents]


def _outside(agent: Agent, ego: Agent) -> Agent:
    if agent.static or not _ways_meet(agent, ego):
        return agent
    w = agent.waypoints
    there = ego.at(w.t_s)
    mine = box_corners_bev(np.stack([w.x_m, w.y_m], axis=1), agent.size_m[0], agent.size_m[1], w.yaw_rad)
    its = box_corners_bev(np.stack([there.x_m, there.y_m], axis=1), ego.size_m[0], ego.size_m[1], there.yaw_rad)
    near = there.valid & (
        np.hypot(w.x_m - there.x_m, w.y_m - there.y_m) < sum(np.hypot(*a.size_m[:2]) for a in (agent, ego)) / 2
    )
    apart = np.array([not n or _share_of_smaller(p, q) <= TOUCHING for n, p, q in zip(near, mine, its)])
    if apart.all() or not apart.any():
        return agent
    first, last = int(np.argmax(apart)), len(apart) - int(np.argmax(apart[::-1]))
    columns = {k: v[first:last] for k, v in vars(w).items() if v is not None}
    return replace(agent, waypoints=Waypoints(**columns))


def thinned(agents: Sequence[Agent]) -> list[Agent]:
    """Agents with few waypoints where they move straight at constant speed; `quality` says how many were left out."""
    out = []
    for agent in agents:
        few = thin(agent.waypoints)
        left_out = len(agent.waypoints) - len(few)
        quality = {**agent.quality, "waypoints_left_out": left_out} if left_out else agent.quality
        out.append(replace(agent, waypoints=few, quality=quality) if left_out else agent)
    return out


def _same_place(a: Agent, b: Agent) -> bool:
    """Whether two agents overlap for most of the time that both are there."""
    first, last = max(a.waypoints.t_s[0], b.waypoints.t_s[0]), min(a.waypoints.t_s[-1], b.waypoints.t_s[-1])
    if last < first or not _ways_meet(a, b):
        return False
    t = np.linspace(first, last, SAMPLES)
    pa, pb = a.at(t), b.at(t)
    distance = np.hypot(pa.x_m - pb.x_m, pa.y_m - pb.y_m)
    if np.median(distance) > (max(a.size_m[:2]) + max(b.size_m[:2])) / 2:
        return False
    if {GROUP_OF[a.category], GROUP_OF[b.category]} == {"pedestrian"}:
        return bool(np.median(distance) < 0.35)
    boxes_a, boxes_b = (
        box_corners_bev(np.stack([p.x_m, p.y_m], axis=1), x.size_m[0], x.size_m[1], p.yaw_rad)
        for p, x in ((pa, a), (pb, b))
    )
    shared = [_share_of_smaller(p, q) for p, q in zip(boxes_a, boxes_b)]
    return bool(np.median(shared) > SHARED_AREA)


def _ways_meet(a: Agent, b: Agent) -> bool:
    """Whether the rectangles around two agents' ways come as near as their boxes could ever touch; quick to tell."""
    reach = (np.hypot(*a.size_m[:2]) + np.hypot(*b.size_m[:2])) / 2
    return all(
        p.min() - q.max() <= reach and q.min() - p.max() <= reach
        for p, q in ((a.waypoints.x_m, b.waypoints.x_m), (a.waypoints.y_m, b.waypoints.y_m))
    )


def _share_of_smaller(a: Array, b: Array) -> float:
    """Area that two rectangles (4, 2) share, as a part of the smaller one's."""
    iou, area_a, area_b = bev_iou(a, b), polygon_area(a), polygon_area(b)
    return iou / (1 + iou) * (area_a + area_b) / min(area_a, area_b)


def ego_agent(log: Log, timeline: Timeline) -> Agent | None:
    """The ego at every tick; None for a log without poses."""
    if log.ego is None:
        return None
    map_T_ego, valid = log.ego.at(timeline.t_ns)
    if not valid.any():
        return None
    vehicle = log.ego_vehicle
    length, width, height = vehicle.size_m
    center = map_T_ego[valid] @ np.array([vehicle.rear_axle_offset_m, 0.0, log.ground_z_ego_m + height / 2, 1.0])
    t, yaw = timeline.seconds(timeline.t_ns[valid]), yaw_of(map_T_ego[valid])
    path = smooth_track(t, center[:, :2], sigma_m=EGO_SIGMA_M)
    speed = signed_speed(path.velocity_mps, yaw)
    waypoints = Waypoints(
        t_s=t,
        x_m=path.xy_m[:, 0],
        y_m=path.xy_m[:, 1],
        z_m=center[:, 2],
        yaw_rad=yaw,
        speed_mps=np.where(np.abs(speed) < STANDING_SPEED_MPS, 0.0, speed),
        observed=np.ones(len(t), dtype=bool),
        sigma_xy_m=np.sqrt(np.trace(path.covariance, axis1=1, axis2=2) / 2),
    )
    moved = float(np.hypot(np.ptp(center[:, 0]), np.ptp(center[:, 1])))
    return Agent(
        "ego", "car", (length, width, height), waypoints, static=moved < 0.3, rear_axle_offset_m=vehicle.rear_axle_offset_m,
        quality={"source": "ego poses of the log", "flags": list(path.flags)},
    )  # fmt: skip


def ego_flow(log: Log, schedule: Schedule) -> Array:
    """Places and headings (K, 3) of the ego's path, which parked cars beside it are taken to follow."""
    if log.ego is None:
        return np.zeros((0, 3))
    map_T_ego, valid = log.ego.at(schedule.t_ns)
    poses = map_T_ego[valid]
    return np.column_stack([poses[:, :2, 3], yaw_of(poses)])


def make_scenario(
    log: Log,
    schedule: Schedule,
    config: Config,
    plan: Plan,
    detector: Detector,
    homographies: Mapping[str, CameraGround],
    ego: Agent | None,
    agents: Sequence[Agent],
) -> Scenario:
    """Put everything into the record that `scenario.json` holds."""
    return Scenario(
        name=log.name,
        t0_ns=int(schedule.t_ns[0]),
        duration_s=float((schedule.t_ns[-1] - schedule.t_ns[0]) / NS_PER_S),
        agents=(*((ego,) if ego is not None else ()), *agents),
        map=log.map,
        cameras=tuple(_camera_entry(name, homographies.get(name), name in plan.cameras) for name in log.cameras),
        plan=tuple(plan.to_list()),
        provenance={
            "log": {"name": log.name, "format": log.format, "digest": log.digest},
            "log2sim_version": log2sim.__version__,
            "detector": detector.name,
            "config": config.to_dict(),
            "seed": config.seed,
            "history": ["reconstruct"],
        },
    )


def _camera_entry(name: str, ground: CameraGround | None, used: bool) -> dict[str, Any]:
    if ground is None or not ground.fit.ok:
        return {"name": name, "used": used, "homography": None}
    fit = ground.fit
    finite_error = float(fit.error_m) if np.isfinite(fit.error_m) else None
    return {
        "name": name,
        "used": used,
        "homography": {
            "ground_H_image": fit.ground_H_image.tolist(),
            "source": ground.source,
            "inliers": int(fit.inliers.sum()),
            "correspondences": len(fit.inliers),
            "error_m": finite_error,
            "condition": float(fit.condition),
        },
    }
