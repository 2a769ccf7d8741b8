"""Predicted positions of agents within the horizon: along their paths in the scenario, or straight ahead."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.simulation.reactive.path_table import PathTable
from log2sim.simulation.reactive.swept_corridor import HORIZON_S

ON_PATH_M, ON_PATH_COS = 1.5, 0.9
"""A driven agent this near to its path in the scenario, and pointing along it, is expected to stay on it."""

Prediction = tuple[Array, Array, Array, Array]
"""x, y relative to the origin of the path table, yaw and speed, all (P, H) at the times of the horizon."""


def predict_by_log(paths: PathTable, agent: NDArray[np.intp], t_s: Array, rate: Array) -> Prediction:
    """Predict agents (P,) that follow their trajectories from times (P,) at rates (P,)."""
    pose = paths.at(agent[:, None], t_s[:, None] + rate[:, None] * HORIZON_S)
    return pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps * rate[:, None]


def predict_along_path(
    paths: PathTable, agent: int, distance_m: Array, pace_mps: Array, left_m: float = 0.0
) -> Prediction:
    """Predict an agent that goes along its path at speeds (P,) from distances (P,), with an offset to the left."""
    ahead = distance_m[:, None] + pace_mps[:, None] * HORIZON_S
    x, y, cos, sin, _ = paths.along(np.array([agent])[:, None], ahead)
    return x - left_m * sin, y + left_m * cos, np.arctan2(sin, cos), np.broadcast_to(pace_mps[:, None], ahead.shape)


def predict_policy_vehicle(
    paths: PathTable, agent: int, x_m: float, y_m: float, yaw_rad: float, speed_mps: float
) -> Prediction:
    """Predict an agent that a policy drives: along its own path while it is on it, else straight ahead; (1, H)."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    whole_m = float(paths.marks[agent])
    foot = paths.foot(np.array([agent]), np.zeros(1), whole_m, np.array([[x_m]]), np.array([[y_m]]))
    left_m = float(foot.left_m[0, 0])
    along = float(cos * foot.cos[0, 0] + sin * foot.sin[0, 0])
    if speed_mps >= 0 and abs(left_m) < ON_PATH_M and along > ON_PATH_COS:
        return predict_along_path(paths, agent, foot.distance_m[0] + foot.ahead_m[0], np.array([speed_mps]), left_m)
    traveled = speed_mps * HORIZON_S[None]
    same = np.ones_like(traveled)
    return x_m + traveled * cos, y_m + traveled * sin, yaw_rad * same, speed_mps * same
