"""The edits: values that describe a change, and apply it to the agents of a scenario."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np

from log2sim.datatypes import CATEGORIES, EGO, TYPICAL_SIZE_M, Agent, Waypoints, retime_spans
from log2sim.edit import motion
from log2sim.errors import ConfigError
from log2sim.files.plugins import nearest
from log2sim.geometry import Array

MAX_STEP_S = 1.0  # waypoints of an agent that is added are at most so far apart, as those of a reconstruction
Agents = Mapping[str, Agent]  # agents by id, in the order of the scenario


def new_id(category: str, taken: Container[str]) -> str:
    """Return the first id of a category that is free, such as "car-3"."""
    return next(name for k in itertools.count(1) if (name := f"{category}-{k}") not in taken)


def ground_at(agents: Iterable[Agent], x_m: Array, y_m: Array) -> Array:
    """Return the height (N,), m, on which the agents nearest to places (N,) stand."""
    ground = [(a.waypoints.x_m, a.waypoints.y_m, a.waypoints.z_m - a.size_m[2] / 2) for a in agents]
    gx, gy, gz = (np.concatenate(column) for column in zip(*ground))
    return np.array([gz[np.argmin(np.hypot(gx - x, gy - y))] for x, y in zip(x_m, y_m)])


class Edit:
    """One change to a scenario."""

    kind: ClassVar[str]

    @property
    def names(self) -> tuple[str, ...]:
        """Ids of the agents that the edit names."""
        return ()

    def applied(self, agents: Agents) -> Agents:
        """Return the agents after the edit; `agents` must include the named ones."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of the edit in a scenario's provenance."""
        values = asdict(self).items()  # type: ignore[call-overload]
        return {"kind": self.kind} | {k: list(v) if isinstance(v, tuple) else v for k, v in values if v is not None}


@dataclass(frozen=True)
class Only(Edit):
    """Keep only the named agents; the ego is removed too unless it is named."""

    agents: tuple[str, ...]
    kind: ClassVar[str] = "only"

    @property
    def names(self) -> tuple[str, ...]:
        """Ids of the agents that are kept."""
        return self.agents

    def applied(self, agents: Agents) -> Agents:
        """Keep the named agents."""
        return {k: a for k, a in agents.items() if k in self.agents}


@dataclass(frozen=True)
class _AgentEdit(Edit):
    """A change to one agent."""

    agent: str

    @property
    def names(self) -> tuple[str, ...]:
        return (self.agent,)


@dataclass(frozen=True)
class Remove(_AgentEdit):
    """Remove an agent."""

    kind: ClassVar[str] = "remove"

    def applied(self, agents: Agents) -> Agents:
        """Return all other agents."""
        return {k: a for k, a in agents.items() if k != self.agent}


@dataclass(frozen=True)
class DropDoubtful(Edit):
    """Remove the agents that the scenario itself doubts, see `Agent.is_doubtful`; the ego stays."""

    kind: ClassVar[str] = "drop_doubtful"

    def applied(self, agents: Agents) -> Agents:
        """Return the agents that are not doubtful, and the ego."""
        return {k: a for k, a in agents.items() if k == EGO or not a.is_doubtful}


@dataclass(frozen=True)
class _WaypointEdit(_AgentEdit):
    """A change to the waypoints of one agent; what sensors saw of it is dropped, since it is unknown at the new positions."""

    def applied(self, agents: Agents) -> Agents:
        agent = agents[self.agent]
        waypoints, retime = self.moved(agent)
        moved = replace(agent, waypoints=replace(waypoints, visible=None, lidar_points=None))
        if retime is not None:
            doubts, seen = motion.retimed_doubts(agent.doubts, retime), agent.observed_by
            moved = replace(moved, doubts=doubts, observed_by=retime_spans(seen, retime, begin_s=0.0))
        return {**agents, self.agent: moved}

    def moved(self, agent: Agent) -> tuple[Waypoints, Callable[[float], float] | None]:
        """Return the waypoints of the agent after the edit, and the change of times, None where it moves in space alone."""
        raise NotImplementedError


@dataclass(frozen=True)
class Window:
    """A stretch of time in which an edit of motion happens: from `begin_s` on for `over_s` seconds."""

    begin_s: float
    over_s: float

    def __post_init__(self) -> None:
        """Check the times."""
        if not (math.isfinite(self.begin_s) and self.begin_s >= 0 and 0.1 <= self.over_s <= 1e4):
            raise ConfigError(
                f"window: from {self.begin_s:g} s over {self.over_s:g} s, expected from 0 s on and over 0.1 s or more"
            )

    def of(self, agent: Agent, kind: str) -> tuple[float, float]:
        """Return both times for an agent, which has to be there when it begins."""
        first_s, last_s = float(agent.waypoints.t_s[0]), float(agent.waypoints.t_s[-1])
        if agent.static or not first_s <= self.begin_s < last_s:
            there = "is static" if agent.static else f"is there from {first_s:.2f} to {last_s:.2f} s"
            raise ConfigError(
                f"{kind}: agent '{agent.id}' {there}, so it cannot begin to move differently at {self.begin_s:g} s"
            )
        return self.begin_s, self.over_s


