"""The last steps: the ego as an agent, few waypoints where few are enough, everything put into a scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import log2sim
from log2sim.assemble import STANDING_SPEED_MPS, Timeline
from log2sim.config import Config
from log2sim.detect import Detector
from log2sim.geometry import NS_PER_S, Array, yaw_of
from log2sim.ground_plane import CameraGround
from log2sim.plan import Plan
from log2sim.scenario import Agent, Scenario, Waypoints
from log2sim.smooth import signed_speed, smooth_track
from log2sim.sync import Schedule
from log2sim.thin import thin
from log2sim.types import Log

EGO_SIGMA_M = 0.02


def thinned(agents: Sequence[Agent]) -> list[Agent]:
    """Agents with few waypoints where they move straight at constant speed; `quality` says how many were left out."""
    out = []
    for agent in agents:
        few = thin(agent.waypoints)
        left_out = len(agent.waypoints) - len(few)
        quality = {**agent.quality, "waypoints_left_out": left_out} if left_out else agent.quality
        out.append(replace(agent, waypoints=few, quality=quality) if left_out else agent)
    return out


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
