"""The edits: values that describe a change, and apply it to the agents of a scenario."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np

from log2sim.datatypes import CATEGORIES, EGO, TYPICAL_SIZE_M, Agent, Waypoints, retime_spans
from log2sim.errors import ConfigError
from log2sim.files.plugins import nearest
from log2sim.geometry import Array, wrap_angle

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
            # Move the spans of doubts, without what then is before the scenario's start t = 0
            retimed = []
            for d in (doubt.retimed(retime) for doubt in agent.doubts):
                if d.end_s is not None and d.end_s < 0.0:
                    continue
                d = replace(d, start_s=None if d.start_s is None else max(d.start_s, 0.0))
                told = d.text is not None and _NAMES_A_TIME.search(d.text) and OLD_TIME not in d.text
                retimed.append(replace(d, text=f"{d.text}, {OLD_TIME}") if told else d)
            doubts, seen = tuple(retimed), agent.observed_by
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
            w, new_s = sped_up_between(agent, self.factor, *self.window.of(agent, self.kind))
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
        # Steps between waypoints (T - 1,) whose radius is not larger than the shift.
        chord, turn = chords(w)
        moves = np.abs(chord) > MIN_PATH_MPS * np.diff(w.t_s)
        fails = moves & (chord * (chord - self.meters * turn) <= 0)
        if self.window is not None:
            fails &= w.t_s[1:] > self.window.begin_s
        if fails.any():
            radius_m = np.where(fails, np.abs(chord / np.where(fails, turn, 1.0)), np.inf)
            k = int(np.argmin(radius_m))
            raise ConfigError(
                f"lateral: agent '{agent.id}' turns with a radius of {radius_m[k]:.2f} m at {w.t_s[k]:.2f} s, so its path "
                f"cannot be shifted to that side by {abs(self.meters):g} m; choose less than {radius_m[k]:.2f} m"
            )
        if self.window is not None:
            return lane_changed(agent, self.meters, *self.window.of(agent, self.kind)), None
        yaw = np.unwrap(w.yaw_rad)
        rate = np.gradient(yaw, w.t_s, edge_order=2 if len(w) > 2 else 1) if len(w) > 1 else np.zeros(len(w))
        return replace(
            w,
            x_m=w.x_m - self.meters * np.sin(w.yaw_rad),
            y_m=w.y_m + self.meters * np.cos(w.yaw_rad),
            speed_mps=w.speed_mps - self.meters * rate,
        ), None


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
            times = life_s[0] + STEP_S * np.arange(int(np.ptp(life_s) / STEP_S) + 1)
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
        path, at = along_path(ego, 0.0), agent.at(t_s)
        station = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(path.x_m), np.diff(path.y_m)))])
        k = np.argmin(np.hypot(at.x_m[:, None] - path.x_m, at.y_m[:, None] - path.y_m), axis=1)
        dx, dy = at.x_m - path.x_m[k], at.y_m - path.y_m[k]
        c, s = np.cos(path.yaw_rad[k]), np.sin(path.yaw_rad[k])
        return station[k] + c * dx + s * dy - np.interp(end_s, path.t_s, station), c * dy - s * dx


def no_category(name: str) -> str:
    """Say that there is no such category, and the nearest or all that there are."""
    known = list(CATEGORIES)
    return f"no category '{name}'{nearest(name, known) or '; there are ' + ', '.join(known)}"


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
            raise ConfigError(f"add: {no_category(self.category)}")
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
            w = along_path(leader, self.meters)
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
            raise ConfigError(f"replace: {no_category(self.category)}")

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
        w = shifted_in_time(agent, self.seconds)
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