@dataclass(frozen=True)
class Speed(_WaypointEdit):
    """Scale the speed of an agent on its path, from its first waypoint on or within a window."""

    factor: float
    window: Window | None = None
    kind: ClassVar[str] = "speed"

    def __post_init__(self) -> None:
        """Check the factor."""
        _require(self, self.factor, 0.01, 100.0, "")

    def moved(self, agent: Agent) -> tuple[Waypoints, Callable[[float], float]]:
        """Return the waypoints at scaled times."""
        if agent.static:
            raise ConfigError(f"speed: agent '{agent.id}' is static and has no speed to change; leave it out")
        if self.window is not None:
            w, new_s = motion.sped_up_between(agent, self.factor, *self.window.of(agent, self.kind))
            return w, lambda t_s: float(new_s(np.array([t_s]))[0])
        w, begin_s = agent.waypoints, float(agent.waypoints.t_s[0])
        sped_up = replace(w, t_s=w.t_s[0] + (w.t_s - w.t_s[0]) / self.factor, speed_mps=w.speed_mps * self.factor)
        return sped_up, lambda t_s: begin_s + (t_s - begin_s) / self.factor


@dataclass(frozen=True)
class Lateral(_WaypointEdit):
    """Shift an agent's path to its left in meters, to its right where negative: all of it, or by a lane change in a window."""

    meters: float
    window: Window | None = None
    kind: ClassVar[str] = "lateral"

    def __post_init__(self) -> None:
        """Check the distance."""
        _require(self, self.meters, -100.0, 100.0, " m")

    def moved(self, agent: Agent) -> tuple[Waypoints, None]:
        """Return the waypoints of the parallel path."""
        w = agent.waypoints
        fails = motion.parallel_fails(w, self.meters)
        if self.window is not None:
            fails &= w.t_s[1:] > self.window.begin_s
        if fails.any():
            chord, turn = motion.chords(w)
            radius_m = np.where(fails, np.abs(chord / np.where(fails, turn, 1.0)), np.inf)
            k = int(np.argmin(radius_m))
            raise ConfigError(
                f"lateral: agent '{agent.id}' turns with a radius of {radius_m[k]:.2f} m at {w.t_s[k]:.2f} s, so its path "
                f"cannot be shifted to that side by {abs(self.meters):g} m; choose less than {radius_m[k]:.2f} m"
            )
        if self.window is not None:
            return motion.lane_changed(agent, self.meters, *self.window.of(agent, self.kind)), None
        return motion.shifted_left(w, self.meters), None


@dataclass(frozen=True)
class CutIn(_AgentEdit):
    """Bring an agent onto the path of the ego by a lane change; with `gap_m` so far ahead of it, bumper to bumper, at its end."""

    window: Window
    gap_m: float | None = None
    kind: ClassVar[str] = "cut_in"

    def applied(self, agents: Agents) -> Agents:
        """Shift the agent in time to the gap, then to the side onto the path of the ego."""
        ego, agent = agents.get(EGO), agents[self.agent]
        begin_s, over_s = self.window.of(agent, self.kind)
        end_s = begin_s + over_s
        if ego is None or self.agent == EGO or not ego.at(end_s).valid[0]:
            raise ConfigError(f"cut_in: needs another agent, and an ego that is there at {end_s:g} s")
        if self.gap_m is not None:
            wanted_m = self.gap_m + (ego.size_m[0] + agent.size_m[0]) / 2
            life_s = agent.waypoints.t_s
            times = life_s[0] + motion.STEP_S * np.arange(int(np.ptp(life_s) / motion.STEP_S) + 1)
            ahead_m = self._ahead(ego, agent, times, end_s)[0]
            k = int(np.argmin(np.abs(ahead_m - wanted_m)))
            if abs(ahead_m[k] - wanted_m) > 1.0:
                raise ConfigError(
                    f"cut_in: agent '{self.agent}' is never {self.gap_m:g} m ahead of where the ego is at {end_s:g} s; the nearest "
                    f"is {ahead_m[k] - wanted_m + self.gap_m:.1f} m"
                )
            agents = Shift(self.agent, float(end_s - times[k])).applied(agents)
            agent = agents[self.agent]
        if not agent.at(end_s).valid[0]:
            raise ConfigError(f"cut_in: agent '{self.agent}' is not there any more at {end_s:g} s; begin earlier")
        _, aside_m = self._ahead(ego, agent, np.array([end_s]), end_s)
        return Lateral(self.agent, -float(aside_m[0]), self.window).applied(agents)

    def _ahead(self, ego: Agent, agent: Agent, t_s: Array, end_s: float) -> tuple[Array, Array]:
        """Return how far an agent is at times (T,) ahead of where the ego is at `end_s`, along the ego's path, and left of it."""
        path, at = motion.along_path(ego, 0.0), agent.at(t_s)
        station = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(path.x_m), np.diff(path.y_m)))])
        k = np.argmin(np.hypot(at.x_m[:, None] - path.x_m, at.y_m[:, None] - path.y_m), axis=1)
        dx, dy = at.x_m - path.x_m[k], at.y_m - path.y_m[k]
        c, s = np.cos(path.yaw_rad[k]), np.sin(path.yaw_rad[k])
        return station[k] + c * dx + s * dy - np.interp(end_s, path.t_s, station), c * dy - s * dx


