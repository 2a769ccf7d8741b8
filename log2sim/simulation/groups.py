"""Groups of agents that are driven alike, the clock and the recording of a replay, and what the ego's policy observes.

A group owns the state of its agents; the simulator that steps it is stateless. All columns are (A,) over the agents of
the group that live in the present window of time; `live` holds their indices in the group.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Trajectory
from log2sim.geometry import Array, cos_sin, wrap_angle
from log2sim.simulation import policy
from log2sim.simulation.corridors import SPACING_M, PathTable
from log2sim.simulation.reference import (
    GRID_S,
    ControllerMemory,
    Reference,
    control_step,
    follow_points,
    follow_vehicles,
    start_vehicles,
)
from log2sim.simulation.vehicles import vehicle
from log2sim.simulation.vehicles.single_track import set_slip_states

STORE_S = 0.05  # spacing of stored states, about 20 Hz
MARGIN = 1e-6  # in steps, for rounding: a waypoint at 0.3 s is on step 30 of 10 ms


@dataclass(frozen=True)
class StepClock:
    """Steps at `begin_s + n * dt_s` for n in [0, `steps`)."""

    begin_s: float
    dt_s: float  # length of a step
    steps: int

    @classmethod
    def spanning(cls, begin_s: float, end_s: float, dt_s: float) -> StepClock:
        """Create the clock whose steps cover `begin_s` to `end_s`."""
        return cls(begin_s, dt_s, math.floor((end_s - begin_s) / dt_s + MARGIN) + 1)

    @property
    def store_every(self) -> int:
        """States are stored at every so many steps."""
        return max(1, round(STORE_S / self.dt_s))

    def time(self, step: int) -> float:
        """Return the time of a step in s."""
        return self.begin_s + step * self.dt_s

    def first_step(self, t_s: Array) -> NDArray[np.intp]:
        """Return the first steps at or after times (N,)."""
        return np.ceil((t_s - self.begin_s) / self.dt_s - MARGIN).astype(np.intp)

    def last_step(self, t_s: Array) -> NDArray[np.intp]:
        """Return the last steps at or before times (N,)."""
        return np.floor((t_s - self.begin_s) / self.dt_s + MARGIN).astype(np.intp)


@dataclass(frozen=True, eq=False)
class Snapshot(vehicle.Columns):
    """Box centers and actuators of agents (A,), map frame."""

    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    steer_rad: Array
    accel_mps2: Array  # NaN where the model has no such state
    pedal_command_mps2: Array  # commands held over the last step; NaN for agents without
    steer_command_rad: Array
    gear: Array


class AgentGroup:
    """Agents driven alike: here they are exactly where the scenario has them, other groups move them.

    `first`, `last` (A,) are the steps between which each agent lives.
    """

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
        self.kept: dict[str, vehicle.Columns] = {}

    def keep(self, **columns: vehicle.Columns) -> None:
        """Keep columns of all agents, of which those of the living ones are the attributes of these names."""
        self.kept = columns
        self._take()

    def _take(self) -> None:
        for name, all_agents in self.kept.items():
            setattr(self, name, all_agents.take(self.live))

    def open_window(self, begin: int, end: int, begin_s: float, end_s: float) -> None:
        """Prepare reference tables and columns of the agents that live within the steps [begin, end)."""
        for name, all_agents in self.kept.items():
            all_agents.put(self.live, getattr(self, name))
        self.live = np.flatnonzero((self.first < end) & (self.last >= begin) & (self.last >= self.first))
        self._row0 = int(np.floor(begin_s / GRID_S))
        rows = int(np.floor(end_s / GRID_S)) + 3 - self._row0
        self._table = None
        if len(self.live):
            self._table = np.empty((rows, self.references[0].columns.shape[1], len(self.live)))
            for slot, i in enumerate(self.live):
                # The first and the last row of a table fill what lies before and after.
                columns, begin_row = self.references[i].columns, self.references[i].first_row - self._row0
                low = min(max(begin_row, 0), rows)
                high = min(max(begin_row + len(columns), low), rows)
                self._table[:low, :, slot] = columns[0]
                self._table[low:high, :, slot] = columns[low - begin_row : high - begin_row]
                self._table[high:, :, slot] = columns[-1]
        self._take()

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

    def place(self, index: NDArray[np.intp], t_s: float) -> None:
        """Put the agents at `index` (of all agents of the group) on their references at a time, if they are not there anyway."""

    def snapshot(self) -> Snapshot:
        """Return the present states of the living agents."""
        x, y, yaw, speed = self.row[:4]
        unknown = np.full(len(self.live), np.nan)
        x, y = x + self.origin_x_m[self.live], y + self.origin_y_m[self.live]
        return Snapshot(x, y, wrap_angle(yaw), speed, np.zeros(len(self.live)), unknown, unknown, unknown, unknown)

    def advance(self, dt_s: float) -> None:
        """Move the living agents by one step; within a long step controls are renewed."""
        held_s = control_step(dt_s)
        for part in range(round(dt_s / held_s)):
            if part:
                self.look_up(self.now_s + held_s)
            self._step(held_s)

    def _step(self, dt_s: float) -> None:
        """Move the living agents with their present controls, if they have any."""

    def _exact(self, index: NDArray[np.intp], t_s: float) -> Array:
        return np.stack([self.references[i].exact(np.array([t_s]))[0] for i in index], axis=1)


class VehicleGroup(AgentGroup):
    """Vehicles that follow their trajectories through a vehicle model."""

    driver = "pid"
    state: vehicle.VehicleState
    memory: ControllerMemory
    commands: vehicle.VehicleControls
    living: vehicle.VehicleParameters

    def __init__(
        self,
        agents: Sequence[Agent],
        references: Sequence[Reference],
        first: NDArray[np.intp],
        last: NDArray[np.intp],
        parameters: vehicle.VehicleParameters,
        move: vehicle.VehicleStep,
    ) -> None:
        super().__init__(agents, references, first, last)
        self.parameters, self.move, count = parameters, move, len(agents)
        state, memory = vehicle.VehicleState.zeros(count), ControllerMemory.fresh(count)
        commands = vehicle.VehicleControls(np.zeros(count), np.zeros(count), np.zeros(count, bool))
        self.keep(state=state, memory=memory, commands=commands, living=parameters)

    def place(self, index: NDArray[np.intp], t_s: float) -> None:
        """Put vehicles on their references, with the slip that the reference has there."""
        slots = np.searchsorted(self.live, index)
        state = start_vehicles(self._exact(index, t_s), self.living.take(slots))
        if self.references[index[0]].slips:  # all of a fleet have the same model
            state = set_slip_states(state, lambda at_s: self._exact(index, at_s), t_s)
        self.state.put(slots, state)
        self.memory.put(slots, ControllerMemory.fresh(len(slots)))
        placed = self.state.take(slots)
        self.commands.put(slots, vehicle.VehicleControls(placed.pedal_mps2, placed.steer_rad, placed.speed_mps < 0))

    def snapshot(self) -> Snapshot:
        """Return the present states of the living vehicles."""
        s, o = self.state, self.offset_m[self.live]
        cos, sin = cos_sin(s.yaw_rad)
        x = s.x_m + o * cos + self.origin_x_m[self.live]
        y = s.y_m + o * sin + self.origin_y_m[self.live]
        held, forward = (s.speed_mps == 0) & (s.pedal_mps2 < 0), np.where(s.speed_mps < 0, -1.0, 1.0)
        accel, c = np.where(held, 0.0, s.pedal_mps2 * forward), self.commands
        gear = np.where(c.reverse, -1.0, 1.0)
        return Snapshot(x, y, wrap_angle(s.yaw_rad), s.speed_mps, s.steer_rad, accel, c.pedal_mps2, c.steer_rad, gear)

    def _step(self, dt_s: float) -> None:
        self.commands, self.memory = follow_vehicles(self.row, self.state, self.memory, self.living, dt_s)
        self.state = self.move(self.state, self.commands, self.living, dt_s)


class PolicyVehicle(VehicleGroup):
    """The vehicle that the user's policy drives, by the controls set before each step."""

    driver = "policy"
    follows_scenario_time = False
    controls = policy.Controls(0.0, 0.0)

    def _step(self, dt_s: float) -> None:
        c = self.controls
        pedal, steer = np.array([[c.accel_mps2], [c.steer_rad]], float)
        self.commands = vehicle.VehicleControls(pedal, steer, np.array([c.reverse], bool))
        self.state = self.move(self.state, self.commands, self.living, dt_s)


