"""The result of a replay and its warnings, as `replay.json` holds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EGO, Scenario, Waypoints
from log2sim.errors import ScenarioError
from log2sim.files import plugins
from log2sim.files.documents import check, read_json, short_repr, write_json
from log2sim.geometry import Array


@dataclass(frozen=True)
class Moment:
    """The ego and another agent at one time."""

    t_s: float
    distance_m: float  # between the boxes
    ego_speed_mps: float
    stopping_m: float  # way of the ego until it stands, with the reaction


@dataclass(frozen=True)
class CollisionWarning:
    """What is known of an agent on a collision course with the ego, or with another vehicle that is warned in its place."""

    agent: str
    category: str
    known: Moment | None  # when it is first known; None where it never is
    # When each end alone knows it first, s; only where both have observed somebody.
    known_by: Mapping[str, float] = field(default_factory=dict)
    warned: Moment | None = None  # when it is first warned of; None for a collision that was not predicted
    probability: float = 0.0  # of the collision, at that time
    ttc_s: float | None = None  # time to the collision then
    way_m: float | None = None  # of the ego until then, at its speed
    needed_mps2: float | None = None  # deceleration with which the ego stands before that place; None: too late
    braking_suffices: bool = False  # whether the ego can stand before that place
    spans_s: tuple[tuple[float, float], ...] = ()  # while it is warned of
    collision_s: float | None = None  # when the ego touches it in the replay
    driver: str = EGO  # who is warned: the ego, or a vehicle of a scenario without one

    @property
    def begin_s(self) -> float:
        """Return when it is first warned of, or the collision."""
        return min([a for a, _ in self.spans_s] + ([] if self.collision_s is None else [self.collision_s]))

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Build a warning from its entry in a document."""
        moments = {k: Moment(**entry[k]) if entry[k] else None for k in ("known", "warned")}
        spans = tuple((float(a), float(b)) for a, b in entry["spans_s"])
        return cls(**{**entry, **moments, "spans_s": spans})


@dataclass(frozen=True)
class Warnings:
    """All warnings of a replay, in order of time."""

    ends: str  # whose observations count: "vehicle", "road" or "both"
    tells_ends: bool  # whether the scenario says which end observed its agents; else what it observed counts
    # horizon_s, min_probability, early_probability, margin_s, reaction_s, brake_mps2: as in `WarningSettings`.
    horizon_s: float
    min_probability: float
    early_probability: float
    margin_s: float
    reaction_s: float
    brake_mps2: float
    agents: int  # without the ego
    known_agents: int  # how many of them the ends get to know
    driven_s: float  # for how long the ego moved, or all together who are warned in its place
    events: tuple[CollisionWarning, ...] = ()

    def of(self, agent: str) -> CollisionWarning | None:
        """Return the warning of an agent; None without."""
        return next((w for w in self.events if w.agent == agent), None)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `warnings` of `schemas/replay-1.json`."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        return {**plain, "events": [{**asdict(w), "spans_s": [list(s) for s in w.spans_s]} for w in self.events]}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self:
        """Build warnings from an entry that keeps the schema."""
        return cls(**{**document, "events": tuple(CollisionWarning.from_dict(e) for e in document["events"])})


VERSION = 1


@dataclass(frozen=True, eq=False)
class Commands:
    """Commands of a vehicle, each held over the step before its row.

    `AgentReplay.steer_rad` and `accel_mps2` hold what the actuators did.

    `pedal_mps2` (S,), m/s2: throttle (positive) or brake (negative). `steer_rad` (S,): at the road wheels, positive left.
    `gear` (S,): 1 forward, -1 reverse.
    """

    __repr__ = short_repr

    pedal_mps2: Array
    steer_rad: Array
    gear: NDArray[np.int8]

    COLUMNS = ("pedal_mps2", "steer_rad", "gear")