@dataclass(frozen=True)
class Add(Edit):
    """Add an agent of the typical size of its category."""

    category: str  # one of `CATEGORIES`
    # x_m, y_m, yaw_rad: where its center is at the start.
    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    speed_mps: float = 0.0  # it goes straight on from there; it is static at 0
    ahead_of: str = ""  # instead: it moves `meters` ahead of this agent on its path, behind where negative
    meters: float = 0.0
    kind: ClassVar[str] = "add"

    def __post_init__(self) -> None:
        """Check the category and the numbers."""
        if self.category not in CATEGORIES:
            raise ConfigError(f"add: no category '{self.category}'{nearest(self.category, list(CATEGORIES))}")
        numbers = (self.x_m, self.y_m, self.yaw_rad, self.speed_mps, self.meters)
        if not all(math.isfinite(v) and abs(v) < 1e8 for v in numbers) or not -20 <= self.speed_mps <= 100:
            raise ConfigError("add: expected a finite place, and a speed from -20 to 100 m/s")

    @property
    def names(self) -> tuple[str, ...]:
        """Id of the agent that it follows or leads, if any."""
        return (self.ahead_of,) if self.ahead_of else ()

    def applied(self, agents: Agents) -> Agents:
        """Append the agent, on the ground that the agents nearest to it stand on."""
        size = TYPICAL_SIZE_M[self.category]
        end_s = max(float(a.waypoints.t_s[-1]) for a in agents.values())
        if self.ahead_of:
            leader = agents[self.ahead_of]
            w = motion.along_path(leader, self.meters)
            w = replace(w, z_m=w.z_m + (size[2] - leader.size_m[2]) / 2)
        else:
            t_s = np.linspace(0.0, end_s, int(end_s / MAX_STEP_S) + 2) if self.speed_mps and end_s > 0 else np.zeros(1)
            x = self.x_m + self.speed_mps * np.cos(self.yaw_rad) * t_s
            y = self.y_m + self.speed_mps * np.sin(self.yaw_rad) * t_s
            z = ground_at(agents.values(), x, y) + size[2] / 2
            still = np.zeros(len(t_s))
            w = Waypoints(t_s, x, y, z, still + self.yaw_rad, still + self.speed_mps, still > 0, still)
        w = replace(w, observed=np.zeros(len(w), dtype=bool), visible=None)
        static = bool(len(w) == 1 or not np.any(w.speed_mps))
        name = new_id(self.category, agents)
        added = Agent(name, self.category, size, w, static=static, quality={"added": True})
        return {**agents, name: added}


@dataclass(frozen=True)
class Replace(_AgentEdit):
    """Replace an agent by one of another category and its typical size, on the same trajectory of the center."""

    category: str
    kind: ClassVar[str] = "replace"

    def __post_init__(self) -> None:
        """Check the category."""
        if self.category not in CATEGORIES:
            raise ConfigError(f"replace: no category '{self.category}'{nearest(self.category, list(CATEGORIES))}")

    def applied(self, agents: Agents) -> Agents:
        """Give the agent its category, size and height above the ground."""
        agent, size = agents[self.agent], TYPICAL_SIZE_M[self.category]
        w = replace(agent.waypoints, z_m=agent.waypoints.z_m + (size[2] - agent.size_m[2]) / 2, visible=None)
        offset_m = agent.rear_axle_offset_m * size[0] / agent.size_m[0]
        changed = replace(agent, category=self.category, size_m=size, waypoints=w, rear_axle_offset_m=offset_m)
        return {**agents, self.agent: changed}


@dataclass(frozen=True)
class Shift(_WaypointEdit):
    """Delay an agent by seconds, or advance it where negative; waypoints before t = 0 are cut off."""

    seconds: float
    kind: ClassVar[str] = "shift"

    def __post_init__(self) -> None:
        """Check the time."""
        _require(self, self.seconds, -1e5, 1e5, " s")

    def moved(self, agent: Agent) -> tuple[Waypoints, Callable[[float], float]]:
        """Return the waypoints at shifted times."""
        w = motion.shifted_in_time(agent, self.seconds)
        if len(w) == 0:
            end_s = float(agent.waypoints.t_s[-1])
            raise ConfigError(
                f"shift: nothing is left of agent '{agent.id}', which is there until {end_s:g} s, when it comes "
                f"{-self.seconds:g} s earlier; choose less, or remove the agent"
            )
        return w, lambda t_s: t_s + self.seconds


def _require(edit: _WaypointEdit, value: float, low: float, high: float, unit: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigError(
            f"{edit.kind}: {value:g}{unit} for agent '{edit.agent}', expected a number from {low:g} to {high:g}{unit}"
        )
