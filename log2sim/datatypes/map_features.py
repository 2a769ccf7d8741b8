"""Map features: markings on the ground, borders of roads, and lanes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from log2sim.errors import ScenarioError
from log2sim.files.documents import from_entry, short_repr, to_entry
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
    inferred_from: str = "markings"  # one of `LANE_ORIGINS`
    confidence: float = 1.0  # probability that it is a lane, in this direction, in [0, 1]

    @property
    def neighbors(self) -> tuple[str, ...]:
        """Ids of all lanes that it refers to."""
        beside = (self.left_lane, self.right_lane, self.opposite)
        return (*self.predecessors, *self.successors, *(lane for lane in beside if lane is not None))


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
            for name, known, what in (
                *((name, lanes, "lane") for name in lane.neighbors),
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
