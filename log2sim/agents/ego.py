"""The ego as an agent, from the poses of its log."""

from __future__ import annotations

import numpy as np

from log2sim.agents.candidate import Timeline
from log2sim.agents.smooth.feasibility import limit_doubts
from log2sim.agents.smooth.smoother import signed_speed, smooth_track
from log2sim.datatypes import STANDSTILL_DRIFT_M, STANDSTILL_MPS, Agent, Log, Waypoints
from log2sim.geometry import Array, yaw_of
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
    base_m = EGO_SIGMA_M if log.ego.sigma_m is None else float(log.ego.sigma_m.min())
    bridging_m2 = np.maximum(sigma_m**2 - base_m**2, 0.0)
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


def ego_path(log: Log, schedule: Schedule) -> Array:
    """Return x, y and heading (K, 3) of the ego at every tick, as evidence of the direction of traffic."""
    if log.ego is None:
        return np.zeros((0, 3))
    map_T_ego, valid = log.ego.at(schedule.t_ns)
    poses = map_T_ego[valid]
    return np.column_stack([poses[:, :2, 3], yaw_of(poses)])
