"""Lanes as polylines, for formats that need a road under the vehicles: the driven lane of each inferred road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.export.roads.infer import InferredRoad, infer_roads
from log2sim.geometry import Array

SPACING_M = 1.0


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane in its driving direction.

    Attributes
    ----------
    agent : str
        Id of the agent whose path it follows.
    points_m : (N, 3) float64
        Center line on the ground, N >= 2.
    heading_rad : (N,) float64
    width_m : float
    """

    agent: str
    points_m: Array
    heading_rad: Array
    width_m: float

    @property
    def bounds_m(self) -> tuple[Array, Array]:
        """The left and the right edge, (N, 3) each."""
        left = np.stack([-np.sin(self.heading_rad), np.cos(self.heading_rad), np.zeros(len(self.heading_rad))], axis=-1)
        return self.points_m + left * self.width_m / 2, self.points_m - left * self.width_m / 2


def lanes(scenario: Scenario) -> list[Lane]:
    """Return a lane along the ego's path, and one for each other inferred road; the ego's first."""
    return [_lane(road) for road in infer_roads(scenario)]


def _lane(road: InferredRoad) -> Lane:
    stations = np.linspace(0.0, road.line.length_m, max(int(np.ceil(road.line.length_m / SPACING_M)), 1) + 1)
    points = road.line.at(stations)
    row = np.maximum(np.searchsorted(road.elevation[:, 0], stations, side="right") - 1, 0)
    start, a, b, c, d = road.elevation[row].T
    along = stations - start
    height = a + along * (b + along * (c + along * d))
    return Lane(road.name, np.column_stack([points[:, :2], height]), points[:, 2], road.lane_m)
