"""The ego as an agent, from the poses of its log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import Timeline
from log2sim.agents.smooth.feasibility import limit_doubts
from log2sim.agents.smooth.smoother import signed_speed, smooth_track
from log2sim.datatypes import STANDSTILL_DRIFT_M, STANDSTILL_MPS, Agent, Log, Waypoints
from log2sim.geometry import NS_PER_S, Array, PoseTrack, yaw_of
from log2sim.perception.sync import Schedule

# Standard deviations of ego positions and yaws from GNSS/INS with RTK or LiDAR odometry.
EGO_SIGMA_M, EGO_SIGMA_RAD = 0.02, 0.002


def ego_agent(log: Log, timeline: Timeline, source: str = "ego poses of the log") -> Agent | None:
    """Make the ego an agent with a waypoint at every tick; None for a log without poses at them.

    `source` says where the poses come from.
    """
    if log.ego is None:
        return None
    map_T_ego, valid = log.ego.at(timeline.t_ns)
    if not valid.any():
        return None
    vehicle = log.ego_vehicle
    center = log.ego_centers(map_T_ego[valid])
    t, yaw = timeline.seconds(timeline.t_ns[valid]), yaw_of(map_T_ego[valid])
    sigma_m = log.ego.sigmas_at(timeline.t_ns[valid], (EGO_SIGMA_M, EGO_SIGMA_RAD))[:, 0]
    path = smooth_track(t, center[:, :2], sigma_m=sigma_m)
    # Poses that bridge a gap are off together, so that smoothing does not make them better.
    bridging_m2 = bridging_variances(log.ego, timeline.t_ns[valid])[:, 0]
    speed = signed_speed(path.velocity_mps, yaw)
    waypoints = Waypoints(
        t_s=t,
        x_m=path.xy_m[:, 0],
        y_m=path.xy_m[:, 1],
        z_m=center[:, 2],
        yaw_rad=yaw,
        speed_mps=np.where(np.abs(speed) < STANDSTILL_MPS, 0.0, speed),
        observed=np.ones(len(t), dtype=bool),
        sigma_xy_m=np.sqrt(np.trace(path.covariance, axis1=1, axis2=2) / 2 + bridging_m2),
    )
    moved = float(np.hypot(np.ptp(center[:, 0]), np.ptp(center[:, 1])))
    return Agent(
        "ego", "car", vehicle.size_m, waypoints, static=moved < STANDSTILL_DRIFT_M, rear_axle_offset_m=vehicle.rear_axle_offset_m,
        doubts=limit_doubts(path.broken), quality={"source": source},
    )  # fmt: skip


def bridging_variances(poses: PoseTrack, t_ns: NDArray[np.int64]) -> Array:
    """Return the variances (N, 2) of positions, m2, and yaws, rad2, at stamps (N,), beyond those of measured poses."""
    sigmas = poses.sigmas_at(t_ns, (EGO_SIGMA_M, EGO_SIGMA_RAD))
    known = zip((EGO_SIGMA_M, EGO_SIGMA_RAD), (poses.sigma_m, poses.sigma_yaw_rad), strict=True)
    measured = np.array([usual if sigma is None else float(sigma.min()) for usual, sigma in known])
    return np.asarray(np.maximum(sigmas**2 - measured**2, 0.0))


def with_pose_errors(agent: Agent, log: Log, timeline: Timeline) -> Agent:
    """Add to the standard deviations of an agent what the ego's poses are uncertain by where they bridge gaps.

    An agent is placed by the pose of its tick, from which it is as far away as it is seen. One that stands is placed by the best
    pose of its time.
    """
    w = agent.waypoints
    if log.ego is None or log.ego.sigma_m is None:
        return agent
    ticks = timeline.t0_ns + np.round(w.t_s * NS_PER_S).astype(np.int64)
    if agent.static:
        ticks = timeline.t_ns[(timeline.t_ns >= ticks[0]) & (timeline.t_ns <= ticks[-1])]
    variances = bridging_variances(log.ego, ticks)
    if not variances.any():
        return agent
    away_m2 = np.sum((log.ego.at(ticks)[0][:, :2, 3] - _positions(agent, timeline.seconds(ticks))) ** 2, axis=1)
    position, yaw = variances[:, 0] + away_m2 * variances[:, 1], variances[:, 1]
    if agent.static:
        position, yaw = (np.full(len(w), v.min()) for v in (position, yaw))
    return replace(agent, waypoints=replace(
        w,
        sigma_xy_m=None if w.sigma_xy_m is None else np.sqrt(w.sigma_xy_m**2 + position),
        sigma_yaw_rad=None if w.sigma_yaw_rad is None else np.sqrt(w.sigma_yaw_rad**2 + yaw),
    ))  # fmt: skip


def _positions(agent: Agent, t_s: Array) -> Array:
    """Interpolate the positions (N, 2), m, of an agent at times (N,)."""
    w = agent.waypoints
    return np.stack([np.interp(t_s, w.t_s, w.x_m), np.interp(t_s, w.t_s, w.y_m)], axis=1)


def ego_path(log: Log, schedule: Schedule) -> Array:
    """Return x, y and heading (K, 3) of the ego at every tick, as evidence of the direction of traffic."""
    if log.ego is None:
        return np.zeros((0, 3))
    map_T_ego, valid = log.ego.at(schedule.t_ns)
    poses = map_T_ego[valid]
    return np.column_stack([poses[:, :2, 3], yaw_of(poses)])
