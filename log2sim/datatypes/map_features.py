"""Map features: markings on the ground, borders of roads, and lanes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from log2sim.errors import ScenarioError
from log2sim.files.documents import short_repr
from log2sim.geometry import Array

MARKING_KINDS = ("solid", "dashed", "stop_line", "crosswalk", "other")
"""Kinds of markings; lane lines are the first two, arrows and letters are "other"."""
LANE_LINE_KINDS = ("solid", "dashed")
BORDER_KINDS = ("curb", "edge")
"""Kinds of road borders: a step in height, or where asphalt ends."""
LANE_ORIGINS = ("markings", "paths", "both")
"""What lanes are inferred from."""


@dataclass(frozen=True, eq=False)
class Marking:
    """Paint on the ground."""

    __repr__ = short_repr

    id: str  # unique among markings and borders
    kind: str  # one of `MARKING_KINDS`
    # (N, 3), m: map frame. Of lines, dashed ones included, the middle from end to end; of crosswalks and others the outline, whose
    # first point is not repeated.
    points_m: Array
    width_m: float  # m: of the line; of a crosswalk its extent along the road
    color: str | None = None  # "white" or "yellow", None where unknown
    confidence: float = 1.0  # probability that it is there, in [0, 1]
    sources: tuple[str, ...] = ()  # what shows it: "camera", "lidar"

    @property
    def is_lane_line(self) -> bool:
        """Whether it runs along lanes."""
        return self.kind in LANE_LINE_KINDS

    def to_dict(self) -> dict[str, Any]:
        """Return the entry in a document of `schemas/scenario-1.json`."""
        return {
            "id": self.id,
            "kind": self.kind,
            "points_m": self.points_m.tolist(),
            "width_m": float(self.width_m),
            "color": self.color,
            "confidence": float(self.confidence),
            "sources": list(self.sources),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Marking:
        """Read an entry that keeps the schema."""
        return cls(
            entry["id"],
            entry["kind"],
            np.array(entry["points_m"], dtype=np.float64),
            float(entry["width_m"]),
            entry["color"],
            float(entry["confidence"]),
            tuple(entry["sources"]),
        )


@dataclass(frozen=True, eq=False)
class RoadBorder:
    """Where a road ends at its side."""

    __repr__ = short_repr

    id: str  # unique among markings and borders
    kind: str  # one of `BORDER_KINDS`
    points_m: Array  # (N, 3), m: map frame
    confidence: float = 1.0  # probability that it is there, in [0, 1]
    sources: tuple[str, ...] = ()  # what shows it: "camera", "lidar"

    def to_dict(self) -> dict[str, Any]:
        """Return the entry in a document of `schemas/scenario-1.json`."""
        return {
            "id": self.id,
            "kind": self.kind,
            "points_m": self.points_m.tolist(),
            "confidence": float(self.confidence),
            "sources": list(self.sources),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> RoadBorder:
        """Read an entry that keeps the schema."""
        points_m = np.array(entry["points_m"], dtype=np.float64)
        return cls(entry["id"], entry["kind"], points_m, float(entry["confidence"]), tuple(entry["sources"]))


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
    inferred_from: str = "markings"  # one of `LANE_ORIGINS`
    confidence: float = 1.0  # probability that it is a lane, in this direction, in [0, 1]

    @property
    def neighbors(self) -> tuple[str, ...]:
        """Ids of all lanes that it refers to."""
        beside = (self.left_lane, self.right_lane, self.opposite)
        return (*self.predecessors, *self.successors, *(lane for lane in beside if lane is not None))

    def to_dict(self) -> dict[str, Any]:
        """Return the entry in a document of `schemas/scenario-1.json`."""
        return {
            "id": self.id,
            "points_m": self.points_m.tolist(),
            "width_m": self.width_m.tolist(),
            "left": self.left,
            "right": self.right,
            "predecessors": list(self.predecessors),
            "successors": list(self.successors),
            "left_lane": self.left_lane,
            "right_lane": self.right_lane,
            "opposite": self.opposite,
            "junction": self.junction,
            "inferred_from": self.inferred_from,
            "confidence": float(self.confidence),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> MapLane:
        """Read an entry that keeps the schema.

        Raises `ScenarioError` when it has not one width for each point.
        """
        points_m, width_m = (np.array(entry[key], dtype=np.float64) for key in ("points_m", "width_m"))
        if len(points_m) != len(width_m):
            raise ScenarioError(
                f"lane '{entry['id']}': width_m has {len(width_m)} values for {len(points_m)} points, expected equal"
            )
        return cls(
            entry["id"],
            points_m,
            width_m,
            predecessors=tuple(entry["predecessors"]),
            successors=tuple(entry["successors"]),
            inferred_from=entry["inferred_from"],
            confidence=float(entry["confidence"]),
            **{key: entry[key] for key in ("left", "right", "left_lane", "right_lane", "opposite", "junction")},
        )


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
            "markings": [marking.to_dict() for marking in self.markings],
            "borders": [border.to_dict() for border in self.borders],
            "lanes": [lane.to_dict() for lane in self.lanes],
            "notes": list(self.notes),
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> MapFeatures:
        """Build them from a part of a document that keeps the schema.

        Raises `ScenarioError` when an id occurs twice, or a lane names a lane, marking or border that is not there.
        """
        features = cls(
            tuple(Marking.from_dict(entry) for entry in document["markings"]),
            tuple(RoadBorder.from_dict(entry) for entry in document["borders"]),
            tuple(MapLane.from_dict(entry) for entry in document["lanes"]),
            tuple(document["notes"]),
        )
        features._require_known_ids()
        return features

    def _require_known_ids(self) -> None:
        sides = _unique_ids("marking or border", (*self.markings, *self.borders))
        lanes = _unique_ids("lane", self.lanes)
        for lane in self.lanes:
            for name, known, what in (
                *((name, lanes, "lane") for name in lane.neighbors),
                *((name, sides, "marking or border") for name in (lane.left, lane.right) if name is not None),
            ):
                if name not in known:
                    raise ScenarioError(f"lane '{lane.id}': names the {what} '{name}', which is not there")


def _unique_ids(what: str, items: Sequence[Any]) -> set[str]:
    seen: set[str] = set()
    for item in items:
        if item.id in seen:
            raise ScenarioError(f"{what} '{item.id}': the id occurs twice; ids must be unique")
        seen.add(item.id)
    return seen
