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
    """Paint on the ground.

    Attributes
    ----------
    id : str
        Unique among markings and borders.
    kind : str
        One of `MARKING_KINDS`.
    points_m : (N, 3) float64, m
        Map frame. Of lines, dashed ones included, the middle from end to end; of crosswalks and others the outline, whose
        first point is not repeated.
    width_m : float, m
        Of the line; of a crosswalk its extent along the road.
    color : str or None
        "white" or "yellow", None where unknown.
    confidence : float
        Probability that it is there, in [0, 1].
    sources : tuple of str
        What shows it: "camera", "lidar".
    """

    __repr__ = short_repr

    id: str
    kind: str
    points_m: Array
    width_m: float
    color: str | None = None
    confidence: float = 1.0
    sources: tuple[str, ...] = ()

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
    """Where a road ends at its side.

    Attributes
    ----------
    id : str
        Unique among markings and borders.
    kind : str
        One of `BORDER_KINDS`.
    points_m : (N, 3) float64, m
        Map frame.
    confidence : float
        Probability that it is there, in [0, 1].
    sources : tuple of str
        What shows it: "camera", "lidar".
    """

    __repr__ = short_repr

    id: str
    kind: str
    points_m: Array
    confidence: float = 1.0
    sources: tuple[str, ...] = ()

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
    """A lane in its driving direction.

    Attributes
    ----------
    id : str
        Unique among lanes.
    points_m : (N, 3) float64, m
        Center line, map frame.
    width_m : (N,) float64, m
    left, right : str or None
        Marking or border on that side.
    predecessors, successors : tuple of str
        Lanes before and behind it.
    left_lane, right_lane : str or None
        Lanes beside it in the same direction.
    opposite : str or None
        Lane beside it in the other direction.
    junction : str or None
        Junction that it crosses.
    inferred_from : str
        One of `LANE_ORIGINS`.
    confidence : float
        Probability that it is a lane, in this direction, in [0, 1].
    """

    __repr__ = short_repr

    id: str
    points_m: Array
    width_m: Array
    left: str | None = None
    right: str | None = None
    predecessors: tuple[str, ...] = ()
    successors: tuple[str, ...] = ()
    left_lane: str | None = None
    right_lane: str | None = None
    opposite: str | None = None
    junction: str | None = None
    inferred_from: str = "markings"
    confidence: float = 1.0

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

        Raises
        ------
        ScenarioError
            When it has not one width for each point.
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
    """What the ground shows, and the lanes on it.

    Attributes
    ----------
    notes : tuple of str
        What is not there, and why.
    """

    __repr__ = short_repr

    markings: tuple[Marking, ...] = ()
    borders: tuple[RoadBorder, ...] = ()
    lanes: tuple[MapLane, ...] = ()
    notes: tuple[str, ...] = ()

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

        Raises
        ------
        ScenarioError
            When an id occurs twice, or a lane names a lane, marking or border that is not there.
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
