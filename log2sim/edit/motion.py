"""The effect of edits on the waypoints of one agent."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Finding, Waypoints
from log2sim.geometry import Array, wrap_angle

MIN_PATH_MPS = 0.5  # slower waypoints do not define the curvature of a path
# Waypoints of a maneuver are so far apart: a lane change of 2 s is then right to a millimeter between them.
STEP_S = 0.1
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
    start = replace(resampled(agent, np.array([-seconds])), t_s=np.zeros(1))
    return Waypoints(**{k: np.concatenate([v, getattr(kept, k)]) for k, v in start.columns().items()})


def retimed_doubts(doubts: Sequence[Finding], change: Callable[[float], float]) -> tuple[Finding, ...]:
    """Move the spans of doubts, without what then is before the scenario's start t = 0.

    A sentence of a file that names a time, which stays that of the source, says so.
    """
    moved = []
    for d in (doubt.retimed(change) for doubt in doubts):
        if d.end_s is not None and d.end_s < 0.0:
            continue
        d = replace(d, start_s=None if d.start_s is None else max(d.start_s, 0.0))
        told = d.text is not None and _NAMES_A_TIME.search(d.text) and OLD_TIME not in d.text
        moved.append(replace(d, text=f"{d.text}, {OLD_TIME}") if told else d)
    return tuple(moved)


def shifted_left(w: Waypoints, meters: float) -> Waypoints:
    """Return waypoints `meters` to the left of their headings, to the right where negative.

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


def resampled(agent: Agent, t_s: Array) -> Waypoints:
    """Return waypoints at times (T,) within the life of an agent; a waypoint is observed where both of its neighbors are."""
    w, at = agent.waypoints, agent.at(t_s)
    columns = {k: getattr(at, k) for k in ("x_m", "y_m", "z_m", "yaw_rad", "speed_mps")}
    columns |= {k: np.interp(t_s, w.t_s, v) for k, v in w.columns().items() if k.startswith("sigma")}
    observed = np.interp(t_s, w.t_s, w.observed.astype(np.float64)) > 1 - 1e-9
    return Waypoints(t_s=np.asarray(t_s, dtype=np.float64), observed=observed, **columns)


def insert_steps(w: Waypoints, begin_s: float, end_s: float) -> Array:
    """Return the times of waypoints with more of them, at most `STEP_S` apart, between two times."""
    begin_s, end_s = np.clip([begin_s, end_s], w.t_s[0], w.t_s[-1])
    steps = np.linspace(begin_s, end_s, max(int(np.ceil((end_s - begin_s) / STEP_S)), 1) + 1)
    times = np.unique(np.concatenate([w.t_s, steps]))
    kept: Array = times[np.concatenate([[True], np.diff(times) > 1e-9])]
    return kept


def smooth_step(share: Array) -> tuple[Array, Array]:
    """Return the polynomial of least jerk from 0 to 1 at shares (T,) of its duration, and its derivative.

    Flash and Hogan, "The coordination of arm movements", Journal of Neuroscience 5, 1985: velocity and acceleration are 0 at
    both ends. Its largest derivative is 15/8, its largest second derivative 10 / sqrt(3).
    """
    u = np.clip(share, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2), 30 * u**2 * (1 - u) ** 2


def lane_changed(agent: Agent, meters: float, begin_s: float, over_s: float) -> Waypoints:
    """Return waypoints that move `meters` to the left within `over_s` seconds and stay there.

    The heading follows the direction of motion, the speed its length, so that a vehicle can drive it.
    """
    w = resampled(agent, insert_steps(agent.waypoints, begin_s, begin_s + over_s))
    offset, slope = smooth_step((w.t_s - begin_s) / over_s)
    offset, drift = meters * offset, meters * slope / over_s
    yaw = np.unwrap(w.yaw_rad)
    rate = np.gradient(yaw, w.t_s, edge_order=2 if len(w) > 2 else 1) if len(w) > 1 else np.zeros(len(w))
    along = w.speed_mps - offset * rate
    # Backward motion drifts to the left with the front to the right.
    turn = np.arctan2(drift * np.where(along < 0, -1.0, 1.0), np.abs(along))
    return replace(
        w,
        x_m=w.x_m - offset * np.sin(yaw),
        y_m=w.y_m + offset * np.cos(yaw),
        yaw_rad=wrap_angle(yaw + np.where(drift == 0, 0.0, turn)),
        speed_mps=np.where(along < 0, -1.0, 1.0) * np.hypot(along, drift),
    )


def sped_up_between(
    agent: Agent, factor: float, begin_s: float, over_s: float
) -> tuple[Waypoints, Callable[[Array], Array]]:
    """Return waypoints passed `factor` times as fast for a while, and the new times of old ones.

    The factor comes and goes within a quarter of the time each, by the polynomial of least jerk.
    """
    ramp_s, life = over_s / 4, agent.waypoints.t_s
    last_s = begin_s + max(over_s, (life[-1] - begin_s) / min(factor, 1.0)) + over_s
    new = np.union1d(np.arange(life[0], last_s, STEP_S / 10), [begin_s, begin_s + over_s])
    up, _ = smooth_step((new - begin_s) / ramp_s)
    down, _ = smooth_step((new - begin_s - over_s + ramp_s) / ramp_s)
    pace = 1 + (factor - 1) * (up - down)
    old = life[0] + np.concatenate([[0.0], np.cumsum((pace[1:] + pace[:-1]) / 2 * np.diff(new))])

    def moved(t_s: Array) -> Array:
        return np.asarray(np.interp(t_s, old, new))

    during = old[(new >= begin_s) & (new <= begin_s + over_s)]
    w = resampled(agent, insert_steps(agent.waypoints, float(during[0]), float(during[-1])))
    t_s = moved(w.t_s)
    return replace(w, t_s=t_s, speed_mps=w.speed_mps * np.interp(t_s, new, pace)), moved


def along_path(agent: Agent, meters: float) -> Waypoints:
    """Return waypoints `meters` ahead on the path of an agent at its pace, straight on beyond its ends; behind where negative."""
    w = resampled(agent, insert_steps(agent.waypoints, *agent.waypoints.t_s[[0, -1]]))
    station = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(w.x_m), np.diff(w.y_m)))])
    moves = np.concatenate([[True], np.diff(station) > 1e-6])
    path, target = station[moves], station + meters
    beyond = target - np.clip(target, path[0], path[-1])
    yaw = np.interp(target, path, np.unwrap(w.yaw_rad[moves]))
    x, y, z = (np.interp(target, path, column[moves]) for column in (w.x_m, w.y_m, w.z_m))
    return replace(w, x_m=x + beyond * np.cos(yaw), y_m=y + beyond * np.sin(yaw), z_m=z, yaw_rad=wrap_angle(yaw))
