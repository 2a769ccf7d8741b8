"""Infers roads: one along the ego's path, and one wherever another vehicle leaves the existing ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Scenario
from log2sim.export.roads.reference_line import MIN_STEP_M, TOLERANCE_M, ReferenceLine, fit, straight
from log2sim.geometry import Array, wrap_angle

LANE_M = 3.5
# Free space beside the vehicle that a lane is made for, both sides together.
LANE_CLEARANCE_M = 0.8
# Extension of roads before and after the path, so that the whole vehicle is on them.
EXTENSION_M = 10.0
# A vehicle that moves back by less is settling; more begins a new path.
REVERSAL_M = 0.1
# A vehicle that moves less needs no road; paths that leave the roads for less are on them.
MIN_PATH_M = 2.0
MIN_LINE_M = 0.1
# Two stretches off the roads with a smaller gap become one road, which overlaps the roads that it leaves by as much.
JOIN_M = 10.0
# Larger differences of heading are crossings of a road.
MAX_HEADING_DIFFERENCE_RAD = np.deg2rad(30.0)
PROBE_M = 0.25
# Lengths over which heights are averaged against their noise: the ego's over less than those observed from afar.
EGO_LEVEL_M, LEVEL_M = 5.0, 20.0


@dataclass(frozen=True, eq=False)
class InferredRoad:
    """A road with lane -1 centered on the reference line.

    Attributes
    ----------
    name : str
        Id of the agent whose path it follows.
    line : ReferenceLine
    elevation : (K, 5) float64
        Stations and coefficients a, b, c, d of cubics.
    lane_m : float
        Width of lane -1.
    left_m, right_m : float
        Width of a lane beside it, 0 for none.
    """

    name: str
    line: ReferenceLine
    elevation: Array
    lane_m: float
    left_m: float = 0.0
    right_m: float = 0.0

    @cached_property
    def _probes(self) -> tuple[Array, Any]:
        """Points (P, 3) x, y, heading every `PROBE_M`, and a tree of their positions."""
        from scipy.spatial import cKDTree

        probes = self.line.at(np.linspace(0.0, self.line.length_m, max(int(self.line.length_m / PROBE_M), 1) + 1))
        return probes, cKDTree(probes[:, :2])

    def holds(self, points: Array, aside_m: float | None = None) -> NDArray[np.bool_]:
        """Whether points (N, 3) x, y, heading lie along the road, on its lanes or within `aside_m` of its line."""
        left, right = self.lane_m / 2 + self.left_m, self.lane_m / 2 + self.right_m
        if aside_m is not None:
            left = right = aside_m
        probes, tree = self._probes
        near = tree.query(points[:, :2], distance_upper_bound=max(left, right) + PROBE_M)[1]
        held: NDArray[np.bool_] = near < len(probes)
        x, y, heading = probes[near[held]].T
        dx, dy = points[held, 0] - x, points[held, 1] - y
        along, across = dx * np.cos(heading) + dy * np.sin(heading), dy * np.cos(heading) - dx * np.sin(heading)
        turned = np.abs(wrap_angle(points[held, 2] - heading))
        parallel = np.minimum(turned, np.pi - turned) <= MAX_HEADING_DIFFERENCE_RAD
        held[held] = parallel & (np.abs(along) <= PROBE_M) & (across <= left) & (across >= -right)
        return held


@dataclass(frozen=True, eq=False)
class DirectedPath:
    """A stretch of an agent's path without a reversal, in the direction of its heading.

    Attributes
    ----------
    points : (N, 4) float64
        x, y, z, heading.
    beyond_m : (2,) tuple of float
        How far a road extends straight before and after them.
    """

    points: Array
    beyond_m: tuple[float, float] = (EXTENSION_M, EXTENSION_M)


def infer_roads(scenario: Scenario) -> list[InferredRoad]:
    """Return all roads of a scenario, the ego's first; without an ego, that of the vehicle that goes farthest.

    Positions are those of the scenario, z that of the ground.
    """
    vehicles = [a for a in scenario.agents if a.category != "pedestrian"] or list(scenario.agents)
    first = scenario.ego or max(vehicles, key=lambda a: float(np.ptp(_progress(a))))
    roads: list[InferredRoad] = []
    for way in directed_paths(first):
        if not roads or not _on_roads(roads, way, TOLERANCE_M).all():
            roads.append(_road(first, way, beside_m=LANE_M, level_m=EGO_LEVEL_M))
    if not roads:
        roads.append(_road_of_standing_agent(first))
    others = [a for a in vehicles if a is not first and not a.static]
    for agent in sorted(others, key=lambda a: -float(np.ptp(_progress(a)))):
        for way in directed_paths(agent):
            roads.extend([_road(agent, part) for part in _stretches_off_roads(way, roads)])
    return roads


def directed_paths(agent: Agent) -> list[DirectedPath]:
    """Return the stretches of an agent's path between its reversals; none for one that stands."""
    w = agent.waypoints
    points = np.column_stack([w.x_m, w.y_m, w.z_m - agent.size_m[2] / 2, np.unwrap(w.yaw_rad)])
    progress = _progress(agent)
    found = []
    for first, last, sign in _monotone_stretches(progress):
        rows = np.arange(first, last + 1)
        ahead = sign * progress[rows]
        new = np.maximum.accumulate(ahead)
        kept = [0]
        for k in range(1, len(rows)):
            if new[k] == ahead[k] and ahead[k] >= ahead[kept[-1]] + MIN_STEP_M:
                kept.append(k)
        if ahead[kept[-1]] - ahead[0] >= MIN_LINE_M:
            found.append(DirectedPath(points[rows[kept]][::sign]))
    return found


