"""A scenario as CARLA's script reads it: assets, and the trajectory of each agent in CARLA's frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from log2sim.datatypes import Agent, Trajectory
from log2sim.errors import ScenarioError
from log2sim.geometry import Array
from log2sim.simulation.carla.assets import nearest_assets
from log2sim.simulation.follower import GAINS
from log2sim.simulation.reference import vehicle_limits, vehicle_reference
from log2sim.simulation.vehicles.parameters import PEDAL_LAG_S, STEER_LAG_S, WHEELED, parameters_for, rear_axle_offset

SAMPLE_S = 0.05
"""Spacing of the samples; linear interpolation errs by at most a h^2 / 8 = 3 mm at 10 m/s2."""

MAX_SAMPLED_BYTES = 1536 * 1024 * 1024
BYTES_PER_SAMPLE = 480
"""Of the numbers of a sample in the lists that are written, as objects of Python; 1.5 GiB hold 46 hours of one agent."""

DISCONTINUITY_S = 1e-6  # spacing of the two samples at a discontinuity of the scenario


def controller_data() -> dict[str, float]:
    """Return the gains of the vehicle controller and the lags of its actuators, as `player` reads them."""
    return {**asdict(GAINS), "pedal_lag_s": PEDAL_LAG_S, "steer_lag_s": STEER_LAG_S}


def carla_agents(agents: Sequence[Agent]) -> list[dict[str, Any]]:
    """Describe agents as `player` reads them. Their positions should be near the origin: CARLA computes in float32.

    Raises
    ------
    ScenarioError
        When their samples would take more than `MAX_SAMPLED_BYTES`, before anything is allocated for them.
    """
    _require_few_samples(agents)
    begin_s = min(float(a.waypoints.t_s[0]) for a in agents)
    end_s = max(float(a.waypoints.t_s[-1]) for a in agents)
    counts: Counter[str] = Counter()
    described = []
    for agent in agents:
        described.append(_agent(agent, counts[agent.category], (begin_s, end_s)))
        counts[agent.category] += 1
    return described


def _require_few_samples(agents: Sequence[Agent]) -> None:
    lasts_s = [0.0 if a.static else float(a.waypoints.t_s[-1] - a.waypoints.t_s[0]) for a in agents]
    size_bytes = sum(lasts_s) / SAMPLE_S * BYTES_PER_SAMPLE
    if size_bytes > MAX_SAMPLED_BYTES:
        k = int(np.argmax(lasts_s))
        raise ScenarioError(
            f"agents last {sum(lasts_s):g} s together, '{agents[k].id}' {lasts_s[k]:g} s: their samples every {SAMPLE_S:g} s take "
            f"{size_bytes / 2**30:.3g} GiB, at most {MAX_SAMPLED_BYTES / 2**30:g} GiB can be written; cut the scenario into parts"
        )


def _agent(agent: Agent, turn: int, span_s: tuple[float, float]) -> dict[str, Any]:
    """Describe one agent; a permanent one is present for all of `span_s`, as in log2sim's own simulator."""
    w, wheeled = agent.waypoints, agent.category in WHEELED
    moves = not agent.static and len(w) > 1
    life_s = span_s if agent.is_permanent else (float(w.t_s[0]), float(w.t_s[-1]))
    trajectory = Trajectory.through(agent.waypoints, rear_axle_offset(agent))
    exact, pid = _trajectories(agent, trajectory, drives=moves and wheeled)
    limits = parameters_for([agent]) if wheeled else None
    return {
        "id": agent.id,
        "category": agent.category,
        "size_m": [round(v, 3) for v in agent.size_m],
        "color": None if agent.color is None else list(agent.color["rgb"]),
        "static": agent.static,
        "doubts": [doubt.to_dict() for doubt in agent.doubts],
        "assets": [
            {"blueprint": a.blueprint, "size_m": a.size_m, "error_m": a.error_m}
            for a in nearest_assets(agent, turn=turn)
        ],
        "begin_s": life_s[0],
        "end_s": life_s[1],
        "discontinuities_s": [float(t) for t in trajectory.discontinuity_times()],
        "drive": None if not moves else "vehicle" if wheeled else "walker" if agent.category == "pedestrian" else None,
        "max_throttle_mps2": None if limits is None else float(limits.max_throttle_mps2[0]),
        "max_brake_mps2": None if limits is None else float(limits.max_brake_mps2[0]),
        "exact": exact,
        "pid": pid,
    }


def _trajectories(
    agent: Agent, trajectory: Trajectory, *, drives: bool
) -> tuple[dict[str, list[float]], dict[str, list[float]] | None]:
    """Return columns of the trajectory and, for a vehicle that drives, of the feasible one; both of the box center."""
    t_s = _times(agent, trajectory)
    x, y, yaw, _ = trajectory.relative(t_s)
    z = trajectory.heights(t_s) - agent.size_m[2] / 2
    origin_x, origin_y = trajectory.origin_m
    if not drives:
        return {**_left_handed(t_s, x + origin_x, y + origin_y, z, yaw), "curvature_1pm": [0.0] * len(t_s)}, None
    limits = vehicle_limits(agent)
    reference = vehicle_reference(trajectory, limits, accel_ahead_s=0.0, curvature_ahead_s=0.0)
    rear_x, rear_y, rear_yaw, speed, accel, curvature, gear, stands = reference.exact(t_s).T
    center_x, center_y = rear_x + limits.offset_m * np.cos(rear_yaw), rear_y + limits.offset_m * np.sin(rear_yaw)
    bend = {"curvature_1pm": _rounded(-curvature)}
    exact = {**_left_handed(t_s, x + origin_x, y + origin_y, z, yaw), **bend}
    pid = {
        **_left_handed(t_s, center_x + origin_x, center_y + origin_y, z, rear_yaw),
        **bend,
        "speed_mps": _rounded(speed),
        "accel_mps2": _rounded(accel),
        "gear": _rounded(gear),
        "stands": _rounded(stands),
    }
    return exact, pid


def _times(agent: Agent, trajectory: Trajectory) -> Array:
    """Return the sample times: regular ones, every waypoint, and one just before a discontinuity."""
    if agent.static:
        return trajectory.t_s[:1]
    regular = np.arange(trajectory.t_s[0], trajectory.t_s[-1], SAMPLE_S)
    k = np.searchsorted(trajectory.t_s, regular, side="right")
    gap_s = np.minimum(
        regular - trajectory.t_s[k - 1], trajectory.t_s[np.minimum(k, len(trajectory.t_s) - 1)] - regular
    )
    return np.sort(
        np.concatenate(
            [regular[gap_s > 10 * DISCONTINUITY_S], trajectory.t_s, trajectory.discontinuity_times() - DISCONTINUITY_S]
        )
    )


def _left_handed(t_s: Array, x: Array, y: Array, z: Array, yaw: Array) -> dict[str, list[float]]:
    """Convert columns to CARLA's left-handed frame."""
    return {
        "t_s": _rounded(t_s, 7),
        "x_m": _rounded(x),
        "y_m": _rounded(-y),
        "z_m": _rounded(z),
        "yaw_deg": _rounded(-np.degrees(yaw)),
    }


def _rounded(values: ArrayLike, digits: int = 4) -> list[float]:
    """Round for the file: a tenth of a millimeter, or of a thousandth of a degree."""
    return [float(v) for v in np.round(np.asarray(values, dtype=np.float64), digits) + 0.0]