@dataclass(frozen=True, eq=False)
class AgentReplay:
    """States of one agent during its lifetime."""

    __repr__ = short_repr

    id: str
    category: str
    size_m: tuple[float, float, float]  # (3,), m: length, width, height
    driver: str  # "static" (one pose, two rows), "exact" (placed on its trajectory), "pid", "reactive" or "policy"
    model: str  # "none", "point", "kinematic", "dynamic", "single-track" or the name of an external simulator
    t_s: Array  # (S,), s
    x_m: Array  # (S,), m: box center, map frame; likewise `y_m`, `z_m`
    y_m: Array
    z_m: Array
    yaw_rad: Array  # (S,)
    speed_mps: Array  # (S,), m/s: along the heading
    steer_rad: Array  # (S,): at the road wheels; 0 for agents that do not steer
    accel_mps2: Array  # (S,), m/s2: along the heading
    flags: tuple[str, ...] = ()  # what in the scenario cannot be driven
    model_reason: str = ""  # why this model was chosen
    commands: Commands | None = None  # None without a vehicle model
    # (S,), m: distance from the scenario, left and ahead positive; None for static agents; likewise `along_track_m`.
    cross_track_m: Array | None = None
    along_track_m: Array | None = None

    COLUMNS = ("t_s", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "steer_rad", "accel_mps2")
    ERRORS = ("cross_track_m", "along_track_m")

    def __len__(self) -> int:
        """Return the number of stored states."""
        return len(self.t_s)