class PedestrianGroup(AgentGroup):
    """Pedestrians, and all else without wheels, as point masses that follow their trajectories."""

    driver = "pid"
    state: vehicle.PointState
    commands: vehicle.PointControls
    move = staticmethod(vehicle.step_point)

    def __init__(
        self, agents: Sequence[Agent], references: Sequence[Reference], first: NDArray[np.intp], last: NDArray[np.intp]
    ) -> None:
        super().__init__(agents, references, first, last)
        self.keep(state=vehicle.PointState.zeros(len(agents)), commands=vehicle.PointControls.zeros(len(agents)))

    def place(self, index: NDArray[np.intp], t_s: float) -> None:
        """Put points on their references."""
        slots = np.searchsorted(self.live, index)
        x, y, _, yaw, speed, *_ = self._exact(index, t_s)
        self.state.put(slots, vehicle.PointState(x.copy(), y.copy(), yaw.copy(), speed.copy()))

    def snapshot(self) -> Snapshot:
        """Return the present states of the living points."""
        s, yaw = self.state, self.row[2]
        speed = s.velocity_x_mps * np.cos(yaw) + s.velocity_y_mps * np.sin(yaw)
        x, y = s.x_m + self.origin_x_m[self.live], s.y_m + self.origin_y_m[self.live]
        unknown = np.full(len(x), np.nan)
        return Snapshot(x, y, wrap_angle(yaw), speed, np.zeros(len(x)), unknown, unknown, unknown, unknown)

    def _step(self, dt_s: float) -> None:
        self.commands = follow_points(self.row, self.state)
        self.state = self.move(self.state, self.commands, dt_s)


