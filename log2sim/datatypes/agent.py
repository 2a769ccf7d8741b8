"""Road users: a box of one size on a trajectory, with what speaks against it; boxes of many at common times, as columns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes.categories import CATEGORIES, GROUP_OF
from log2sim.datatypes.findings import Finding
from log2sim.datatypes.log import Span
from log2sim.errors import ScenarioError
from log2sim.files.arrays import Columns
from log2sim.files.documents import short_repr
from log2sim.geometry import Array, wrap_angle


@dataclass(frozen=True, eq=False)
class Waypoints(Columns):
    """A trajectory of the box center as columns, map frame.

    Half a turn is no part of `sigma_yaw_rad`: whether front and back may be swapped is a doubt of the agent.
    """

    __repr__ = short_repr

    t_s: Array  # (T,), s: strictly increasing times since the scenario's start
    x_m: Array  # (T,), m, as `y_m` and `z_m`
    y_m: Array
    z_m: Array
    yaw_rad: Array  # (T,)
    speed_mps: Array  # (T,), m/s: along the heading, negative when reversing
    observed: NDArray[np.bool_]  # (T,): False where a gap was filled
    sigma_xy_m: Array  # (T,), m: one standard deviation of the position
    sigma_yaw_rad: Array | None = None  # (T,): the same of heading and speed; None where unknown
    sigma_speed_mps: Array | None = None
    visible: NDArray[np.bool_] | None = None  # (T,): whether the sensors could see the agent; only in truth
    lidar_points: Array | None = None  # (T,): LiDAR points in the agent's box, of all LiDARs together; only in truth

    FLOATS = ("t_s", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "sigma_xy_m")
    OPTIONAL_FLOATS = ("sigma_yaw_rad", "sigma_speed_mps")

    def __post_init__(self) -> None:
        """Check that all columns have one length; `ValueError` names the one that has another."""
        for key, column in self.columns().items():
            if len(column) != len(self.t_s):
                raise ValueError(f"waypoints: {key} has {len(column)} values, t_s has {len(self.t_s)}")

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the columns that there are, by name."""
        names = (*self.FLOATS, "observed", *self.OPTIONAL_FLOATS, "visible", "lidar_points")
        return {key: getattr(self, key) for key in names if getattr(self, key) is not None}

    def problem(self) -> str | None:
        """Describe the first defect: no waypoint, a value that is not finite, times that do not increase; None without."""
        if len(self) == 0:
            return "has no waypoints, expected at least one"
        for key, column in self.columns().items():
            finite = np.isfinite(column)
            if not finite.all():
                return f"waypoints.{key} is not finite at index {int(np.argmin(finite))}"
        late = np.diff(self.t_s) <= 0
        if late.any():
            k = int(np.argmax(late)) + 1
            return f"waypoints.t_s does not increase at index {k} ({self.t_s[k]:g} s)"
        return None


STANDSTILL_MPS = 0.15
"""An agent stands when it is slower: half a kilometer per hour, the standard deviation of smoothed speeds of distant boxes."""

STANDSTILL_DRIFT_M = 2.0 * STANDSTILL_MPS
"""How far a standing agent may seem to move: 2 s at that speed, after which a smoothed drift is seen as motion."""

MARGIN_S = 1e-6
"""Times this far outside a trajectory are at its ends: stamps of ticks and waypoints are the same up to rounding."""

MIN_DISCONTINUITY_M = 2.0
"""A waypoint counts as a jump when it is farther than this from where the speeds lead and the next constant holds, too."""

MIN_DISCONTINUITY_MPS = 15.0
"""Speed by which a vehicle would have to be faster to reach such a waypoint: it is another object under the same id."""