@dataclass(frozen=True, eq=False)
class Replay:
    """A replayed scenario."""

    scenario: str  # name of the scenario
    scenario_digest: str  # SHA-256 of its document
    mode: str  # as requested; likewise `model`
    model: str
    dt_s: float  # s: simulation step
    store_dt_s: float  # s: spacing of the stored states
    agents: tuple[AgentReplay, ...]
    metrics: Mapping[str, Any] = field(default_factory=dict)  # as in `schemas/replay-1.json`
    # Agents of the scenario's file that were left out before it was replayed: id and why.
    left_out: Mapping[str, str] = field(default_factory=dict)
    warnings: Warnings | None = None  # who was on a collision course with the ego, if that was asked for

    def __repr__(self) -> str:
        """Return scenario, mode, model and agents in one line."""
        count = len(self.agents)
        return f"<Replay of {self.scenario!r:.80}: {count} agent{'s' * (count != 1)}, mode {self.mode}, model {self.model}>"

    def _repr_html_(self) -> str | None:
        """Return what a notebook shows: models and collisions, and the paths from above."""
        return plugins.html_or_none(self)

    def agent(self, id: str) -> AgentReplay:
        """Return the agent with an id; `KeyError` when there is none."""
        return {agent.id: agent for agent in self.agents}[id]

    def save(self, path: Path | str) -> None:
        """Write the replay, whole or not at all."""
        document = self.to_dict()
        check(document, "replay-1", ScenarioError)
        write_json(path, document)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read and check a replay file; `ScenarioError` names the field that is wrong."""
        document = read_json(path, ScenarioError)
        try:
            return cls.from_dict(document)
        except ScenarioError as error:
            raise ScenarioError(f"{path}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """Return the document of `schemas/replay-1.json`."""
        plain = {k: getattr(self, k) for k in ("scenario", "scenario_digest", "mode", "model", "dt_s", "store_dt_s")}
        agents = []
        for a in self.agents:
            length, width, height = (float(v) for v in a.size_m)
            commands, errors = a.commands, AgentReplay.ERRORS if a.cross_track_m is not None else ()
            agents.append({
                "id": a.id, "category": a.category, "size_m": {"length": length, "width": width, "height": height},
                "driver": a.driver, "model": a.model, "model_reason": a.model_reason, "flags": list(a.flags),
                "states": {k: getattr(a, k).tolist() for k in AgentReplay.COLUMNS},
                "commands": commands and {k: getattr(commands, k).tolist() for k in Commands.COLUMNS},
                "errors": {k: getattr(a, k).tolist() for k in errors} or None,
            })  # fmt: skip
        document = {"replay_version": VERSION, **plain, "agents": agents, "metrics": dict(self.metrics)}
        warned = {} if self.warnings is None else {"warnings": self.warnings.to_dict()}
        return {**document, "left_out": dict(self.left_out), **warned}

    @classmethod
    def from_dict(cls, document: Any) -> Self:
        """Build a replay from a document, after checking it against the schema."""
        version = document.get("replay_version") if isinstance(document, dict) else None
        if version != VERSION:
            raise ScenarioError(f"replay_version is {version!r}, expected {VERSION}; is this a replay file of log2sim?")
        check(document, "replay-1", ScenarioError)
        agents = []
        for entry in document["agents"]:
            states = _columns(entry, "states", AgentReplay.COLUMNS)
            # Files written by 0.1.0 have neither commands nor errors.
            commands = _columns(entry, "commands", Commands.COLUMNS)
            if commands:
                commands["gear"] = commands["gear"].astype(np.int8)
            length, width, height = (float(entry["size_m"][key]) for key in ("length", "width", "height"))
            agents.append(AgentReplay(
                **{key: entry[key] for key in ("id", "category", "driver", "model")}, size_m=(length, width, height),
                flags=tuple(entry["flags"]), model_reason=entry.get("model_reason", ""),
                commands=Commands(**commands) if commands else None, **states,
                **_columns(entry, "errors", AgentReplay.ERRORS),
            ))  # fmt: skip

        # Older files only say whether the scenario has a collision, as `in_log`, and not whose each is.
        def owned(events: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
            return [{"belongs_to": "scenario" if e["in_log"] else "replay", **e} for e in events]

        metrics = dict(document["metrics"])
        metrics["by_agent"] = {k: {**m, "collisions": owned(m["collisions"])} for k, m in metrics["by_agent"].items()}
        metrics["collisions"] = owned(metrics["collisions"])
        if "conflicts" in metrics:
            metrics["conflicts"] = [
                {**c, "contact": "scenario" if c["contact"] == "log" else c["contact"]} for c in metrics["conflicts"]
            ]
        plain = {k: document[k] for k in ("scenario", "scenario_digest", "mode", "model", "dt_s", "store_dt_s")}
        warned = Warnings.from_dict(document["warnings"]) if "warnings" in document else None
        return cls(
            agents=tuple(agents), metrics=metrics, left_out=document.get("left_out", {}), warnings=warned, **plain
        )


def to_scenario(replay: Replay, scenario: Scenario) -> Scenario:
    """Return the scenario with its agents where the replay has them, to be evaluated, plotted or exported."""
    done = {a.id: a for a in replay.agents}
    agents = []
    for agent in (a for a in scenario.agents if a.id in done):
        r, w = done[agent.id], agent.waypoints
        waypoints = Waypoints(
            r.t_s, r.x_m, r.y_m, r.z_m, r.yaw_rad, r.speed_mps,
            observed=np.zeros(len(r), dtype=bool),
            sigma_xy_m=np.interp(r.t_s, w.t_s, w.sigma_xy_m),
        )  # fmt: skip
        agents.append(replace(agent, waypoints=waypoints))
    provenance = {**scenario.provenance, "replay": {"mode": replay.mode, "model": replay.model, "dt_s": replay.dt_s}}
    return replace(scenario, agents=tuple(agents), provenance=provenance, tags=None)


def _columns(entry: Mapping[str, Any], group: str, keys: Sequence[str]) -> dict[str, Any]:
    """Read the columns of a group, which must be as long as the times; none where the group is absent."""
    count = len(entry["states"]["t_s"])
    columns = {k: np.array(v, dtype=np.float64) for k, v in (entry.get(group) or {}).items() if k in keys}
    for key, values in columns.items():
        if len(values) != count:
            raise ScenarioError(f"agent '{entry['id']}': {group}.{key} has {len(values)} values, t_s has {count}")
    return columns
