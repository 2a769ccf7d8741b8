"""Groups of agents that are driven alike: placed ones, vehicles, pedestrians, and the vehicle of the user's policy.

A group owns the state of its agents; the simulator that steps it is stateless. All columns are (A,) over the agents of
the group that live in the present window of time; `live` holds their indices in the group.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent
from log2sim.geometry import Array, cos_sin, wrap_angle
from log2sim.simulation.follower import (
    ControllerMemory,
    control_step,
    follow_points,
    follow_vehicles,
    start_points,
    start_vehicles,
)
from log2sim.simulation.policy import Controls
from log2sim.simulation.reference import GRID_S, Reference
from log2sim.simulation.simulators import Simulator
from log2sim.simulation.vehicles.model_choice import with_slip_states
from log2sim.simulation.vehicles.vehicle import Columns, PointState, VehicleControls, VehicleParameters, VehicleState


@dataclass(frozen=True, eq=False)
class Snapshot(Columns):
    """Box centers and actuators of agents (A,), map frame.

    Commands are those held over the last step; NaN for agents without.

    Attributes
    ----------
    x_m, y_m, yaw_rad, speed_mps : (A,) float64
    steer_rad : (A,) float64
    accel_mps2 : (A,) float64
        NaN where the model has no such state.
    pedal_command_mps2, steer_command_rad, gear : (A,) float64
    """

    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    steer_rad: Array
    accel_mps2: Array
    pedal_command_mps2: Array
    steer_command_rad: Array
    gear: Array


class AgentGroup(ABC):
    """Agents driven alike; `first`, `last` (A,) are the steps between which each agent lives."""

    driver = "exact"
    follows_scenario_time = True  # its agents are where the scenario has them, after a discontinuity too

    def __init__(
        self, agents: Sequence[Agent], references: Sequence[Reference], first: NDArray[np.intp], last: NDArray[np.intp]
    ) -> None:
        self.agents, self.references, self.first, self.last = tuple(agents), tuple(references), first, last
        self.origin_x_m = np.array([r.trajectory.origin_m[0] for r in references])
        self.origin_y_m = np.array([r.trajectory.origin_m[1] for r in references])
        self.offset_m = np.array([r.offset_m for r in references])
        self.live = np.zeros(0, dtype=np.intp)
        self.row = np.zeros((0, 0))
        self.now_s = 0.0

    def open_window(self, begin: int, end: int, begin_s: float, end_s: float) -> None:
        """Prepare the reference tables of the agents that live within the steps [begin, end)."""
        self.live = np.flatnonzero((self.first < end) & (self.last >= begin) & (self.last >= self.first))
        self._row0 = int(np.floor(begin_s / GRID_S))
        rows = int(np.floor(end_s / GRID_S)) + 3 - self._row0
        self._table = None
        if len(self.live):
            self._table = np.empty((rows, self.references[0].columns.shape[1], len(self.live)))
            for slot, i in enumerate(self.live):
                _copy_rows(self._table[:, :, slot], self.references[i], self._row0)

    def log_times(self, t_s: float) -> Array:
        """Return the times of the scenario (A,) whose places the living agents follow at a time."""
        return np.full(len(self.live), t_s)

    def look_up(self, t_s: float) -> None:
        """Set `row` (C, A) to the references at a time."""
        self.now_s = t_s
        if self._table is None:
            return
        place = t_s / GRID_S - self._row0
        k = int(place)
        lower = self._table[k]
        self.row = lower + (place - k) * (self._table[k + 1] - lower)

    @abstractmethod
    def place(self, index: NDArray[np.intp], t_s: float) -> None:
        """Put the agents at `index` (of all agents of the group) on their references at a time."""

    @abstractmethod
    def snapshot(self) -> Snapshot:
        """Return the present states of the living agents."""

    def advance(self, dt_s: float) -> None:
        """Move the living agents by one step; within a long step controls are renewed."""
        held_s = control_step(dt_s)
        for part in range(round(dt_s / held_s)):
            if part:
                self.look_up(self.now_s + held_s)
            self._step(held_s)

    @abstractmethod
    def _step(self, dt_s: float) -> None:
        """Move the living agents with their present controls."""

    def _exact(self, index: NDArray[np.intp], t_s: float) -> Array:
        return np.stack([self.references[i].exact(np.array([t_s]))[0] for i in index], axis=1)

    def _slots(self, index: NDArray[np.intp]) -> NDArray[np.intp]:
        return np.searchsorted(self.live, index)


class LogReplayGroup(AgentGroup):
    """Agents that are exactly where the scenario has them."""

    def place(self, index: NDArray[np.intp], t_s: float) -> None:
        """Do nothing: the agents are always on their references."""
        pass

    def _step(self, dt_s: float) -> None:
        pass

    def snapshot(self) -> Snapshot:
        """Return the states of the scenario."""
        x, y, yaw, speed = self.row[:4]
        unknown = np.full(len(self.live), np.nan)
        x, y = x + self.origin_x_m[self.live], y + self.origin_y_m[self.live]
        return Snapshot(x, y, wrap_angle(yaw), speed, np.zeros(len(self.live)), unknown, unknown, unknown, unknown)


class VehicleGroup(AgentGroup):
    """Vehicles that follow their trajectories through a vehicle model."""

    driver = "pid"

    def __init__(
        self,
        agents: Sequence[Agent],
        references: Sequence[Reference],
        first: NDArray[np.intp],
        last: NDArray[np.intp],
        parameters: VehicleParameters,
        simulator: Simulator,
    ) -> None:
        super().__init__(agents, references, first, last)
        self.parameters, self.simulator = parameters, simulator
        self._all = VehicleState.zeros(len(agents))
        self._all_memory = ControllerMemory.fresh(len(agents))
        self._all_commands = VehicleControls(np.zeros(len(agents)), np.zeros(len(agents)), np.zeros(len(agents), bool))
        self._open(self.live)

    def _open(self, live: NDArray[np.intp]) -> None:
        self.state, self.memory, self.living = (
            self._all.take(live),
            self._all_memory.take(live),
            self.parameters.take(live),
        )
        self.commands = self._all_commands.take(live)

    def open_window(self, begin: int, end: int, begin_s: float, end_s: float) -> None:
        """Prepare tables and states of the vehicles that live within the steps [begin, end)."""
        self._all.put(self.live, self.state)
        self._all_memory.put(self.live, self.memory)
        self._all_commands.put(self.live, self.commands)
        super().open_window(begin, end, begin_s, end_s)
        self._open(self.live)

    def place(self, index: NDArray[np.intp], t_s: float) -> None:
        """Put vehicles on their references, with the slip that the reference has there."""
        slots = self._slots(index)
        state = start_vehicles(self._exact(index, t_s), self.living.take(slots))
        if self.references[index[0]].slips:  # all of a fleet have the same model
            state = with_slip_states(state, lambda at_s: self._exact(index, at_s), t_s)
        self.state.put(slots, state)
        self.memory.put(slots, ControllerMemory.fresh(len(slots)))
        placed = self.state.take(slots)
        self.commands.put(slots, VehicleControls(placed.pedal_mps2, placed.steer_rad, placed.speed_mps < 0))

    def snapshot(self) -> Snapshot:
        """Return the present states of the living vehicles."""
        s, o = self.state, self.offset_m[self.live]
        cos, sin = cos_sin(s.yaw_rad)
        x = s.x_m + o * cos + self.origin_x_m[self.live]
        y = s.y_m + o * sin + self.origin_y_m[self.live]
        accel = np.where(
            (s.speed_mps == 0) & (s.pedal_mps2 < 0), 0.0, s.pedal_mps2 * np.where(s.speed_mps < 0, -1.0, 1.0)
        )
        c = self.commands
        gear = np.where(c.reverse, -1.0, 1.0)
        return Snapshot(x, y, wrap_angle(s.yaw_rad), s.speed_mps, s.steer_rad, accel, c.pedal_mps2, c.steer_rad, gear)

    def _step(self, dt_s: float) -> None:
        self.commands, self.memory = follow_vehicles(self.row, self.state, self.memory, self.living, dt_s)
        self.state = self.simulator.step_vehicles(self.state, self.commands, self.living, dt_s)


class PolicyVehicle(VehicleGroup):
    """The vehicle that the user's policy drives, by the controls set before each step."""

    driver = "policy"
    follows_scenario_time = False
    controls = Controls(0.0, 0.0)

    def _step(self, dt_s: float) -> None:
        c = self.controls
        self.commands = VehicleControls(
            np.array([c.accel_mps2], float), np.array([c.steer_rad], float), np.array([c.reverse], bool)
        )
        self.state = self.simulator.step_vehicles(self.state, self.commands, self.living, dt_s)


