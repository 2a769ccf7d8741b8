"""The effect of edits on the waypoints of one agent."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Doubt, Waypoints
from log2sim.geometry import Array

MIN_PATH_MPS = 0.5  # slower waypoints do not define the curvature of a path
OLD_TIME = "before it was moved in time"
_NAMES_A_TIME = re.compile(r"\d s\b")


def shifted_in_time(agent: Agent, seconds: float) -> Waypoints:
    """Return waypoints `seconds` later, cut at the scenario's start t = 0.

    Where that cuts between two waypoints, one at t = 0 is interpolated. None may be left: (0,) columns.
    """
    moved = replace(agent.waypoints, t_s=agent.waypoints.t_s + seconds)
    first = int(np.searchsorted(moved.t_s, 0.0))
    kept = moved.take(np.arange(first, len(moved)))
    if first == 0 or first == len(moved) or moved.t_s[first] == 0.0:
        return kept
    at_start = agent.at(-seconds)
    start = {k: getattr(at_start, k) for k in ("x_m", "y_m", "z_m", "yaw_rad", "speed_mps")}
    start["t_s"] = np.zeros(1)
    for k in moved.columns():
        if k.startswith("sigma"):
            start[k] = np.interp([0.0], moved.t_s, getattr(moved, k))
    start["observed"] = moved.observed[first - 1 : first] & moved.observed[first : first + 1]
    return Waypoints(**{k: np.concatenate([v, getattr(kept, k)]) for k, v in start.items()})


def doubts_shifted(agent: Agent, seconds: float) -> tuple[Doubt, ...]:
    """Return the doubts of an agent that comes `seconds` later; none that held only before the scenario's start t = 0."""
    moved = _retimed(agent.doubts, lambda t_s: t_s + seconds)
    cut = (replace(d, start_s=None if d.start_s is None else max(d.start_s, 0.0)) for d in moved)
    return tuple(d for d in cut if d.end_s is None or d.end_s >= 0.0)


def doubts_sped_up(agent: Agent, factor: float) -> tuple[Doubt, ...]:
    """Return the doubts of an agent that passes its waypoints `factor` times as fast from the first one on."""
    begin_s = float(agent.waypoints.t_s[0])
    return _retimed(agent.doubts, lambda t_s: begin_s + (t_s - begin_s) / factor)


def _retimed(doubts: Sequence[Doubt], change: Callable[[float], float]) -> tuple[Doubt, ...]:
    """Move the spans of doubts; a reason that names a time, which stays that of the source, says so."""
    moved = (doubt.retimed(change) for doubt in doubts)
    return tuple(
        replace(d, reason=f"{d.reason}, {OLD_TIME}")
        if _NAMES_A_TIME.search(d.reason) and OLD_TIME not in d.reason
        else d
        for d in moved
    )


def sped_up(w: Waypoints, factor: float) -> Waypoints:
    """Return waypoints passed `factor` times as fast from the first one on: the same places at other times."""
    return replace(w, t_s=w.t_s[0] + (w.t_s - w.t_s[0]) / factor, speed_mps=w.speed_mps * factor)


def shifted_left(w: Waypoints, meters: float) -> Waypoints:
    """Return waypoints `meters` to the left of their headings, to the right where negative.

    Notes
    -----
    A point fixed to the left of a rigid body moves along the body's heading, `meters` times the yaw rate slower than
    the body, which is 1 - curvature times `meters` of its speed. So all points of the body, also the rear axle, drive a
    parallel curve, and a standing body keeps its heading. `parallel_fails` tells where no parallel curve exists. The
    height stays.
    """
    yaw = np.unwrap(w.yaw_rad)
    rate = np.gradient(yaw, w.t_s, edge_order=2 if len(w) > 2 else 1) if len(w) > 1 else np.zeros(len(w))
    return replace(
        w,
        x_m=w.x_m - meters * np.sin(w.yaw_rad),
        y_m=w.y_m + meters * np.cos(w.yaw_rad),
        speed_mps=w.speed_mps - meters * rate,
    )


def parallel_fails(w: Waypoints, meters: float) -> NDArray[np.bool_]:
    """Mask (T - 1,) of the steps between waypoints whose radius is not larger than the shift."""
    chord, turn = chords(w)
    moves = np.abs(chord) > MIN_PATH_MPS * np.diff(w.t_s)
    return moves & (chord * (chord - meters * turn) <= 0)


def chords(w: Waypoints) -> tuple[Array, Array]:
    """Return the signed distance along the mean heading, m, and the change of heading, rad, of the steps, (T - 1,) each."""
    yaw = np.unwrap(w.yaw_rad)
    turn, mean = np.diff(yaw), (yaw[1:] + yaw[:-1]) / 2
    return np.diff(w.x_m) * np.cos(mean) + np.diff(w.y_m) * np.sin(mean), turn
