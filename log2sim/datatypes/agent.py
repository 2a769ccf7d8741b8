"""Road users: a box of one size on a trajectory."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes.categories import CATEGORIES
from log2sim.datatypes.doubts import MIN_TRUSTED_CONFIDENCE, Doubt
from log2sim.datatypes.ends import Span
from log2sim.datatypes.trajectory import Trajectory
from log2sim.datatypes.waypoints import Waypoints
from log2sim.errors import ScenarioError
from log2sim.geometry import Array
from log2sim.numerals import short_repr

COLOR_NAMES = ("black", "white", "gray", "silver", "red", "blue", "green", "yellow", "brown", "orange")
"""Names that reconstructed colors of vehicles have."""


@dataclass(frozen=True, eq=False)
class AgentStates:
    """States of one agent at requested times; NaN where not valid.

    Attributes
    ----------
    valid : (T,) bool
        Whether the trajectory covers the time.
    x_m, y_m, z_m : (T,) float64, m
        Box center, map frame.
    yaw_rad : (T,) float64
    speed_mps : (T,) float64, m/s
    """

    __repr__ = short_repr

    valid: NDArray[np.bool_]
    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array


@dataclass(frozen=True, eq=False)
class Agent:
    """One road user.

    Attributes
    ----------
    id : str
        Unique within the scenario; `EGO` for the ego.
    category : str
        One of `CATEGORIES`.
    size_m : (3,) tuple of float, m
        Length, width, height.
    waypoints : Waypoints
    static : bool
        Whether it never moves.
    rear_axle_offset_m : float, m
        From the rear axle forward to the center of the box.
    color : mapping or None
        {"rgb": [r, g, b], "name": ...}; of a reconstruction the name is one of `COLOR_NAMES`, and "confidence" the probability
        that it is right.
    confidence : float
        In [0, 1].
    quarantined : bool
        Whether it is too likely wrong to be replayed or exported unless that is asked for, see `Scenario.active`.
    quality : mapping
        Figures of the reconstruction, such as the number of detections.
    doubts : tuple of Doubt
        What speaks against it.
    observed_by : mapping of str to tuple of Span
        Times of the scenario, s, between which each of the `ENDS` measured it; empty for truth and the ego.
    """

    id: str
    category: str
    size_m: tuple[float, float, float]
    waypoints: Waypoints
    static: bool = False
    rear_axle_offset_m: float = 0.0
    color: Mapping[str, Any] | None = None
    confidence: float = 1.0
    quarantined: bool = False
    quality: Mapping[str, Any] = field(default_factory=dict)
    doubts: tuple[Doubt, ...] = ()
    observed_by: Mapping[str, tuple[Span, ...]] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return category, size, times and confidence in one line."""
        size, t = " x ".join(f"{edge_m:.1f}" for edge_m in self.size_m), self.waypoints.t_s
        times = f"{t[0]:.1f} to {t[-1]:.1f} s" if len(t) > 1 else "the whole time" if self.static else "once"
        notes = [f"confidence {self.confidence:.2f}", *(["static"] if self.static else [])]
        notes += [doubt.flag for doubt in self.doubts]
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

    def at(self, t_s: ArrayLike, max_gap_s: float = math.inf, margin_s: float = 1e-6) -> AgentStates:
        """Evaluate the trajectory at times: positions by cubics with the logged velocities, yaw along the shorter arc.

        Parameters
        ----------
        t_s : float or (T,), s
        max_gap_s : float, s
            Times inside a longer gap between waypoints are not valid.
        margin_s : float, s
            Times up to this far outside the trajectory take its nearest end.
        """
        t, w = np.atleast_1d(np.asarray(t_s, dtype=np.float64)), self.waypoints
        valid = (t >= w.t_s[0] - margin_s) & (t <= w.t_s[-1] + margin_s)
        if len(w) > 1:
            i = np.clip(np.searchsorted(w.t_s, t, side="right") - 1, 0, len(w) - 2)
            on_waypoint = np.minimum(np.abs(t - w.t_s[i]), np.abs(w.t_s[i + 1] - t)) <= margin_s
            valid &= on_waypoint | (w.t_s[i + 1] - w.t_s[i] <= max_gap_s)
        states = self.trajectory.at(t)
        return AgentStates(valid=valid, **{k: np.where(valid, v, np.nan) for k, v in states._asdict().items()})


def agent_to_dict(agent: Agent) -> dict[str, Any]:
    """Return the entry of an agent in a document of `schemas/scenario-1.json`."""
    w = agent.waypoints
    columns = {
        k: v.astype(bool).tolist() if k in ("observed", "visible") else v.astype(np.float64).tolist()
        for k, v in w.columns().items()
    }
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

    Raises
    ------
    ScenarioError
        For an unknown category, columns of different lengths or an impossible trajectory.
    """
    where = f"agent '{entry['id']}'"
    if entry["category"] not in CATEGORIES:
        raise ScenarioError(f"{where}: category '{entry['category']}' is not known; known: {', '.join(CATEGORIES)}")
    columns = entry["waypoints"]
    count = len(columns["t_s"])
    for key, values in columns.items():
        if len(values) != count:
            raise ScenarioError(f"{where}: waypoints.{key} has {len(values)} values, t_s has {count}")
    waypoints = Waypoints(
        **{k: np.array(v, dtype=bool if k in ("observed", "visible") else np.float64) for k, v in columns.items()}
    )
    problem = waypoints.problem()
    if problem is not None:
        raise ScenarioError(f"{where}: {problem}")
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
        doubts=_doubts_of(entry),
        quality=entry["quality"],
        observed_by={
            end: tuple((float(first), float(last)) for first, last in spans)
            for end, spans in entry.get("observed_by", {}).items()
        },
    )


def _doubts_of(entry: Mapping[str, Any]) -> tuple[Doubt, ...]:
    """Read the doubts of an agent; before there were any, `quality` named the limits that its motion breaks."""
    if "doubts" in entry:
        return tuple(Doubt.from_dict(doubt) for doubt in entry["doubts"])
    flags = entry["quality"].get("flags")
    return tuple(Doubt(str(flag), f"breaks the limit of {flag}") for flag in flags) if isinstance(flags, list) else ()