class PedestrianGroup(AgentGroup):
    """Pedestrians, and all else without wheels, as point masses that follow their trajectories."""

    driver = "pid"

    def __init__(
        self,
        agents: Sequence[Agent],
        references: Sequence[Reference],
        first: NDArray[np.intp],
        last: NDArray[np.intp],
        simulator: Simulator,
    ) -> None:
        super().__init__(agents, references, first, last)
        self.simulator = simulator
        self._all = PointState.zeros(len(agents))
        self.state = self._all.take(self.live)

    def open_window(self, begin: int, end: int, begin_s: float, end_s: float) -> None:
        """Prepare tables and states of the points that live within the steps [begin, end)."""
        self._all.put(self.live, self.state)
        super().open_window(begin, end, begin_s, end_s)
        self.state = self._all.take(self.live)

    def place(self, index: NDArray[np.intp], t_s: float) -> None:
        """Put points on their references."""
        slots = self._slots(index)
        self.state.put(slots, start_points(self._exact(index, t_s)))

    def snapshot(self) -> Snapshot:
        """Return the present states of the living points."""
        s, yaw = self.state, self.row[2]
        speed = s.velocity_x_mps * np.cos(yaw) + s.velocity_y_mps * np.sin(yaw)
        x, y = s.x_m + self.origin_x_m[self.live], s.y_m + self.origin_y_m[self.live]
        unknown = np.full(len(x), np.nan)
        return Snapshot(x, y, wrap_angle(yaw), speed, np.zeros(len(x)), unknown, unknown, unknown, unknown)

    def _step(self, dt_s: float) -> None:
        self.state = self.simulator.step_points(self.state, follow_points(self.row, self.state), dt_s)


def _copy_rows(window: Array, reference: Reference, row0: int) -> None:
    """Copy the rows from `row0` on of a table to a window (W, C); its first and last row fill what lies before and after."""
    columns, begin = reference.columns, reference.first_row - row0
    low = min(max(begin, 0), len(window))
    high = min(max(begin + len(columns), low), len(window))
    window[:low] = columns[0]
    window[low:high] = columns[low - begin : high - begin]
    window[high:] = columns[-1]
