"""How far a replay is from the log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from log2sim.errors import CheckFailed
from log2sim.geometry import Array, wrap_angle
from log2sim.replay.path import Path

SEARCH_S = 1.0
SEARCH_STEP_S = 0.05
STANDING_MPS = 0.1

CROSS_TRACK_LIMIT_M = 0.5
"""Limit of a strict replay: a car of 1.9 m in a lane of 3.5 m has 0.8 m on either side."""


def tracking_errors(path: Path, t_s: Array, x_m: Array, y_m: Array) -> tuple[Array, Array]:
    """Errors across and along the logged path, (S,) each in m, left and ahead positive.

    Along: from the logged box center at the same time, in the direction of its heading. Across: distance from the nearest
    point of the course of logged box centers within `SEARCH_S`, so being late in a curve is no error across. Where the
    nearest point is an end of that course, or the log stands, what lies along its direction counts as along.
    """
    log_x, log_y, log_yaw, _ = path.centers(t_s)
    along = (x_m - log_x) * np.cos(log_yaw) + (y_m - log_y) * np.sin(log_yaw)
    times = t_s[:, None] + np.arange(-SEARCH_S, SEARCH_S + SEARCH_STEP_S / 2, SEARCH_STEP_S)
    px, py, yaw, _ = (v.reshape(times.shape) for v in path.centers(times.ravel()))
    ux, uy = np.diff(px, axis=1), np.diff(py, axis=1)
    dx, dy = x_m[:, None] - px[:, :-1], y_m[:, None] - py[:, :-1]
    square = ux**2 + uy**2
    moves = square > (STANDING_MPS * SEARCH_STEP_S) ** 2
    share = np.clip(np.divide(dx * ux + dy * uy, square, out=np.zeros_like(square), where=moves), 0.0, 1.0)
    nearest = np.argmin(np.hypot(dx - share * ux, dy - share * uy), axis=1)
    row = np.arange(len(t_s))
    length = np.sqrt(np.where(moves, square, 1.0))
    cos, sin = np.where(moves, ux / length, np.cos(yaw[:, :-1])), np.where(moves, uy / length, np.sin(yaw[:, :-1]))
    across = dy * cos - dx * sin
    # A vehicle that reverses has its left on the other side of its course.
    behind = cos * np.cos(yaw[:, :-1]) + sin * np.sin(yaw[:, :-1]) < 0
    return np.where(behind, -across, across)[row, nearest], along


def agent_metrics(path: Path, t_s: Array, x_m: Array, y_m: Array, yaw_rad: Array, speed_mps: Array) -> dict[str, float]:
    """Tracking errors of one agent."""
    across, along = tracking_errors(path, t_s, x_m, y_m)
    _, _, log_yaw, log_speed = path.centers(t_s)
    return {
        "cross_track_rms_m": _rms(across),
        "cross_track_max_m": round(float(np.max(np.abs(across))), 6),
        "along_track_rms_m": _rms(along),
        "speed_rms_mps": _rms(speed_mps - log_speed),
        "yaw_rms_rad": _rms(wrap_angle(yaw_rad - log_yaw)),
    }


def overall(
    by_agent: Mapping[str, Mapping[str, Any]], samples: Mapping[str, int], events: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Errors over all followers, every stored sample counting alike; 0 where nobody follows."""
    ids = [k for k in by_agent if samples[k] > 0]
    total = sum(samples[k] for k in ids)
    out: dict[str, Any] = {}
    for key in ("cross_track_rms_m", "along_track_rms_m", "speed_rms_mps", "yaw_rms_rad"):
        square = sum(samples[k] * by_agent[k][key] ** 2 for k in ids)
        out[key] = round(float(np.sqrt(square / total)), 6) if total else 0.0
    out["cross_track_max_m"] = max((by_agent[k]["cross_track_max_m"] for k in ids), default=0.0)
    out["followers"] = len(ids)
    out["collisions"] = [dict(e) for e in events]
    out["new_collisions"] = sum(not e["in_log"] for e in events)
    out["by_agent"] = {k: dict(v) for k, v in by_agent.items()}
    return out


def check_strict(replay: Any) -> list[str]:
    """What breaks a limit of `--strict`: collisions that the log does not have, vehicles off their path, impossible logs."""
    broken = [
        f"{' and '.join(e['agents'])} collide at {e['t_s']:.2f} s ({e['relative_speed_mps']:.1f} m/s); the log has no such collision"
        for e in replay.metrics["collisions"]
        if not e["in_log"]
    ]
    for agent in replay.agents:
        if agent.driver in ("policy", "reactive"):
            continue
        worst = replay.metrics["by_agent"].get(agent.id, {}).get("cross_track_max_m", 0.0)
        if worst > CROSS_TRACK_LIMIT_M:
            broken.append(f"agent '{agent.id}': {worst:.2f} m off its path, limit {CROSS_TRACK_LIMIT_M:g} m")
        broken += [f"agent '{agent.id}': {flag}" for flag in agent.flags]
    return broken


def require_strict(replay: Any) -> None:
    """Raise `CheckFailed` with all broken limits."""
    broken = check_strict(replay)
    if broken:
        raise CheckFailed("the replay breaks limits:\n  " + "\n  ".join(broken))


def _rms(values: Array) -> float:
    return round(float(np.sqrt(np.mean(values**2))), 6)
