"""A policy for the ego that drives as in the scenario, and brakes when it is warned."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import STANDSTILL_MPS, Scenario, Trajectory
from log2sim.geometry import Array
from log2sim.prediction.motion_table import TICK_S, table_of
from log2sim.simulation.policy import Controls, EgoState, Observation, PathAhead
from log2sim.simulation.warnings.ego_way import EgoStates
from log2sim.simulation.warnings.settings import WarningSettings
from log2sim.simulation.warnings.watch import MIN_EGO_MPS, Watch

CLEAR_S = 1.0
"""The ego drives on when its way has been clear for so long."""

RESPONSE_S = 0.6
"""Time constant with which errors of place, along and across the path, decay: that of the controllers of `pid`."""

MAX_AHEAD_M = 3.0
"""Longer distances behind the scenario are caught up with as this one: by 2.5 m/s faster."""

MAX_THROTTLE_MPS2 = 3.0
"""Of a car that pulls away: twice what the intelligent driver model takes for comfortable in towns."""

CATCH_UP_S = 0.2
"""After it has braked, the ego catches up with so much and no more."""

MIN_LOOK_M = 3.0
"""Errors across the path decay within this distance or more: a slow car cannot move sideways."""


class BrakeWhenWarned:
    """Drives along the path of the scenario at its times; when warned, brakes after the reaction time until its way is clear.

    Its way is clear when no collision would be predicted if it drove on as in the scenario. It then goes on from there, later than
    in the scenario.

    Parameters
    ----------
    settings : WarningSettings, optional
    """

    def __init__(self, settings: WarningSettings | None = None) -> None:
        self.settings = settings or WarningSettings()

    def reset(self, scenario: Scenario) -> None:
        """Begin a scenario."""
        assert scenario.ego is not None  # a policy drives an ego
        t_s = table_of(scenario).t_s
        self._watch = Watch(scenario, scenario.others, self.settings, t_s)
        self._index = {a.id: k for k, a in enumerate(scenario.others)}
        self._trajectory = Trajectory.through(scenario.ego.waypoints, scenario.ego.rear_axle_offset_m)
        self._tick, self._delay_s, self._braked = -1, 0.0, False
        self._warned_s, self._danger_s = np.inf, -np.inf

    def __call__(self, seen: Observation) -> Controls:
        """Answer an observation."""
        tick = int((seen.t_s - self._watch.table.t_s[0]) / TICK_S + 1e-6)
        if tick > self._tick:
            self._tick = tick
            self._look(seen, min(tick, len(self._watch.table.t_s) - 1))
        steer = steer_along(seen.ego, seen.path)
        if self.braking(seen.t_s):
            self._braked, self._delay_s = True, seen.t_s - self._place_s(seen.path)
            return Controls(-self.settings.brake_mps2, steer)
        return Controls(self._pace(seen), steer)

    def braking(self, t_s: float) -> bool:
        """Whether the brakes work at a time."""
        return t_s >= self._warned_s + self.settings.reaction_s - 1e-9

    def _look(self, seen: Observation, tick: int) -> None:
        """Look for danger, and forget the warning where there was none for `CLEAR_S`."""
        ego, t_s = seen.ego, seen.t_s
        speed, accel = ego.speed_mps, ego.accel_mps2
        if self.braking(t_s):
            speed, accel = max(speed, float(seen.path.speed_mps[0]), MIN_EGO_MPS), 0.0
        one = [np.array([v]) for v in (ego.x_m, ego.y_m, ego.yaw_rad, speed, accel, seen.path.progress_m)]
        place, pace = np.full(len(self._index), np.nan, dtype=complex), np.full(len(self._index), np.nan)
        rows = np.array([self._index[i] for i in seen.others.id.tolist()], dtype=np.intp)
        place[rows] = seen.others.x_m + 1j * seen.others.y_m
        pace[rows] = np.hypot(seen.others.velocity_x_mps, seen.others.velocity_y_mps)
        found = self._watch.courses(EgoStates(*one), np.array([tick]), (place, pace))
        if found.due.any():
            self._danger_s, self._warned_s = t_s, min(self._warned_s, t_s)
        elif t_s > self._danger_s + CLEAR_S - 1e-9:
            self._warned_s = np.inf

    def _place_s(self, path: PathAhead) -> float:
        """Return when the scenario was at this place; its end beyond."""
        at_s = float(path.t_s[0])
        return at_s if np.isfinite(at_s) else float(self._trajectory.t_s[-1])

    def _pace(self, seen: Observation) -> float:
        """Return the acceleration that keeps the scenario's times, as late as the ego is."""
        due_s = seen.t_s - self._delay_s
        if self._braked and abs(self._trajectory.at(np.array([due_s])).speed_mps[0]) > STANDSTILL_MPS:
            self._delay_s = max(self._delay_s, seen.t_s - self._place_s(seen.path) - CATCH_UP_S)
        due = np.array([seen.t_s - self._delay_s, seen.t_s - self._delay_s + seen.dt_s])
        x, y, _, _, speed = self._trajectory.at(due)
        p = seen.path
        behind = float((x[0] - seen.ego.x_m) * np.cos(p.yaw_rad[0]) + (y[0] - seen.ego.y_m) * np.sin(p.yaw_rad[0]))
        behind = float(np.clip(behind, -MAX_AHEAD_M, MAX_AHEAD_M))
        pace = abs(seen.ego.speed_mps)
        if abs(speed[0]) < STANDSTILL_MPS and pace < STANDSTILL_MPS and behind < 0.5:
            return -self.settings.brake_mps2 / 4
        wanted = float(np.abs(speed[1]) - np.abs(speed[0])) / seen.dt_s
        wanted += behind / RESPONSE_S**2 + 2 * (float(np.abs(speed[0])) - pace) / RESPONSE_S
        return float(np.clip(wanted, -self.settings.brake_mps2, MAX_THROTTLE_MPS2 if self._braked else np.inf))


def steer_along(ego: EgoState, path: PathAhead) -> float:
    """Return the steering angle in rad that keeps to a path: its curvature, and what lets errors of place and heading decay.

    The errors decay over a distance as those of a critically damped oscillator do over time, so nothing is divided by the speed.
    """
    yaw = np.unwrap(path.yaw_rad)
    ahead = min(int(0.25 * abs(ego.speed_mps)), len(yaw) - 5)
    curvature = _mean_slope(path.distance_m[ahead : ahead + 5], yaw[ahead : ahead + 5])
    cos, sin = np.cos(yaw[0]), np.sin(yaw[0])
    aside_m = float((path.y_m[0] - ego.y_m) * cos - (path.x_m[0] - ego.x_m) * sin)
    look_m = max(MIN_LOOK_M, RESPONSE_S * abs(ego.speed_mps))
    curvature += aside_m / look_m**2 + 2.0 * float(np.sin(yaw[0] - ego.yaw_rad)) / look_m
    return float(np.arctan(ego.wheelbase_m * curvature * (1 + ego.understeer_s2pm2 * ego.speed_mps**2)))


def _mean_slope(at: Array, values: Array) -> float:
    return float((values[-1] - values[0]) / (at[-1] - at[0]))
