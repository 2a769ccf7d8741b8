"""A policy for the ego that drives as in the scenario, and brakes when it is warned."""

from __future__ import annotations

import math

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.prediction.motion_table import TICK_S, table_of
from log2sim.simulation.policy import Controls, Observation
from log2sim.simulation.warnings.ego_path import EgoStates
from log2sim.simulation.warnings.late_driver import LateDriver
from log2sim.simulation.warnings.settings import WarningSettings
from log2sim.simulation.warnings.watch import MIN_EGO_MPS, Watch

CLEAR_S = 1.0
"""The ego drives on when its way has been clear for so long."""


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
        self._watch = Watch(scenario, scenario.others, self.settings, table_of(scenario).t_s)
        self._index = {a.id: k for k, a in enumerate(scenario.others)}
        self._driver, self._tick = LateDriver(scenario.ego), -1
        self._warned_s, self._danger_s = np.inf, -np.inf

    def __call__(self, seen: Observation) -> Controls:
        """Answer an observation."""
        tick = int((seen.t_s - self._watch.table.t_s[0]) / TICK_S + 1e-6)
        if tick > self._tick:
            self._tick = tick
            self._look(seen, min(tick, len(self._watch.table.t_s) - 1))
        if self.braking(seen.t_s):
            return self._driver.brake(seen, self.settings.brake_mps2)
        return self._driver.drive(seen)

    def braking(self, t_s: float) -> bool:
        """Whether the brakes work at a time."""
        return t_s >= self._warned_s + self.settings.reaction_s - 1e-9

    def _look(self, seen: Observation, tick: int) -> None:
        """Look for danger, and forget the warning where there was none for `CLEAR_S`."""
        ego, t_s = seen.ego, seen.t_s
        speed, accel = ego.speed_mps, math.copysign(ego.accel_mps2, ego.accel_mps2 * ego.speed_mps)
        if self.braking(t_s):
            forward = math.cos(
                float(seen.path.yaw_rad[0]) - ego.yaw_rad
            )  # negative where the path is driven in reverse
            speed = math.copysign(max(abs(speed), float(seen.path.speed_mps[0]), MIN_EGO_MPS), forward)
            accel = 0.0
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
