"""The scenario: agents with their sizes and trajectories, as `scenario.json` holds them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from log2sim import late_functions
from log2sim.datatypes.agent import Agent, agent_from_dict, agent_to_dict
from log2sim.datatypes.ignore_regions import IgnoreRegions
from log2sim.datatypes.log import MapFrame
from log2sim.datatypes.map_features import MapFeatures
from log2sim.datatypes.signals import Signal
from log2sim.datatypes.waypoint_table import dataframe_of, dataset_of, write_parquet
from log2sim.documents import check, read_json, write_json
from log2sim.errors import ConfigError, ScenarioError
from log2sim.geometry import NS_PER_S, Array
from log2sim.registry import nearest

VERSION = 1
EGO = "ego"
"""Id of the ego."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """Road users with their trajectories, as simulators run them.

    Attributes
    ----------
    name : str
    t0_ns : int
        Absolute time of t_s = 0.
    duration_s : float, s
    agents : tuple of Agent
        The ego is the one with id `EGO`, if there is one.
    map : MapFrame
    cameras : tuple of mapping
        The cameras of the log with the homographies that were fitted.
    stages : tuple of mapping
        Stages of the reconstruction that were run or left out, each with its reason.
    provenance : mapping
        Log, settings and versions that the scenario came from.
    ignore_regions : IgnoreRegions or None
        Only in truth: where objects were left without labels; None when the labels are complete.
    map_features : MapFeatures or None
        Markings, borders and lanes; None where they were not looked for.
    signals : tuple of Signal
    """

    name: str
    t0_ns: int
    duration_s: float
    agents: tuple[Agent, ...]
    map: MapFrame = field(default_factory=MapFrame)
    cameras: tuple[Mapping[str, Any], ...] = ()
    stages: tuple[Mapping[str, Any], ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    ignore_regions: IgnoreRegions | None = None
    map_features: MapFeatures | None = None
    signals: tuple[Signal, ...] = ()

    def __repr__(self) -> str:
        """Return name, agents and duration in one line."""
        count = len(self.others)
        agents = f"{'the ego and ' * (self.ego is not None)}{count} {'other ' * (self.ego is not None)}agent{'s' * (count != 1)}"
        notes = [f"{len(self.doubtful)} doubtful"] * bool(self.doubtful)
        return f"<Scenario {self.name!r:.80}: {', '.join([agents, *notes, f'{self.duration_s:.1f} s'])}>"

    def _repr_html_(self) -> str | None:
        """Return what a notebook shows: the agents by category, and the tracks from above."""
        return late_functions.html_or_none(self)

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

    def without_doubtful(self) -> Scenario:
        """Return a copy without the doubtful agents; the ego stays."""
        return replace(self, agents=tuple(a for a in self.agents if a.id == EGO or not a.is_doubtful))

    def trusted(self, min_confidence: float) -> Scenario:
        """Return a copy with the agents whose confidence is at least `min_confidence`, in [0, 1]; the ego stays.

        Raises
        ------
        ConfigError
            When `min_confidence` is no number from 0 to 1.
        """
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
        """Read and check a scenario file.

        Raises
        ------
        ScenarioError
            When the file is missing, is not JSON, violates the schema or holds impossible values; it names the agent and
            the field.
        """
        document = read_json(path, ScenarioError)
        try:
            return cls.from_dict(document)
        except ScenarioError as error:
            raise ScenarioError(f"{path}: {error}") from None

    def shift_to(self, other: Scenario) -> Array:
        """Return the translation (3,), m, that brings positions of this scenario into the map of another.

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

    def aligned_to(self, other: Scenario) -> Scenario:
        """Return a copy in another scenario's time and map, to show or compare both.

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
            doubts = tuple(doubt.retimed(lambda t_s: t_s + later_s) for doubt in agent.doubts)
            moved.append(replace(agent, waypoints=w, doubts=doubts))
        shift = np.array([dx, dy, dz])
        features = None if self.map_features is None else self.map_features.moved(lambda points_m: points_m + shift)
        signals = tuple(replace(s, position_m=s.position_m + shift, t_s=s.t_s + later_s) for s in self.signals)
        placed = replace(self, map_features=features, signals=signals)
        return replace(placed, t0_ns=other.t0_ns, map=other.map, agents=tuple(moved))

    def save(self, path: Path | str) -> None:
        """Write the scenario atomically; `load` returns exactly the same numbers.

        Raises
        ------
        ScenarioError
            When it violates the schema.
        """
        document = self.to_dict()
        check(document, "scenario-1", ScenarioError)
        write_json(path, document)

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with one row for each agent and waypoint, ordered by agent and time.

        Columns: `agent`, `category`, `t_s`, `x_m`, `y_m`, `z_m` (center of the box, map frame), `yaw_rad`, `speed_mps`,
        `observed`, `sigma_xy_m`, `sigma_yaw_rad`, `sigma_speed_mps` (NaN where not known), `length_m`, `width_m`,
        `height_m`, `static`, `confidence`, `doubts` (the flags, joined by commas). `attrs` hold name and start of the scenario.

        Raises
        ------
        MissingExtra
            When pandas is not installed.
        """
        return dataframe_of(self.agents, {"name": self.name, "t0_ns": int(self.t0_ns)})

    def to_xarray(self) -> Any:
        """Return an xarray Dataset: the columns of `to_dataframe` along `agent` and, where they change with it, `t_s`.

        Times are those of all waypoints; numbers are NaN and `observed` is False where an agent has no waypoint at a time, as
        static agents with a single one at all others.

        Raises
        ------
        MissingExtra
            When xarray is not installed.
        """
        return dataset_of(self.agents, {"name": self.name, "t0_ns": int(self.t0_ns)})

    def to_parquet(self, path: Path | str) -> None:
        """Write the rows of `to_dataframe` as a Parquet file, atomically; its schema states unit and meaning of each column.

        Raises
        ------
        MissingExtra
            When pyarrow is not installed.
        ConfigError
            When the file cannot be written.
        """
        write_parquet(self.agents, {"name": self.name, "t0_ns": int(self.t0_ns)}, Path(path))

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
            document["signals"] = [signal.to_dict() for signal in self.signals]
        return document

    @classmethod
    def from_dict(cls, document: Any) -> Scenario:
        """Build a scenario from a document.

        Raises
        ------
        ScenarioError
            When it violates the schema or holds impossible values.
        """
        version = document.get("scenario_version") if isinstance(document, dict) else None
        if version != VERSION:
            raise ScenarioError(
                f"scenario_version is {version!r}, expected {VERSION}; is this a scenario file of log2sim?"
            )
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
            signals=tuple(Signal.from_dict(entry) for entry in document.get("signals", ())),
        )
        for what, items in (("agent", scenario.agents), ("signal", scenario.signals)):
            seen: set[str] = set()
            for item in items:
                if item.id in seen:
                    raise ScenarioError(f"{what} '{item.id}': the id occurs twice; ids must be unique")
                seen.add(item.id)
        return scenario