def _progress(agent: Agent) -> Array:
    """Return the distance (T,) traveled along the heading, which decreases in reverse."""
    w = agent.waypoints
    heading = np.unwrap(w.yaw_rad)
    mean = (heading[1:] + heading[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(np.diff(w.x_m) * np.cos(mean) + np.diff(w.y_m) * np.sin(mean))])


def _monotone_stretches(progress: Array) -> Iterator[tuple[int, int, int]]:
    """Yield first and last row and direction of each stretch in one direction, ignoring reversals up to `REVERSAL_M`."""
    start, extreme, sign = 0, 0, 0
    for k in range(1, len(progress)):
        if sign == 0:
            if abs(progress[k] - progress[start]) > REVERSAL_M or k == len(progress) - 1:
                sign, extreme = (1 if progress[k] >= progress[start] else -1), k
        elif sign * (progress[k] - progress[extreme]) > 0:
            extreme = k
        elif sign * (progress[extreme] - progress[k]) > REVERSAL_M:
            yield start, extreme, sign
            start, extreme, sign = extreme, k, -sign
    if sign:
        yield start, extreme, sign


def _on_roads(roads: list[InferredRoad], way: DirectedPath, aside_m: float | None) -> NDArray[np.bool_]:
    states = way.points[:, [0, 1, 3]]
    result: NDArray[np.bool_] = np.any([road.holds(states, aside_m) for road in roads], axis=0)
    return result


def _stretches_off_roads(way: DirectedPath, roads: list[InferredRoad]) -> Iterator[DirectedPath]:
    """Yield the stretches of a path that leave the roads, with `JOIN_M` of the path on either side."""
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way.points[:, :2], axis=0).T))])
    if travelled[-1] < MIN_PATH_M:
        return
    off = np.flatnonzero(~_on_roads(roads, way, None))
    if not len(off):
        return
    runs = np.split(off, np.flatnonzero(np.diff(travelled[off]) > 2 * JOIN_M) + 1)
    for run in runs:
        begin, end = travelled[run[0]] - JOIN_M, travelled[run[-1]] + JOIN_M
        rows = np.flatnonzero((travelled >= begin) & (travelled <= end))
        if len(rows) >= 2 and travelled[rows[-1]] - travelled[rows[0]] >= MIN_PATH_M:
            ends = (rows[0] == 0, rows[-1] == len(way.points) - 1)
            yield DirectedPath(way.points[rows], (EXTENSION_M * ends[0], EXTENSION_M * ends[1]))


def _road(agent: Agent, way: DirectedPath, beside_m: float = 0.0, level_m: float = LEVEL_M) -> InferredRoad:
    line, stations = fit(way.points[:, :2])
    before, after = way.beyond_m
    line = line.extended(before, after)
    elevation = _elevation(stations + before, way.points[:, 2], line.length_m, level_m)
    return InferredRoad(agent.id, line, elevation, _lane_m(agent), beside_m, beside_m)


def _road_of_standing_agent(agent: Agent) -> InferredRoad:
    """Return a straight road through the place of an agent that stands."""
    w = agent.waypoints
    x, y, yaw = (float(np.mean(v)) for v in (w.x_m, w.y_m, np.unwrap(w.yaw_rad)))
    ground = float(np.mean(w.z_m)) - agent.size_m[2] / 2
    elevation = np.array([[0.0, ground, 0.0, 0.0, 0.0]])
    return InferredRoad(agent.id, straight(x, y, yaw, 2 * EXTENSION_M), elevation, _lane_m(agent), LANE_M, LANE_M)


def _lane_m(agent: Agent) -> float:
    return max(LANE_M, agent.size_m[1] + LANE_CLEARANCE_M)


def _elevation(stations: Array, ground_m: Array, length_m: float, level_m: float) -> Array:
    """Fit cubics (K, 5) s, a, b, c, d through heights (N,) at the ends and their means every `level_m`, without overshoot.

    Before and after the stations the slope at the ends continues.
    """
    from scipy.interpolate import PchipInterpolator

    block = np.floor((stations - stations[0]) / level_m).astype(int)
    _, first, counts = np.unique(block, return_index=True, return_counts=True)
    s, z = (np.add.reduceat(v, first) / counts for v in (stations, ground_m))
    inner = (s > stations[0] + level_m / 4) & (s < stations[-1] - level_m / 4)
    s = np.concatenate([stations[:1], s[inner], stations[-1:]])
    z = np.concatenate([ground_m[:1], z[inner], ground_m[-1:]])
    grade = np.diff(z) / np.diff(s)
    z = np.concatenate([[z[0] - grade[0] * s[0]], z, [z[-1] + grade[-1] * (length_m - s[-1])]])
    s = np.concatenate([[0.0], s, [length_m]])
    apart = np.concatenate([np.diff(s) > 1e-6, [True]])
    d, c, b, a = PchipInterpolator(s[apart], z[apart]).c
    return _merged_cubics(np.column_stack([s[apart][:-1], a, b, c, d]))


def _merged_cubics(rows: Array) -> Array:
    """Drop cubics (K, 5) that only continue the one before, which checkers call redundant."""
    kept = [rows[0]]
    for row in rows[1:]:
        s, a, b, c, d = kept[-1]
        h = row[0] - s
        goes_on = [a + h * (b + h * (c + h * d)), b + h * (2 * c + 3 * h * d), c + 3 * h * d, d]
        if np.abs(row[1:] - goes_on).max() > 1e-9:
            kept.append(row)
    return np.array(kept)
