"""Tracking errors: the distance of a replay from the scenario."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.datatypes import STANDSTILL_MPS, Trajectory
from log2sim.geometry import Array, wrap_angle
from log2sim.simulation.result import AgentReplay

SEARCH_S = 1.0
SEARCH_STEP_S = 0.05

OFF_PATH_M = 0.5
"""Cross-track error beyond which an agent is off its path: a 1.9 m wide car in a 3.5 m lane has 0.8 m on each side."""


@dataclass(frozen=True, eq=False)
class TrackingErrors:
    """Distance of an agent from the scenario at its rows (S,); left, ahead, faster and counter-clockwise are positive.

    Attributes
    ----------
    across_m, along_m, speed_mps, yaw_rad : (S,) float64
    """

    across_m: Array
    along_m: Array
    speed_mps: Array
    yaw_rad: Array


def agent_errors(trajectory: Trajectory, agent: AgentReplay, *, follows: bool) -> TrackingErrors:
    """Compute the errors of an agent; one that is not on time may be far along its path and still on it."""
    near_s = agent.t_s if follows else _nearest_times(trajectory, agent.x_m, agent.y_m)
    across, along = tracking_errors(trajectory, agent.t_s, agent.x_m, agent.y_m, near_s)
    log = trajectory.at(agent.t_s)
    return TrackingErrors(across, along, agent.speed_mps - log.speed_mps, wrap_angle(agent.yaw_rad - log.yaw_rad))


def tracking_errors(
    trajectory: Trajectory, t_s: Array, x_m: Array, y_m: Array, near_s: Array | None = None
) -> tuple[Array, Array]:
    """Return the errors across and along the path of the scenario, (S,) each in m, left and ahead positive.

    Along: from the scenario's box center at the same time, in the direction of its heading. Across: distance from the
    nearest point of the path of the scenario's box centers within `SEARCH_S` of the same time, or of the times `near_s`
    (S,), so a delay in a curve is no error across. Where the nearest point is an end of that path, or the scenario
    stands, the component along its direction counts as along.
    """
    log_x, log_y, _, log_yaw, _ = trajectory.at(t_s)
    along = (x_m - log_x) * np.cos(log_yaw) + (y_m - log_y) * np.sin(log_yaw)
    begin_s, end_s = trajectory.t_s[0] - SEARCH_S, trajectory.t_s[-1] + SEARCH_S
    px, py, _, yaw, _ = trajectory.at(np.arange(begin_s, end_s + SEARCH_STEP_S, SEARCH_STEP_S))
    ux, uy = np.diff(px), np.diff(py)
    square = ux**2 + uy**2
    moves = square > (STANDSTILL_MPS * SEARCH_STEP_S) ** 2
    # Segments near each row (S, K): on each the share of it at which it is nearest.
    reach = round(SEARCH_S / SEARCH_STEP_S)
    middle = np.rint(((t_s if near_s is None else near_s) - begin_s) / SEARCH_STEP_S).astype(np.intp)
    near = np.clip(middle[:, None] + np.arange(-reach, reach), 0, len(square) - 1)
    dx, dy, sx, sy = x_m[:, None] - px.take(near), y_m[:, None] - py.take(near), ux.take(near), uy.take(near)
    slope = np.divide(1.0, square, out=np.zeros_like(square), where=moves)
    share = np.clip((dx * sx + dy * sy) * slope.take(near), 0.0, 1.0)
    best = np.argmin((dx - share * sx) ** 2 + (dy - share * sy) ** 2, axis=1)
    row = np.arange(len(t_s))
    k, dx, dy = near[row, best], dx[row, best], dy[row, best]
    length = np.sqrt(np.where(moves, square, 1.0))
    cos, sin = np.where(moves, ux / length, np.cos(yaw[:-1])), np.where(moves, uy / length, np.sin(yaw[:-1]))
    # For a vehicle in reverse, left of its heading is right of its direction of travel.
    left = np.where(cos * np.cos(yaw[:-1]) + sin * np.sin(yaw[:-1]) < 0, -1.0, 1.0)
    return left[k] * (dy * cos[k] - dx * sin[k]), along


def agent_metrics(errors: TrackingErrors) -> dict[str, Any]:
    """Return the tracking errors of one agent, and the share of its rows that are farther than `OFF_PATH_M` from its path."""
    across = np.abs(errors.across_m)
    return {
        "cross_track_rms_m": _rms(errors.across_m),
        "cross_track_max_m": round(float(np.max(across)), 6),
        "along_track_rms_m": _rms(errors.along_m),
        "speed_rms_mps": _rms(errors.speed_mps),
        "yaw_rms_rad": _rms(errors.yaw_rad),
        "off_path_share": round(float(np.mean(across > OFF_PATH_M)), 6),
    }


def scenario_metrics(
    by_agent: Mapping[str, Mapping[str, Any]], on_time: Mapping[str, int], on_way: Mapping[str, int]
) -> dict[str, Any]:
    """Average the errors over all followers, every stored sample counting alike; 0 without followers.

    Parameters
    ----------
    by_agent : by id
        The errors of each agent.
    on_time, on_way : by id
        The samples of agents that follow the scenario in time, and of all that keep to its path.
    """
    out: dict[str, Any] = {}
    for key, samples in (
        ("cross_track_rms_m", on_way), ("along_track_rms_m", on_time), ("speed_rms_mps", on_time), ("yaw_rms_rad", on_time),
    ):  # fmt: skip
        out[key] = round(float(np.sqrt(_mean({k: e[key] ** 2 for k, e in by_agent.items()}, samples))), 6)
    out["cross_track_max_m"] = max((e["cross_track_max_m"] for k, e in by_agent.items() if k in on_way), default=0.0)
    out["off_path_share"] = round(_mean({k: e["off_path_share"] for k, e in by_agent.items()}, on_way), 6)
    out["followers"] = len(on_time)
    return out


def _mean(values: Mapping[str, float], samples: Mapping[str, int]) -> float:
    """Return the mean of the values weighted by their samples; 0 without any."""
    total = sum(samples.values())
    return sum(count * values[k] for k, count in samples.items()) / total if total else 0.0


def _nearest_times(trajectory: Trajectory, x_m: Array, y_m: Array) -> Array:
    """Return the times (S,) at which the scenario is nearest to places."""
    from scipy.spatial import cKDTree

    t = np.arange(trajectory.t_s[0], trajectory.t_s[-1] + SEARCH_STEP_S / 2, SEARCH_STEP_S)
    x, y = trajectory.relative(t)[:2]
    _, nearest = cKDTree(np.stack([x, y], axis=1)).query(
        np.stack([x_m - trajectory.origin_m[0], y_m - trajectory.origin_m[1]], axis=1)
    )
    result: Array = t[nearest]
    return result


def _rms(values: Array) -> float:
    return round(float(np.sqrt(np.mean(values**2))), 6)