# By agent id: the stored steps (S,) and the columns (C, S) of `Snapshot` at these steps.
RecordedTracks = dict[str, tuple[NDArray[np.intp], Array]]

COLUMNS = tuple(f.name for f in fields(Snapshot))


class WindowRecording:
    """Snapshots of a group at every `every`-th step of a window [begin, end), in one array (S, C, A)."""

    def __init__(self, group: AgentGroup, begin: int, end: int, every: int) -> None:
        self.group, self.live = group, group.live
        self.steps = np.arange(-(-begin // every) * every, end, every)
        self.rows = np.empty((len(self.steps), len(COLUMNS), len(group.live)))
        self.count = 0

    def add(self) -> None:
        """Store the present state of the group."""
        snapshot = self.group.snapshot()
        for column, name in zip(self.rows[self.count], COLUMNS):
            column[:] = getattr(snapshot, name)
        self.count += 1


def merged_tracks(records: Iterable[WindowRecording]) -> RecordedTracks:
    """Join the recordings of each agent, cut to its lifetime, in order of time."""
    parts: dict[str, list[tuple[NDArray[np.intp], Array]]] = {}
    for record in records:
        group, steps = record.group, record.steps[: record.count]
        begin = np.searchsorted(steps, group.first[record.live])
        end = np.searchsorted(steps, group.last[record.live], side="right")
        for slot, i in enumerate(record.live):
            alive = slice(begin[slot], end[slot])
            if begin[slot] < end[slot]:
                parts.setdefault(group.agents[i].id, []).append((steps[alive], record.rows[alive, :, slot].T))
    return {k: (np.concatenate([s for s, _ in v]), np.concatenate([c for _, c in v], axis=1)) for k, v in parts.items()}


ONE = np.zeros(1, dtype=np.intp)


class PolicyObserver:
    """Observations for the one vehicle that a policy drives, among all groups and static agents."""

    def __init__(
        self, ego: PolicyVehicle, groups: Sequence[AgentGroup], statics: Sequence[Agent], sight_m: float
    ) -> None:
        self.ego, self.sight_m = ego, sight_m
        self._trajectory = ego.references[0].trajectory
        self._path_table = PathTable([self._trajectory])
        self._groups = [g for g in groups if g is not ego]
        first = [(a.waypoints.x_m[0], a.waypoints.y_m[0], a.waypoints.yaw_rad[0], 0.0) for a in statics]
        self._statics = np.array(first, dtype=np.float64).reshape(-1, 4).T
        lives = [(-np.inf, np.inf) if a.is_permanent else (a.waypoints.t_s[0], a.waypoints.t_s[-1]) for a in statics]
        self._static_lives_s = np.array(lives, dtype=np.float64).reshape(-1, 2)
        self._agents = [_identities(g.agents, [r.trajectory for r in g.references]) for g in self._groups]
        self._static_agents = _identities(statics, [Trajectory.through(a.waypoints, 0.0) for a in statics])
        self.progress_m = 0.0

    def __call__(self, step: int, t_s: float, dt_s: float) -> policy.Observation:
        """Build the observation at a step; steps must be in order, but for `progress_m` = 0 at the first."""
        table, trajectory, now, p = self._path_table, self._trajectory, self.ego.snapshot(), self.ego.living
        self.progress_m = table.progress_near(0, self.progress_m, float(now.x_m[0]), float(now.y_m[0]))
        ahead = np.arange(0.0, policy.PATH_AHEAD_M + SPACING_M / 2, SPACING_M)
        x, y, cos, sin, at_s = table.along(ONE, self.progress_m + ahead)
        pace = np.abs(table.at(ONE, np.where(np.isnan(at_s), trajectory.t_s[-1], at_s)).speed_mps)
        columns = (ahead, x + table.origin_m[0], y + table.origin_m[1], wrap_angle(np.arctan2(sin, cos)), pace, at_s)
        path = policy.PathAhead(self.progress_m, *(_read_only(c) for c in columns))
        # The ego is at the height of its path in the scenario.
        z_m = float(trajectory.heights(table.times(ONE, np.array([self.progress_m])))[0])
        moves = {
            k: float(getattr(now, k)[0]) for k in ("x_m", "y_m", "yaw_rad", "speed_mps", "accel_mps2", "steer_rad")
        }
        built = {k: float(getattr(p, k)[0]) for k in ("wheelbase_m", "rear_axle_offset_m", "understeer_s2pm2")}
        length, width, height = self.ego.agents[0].size_m
        ego = policy.EgoState(z_m=z_m, length_m=length, width_m=width, height_m=height, **moves, **built)
        until_s = min(t_s + policy.ROUTE_AHEAD_S, trajectory.t_s[-1]) + policy.ROUTE_STEP_S / 2
        t = np.arange(t_s, until_s, policy.ROUTE_STEP_S)
        x, y, _, yaw, speed = trajectory.at(t)
        route = policy.Route(*(_read_only(c) for c in (t, x, y, yaw, speed)))
        return policy.Observation(t_s, dt_s, ego, self._others(ego, step, t_s), route, path)

    def _others(self, ego: policy.EgoState, step: int, t_s: float) -> policy.Others:
        begin_s, end_s = self._static_lives_s.T
        here = (begin_s <= t_s) & (t_s <= end_s)
        poses, who, log_s = [self._statics[:, here]], [self._static_agents[here]], [np.full(here.sum(), t_s)]
        for group, agents in zip(self._groups, self._agents):
            if len(group.live):
                present = (group.first[group.live] <= step) & (step <= group.last[group.live])
                s = group.snapshot()
                poses.append(np.stack([s.x_m, s.y_m, s.yaw_rad, s.speed_mps])[:, present])
                who.append(agents[group.live[present]])
                log_s.append(group.log_times(t_s)[present])
        x, y, yaw, speed = np.concatenate(poses, axis=1)
        distance = np.hypot(x - ego.x_m, y - ego.y_m)
        near = np.argsort(distance, kind="stable")
        near = near[distance[near] <= self.sight_m]
        x, y, yaw, speed, seen = x[near], y[near], yaw[near], speed[near], np.concatenate(who)[near]
        times = zip(seen["trajectory"], np.concatenate(log_s)[near])
        z = np.array([trajectory.heights(t) for trajectory, t in times], dtype=np.float64)
        size = (seen[k] for k in ("length_m", "width_m", "height_m"))
        columns = (x, y, z, yaw, speed, speed * np.cos(yaw), speed * np.sin(yaw), *size)
        return policy.Others(_read_only(seen["id"]), _read_only(seen["category"]), *(_read_only(c) for c in columns))


def _identities(agents: Sequence[Agent], trajectories: Sequence[Trajectory]) -> NDArray[Any]:
    """Return id, category, size and trajectory in the scenario of agents as records (A,)."""
    rows = [(a.id, a.category, *a.size_m, trajectory) for a, trajectory in zip(agents, trajectories)]
    sizes = [(k, np.float64) for k in ("length_m", "width_m", "height_m")]
    return np.array(rows, dtype=[("id", object), ("category", object), *sizes, ("trajectory", object)])


def _read_only(values: NDArray[Any]) -> NDArray[Any]:
    """Return the array protected against writing, strings as such and not as objects."""
    out = values.astype(str) if values.dtype == object else np.ascontiguousarray(values)
    out.setflags(write=False)
    return out
