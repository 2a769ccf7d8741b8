"""Road marks of lanes, as OpenDRIVE names them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from log2sim.datatypes import MapLane, Marking, RoadBorder, Scenario

USUAL_WIDTH_M = 0.12
"""Of lane lines: 12 cm on most roads (RMS 1993)."""


@dataclass(frozen=True)
class RoadMark:
    """A mark at the edge of a lane: its kind, "solid", "broken", "curb" or "none", color and width."""

    kind: str
    color: str = "standard"
    width_m: float = USUAL_WIDTH_M


@dataclass(frozen=True)
class MarkFinder:
    """Finds the marks at the edges of lanes among markings and borders by their ids."""

    sides: Mapping[str, Marking | RoadBorder]

    @classmethod
    def of(cls, scenario: Scenario) -> MarkFinder:
        """Collect the markings and borders of a scenario."""
        features = scenario.map_features
        found: dict[str, Marking | RoadBorder] = {}
        if features is not None:
            found |= {marking.id: marking for marking in features.markings}
            found |= {border.id: border for border in features.borders}
        return cls(found)

    def left_of(self, lane: MapLane) -> RoadMark:
        """Return the mark at the left edge of a lane."""
        return self._mark(lane.left)

    def right_of(self, lane: MapLane) -> RoadMark:
        """Return the mark at the right edge of a lane."""
        return self._mark(lane.right)

    def _mark(self, name: str | None) -> RoadMark:
        item = self.sides.get(name) if name is not None else None
        if isinstance(item, RoadBorder):
            return RoadMark("curb") if item.kind == "curb" else RoadMark("none")
        if item is None:
            return RoadMark("none")
        return RoadMark("broken" if item.kind == "dashed" else "solid", item.color or "standard", item.width_m)
