"""The lanes under a scenario, for formats that need a road under the vehicles."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Agent, MapFeatures, MapLane, Scenario
from log2sim.geometry import Array
from log2sim.lanes.graph.lane_graph import add_missing_lanes, infer_lanes
from log2sim.lanes.graph.polyline import Polyline

STANDING_M = 20.0
"""Length of the lane under an agent that stands, where nobody moves: its whole vehicle is on it."""

STANDING_WIDTH_M = 3.5
"""Of that lane, as of lanes along paths."""


def lanes(scenario: Scenario) -> tuple[MapLane, ...]:
    """Return the lanes of a scenario: those of its map features, else inferred ones, and more where paths leave them.

    Where no vehicle moves, there is a straight one under the agent that moves farthest.
    """
    features = scenario.map_features or MapFeatures()
    if features.lanes:
        return add_missing_lanes(features.lanes, scenario)
    found, _ = infer_lanes(features.markings, features.borders, scenario)
    return found or (_lane_of_standing_agent(_first_agent(scenario)),)


def _first_agent(scenario: Scenario) -> Agent:
    vehicles = [a for a in scenario.agents if a.category != "pedestrian"] or list(scenario.agents)
    return scenario.ego or max(
        vehicles, key=lambda a: float(np.hypot(np.ptp(a.waypoints.x_m), np.ptp(a.waypoints.y_m)))
    )


def _lane_of_standing_agent(agent: Agent) -> MapLane:
    w = agent.waypoints
    x, y, yaw = (float(np.mean(v)) for v in (w.x_m, w.y_m, np.unwrap(w.yaw_rad)))
    ground = float(np.mean(w.z_m)) - agent.size_m[2] / 2
    ahead = np.array([-STANDING_M / 2, STANDING_M / 2])
    points = np.column_stack([x + ahead * np.cos(yaw), y + ahead * np.sin(yaw), [ground, ground]])
    return MapLane(
        "lane-1",
        points,
        np.full(2, max(STANDING_WIDTH_M, agent.size_m[1] + 0.8)),
        inferred_from="paths",
        confidence=0.0,
    )


def edges_of(lane: MapLane) -> tuple[Array, Array]:
    """Return the left and the right edge (N, 3) of a lane, point by point."""
    heading = Polyline(lane.points_m).heading_rad
    left = np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(len(heading))])
    half = lane.width_m[:, None] / 2
    return lane.points_m + left * half, lane.points_m - left * half
