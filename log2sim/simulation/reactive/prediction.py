"""Where agents are expected to be within the horizon: on their own logged ways, or straight ahead."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.simulation.reactive.path_table import PathTable
from log2sim.simulation.reactive.swept_corridor import HORIZON_S

ON_PATH_M, ON_PATH_COS = 1.5, 0.9
"""A driven agent this near to its logged way, and pointing along it, is expected to stay on it."""

Prediction = tuple[Array, Array, Array, Array]
"""x, y relative to the origin of the ways, yaw and speed, all (P, H) at the times of the horizon."""


def predict_by_log(ways: PathTable, agent: NDArray[np.intp], t_s: Array, rate: Array) -> Prediction:
    """Agents (P,) that go on through their logs from times (P,) at rates (P,)."""
    pose = ways.at(agent[:, None], t_s[:, None] + rate[:, None] * HORIZON_S)
    return pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps * rate[:, None]


def predict_along_path(
    ways: PathTable, agent: int, distance_m: Array, pace_mps: Array, left_m: float = 0.0
) -> Prediction:
    """An agent that goes along its way at paces (P,) from distances (P,), so far left of it."""
    ahead = distance_m[:, None] + pace_mps[:, None] * HORIZON_S
    x, y, cos, sin, _ = ways.along(np.array([agent])[:, None], ahead)
    return x - left_m * sin, y + left_m * cos, np.arctan2(sin, cos), np.broadcast_to(pace_mps[:, None], ahead.shape)


def predict_policy_vehicle(
    ways: PathTable, agent: int, x_m: float, y_m: float, yaw_rad: float, speed_mps: float
) -> Prediction:
    """An agent whose driver is free: along its logged way while it is on it, else straight ahead; (1, H)."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    whole_m = float(ways.marks[agent])
    foot = ways.foot(np.array([agent]), np.zeros(1), whole_m, np.array([[x_m]]), np.array([[y_m]]))
    left_m = float(foot.left_m[0, 0])
    along = float(cos * foot.cos[0, 0] + sin * foot.sin[0, 0])
    if speed_mps >= 0 and abs(left_m) < ON_PATH_M and along > ON_PATH_COS:
        return predict_along_path(ways, agent, foot.distance_m[0] + foot.ahead_m[0], np.array([speed_mps]), left_m)
    way = speed_mps * HORIZON_S[None]
    same = np.ones_like(way)
    return x_m + way * cos, y_m + way * sin, yaw_rad * same, speed_mps * same
