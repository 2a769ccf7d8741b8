"""What is known of the agents of a scenario at a moment from which they are simulated: their last second, and what they did then."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import STANDSTILL_MPS, Agent, Scenario
from log2sim.geometry import Array, wrap_angle
from log2sim.simulation.metrics.realism import Motions
from log2sim.simulation.prediction.motion_table import TICK_S, Complex, smooth_motion, tabulate
from log2sim.simulation.vehicles.vehicle import WHEELED

HISTORY_S = 1.0  # of the past is known; with the present eleven ticks, as in the challenge
NORMAL_PER_MEDIAN = 1.4826

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Present:
    """Agents (A,) at the moment from which they are simulated, as their own last second tells."""

    agents: tuple[Agent, ...]
    place_m: Complex  # (A,), complex
    course_rad: Array  # (A,): direction of travel and of the box; likewise `yaw_rad`
    yaw_rad: Array
    speed_mps: Array  # (A,): along the course; likewise `accel_mps2`, `turn_radps`
    accel_mps2: Array
    turn_radps: Array
    moves: Mask  # (A,): False for those that are static
    jitter: Array  # (3, A): what the log jitters by along, across, in m, and in heading, in rad: one standard deviation
    size_m: Array  # (A, 2), m: length and width
    group: NDArray[np.str_]  # (A,): of categories


def recorded(scenario: Scenario, now_s: float, horizon_s: float = 8.0) -> tuple[Motions, int]:
    """Return what the agents that are there at a time did from `HISTORY_S` before, (1, A, T), and the tick of that time."""
    before, after = round(HISTORY_S / TICK_S), round(horizon_s / TICK_S)
    t_s: Array = now_s + np.arange(-before, after + 1, dtype=np.float64) * TICK_S
    there = [
        a for a in scenario.agents if a.is_permanent or a.waypoints.t_s[0] - 1e-3 <= now_s <= a.waypoints.t_s[-1] + 1e-3
    ]
    table = tabulate(there, t_s)
    jumps = table.piece != table.piece[:, before, None]
    yaw = np.where(jumps, np.nan, table.yaw_rad)
    return Motions(tuple(there), TICK_S, np.where(jumps, np.nan, table.position_m)[None], yaw[None]), before


def judged(log: Motions, now: int) -> list[int]:
    """Return the rows of agents that move within the log or wait, and were there a while: those whose realism is measured."""
    past = log.present[0, :, : now + 1].sum(axis=1)
    return [k for k, a in enumerate(log.agents) if not a.static and past[k] > now / 2]


def observe(scenario: Scenario, now_s: float) -> Present:
    """Fit the state of agents at a time to their last second; nothing later is looked at."""
    log, now = recorded(scenario, now_s, 0.0)
    known = list(log.agents)
    for k, a in enumerate(log.agents):
        past = (a.waypoints.t_s <= now_s + TICK_S / 2) & (a.waypoints.t_s >= now_s - HISTORY_S - TICK_S)
        if not (a.is_permanent or a.static) and past.any():
            known[k] = replace(a, waypoints=a.waypoints.take(np.flatnonzero(past)))
    t_s: Array = now_s + np.arange(-now, 1, dtype=np.float64) * TICK_S
    table = tabulate(known, t_s)
    smooth = smooth_motion(table)
    row = np.arange(len(known))
    last = table.present.shape[1] - 1 - table.present[:, ::-1].argmax(axis=1)
    yaw, velocity = table.yaw_rad[row, last], smooth.velocity_mps[row, last]
    place = table.position_m[row, last] + velocity * (now_s - t_s[last])
    for k in np.flatnonzero(~table.present.any(axis=1)).tolist():  # seen once, between two ticks
        w = known[k].waypoints
        yaw[k], velocity[k] = w.yaw_rad[-1], w.speed_mps[-1] * np.exp(1j * w.yaw_rad[-1])
        place[k] = complex(w.x_m[-1], w.y_m[-1]) + velocity[k] * (now_s - w.t_s[-1])
    wheeled = np.isin(table.category, WHEELED)
    forward = (velocity * np.exp(-1j * yaw)).real
    slow = np.abs(velocity) < 2 * STANDSTILL_MPS
    course = np.where(wheeled | slow, np.where(wheeled & (forward < -0.5), yaw + np.pi, yaw), np.angle(velocity))
    speed = np.where(wheeled, np.abs(forward), np.abs(velocity))
    accel, jitter = np.zeros(len(known)), np.full((3, len(known)), np.nan)
    for k in np.flatnonzero([not a.static for a in known]).tolist():
        there = np.flatnonzero(table.present[k] & (table.piece[k] == table.piece[k, last[k]]))
        if len(there) < 7:
            continue
        t = t_s[there] - t_s[there[-1]]
        way = (table.position_m[k, there] - table.position_m[k, there[-1]]) * np.exp(-1j * course[k])
        fits = [np.polyfit(t, c, 2) for c in (way.real, way.imag)]
        accel[k] = 2 * fits[0][0]
        rest = [c - np.polyval(fit, t) for c, fit in zip((way.real, way.imag), fits)]
        # White noise, whose second differences over two ticks have a standard deviation of sqrt(6) times its own.
        bends = [np.abs(c[4:] - 2 * c[2:-2] + c[:-4]) for c in (*rest, np.unwrap(table.yaw_rad[k, there]))]
        jitter[:, k] = np.median(bends, axis=1) * NORMAL_PER_MEDIAN / np.sqrt(6.0)
    return Present(
        tuple(known), place, wrap_angle(course), yaw, np.where(slow, 0.0, speed), np.clip(accel, -4.0, 3.0),
        np.where(slow, 0.0, smooth.turn_radps[row, last]), np.array([not a.static for a in known], dtype=bool),
        np.stack([_drawn_to_group(c, table.group) for c in jitter]), table.size_m[:, :2], table.group,
    )  # fmt: skip


def _drawn_to_group(own: Array, group: NDArray[np.str_]) -> Array:
    """Return variances' roots (A,) drawn halfway to those of the group, which stand in where nothing is known; 0 without either."""
    out = np.zeros(len(own))
    for name in np.unique(group):
        rows = group == name
        known = own[rows & np.isfinite(own)]
        usual = float(np.median(known)) if len(known) else 0.0
        out[rows] = np.sqrt((np.where(np.isfinite(own[rows]), own[rows], usual) ** 2 + usual**2) / 2)
    return out
