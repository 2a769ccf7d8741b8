"""The scenario: agents, map features and signals, as `scenario.json` holds it."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes.agent import Agent, agent_from_dict, agent_to_dict
from log2sim.datatypes.log import IgnoreRegions, MapFrame
from log2sim.errors import ConfigError, MissingExtra, ScenarioError
from log2sim.files import plugins
from log2sim.files.documents import check, from_entry, kind_of, read_json, replaced, short_repr, to_entry, write_json
from log2sim.files.plugins import nearest
from log2sim.geometry import NS_PER_S, Array

BORDER_KINDS = ("curb", "edge")
"""Kinds of road borders: a step in height, or where asphalt ends."""


@dataclass(frozen=True, eq=False)
class Marking:
    """Paint on the ground."""

    __repr__ = short_repr

    id: str  # unique among markings and borders
    kind: str  # "solid" or "dashed" lane line, "stop_line", "crosswalk", or "other" for arrows and letters
    # (N, 3), m: map frame. Of lines, also dashed, the middle from end to end; of others the outline, its first point once
    points_m: Array
    width_m: float  # m: of the line; of others their lesser extent
    color: str | None = None  # "white" or "yellow", None where unknown
    confidence: float = 1.0  # probability that it is there, in [0, 1]
    sources: tuple[str, ...] = ()  # what shows it: "camera", "lidar"

    @property
    def is_lane_line(self) -> bool:
        """Whether it runs along lanes."""
        return self.kind in ("solid", "dashed")


@dataclass(frozen=True, eq=False)
class RoadBorder:
    """Where a road ends at its side."""

    __repr__ = short_repr

    id: str  # unique among markings and borders
    kind: str  # one of `BORDER_KINDS`
    points_m: Array  # (N, 3), m: map frame
    confidence: float = 1.0  # probability that it is there, in [0, 1]
    sources: tuple[str, ...] = ()  # what shows it: "camera", "lidar"


@dataclass(frozen=True, eq=False)
class MapLane:
    """A lane in its driving direction."""

    __repr__ = short_repr

    id: str  # unique among lanes
    points_m: Array  # (N, 3), m: center line, map frame
    width_m: Array  # (N,), m
    left: str | None = None  # marking or border on that side
    right: str | None = None
    predecessors: tuple[str, ...] = ()
    successors: tuple[str, ...] = ()
    left_lane: str | None = None  # lanes beside it in the same direction
    right_lane: str | None = None
    opposite: str | None = None  # lane beside it in the other direction
    junction: str | None = None  # junction that it crosses
    inferred_from: str = "markings"  # or "paths", or "both"
    confidence: float = 1.0  # probability that it is a lane, in this direction, in [0, 1]


@dataclass(frozen=True, eq=False)
class MapFeatures:
    """What the ground shows, and the lanes on it."""

    __repr__ = short_repr

    markings: tuple[Marking, ...] = ()
    borders: tuple[RoadBorder, ...] = ()
    lanes: tuple[MapLane, ...] = ()
    notes: tuple[str, ...] = ()  # what is not there, and why

    def __bool__(self) -> bool:
        """Whether there is any feature."""
        return bool(self.markings or self.borders or self.lanes)

    def moved(self, change: Callable[[Array], Array]) -> MapFeatures:
        """Return the features with all points (N, 3) put elsewhere by `change`, which keeps lengths."""

        def apply(items: Sequence[Any]) -> tuple[Any, ...]:
            return tuple(replace(item, points_m=change(item.points_m)) for item in items)

        return replace(self, markings=apply(self.markings), borders=apply(self.borders), lanes=apply(self.lanes))

    def to_dict(self) -> dict[str, Any]:
        """Return the part `map_features` of a document of `schemas/scenario-1.json`."""
        return {
            **{name: [to_entry(item) for item in getattr(self, name)] for name in ("markings", "borders", "lanes")},
            "notes": list(self.notes),
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> MapFeatures:
        """Build them from a part of a document that keeps the schema.

        Raises `ScenarioError` when an id occurs twice, or a lane has not one width for each point or names a lane, marking or border that is not there.
        """
        features = cls(
            tuple(from_entry(Marking, entry) for entry in document["markings"]),
            tuple(from_entry(RoadBorder, entry) for entry in document["borders"]),
            tuple(from_entry(MapLane, entry) for entry in document["lanes"]),
            tuple(document["notes"]),
        )
        sides = unique_ids("marking or border", (*features.markings, *features.borders))
        lanes = unique_ids("lane", features.lanes)
        for lane in features.lanes:
            if len(lane.points_m) != len(lane.width_m):
                raise ScenarioError(
                    f"lane '{lane.id}': width_m has {len(lane.width_m)} values for {len(lane.points_m)} points, expected equal"
                )
            beside = (lane.left_lane, lane.right_lane, lane.opposite)
            for name, known, what in (
                *((name, lanes, "lane") for name in (*lane.predecessors, *lane.successors)),
                *((name, lanes, "lane") for name in beside if name is not None),
                *((name, sides, "marking or border") for name in (lane.left, lane.right) if name is not None),
            ):
                if name not in known:
                    raise ScenarioError(f"lane '{lane.id}': names the {what} '{name}', which is not there")
        return features


def unique_ids(what: str, items: Sequence[Any]) -> set[str]:
    """Return the ids of items; raises `ScenarioError` for one that occurs twice."""
    seen: set[str] = set()
    for item in items:
        if item.id in seen:
            raise ScenarioError(f"{what} '{item.id}': the id occurs twice; ids must be unique")
        seen.add(item.id)
    return seen


@dataclass(frozen=True, eq=False)
class Signal:
    """A signal head of a traffic light."""

    __repr__ = short_repr

    id: str
    position_m: Array  # (3,), m: middle of its housing, map frame
    heading_rad: float | None  # direction that its lamps face, None where unknown
    t_s: Array  # (T,), s: strictly increasing times at which its state changes; the last state lasts to the end of the scenario
    # (T,), from each time on: "red", "red_yellow", "yellow", "green", "off" (no lamp is lit), "unknown" (no camera shows it)
    state: NDArray[np.str_]
    sigma_m: float = 0.0  # m: standard deviation of the position along the axis on which it is largest
    confidence: float = 1.0  # probability that it is a traffic light, there, in [0, 1]
    cameras: tuple[str, ...] = ()  # that saw it

    def at(self, t_s: ArrayLike) -> NDArray[np.str_]:
        """Return its states (T,) at times (T,); unknown before its first time."""
        k = np.searchsorted(self.t_s, np.atleast_1d(np.asarray(t_s, dtype=np.float64)), side="right") - 1
        return np.asarray(np.where(k >= 0, self.state[np.maximum(k, 0)], "unknown"))


TAGS: Mapping[str, str] = {
    "in_lane": "is in a lane of the map",
    "lane_change": "changes to a lane beside it",
    "turning": "turns by at least 60 degrees, to the left where angle_rad is positive",
    "u_turn": "turns back",
    "starting": "starts from standstill",
    "stopping": "brakes to standstill",
    "standing": "stands; it moves at another time",
    "standing_at_light": "stands before a traffic light that is red or yellow",
    "standing_at_crosswalk": "stands before a crosswalk",
    "hard_braking": "brakes harder than is comfortable",
    "following": "drives behind the other in its lane, about as fast",
    "approaching": "comes nearer to the other, which is ahead in its lane",
    "cut_in": "changes into the lane of the other, ahead of it",
    "cut_out": "leaves the lane of the other, which it was ahead of",
    "merging": "turns into the lane of the other, ahead of it, from another road",
    "overtaking": "passes the other, which moves in the same direction",
    "crossing_path": "crosses the path of the other",
    "turning_across": "turns across the path of the other, which is oncoming",
    "oncoming_in_lane": "comes toward the other in its lane",
    "stepping_out": "walks into the path of the other from where something hid it",
    "near_miss": "comes so near to the other that little is missing to a collision",
}
"""What a tag says of its agent, and of the other where there is one."""


@dataclass(frozen=True)
class Tag:
    """What an agent does during a time."""

    tag: str  # one of `TAGS`
    agent: str  # id of who does it
    start_s: float
    t_s: float  # the moment that `quantities` are of
    end_s: float
    probability: float  # that it is so, by the standard deviations and the confidence of the agents, in [0, 1]
    other: str | None = None  # id of the agent that it is done to
    lane: str | None = None  # the lane that the agent is in then, or changes to
    # What defines it, in SI units, which the names end with
    quantities: Mapping[str, float] = field(default_factory=dict)


COLUMNS: dict[str, tuple[str, str]] = {
    "agent": ("", "id of the agent"),
    "category": ("", "category of the agent"),
    "t_s": ("s", "time since the start of the scenario"),
    "x_m": ("m", "center of the box, map frame, east"),
    "y_m": ("m", "center of the box, map frame, north"),
    "z_m": ("m", "center of the box, map frame, up"),
    "yaw_rad": ("rad", "heading, counter-clockwise from +x"),
    "speed_mps": ("m/s", "along the heading, negative when reversing"),
    "observed": ("", "false where a gap was filled"),
    "sigma_xy_m": ("m", "standard deviation of the position"),
    "sigma_yaw_rad": ("rad", "standard deviation of the heading, NaN where not known"),
    "sigma_speed_mps": ("m/s", "standard deviation of the speed, NaN where not known"),
    "length_m": ("m", "size of the agent"),
    "width_m": ("m", "size of the agent"),
    "height_m": ("m", "size of the agent"),
    "static": ("", "whether the agent never moves"),
    "confidence": ("1", "probability that the agent is right"),
    "doubts": ("", "flags of what speaks against the agent, joined by commas"),
}
"""Unit and meaning of each column."""

TEXTS, FLAGS = ("agent", "category", "doubts"), ("observed", "static")
PER_AGENT = ("category", "length_m", "width_m", "height_m", "static", "confidence", "doubts")


def columns_of(agents: Sequence[Agent]) -> dict[str, NDArray[Any]]:
    """Return the columns (R,) with one row for each agent and waypoint, in the order of the agents."""
    parts = []
    for agent in agents:
        known, (length, width, height) = agent.waypoints.columns(), agent.size_m
        doubts = ",".join(dict.fromkeys(doubt.kind for doubt in agent.doubts))
        same: dict[str, Any] = {
            "agent": agent.id, "category": agent.category, "length_m": length, "width_m": width, "height_m": height,
            "static": agent.static, "confidence": agent.confidence, "doubts": doubts, "sigma_yaw_rad": np.nan,
            "sigma_speed_mps": np.nan,
        }  # fmt: skip
        rows = len(agent.waypoints)
        parts.append({k: known[k] if k in known else np.full(rows, same[k], dtype=_kind(k)) for k in COLUMNS})
    return {key: np.concatenate([np.zeros(0, _kind(key)), *(part[key] for part in parts)]) for key in COLUMNS}


def _kind(key: str) -> Any:
    return object if key in TEXTS else bool if key in FLAGS else np.float64


VERSION = 1
EGO = "ego"
"""Id of the ego."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """Road users with their trajectories, as simulators run them."""

    name: str
    t0_ns: int  # absolute time of t_s = 0
    duration_s: float
    agents: tuple[Agent, ...]  # the ego is the one with id `EGO`, if there is one
    map: MapFrame = field(default_factory=MapFrame)
    cameras: tuple[Mapping[str, Any], ...] = ()  # those of the log with the homographies that were fitted
    stages: tuple[Mapping[str, Any], ...] = ()  # of the reconstruction that were run or left out, each with its reason
    provenance: Mapping[str, Any] = field(default_factory=dict)  # log, settings and versions that it came from
    # Only in truth: where objects were left without labels; None when the labels are complete
    ignore_regions: IgnoreRegions | None = None
    map_features: MapFeatures | None = None  # markings, borders and lanes; None where they were not looked for
    signals: tuple[Signal, ...] = ()
    sensors: tuple[Mapping[str, Any], ...] = ()
    tags: tuple[Tag, ...] | None = None  # what its road users do; None where that was not looked for

    def __repr__(self) -> str:
        """Return name, agents and duration in one line."""
        count = len(self.others)
        agents = f"{'the ego and ' * (self.ego is not None)}{count} {'other ' * (self.ego is not None)}agent{'s' * (count != 1)}"
        notes = [f"{len(self.doubtful)} doubtful"] * bool(self.doubtful)
        return f"<Scenario {self.name!r:.80}: {', '.join([agents, *notes, f'{self.duration_s:.1f} s'])}>"

    def _repr_html_(self) -> str | None:
        """Return what a notebook shows: the agents by category, and the tracks from above."""
        return plugins.html_or_none(self)

    def __getitem__(self, id: str) -> Agent:
        """Return an agent by its id, as in `scenario["car-1"]`; raises `KeyError` where there is none."""
        found = next((a for a in self.agents if a.id == id), None)
        if found is None:
            raise KeyError(f"no agent {id!r}{nearest(str(id), list(self))}; `for id in scenario` goes over their ids")
        return found

    def __iter__(self) -> Iterator[str]:
        """Go over the ids of the agents."""
        return (a.id for a in self.agents)

    @property
    def ego(self) -> Agent | None:
        """Return the ego, None without one."""
        return next((a for a in self.agents if a.id == EGO), None)

    @property
    def others(self) -> tuple[Agent, ...]:
        """Return all agents except the ego."""
        return tuple(a for a in self.agents if a.id != EGO)

    @property
    def is_reconstruction(self) -> bool:
        """Whether it is what a reconstruction says of a log, and neither edited nor replayed since."""
        history = self.provenance.get("history")
        made = isinstance(history, list) and "reconstruct" in history
        return made and not {"edits", "replay"} & self.provenance.keys()

    @property
    def doubtful(self) -> tuple[Agent, ...]:
        """Return the agents that are doubtful, see `Agent.is_doubtful`."""
        return tuple(a for a in self.agents if a.is_doubtful)

    @property
    def active(self) -> Scenario:
        """Return a copy without the quarantined agents, as replays and exports take it; itself where there are none."""
        if not any(a.quarantined for a in self.agents):
            return self
        return replace(self, agents=tuple(a for a in self.agents if not a.quarantined))

    def drop_doubtful(self) -> Scenario:
        """Return a copy without the doubtful agents; the ego stays."""
        return replace(self, agents=tuple(a for a in self.agents if a.id == EGO or not a.is_doubtful))

    def trusted(self, min_confidence: float) -> Scenario:
        """Return a copy with the agents whose confidence is at least `min_confidence`, from 0 to 1, and the ego."""
        if not 0 <= min_confidence <= 1:
            raise ConfigError(f"confidence: {min_confidence:g}, expected a number from 0 to 1")
        return replace(self, agents=tuple(a for a in self.agents if a.id == EGO or a.confidence >= min_confidence))

    @property
    def digest(self) -> str:
        """Return the SHA-256 of the document, by which replays and edits name their source."""
        document = json.dumps(self.to_dict(), sort_keys=True, ensure_ascii=False)
        return hashlib.sha256(document.encode()).hexdigest()

    @classmethod
    def load(cls, path: Path | str) -> Scenario:
        """Read and check a scenario file; `ScenarioError` names the agent and the field that are wrong."""
        document = read_json(path, ScenarioError)
        try:
            return cls.from_dict(document)
        except ScenarioError as error:
            raise ScenarioError(f"{path}: {error}") from None

    def shift_to(self, other: Scenario) -> Array:
        """Return the translation (3,), m, that brings positions of this scenario into the map of another.

        Raises `ScenarioError` when their maps have different projections.
        """
        theirs, ours = other.map, self.map
        if theirs.projection and ours.projection and theirs.projection != ours.projection:
            raise ScenarioError(
                f"map.projection: '{other.name}' has '{theirs.projection}', '{self.name}' has '{ours.projection}'; "
                "bring both to one projection first"
            )
        return np.array(ours.offset_m, dtype=np.float64) - np.array(theirs.offset_m, dtype=np.float64)

    def aligned_to(self, other: Scenario) -> Scenario:
        """Return a copy in another scenario's time and map, to show or compare both.

        Raises `ScenarioError` when their maps have different projections.
        """
        later_s = (self.t0_ns - other.t0_ns) / NS_PER_S
        dx, dy, dz = self.shift_to(other)
        moved = []
        for agent in self.agents:
            w = agent.waypoints
            w = replace(w, t_s=w.t_s + later_s, x_m=w.x_m + dx, y_m=w.y_m + dy, z_m=w.z_m + dz)
            doubts = tuple(doubt.retimed(lambda t_s: t_s + later_s) for doubt in agent.doubts)
            moved.append(replace(agent, waypoints=w, doubts=doubts))
        shift = np.array([dx, dy, dz])
        features = None if self.map_features is None else self.map_features.moved(lambda points_m: points_m + shift)
        signals = tuple(replace(s, position_m=s.position_m + shift, t_s=s.t_s + later_s) for s in self.signals)
        by_axis = {"x_m": dx, "y_m": dy, "z_m": dz}
        sensors = tuple({**s, **{k: s[k] + d for k, d in by_axis.items()}} for s in self.sensors)
        tags = self.tags and tuple(
            replace(g, **{k: getattr(g, k) + later_s for k in ("start_s", "t_s", "end_s")}) for g in self.tags
        )
        placed = replace(self, map_features=features, signals=signals, sensors=sensors, tags=tags)
        return replace(placed, t0_ns=other.t0_ns, map=other.map, agents=tuple(moved))

    def save(self, path: Path | str) -> None:
        """Write the scenario atomically; `load` returns exactly the same numbers.

        Raises `ScenarioError` when it violates the schema.
        """
        document = self.to_dict()
        check(document, "scenario-1", ScenarioError)
        write_json(path, document)

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with one row for each agent and waypoint, ordered by agent and time.

        Columns: `agent`, `category`, `t_s`, `x_m`, `y_m`, `z_m` (center of the box, map frame), `yaw_rad`, `speed_mps`,
        `observed`, `sigma_xy_m`, `sigma_yaw_rad`, `sigma_speed_mps` (NaN where not known), `length_m`, `width_m`,
        `height_m`, `static`, `confidence`, `doubts` (the flags, joined by commas). `attrs` hold name and start of the scenario.

        Raises `MissingExtra` when pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise MissingExtra("to_dataframe", "dataframe") from None
        frame = pd.DataFrame(columns_of(self.agents))
        frame.attrs = {"name": self.name, "t0_ns": int(self.t0_ns)}
        return frame

    def to_xarray(self) -> Any:
        """Return an xarray Dataset: the columns of `to_dataframe` along `agent` and, where they change with it, `t_s`.

        Times are those of all waypoints; numbers are NaN and `observed` is False where an agent has no waypoint at a time, as
        static agents with a single one at all others.

        Raises `MissingExtra` when xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise MissingExtra("to_xarray", "xarray") from None
        agents, columns = self.agents, columns_of(self.agents)
        t_s, tick = np.unique(columns["t_s"], return_inverse=True)
        counts = [len(agent.waypoints) for agent in agents]
        row = np.repeat(np.arange(len(agents)), counts)
        first = np.cumsum([0, *counts[:-1]]) if agents else np.zeros(0, dtype=np.intp)
        along: dict[str, Any] = {}
        for key, (unit, meaning) in COLUMNS.items():
            values, about = columns[key], {"units": unit, "description": meaning}
            if key in PER_AGENT:
                along[key] = ("agent", values[first], about)
            elif key not in ("agent", "t_s"):
                table = np.full((len(agents), len(t_s)), False if key in FLAGS else np.nan)
                table[row, tick] = values
                along[key] = (("agent", "t_s"), table, about)
        times = ("t_s", t_s, {"units": "s", "description": COLUMNS["t_s"][1]})
        coordinates = {"agent": [agent.id for agent in agents], "t_s": times}
        return xarray.Dataset(along, coords=coordinates, attrs={"name": self.name, "t0_ns": int(self.t0_ns)})

    def to_parquet(self, path: Path | str) -> None:
        """Write the rows of `to_dataframe` as a Parquet file, atomically; its schema states unit and meaning of each column.

        Raises `MissingExtra` when pyarrow is not installed; `ConfigError` when the file cannot be written.
        """
        try:
            import pyarrow as pa
            import pyarrow.parquet as pq
        except ImportError:
            raise MissingExtra("to_parquet", "parquet") from None
        columns = columns_of(self.agents)
        kinds = {key: pa.string() if key in TEXTS else pa.bool_() if key in FLAGS else pa.float64() for key in COLUMNS}
        fields = [
            pa.field(key, kinds[key], nullable=False, metadata={"unit": unit, "description": meaning})
            for key, (unit, meaning) in COLUMNS.items()
        ]
        schema = pa.schema(fields, metadata={"name": self.name, "t0_ns": str(int(self.t0_ns))})
        table = pa.table([pa.array(columns[key].tolist(), kinds[key]) for key in COLUMNS], schema=schema)
        with replaced(path) as temporary:
            pq.write_table(table, temporary)

    def to_dict(self) -> dict[str, Any]:
        """Return the document of `schemas/scenario-1.json`."""
        m = self.map
        document: dict[str, Any] = {
            "scenario_version": VERSION,
            "name": self.name,
            "t0_ns": int(self.t0_ns),
            "duration_s": float(self.duration_s),
            "map": {
                "frame": "enu" if m.projection is not None else "local",
                "position": "box_center",
                "latitude_deg": m.latitude_deg,
                "longitude_deg": m.longitude_deg,
                "altitude_m": m.altitude_m,
                "projection": m.projection,
                "offset_m": list(m.offset_m),
            },
            "agents": [agent_to_dict(a) for a in self.agents],
            "cameras": [dict(c) for c in self.cameras],
            "stages": [dict(stage) for stage in self.stages],
            "provenance": dict(self.provenance),
        }
        if self.ignore_regions is not None:
            document["unlabeled"] = self.ignore_regions.to_dict()
        if self.map_features is not None:
            document["map_features"] = self.map_features.to_dict()
        if self.signals:
            document["signals"] = [to_entry(signal) for signal in self.signals]
        if self.sensors:
            document["sensors"] = [dict(sensor) for sensor in self.sensors]
        if self.tags is not None:
            document["tags"] = [to_entry(tag) for tag in self.tags]
        return document

    @classmethod
    def from_dict(cls, document: Any) -> Scenario:
        """Build a scenario from a document; `ScenarioError` when it violates the schema or holds impossible values."""
        version = document.get("scenario_version") if isinstance(document, dict) else None
        if version is None:
            kind = kind_of(document)
            raise ScenarioError(f"is no scenario file of log2sim{f', but a {kind} file' if kind else ''}")
        if version != VERSION:
            raise ScenarioError(f"scenario_version is {version!r}, expected {VERSION}")
        if "plan" in document and "stages" not in document:  # their name in files up to version 0.1
            document = {**document, "stages": document["plan"]}
            del document["plan"]
        check(document, "scenario-1", ScenarioError)
        m = document["map"]
        scenario = cls(
            name=document["name"],
            t0_ns=document["t0_ns"],
            duration_s=float(document["duration_s"]),
            agents=tuple(agent_from_dict(a) for a in document["agents"]),
            map=MapFrame(m["latitude_deg"], m["longitude_deg"], m["altitude_m"], m["projection"], tuple(m["offset_m"])),
            cameras=tuple(document["cameras"]),
            stages=tuple(document["stages"]),
            provenance=document["provenance"],
            ignore_regions=IgnoreRegions.from_dict(document["unlabeled"]) if "unlabeled" in document else None,
            map_features=MapFeatures.from_dict(document["map_features"]) if "map_features" in document else None,
            signals=tuple(from_entry(Signal, entry) for entry in document.get("signals", ())),
            sensors=tuple(document.get("sensors", ())),
            tags=tuple(Tag(**entry) for entry in document["tags"]) if "tags" in document else None,
        )
        for signal in scenario.signals:
            if len(signal.t_s) != len(signal.state):
                raise ScenarioError(f"signal '{signal.id}': {len(signal.t_s)} times for {len(signal.state)} states")
            if np.any(np.diff(signal.t_s) <= 0):
                raise ScenarioError(f"signal '{signal.id}': t_s does not increase")
        unique_ids("agent", scenario.agents)
        unique_ids("signal", scenario.signals)
        return scenario


PLURALS = {"bus": "buses", "other": "others"}


def count_agents(ids: Iterable[str]) -> str:
    """Count agents by their ids, as all commands do: "12 agents and the ego", "1 agent", "no agent but the ego"."""
    listed = list(ids)
    others = sum(id != EGO for id in listed)
    if EGO not in listed:
        return f"{others} agent{'s' * (others != 1)}"
    return f"{others} agent{'s' * (others != 1)} and the ego" if others else "no agent but the ego"


def count_categories(agents: Sequence[Agent]) -> str:
    """Count agents by category, most frequent first, with how many of each are static: "8 cars (3 static), 1 bus"."""
    total, static = Counter(a.category for a in agents), Counter(a.category for a in agents if a.static)
    parts = []
    for category, count in sorted(total.items(), key=lambda entry: (-entry[1], entry[0])):
        noun = category if count == 1 else PLURALS.get(category, f"{category}s")
        parts.append(f"{count} {noun}" + (f" ({static[category]} static)" if static[category] else ""))
    return ", ".join(parts)