class TrajectoryStates(NamedTuple):
    """Box centers on a trajectory, map frame."""

    x_m: Array  # (N,), m
    y_m: Array  # (N,), m
    z_m: Array  # (N,), m
    yaw_rad: Array  # (N,), in [-pi, pi)
    speed_mps: Array  # (N,), m/s: along the heading


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Cubic Hermite spline through the waypoints of a box center."""

    t_s: Array  # (T,), s
    x_m: Array  # (T,), m: relative to `origin_m`, which keeps digits far from the origin of the map, as `y_m`
    y_m: Array
    z_m: Array  # (T,), m
    yaw_rad: Array  # (T,): unwrapped
    speed_mps: Array  # (T,), m/s
    velocity_x_mps: Array  # (T,), m/s: tangents of the spline, as `velocity_y_mps`
    velocity_y_mps: Array
    discontinuous: NDArray[np.bool_]  # (T - 1,): steps over which the log jumps instead of moving
    origin_m: tuple[float, float]  # the first waypoint

    @classmethod
    def through(cls, waypoints: Waypoints, rear_axle_offset_m: float = 0.0) -> Trajectory:
        """Fit the trajectory of a box center that is `rear_axle_offset_m` ahead of the axle that rolls along the heading."""
        w = waypoints
        origin_m = (float(w.x_m[0]), float(w.y_m[0]))
        x, y, yaw = w.x_m - origin_m[0], w.y_m - origin_m[1], np.unwrap(w.yaw_rad)
        vx, vy = w.speed_mps * np.cos(yaw), w.speed_mps * np.sin(yaw)
        jump = np.zeros(max(len(w) - 1, 0), dtype=bool)
        if len(w) > 1:
            span = np.diff(w.t_s)
            miss = np.hypot(np.diff(x) - (vx[1:] + vx[:-1]) / 2 * span, np.diff(y) - (vy[1:] + vy[:-1]) / 2 * span)
            jump = (miss > MIN_DISCONTINUITY_M) & (miss > MIN_DISCONTINUITY_MPS * span)
            at_jump = np.concatenate([jump, [False]]) | np.concatenate([[False], jump])
            swing = np.where(at_jump, 0.0, rear_axle_offset_m * np.gradient(yaw, w.t_s))
            vx, vy = vx - swing * np.sin(yaw), vy + swing * np.cos(yaw)
            # Difference quotients where the logged velocities disagree with them: sideways steps of a pedestrian and a box
            # labeled back to front would otherwise bend the spline into loops.
            dx, dy = np.gradient(x, w.t_s), np.gradient(y, w.t_s)
            replaced = (np.hypot(vx - dx, vy - dy) > 0.5 + 0.3 * np.hypot(dx, dy)) & ~at_jump
            vx, vy = np.where(replaced, dx, vx), np.where(replaced, dy, vy)
        return cls(w.t_s, x, y, w.z_m, yaw, w.speed_mps, vx, vy, jump, origin_m)

    def at(self, t_s: Array) -> TrajectoryStates:
        """Interpolate at times (N,); before the first and after the last waypoint the end is held."""
        x, y, yaw, speed = self.relative(t_s)
        return TrajectoryStates(x + self.origin_m[0], y + self.origin_m[1], self.heights(t_s), wrap_angle(yaw), speed)

    def _since(self, t: Array) -> tuple[NDArray[np.intp], Array, Array, NDArray[np.bool_]]:
        """Return the number of the step that times (N,) are in, how long it has lasted then, its duration, and whether it is a jump."""
        i = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, len(self.t_s) - 2)
        return i, t - self.t_s[i], self.t_s[i + 1] - self.t_s[i], self.discontinuous[i] & (t < self.t_s[i + 1])

    def relative(self, t_s: Array) -> tuple[Array, Array, Array, Array]:
        """Interpolate x, y relative to the origin, unwrapped yaw and speed at times (N,); the ends are held.

        Position by cubics with the waypoints' velocities (Hermite), straight on up to a discontinuity; yaw and speed linearly.
        """
        t = np.clip(t_s, self.t_s[0], self.t_s[-1])
        yaw, speed = np.interp(t, self.t_s, self.yaw_rad), np.interp(t, self.t_s, self.speed_mps)
        if len(self.t_s) == 1:
            return np.full(len(t), self.x_m[0]), np.full(len(t), self.y_m[0]), yaw, speed
        i, since, span, jumps = self._since(t)
        x = hermite(self.x_m, self.velocity_x_mps, i, since, span)
        y = hermite(self.y_m, self.velocity_y_mps, i, since, span)
        if jumps.any():
            x = np.where(jumps, self.x_m[i] + since * self.velocity_x_mps[i], x)
            y = np.where(jumps, self.y_m[i] + since * self.velocity_y_mps[i], y)
            yaw = np.where(jumps, self.yaw_rad[i], yaw)
        return x, y, yaw, speed

    def velocity(self, t_s: Array) -> tuple[Array, Array]:
        """Compute the velocity vx, vy, m/s, at times (N,): the slope of the spline, straight on up to a discontinuity."""
        t = np.clip(t_s, self.t_s[0], self.t_s[-1])
        if len(self.t_s) == 1:
            return np.full(len(t), self.velocity_x_mps[0]), np.full(len(t), self.velocity_y_mps[0])
        i, since, span, jumps = self._since(t)
        vx = hermite_slope(self.x_m, self.velocity_x_mps, i, since, span)
        vy = hermite_slope(self.y_m, self.velocity_y_mps, i, since, span)
        return np.where(jumps, self.velocity_x_mps[i], vx), np.where(jumps, self.velocity_y_mps[i], vy)

    def heights(self, t_s: Array) -> Array:
        """Interpolate the height z of the box center at times (N,); the ends are held."""
        return np.interp(t_s, self.t_s, self.z_m)

    def discontinuity_times(self) -> Array:
        """Return the times (J,) of the waypoints that the agent cannot have moved to."""
        return self.t_s[1:][self.discontinuous]


def hermite(value: Array, slope: Array, i: NDArray[np.intp], t: Array, span: Array) -> Array:
    """Evaluate cubics (..., N) through value[..., i] and value[..., i + 1] with their slopes, at `t` (N,) after the first."""
    f = t / span
    begin, end = value.take(i, axis=-1), value.take(i + 1, axis=-1)
    begin_rise, end_rise, rise = span * slope.take(i, axis=-1), span * slope.take(i + 1, axis=-1), end - begin
    cubic = begin_rise + end_rise - 2 * rise
    return begin + f * (begin_rise + f * (3 * rise - 2 * begin_rise - end_rise + f * cubic))


def hermite_slope(value: Array, slope: Array, i: NDArray[np.intp], t: Array, span: Array) -> Array:
    """Evaluate the slopes (N,) of the cubics of `hermite`."""
    f = t / span
    begin, end, rise = slope[i], slope[i + 1], (value[i + 1] - value[i]) / span
    return begin + f * (2 * (3 * rise - 2 * begin - end) + 3 * f * (begin + end - 2 * rise))


MIN_TRUSTED_CONFIDENCE = 0.5
"""Agents below it are doubtful: by their confidence they are more likely wrong than right."""

COLOR_NAMES = ("black", "white", "gray", "silver", "red", "blue", "green", "yellow", "brown", "orange")
"""Names that reconstructed colors of vehicles have."""


@dataclass(frozen=True, eq=False)
class AgentStates:
    """States of one agent at requested times; NaN where not valid."""

    __repr__ = short_repr

    valid: NDArray[np.bool_]  # (T,): whether the trajectory covers the time
    x_m: Array  # (T,), m: box center, map frame
    y_m: Array
    z_m: Array
    yaw_rad: Array  # (T,)
    speed_mps: Array  # (T,), m/s


@dataclass(frozen=True, eq=False)
class Agent:
    """One road user."""

    id: str  # unique within the scenario; `EGO` for the ego
    category: str  # one of `CATEGORIES`
    size_m: tuple[float, float, float]  # length, width, height
    waypoints: Waypoints
    static: bool = False  # whether it never moves
    rear_axle_offset_m: float = 0.0  # from the rear axle forward to the center of the box
    # {"rgb": [r, g, b], "name": ...}; of a reconstruction one of `COLOR_NAMES`, with "confidence", its probability
    color: Mapping[str, Any] | None = None
    confidence: float = 1.0  # in [0, 1]
    quality: Mapping[str, Any] = field(default_factory=dict)  # figures such as the number of detections
    doubts: tuple[Finding, ...] = ()  # what speaks against it
    # Times of the scenario, s, between which each of the `ENDS` measured it; empty for truth and the ego
    observed_by: Mapping[str, tuple[Span, ...]] = field(default_factory=dict)
    # Whether it is too likely wrong to be replayed or exported unless that is asked for, see `Scenario.active`
    quarantined: bool = False

    def __repr__(self) -> str:
        """Return category, size, times and confidence in one line."""
        size, t = " x ".join(f"{edge_m:.1f}" for edge_m in self.size_m), self.waypoints.t_s
        times = f"{t[0]:.1f} to {t[-1]:.1f} s" if len(t) > 1 else "the whole time" if self.static else "once"
        notes = [f"confidence {self.confidence:.2f}", *(["static"] if self.static else [])]
        notes += [doubt.kind for doubt in self.doubts]
        return f"<Agent {self.id!r:.80}: {self.category}, {size} m, {times}, {', '.join(notes)}>"

    @property
    def is_permanent(self) -> bool:
        """Whether it is a static agent with a single waypoint, which is present during the whole scenario."""
        return self.static and len(self.waypoints) == 1

    @property
    def is_doubtful(self) -> bool:
        """Whether it has a doubt or a confidence below `MIN_TRUSTED_CONFIDENCE`."""
        return bool(self.doubts) or self.confidence < MIN_TRUSTED_CONFIDENCE

    @cached_property
    def trajectory(self) -> Trajectory:
        """The spline through the waypoints."""
        return Trajectory.through(self.waypoints, self.rear_axle_offset_m)

    def at(self, t_s: ArrayLike, max_gap_s: float = math.inf, margin_s: float = MARGIN_S) -> AgentStates:
        """Evaluate the trajectory at times: positions by cubics with the logged velocities, yaw along the shorter arc.

        `t_s`: s, one or (T,). `max_gap_s`: times inside a longer gap between waypoints are not valid. `margin_s`: times up to this
        far outside the trajectory take its nearest end.
        """
        t, w = np.atleast_1d(np.asarray(t_s, dtype=np.float64)), self.waypoints
        valid = (t >= w.t_s[0] - margin_s) & (t <= w.t_s[-1] + margin_s)
        if len(w) > 1:
            i = np.clip(np.searchsorted(w.t_s, t, side="right") - 1, 0, len(w) - 2)
            on_waypoint = np.minimum(np.abs(t - w.t_s[i]), np.abs(w.t_s[i + 1] - t)) <= margin_s
            valid &= on_waypoint | (w.t_s[i + 1] - w.t_s[i] <= max_gap_s)
        states = self.trajectory.at(t)
        return AgentStates(valid=valid, **{k: np.where(valid, v, np.nan) for k, v in states._asdict().items()})


@dataclass(frozen=True, eq=False)
class AgentTable:
    """Boxes of A agents at T times, map frame; NaN where an agent is absent."""

    __repr__ = short_repr

    agents: tuple[Agent, ...]
    t_s: Array  # (T,), s
    center_m: Array  # (A, T, 3), m
    yaw_rad: Array  # (A, T), in [-pi, pi)
    speed_mps: Array  # (A, T), m/s: along the heading, negative when reversing

    @classmethod
    def of(cls, agents: Sequence[Agent], t_s: Array, *, margin_s: float = MARGIN_S, permanent: bool = False) -> Self:
        """Evaluate agents at times (T,); those with `is_permanent` are there at all of them where `permanent` says so.

        Up to `margin_s` before and after its life an agent moves on as it starts and ends.
        """
        columns = np.full((5, len(agents), len(t_s)), np.nan)
        for k, agent in enumerate(agents):
            states = agent.at(t_s, margin_s=np.inf if permanent and agent.is_permanent else margin_s)
            outside_s = t_s - np.clip(t_s, *agent.waypoints.t_s[[0, -1]])
            dx, dy = (states.speed_mps * turn(states.yaw_rad) * outside_s for turn in (np.cos, np.sin))
            columns[:, k] = states.x_m + dx, states.y_m + dy, states.z_m, states.yaw_rad, states.speed_mps
        return cls(tuple(agents), t_s, np.moveaxis(columns[:3], 0, -1).copy(), *columns[3:])

    def take(self, rows: NDArray[np.generic]) -> AgentTable:
        """Return some of the agents."""
        return AgentTable(
            tuple(self.agents[k] for k in np.arange(len(self.agents))[rows].tolist()), self.t_s,
            self.center_m[rows], self.yaw_rad[rows], self.speed_mps[rows],
        )  # fmt: skip

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """Whether an agent is there (A, T)."""
        return np.isfinite(self.yaw_rad)

    @cached_property
    def size_m(self) -> Array:
        """Length, width, height (A, 3)."""
        return np.array([agent.size_m for agent in self.agents], dtype=np.float64).reshape(-1, 3)

    @cached_property
    def category(self) -> NDArray[np.str_]:
        """Category (A,) of each agent."""
        return np.array([agent.category for agent in self.agents], dtype="<U16")

    @cached_property
    def group(self) -> NDArray[np.str_]:
        """Group (A,) of these categories."""
        return np.array([GROUP_OF.get(agent.category, "other") for agent in self.agents], dtype="<U16")

    @property
    def xy_m(self) -> Array:
        """Place (A, T, 2) of the center on the ground."""
        return self.center_m[..., :2]

    @cached_property
    def heading_velocity_mps(self) -> Array:
        """Velocity (A, T, 2) along the heading."""
        return np.stack([self.speed_mps * np.cos(self.yaw_rad), self.speed_mps * np.sin(self.yaw_rad)], axis=-1)

    def rectangles(self, row: NDArray[np.intp] | int, time: NDArray[np.intp] | slice) -> Array:
        """Return footprints (n, 5) at rows and times (n,): x, y, length, width, yaw, as `rectangle_overlap` takes them."""
        xy, yaw = self.xy_m[row, time], self.yaw_rad[row, time]
        return np.column_stack([xy, np.broadcast_to(self.size_m[row, :2], xy.shape), yaw])


def agent_to_dict(agent: Agent) -> dict[str, Any]:
    """Return the entry of an agent in a document of `schemas/scenario-1.json`."""
    columns = {k: v.astype(_type(k)).tolist() for k, v in agent.waypoints.columns().items()}
    length, width, height = (float(v) for v in agent.size_m)
    observed_by = {end: [list(span) for span in spans] for end, spans in agent.observed_by.items()}
    return {
        "id": agent.id,
        "category": agent.category,
        "size_m": {"length": length, "width": width, "height": height},
        "color": dict(agent.color) if agent.color is not None else None,
        "static": bool(agent.static),
        "rear_axle_offset_m": float(agent.rear_axle_offset_m),
        "confidence": float(agent.confidence),
        **({"quarantined": True} if agent.quarantined else {}),
        "doubts": [doubt.to_dict() for doubt in agent.doubts],
        "quality": dict(agent.quality),
        **({"observed_by": observed_by} if observed_by else {}),
        "waypoints": columns,
    }


def agent_from_dict(entry: Mapping[str, Any]) -> Agent:
    """Build an agent from an entry that keeps the schema.

    Raises `ScenarioError` for an unknown category, columns of different lengths or an impossible trajectory.
    """
    where = f"agent '{entry['id']}'"
    if entry["category"] not in CATEGORIES:
        raise ScenarioError(f"{where}: category '{entry['category']}' is not known; known: {', '.join(CATEGORIES)}")
    columns = entry["waypoints"]
    count = len(columns["t_s"])
    for key, values in columns.items():
        if len(values) != count:
            raise ScenarioError(f"{where}: waypoints.{key} has {len(values)} values, t_s has {count}")
    waypoints = Waypoints(**{k: np.array(v, dtype=_type(k)) for k, v in columns.items()})
    problem = waypoints.problem()
    if problem is not None:
        raise ScenarioError(f"{where}: {problem}")
    # Before there were doubts, `quality` named the limits that its motion breaks.
    flags = entry["quality"].get("flags")
    listed = flags if isinstance(flags, list) else ()
    doubts = [Finding(str(flag), text=f"breaks the limit of {flag}") for flag in listed]
    if "doubts" in entry:
        doubts = [Finding.from_dict(doubt) for doubt in entry["doubts"]]
    spans = entry.get("observed_by", {}).items()
    size = entry["size_m"]
    return Agent(
        id=entry["id"],
        category=entry["category"],
        size_m=(float(size["length"]), float(size["width"]), float(size["height"])),
        waypoints=waypoints,
        static=entry["static"],
        rear_axle_offset_m=float(entry["rear_axle_offset_m"]),
        color=entry["color"],
        confidence=float(entry["confidence"]),
        quarantined=bool(entry.get("quarantined", False)),
        doubts=tuple(doubts),
        quality=entry["quality"],
        observed_by={end: tuple((float(first), float(last)) for first, last in of_end) for end, of_end in spans},
    )


def _type(column: str) -> Any:
    return bool if column in ("observed", "visible") else np.float64


MAX_LISTED = 5


def explain_doubt(agent: Agent) -> str:
    """Say why an agent is doubtful: the reasons of its doubts, else its low confidence; empty when it is not doubtful."""
    if agent.doubts:
        return ", ".join(doubt.sentence for doubt in agent.doubts)
    return format_confidence(agent) if agent.confidence < MIN_TRUSTED_CONFIDENCE else ""


def format_confidence(agent: Agent) -> str:
    """Say the confidence of an agent, rounded down, so that 0.499 is not shown as the limit that it misses."""
    return f"confidence {math.floor(agent.confidence * 100 + 1e-9) / 100:.2f}"


def list_doubtful(agents: Sequence[Agent], limit: int | None = MAX_LISTED) -> str:
    """List agents on one line, each with why it is doubtful, else with its confidence; `limit` of many, or all without one.

    Those with a doubt come first, since low confidence alone says less.
    """
    first = sorted(agents, key=lambda agent: not agent.doubts)[:limit]
    named = [f"{agent.id} ({explain_doubt(agent) or format_confidence(agent)})" for agent in first]
    rest = len(agents) - len(first)
    return ", ".join(named) + (f" and {rest} more" if rest > 0 else "")
