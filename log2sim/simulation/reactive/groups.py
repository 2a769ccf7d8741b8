"""Groups of reactive agents: controlled like other agents, on references that they pass at their own rate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.simulation.groups import AgentGroup, LogReplayGroup, PedestrianGroup, VehicleGroup
from log2sim.simulation.reactive.traffic import Traffic
from log2sim.simulation.reference import GRID_S, POINT_COLUMNS, REFERENCE_HOLD_MPS, VEHICLE_COLUMNS
from log2sim.simulation.step_clock import StepClock

RATE_OF_SPEED = {"speed": "accel_ahead", "velocity_x": "accel_x", "velocity_y": "accel_y"}
"""Columns that scale with the rate, and the columns of their derivatives."""


class ReactiveGroup(AgentGroup):
    """A group whose agents follow the scenario at the time and rate that `traffic` decides."""

    driver = "reactive"
    follows_scenario_time = False
    columns: tuple[str, ...] = ("x", "y", "yaw", "speed")

    def join(self, traffic: Traffic, clock: StepClock) -> None:
        """Connect the group with the traffic; call it once, before anything else."""
        self.traffic, self.clock, self._logged_last = traffic, clock, self.last
        self.index = np.array([traffic.index[a.id] for a in self.agents], dtype=np.intp)
        self._end_s = np.array([r.trajectory.t_s[-1] for r in self.references])
        self._first_row = np.array([r.first_row for r in self.references], dtype=np.intp)
        self._rows = np.array([len(r.columns) for r in self.references], dtype=np.intp)
        self._begin = np.cumsum(self._rows) - self._rows
        self._flat = np.concatenate([r.columns for r in self.references])
        jumps = [(k, t) for k, r in enumerate(self.references) for t in r.trajectory.discontinuity_times()]
        # As in the scenario, an agent is placed again after the row that blends both sides of a discontinuity.
        self._discontinuities = np.array([(k, t + wait) for k, t in jumps for wait in (0.0, GRID_S)]).reshape(-1, 2)
        self._tau = np.full(len(self.agents), -np.inf)

    def open_window(self, begin: int, end: int, begin_s: float, end_s: float) -> None:
        """Prepare the tables; at the first step also reset the lifetimes, which delays extend."""
        if begin == 0:
            self.last, self._tau = self._logged_last, np.full(len(self.agents), -np.inf)
        super().open_window(begin, end, begin_s, end_s)

    def log_times(self, t_s: float) -> Array:
        """Return the scenario times of the living agents: the present time less their delay."""
        return t_s - self.traffic.delay_s[self.index[self.live]]

    def look_up(self, t_s: float) -> None:
        """Set `row` (C, A) to the references at the agents' times in the scenario."""
        self.now_s = t_s
        live, delay = self.live, self.traffic.delay_s[self.index]
        # A delayed agent lives on until it has reached the end of its trajectory.
        self.last = np.minimum(self.clock.last_step(self._end_s + delay), self.clock.steps - 1)
        tau = t_s - delay
        last = self._rows[live] - 1
        place = np.clip(tau[live] / GRID_S - self._first_row[live], 0.0, last)
        k = np.minimum(place.astype(np.intp), np.maximum(last - 1, 0))
        low = self._flat[self._begin[live] + k]
        high = self._flat[self._begin[live] + np.minimum(k + 1, last)]
        self.row = self._slowed((low + (place - k)[:, None] * (high - low)).T, live)
        agent, at_s = self._discontinuities[:, 0].astype(np.intp), self._discontinuities[:, 1]
        jumped = (self._tau[agent] < at_s) & (at_s <= tau[agent]) & np.isfinite(self._tau[agent])
        self._tau = tau
        if jumped.any():
            self.place(np.intersect1d(agent[jumped], live), t_s)

    def _exact(self, index: NDArray[np.intp], t_s: float) -> Array:
        at_s = t_s - self.traffic.delay_s[self.index[index]]
        rows = [self.references[i].exact(np.array([t]))[0] for i, t in zip(index, at_s)]
        return self._slowed(np.stack(rows, axis=1), index)

    def _slowed(self, row: Array, index: NDArray[np.intp]) -> Array:
        """Scale the rows (C, N) of agents that pass their references at their rate."""
        rate, slope = self.traffic.rate[self.index[index]], self.traffic.rate_slope[self.index[index]]
        if np.all(rate == 1):
            return row
        row = row.copy()
        names = {name: k for k, name in enumerate(self.columns)}
        speeds = [names[speed] for speed in RATE_OF_SPEED if speed in names]
        for speed, change in RATE_OF_SPEED.items():
            if change in names:
                row[names[change]] = row[names[change]] * rate**2 + row[names[speed]] * slope
        row[speeds] *= rate
        if "stands" in names:
            row[names["stands"]] = np.maximum(row[names["stands"]], np.hypot.reduce(row[speeds]) < REFERENCE_HOLD_MPS)
        return row


class ReactiveVehicleGroup(ReactiveGroup, VehicleGroup):
    """Vehicles that react."""

    columns = VEHICLE_COLUMNS


class ReactivePedestrianGroup(ReactiveGroup, PedestrianGroup):
    """Points that react."""

    columns = POINT_COLUMNS


class ReactiveLogReplayGroup(ReactiveGroup, LogReplayGroup):
    """Agents that react and are placed exactly on their path."""
