"""The result: who was there, how big, where and when, as `scenario.json` holds it."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes.categories import CATEGORIES
from log2sim.datatypes.ignore_regions import Unlabeled
from log2sim.datatypes.log import MapFrame
from log2sim.documents import check, read_json, write_json
from log2sim.errors import ScenarioError
from log2sim.geometry import NS_PER_S, Array, wrap_angle

VERSION = 1
EGO = "ego"  # the id of the ego


@dataclass(frozen=True, eq=False)
class Waypoints:
    """A trajectory of the box center as columns (T,), local ENU axes.

    `t_s` strictly increasing seconds since the scenario's start, `speed_mps` along the heading (negative when reversing),
    `observed` False where a gap was filled, `sigma_xy_m` one standard deviation of the position. `visible` only in truth.
    """

    t_s: Array
    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    observed: NDArray[np.bool_]
    sigma_xy_m: Array
    visible: NDArray[np.bool_] | None = None

    FLOATS = ("t_s", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "sigma_xy_m")

    def __len__(self) -> int:
        return len(self.t_s)

    def problem(self) -> str | None:
        """What keeps them from being a trajectory: none at all, a number that is not finite, times that do not increase."""
        if len(self) == 0:
            return "has no waypoints, expected at least one"
        for key in self.FLOATS:
            finite = np.isfinite(getattr(self, key))
            if not finite.all():
                return f"waypoints.{key} is not finite at index {int(np.argmin(finite))}"
        late = np.diff(self.t_s) <= 0
        if late.any():
            k = int(np.argmax(late)) + 1
            return f"waypoints.t_s does not increase at index {k} ({self.t_s[k]:g} s)"
        return None


@dataclass(frozen=True, eq=False)
class Sampled:
    """States of one agent at asked times (T,): NaN and `valid` False outside its life."""

    valid: NDArray[np.bool_]
    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array


@dataclass(frozen=True, eq=False)
class Agent:
    """One road user. `size_m` length, width, height; `color` is {"rgb": [r, g, b], "name": ...} or None."""

    id: str
    category: str
    size_m: tuple[float, float, float]
    waypoints: Waypoints
    static: bool = False
    rear_axle_offset_m: float = 0.0
    color: Mapping[str, Any] | None = None
    confidence: float = 1.0
    quality: Mapping[str, Any] = field(default_factory=dict)

    @property
    def stays(self) -> bool:
        """Whether it stands and was seen only once: then it is there all the time."""
        return self.static and len(self.waypoints) == 1

    def at(self, t_s: ArrayLike, max_gap_s: float = math.inf, margin_s: float = 1e-6) -> Sampled:
        """Sample the trajectory at times (T,), linearly, yaw along the shorter arc.

        Times within `margin_s` outside the life take its end; times inside a gap longer than `max_gap_s` are not valid.
        """
        t, w = np.atleast_1d(np.asarray(t_s, dtype=np.float64)), self.waypoints
        valid = (t >= w.t_s[0] - margin_s) & (t <= w.t_s[-1] + margin_s)
        if len(w) > 1:
            i = np.clip(np.searchsorted(w.t_s, t, side="right") - 1, 0, len(w) - 2)
            on_waypoint = np.minimum(np.abs(t - w.t_s[i]), np.abs(w.t_s[i + 1] - t)) <= margin_s
            valid &= on_waypoint | (w.t_s[i + 1] - w.t_s[i] <= max_gap_s)
        columns = {k: np.interp(t, w.t_s, getattr(w, k)) for k in ("x_m", "y_m", "z_m", "speed_mps")}
        columns["yaw_rad"] = wrap_angle(np.interp(t, w.t_s, np.unwrap(w.yaw_rad)))
        return Sampled(valid=valid, **{k: np.where(valid, v, np.nan) for k, v in columns.items()})


@dataclass(frozen=True, eq=False)
class Scenario:
    """A scenario. The ego is the agent with id `EGO`, if the log had one; `t0_ns` is the absolute time of t_s = 0.

    `unlabeled` only in truth: where its labels say nothing, None where they are complete.
    """

    name: str
    t0_ns: int
    duration_s: float
    agents: tuple[Agent, ...]
    map: MapFrame = field(default_factory=MapFrame)
    cameras: tuple[Mapping[str, Any], ...] = ()
    plan: tuple[Mapping[str, Any], ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    unlabeled: Unlabeled | None = None

    @property
    def ego(self) -> Agent | None:
        return next((a for a in self.agents if a.id == EGO), None)

    @property
    def others(self) -> tuple[Agent, ...]:
        return tuple(a for a in self.agents if a.id != EGO)

    @property
    def digest(self) -> str:
        """SHA-256 of the scenario's document, by which replays and edits name their source."""
        document = json.dumps(self.to_dict(), sort_keys=True, ensure_ascii=False)
        return hashlib.sha256(document.encode()).hexdigest()

    @classmethod
    def load(cls, path: Path | str) -> Scenario:
        """Read and check a scenario file.

        Raises
        ------
        ScenarioError
            When the file is missing, is no JSON, breaks the schema or holds impossible values; names the agent and field.
        """
        document = read_json(path, ScenarioError)
        try:
            return cls.from_dict(document)
        except ScenarioError as error:
            raise ScenarioError(f"{path}: {error}") from None

    def shift_to(self, other: Scenario) -> Array:
        """What to add to positions (3,) of this scenario to bring them into the map of another.

        Raises
        ------
        ScenarioError
            When their maps have different projections.
        """
        theirs, ours = other.map, self.map
        if theirs.projection and ours.projection and theirs.projection != ours.projection:
            raise ScenarioError(
                f"map.projection: '{other.name}' has '{theirs.projection}', '{self.name}' has '{ours.projection}'; "
                "bring both to one projection first"
            )
        return np.array(ours.offset_m, dtype=np.float64) - np.array(theirs.offset_m, dtype=np.float64)

    def beside(self, other: Scenario) -> Scenario:
        """This scenario with the times and places of another one's start and map, to be shown or compared with it.

        Raises
        ------
        ScenarioError
            When their maps have different projections.
        """
        later_s = (self.t0_ns - other.t0_ns) / NS_PER_S
        dx, dy, dz = self.shift_to(other)
        moved = []
        for agent in self.agents:
            w = agent.waypoints
            w = replace(w, t_s=w.t_s + later_s, x_m=w.x_m + dx, y_m=w.y_m + dy, z_m=w.z_m + dz)
            moved.append(replace(agent, waypoints=w))
        return replace(self, t0_ns=other.t0_ns, map=other.map, agents=tuple(moved))

    def save(self, path: Path | str) -> None:
        """Write the scenario, whole or not at all; what was written reads back to the same numbers."""
        document = self.to_dict()
        check(document, "scenario-1", ScenarioError)
        write_json(path, document)

    def to_dict(self) -> dict[str, Any]:
        """The document of `schemas/scenario-1.json`."""
        m = self.map
        document = {
            "scenario_version": VERSION,
            "name": self.name,
            "t0_ns": int(self.t0_ns),
            "duration_s": float(self.duration_s),
            "map": {
                "latitude_deg": m.latitude_deg,
                "longitude_deg": m.longitude_deg,
                "altitude_m": m.altitude_m,
                "projection": m.projection,
                "offset_m": list(m.offset_m),
            },
            "agents": [_agent_to_dict(a) for a in self.agents],
            "cameras": [dict(c) for c in self.cameras],
            "plan": [dict(p) for p in self.plan],
            "provenance": dict(self.provenance),
        }
        return document if self.unlabeled is None else {**document, "unlabeled": self.unlabeled.to_dict()}

    @classmethod
    def from_dict(cls, document: Any) -> Scenario:
        """Build a scenario from a document, after checking it against the schema and for sense."""
        version = document.get("scenario_version") if isinstance(document, dict) else None
        if version != VERSION:
            raise ScenarioError(
                f"scenario_version is {version!r}, expected {VERSION}; is this a scenario file of log2sim?"
            )
        check(document, "scenario-1", ScenarioError)
        m = document["map"]
        scenario = cls(
            name=document["name"],
            t0_ns=document["t0_ns"],
            duration_s=float(document["duration_s"]),
            agents=tuple(_agent_from_dict(a) for a in document["agents"]),
            map=MapFrame(m["latitude_deg"], m["longitude_deg"], m["altitude_m"], m["projection"], tuple(m["offset_m"])),
            cameras=tuple(document["cameras"]),
            plan=tuple(document["plan"]),
            provenance=document["provenance"],
            unlabeled=Unlabeled.from_dict(document["unlabeled"]) if "unlabeled" in document else None,
        )
        seen: set[str] = set()
        for agent in scenario.agents:
            if agent.id in seen:
                raise ScenarioError(f"agent '{agent.id}': the id stands twice; ids must be unique")
            seen.add(agent.id)
        return scenario


def _agent_to_dict(agent: Agent) -> dict[str, Any]:
    w = agent.waypoints
    columns: dict[str, list[Any]] = {k: np.asarray(getattr(w, k), dtype=np.float64).tolist() for k in Waypoints.FLOATS}
    columns["observed"] = [bool(v) for v in w.observed]
    if w.visible is not None:
        columns["visible"] = [bool(v) for v in w.visible]
    length, width, height = (float(v) for v in agent.size_m)
    return {
        "id": agent.id,
        "category": agent.category,
        "size_m": {"length": length, "width": width, "height": height},
        "color": dict(agent.color) if agent.color is not None else None,
        "static": bool(agent.static),
        "rear_axle_offset_m": float(agent.rear_axle_offset_m),
        "confidence": float(agent.confidence),
        "quality": dict(agent.quality),
        "waypoints": columns,
    }


def _agent_from_dict(entry: Mapping[str, Any]) -> Agent:
    where = f"agent '{entry['id']}'"
    if entry["category"] not in CATEGORIES:
        raise ScenarioError(f"{where}: category '{entry['category']}' is not known; known: {', '.join(CATEGORIES)}")
    columns = entry["waypoints"]
    count = len(columns["t_s"])
    for key, values in columns.items():
        if len(values) != count:
            raise ScenarioError(f"{where}: waypoints.{key} has {len(values)} values, t_s has {count}")
    arrays = {k: np.array(columns[k], dtype=np.float64) for k in Waypoints.FLOATS}
    visible = columns.get("visible")
    waypoints = Waypoints(
        **arrays,
        observed=np.array(columns["observed"], dtype=bool),
        visible=None if visible is None else np.array(visible, dtype=bool),
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
        quality=entry["quality"],
    )
