"""Lanes where vehicles drove, for formats that want a road under them: inferred from the paths alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.scenario import Agent, Scenario
from log2sim.types import GROUP_OF

WIDTH_M = 3.5
MARGIN_M = 0.4  # between a vehicle's side and the edge of its lane
SPACING_M = 1.0
LEAVES_M = 1.5  # a path this far from all lanes has left them
TURNED_RAD = np.pi / 4
SHORTEST_M = 3.0


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane along the path of the agent `agent`: `points_m` (N, 3) on the ground, N >= 2, in its driving direction."""

    agent: str
    points_m: Array
    width_m: float

    @property
    def bounds_m(self) -> tuple[Array, Array]:
        """The left and the right edge, (N, 3) each."""
        direction = np.gradient(self.points_m[:, :2], axis=0)
        left = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
        left *= self.width_m / 2 / np.linalg.norm(left, axis=1, keepdims=True)
        offset = np.concatenate([left, np.zeros((len(left), 1))], axis=1)
        return self.points_m + offset, self.points_m - offset


def lanes(scenario: Scenario) -> tuple[Lane, ...]:
    """Lanes along the ego's path, and along the paths of other moving vehicles where these leave the lanes before.

    Each lane is as long as its agent's boxes reach. Without a moving vehicle there is one lane through the first agent.
    """
    ego = (scenario.ego,) if scenario.ego is not None else ()
    movers = [a for a in scenario.others if GROUP_OF[a.category] == "vehicle" and not a.static]
    found: list[Lane] = []
    for agent in (*ego, *movers):
        for path in _paths(agent):
            found += [Lane(agent.id, path[part], _width(agent)) for part in _new_parts(path, found)]
    return tuple(found) or (_lane_under((*ego, *scenario.agents)[0]),)


def _width(agent: Agent) -> float:
    return max(WIDTH_M, agent.size_m[1] + 2 * MARGIN_M)


def _lane_under(agent: Agent) -> Lane:
    """A straight lane under an agent that stays where it is."""
    w = agent.waypoints
    ahead = max(agent.size_m[0], SHORTEST_M) * np.array([np.cos(w.yaw_rad[0]), np.sin(w.yaw_rad[0]), 0.0])
    center = np.array([w.x_m[0], w.y_m[0], w.z_m[0] - agent.size_m[2] / 2])
    return Lane(agent.id, np.stack([center - ahead, center, center + ahead]), _width(agent))


def _paths(agent: Agent) -> Iterator[Array]:
    """Paths of an agent on the ground (N, 3), as long as its boxes reach; a new one where it changes gear.

    They lead the way that the agent looks, so that one that backs into a gap does not make a lane of its own.
    """
    w = agent.waypoints
    points = np.stack([w.x_m, w.y_m, w.z_m - agent.size_m[2] / 2], axis=-1)
    kept = [0]
    for k in range(1, len(points)):
        if np.linalg.norm(points[k, :2] - points[kept[-1], :2]) >= SPACING_M:
            kept.append(k)
    points, yaw = points[kept], w.yaw_rad[kept]
    step = np.diff(points[:, :2], axis=0)
    forward = step[:, 0] * np.cos(yaw[:-1]) + step[:, 1] * np.sin(yaw[:-1]) >= 0
    for start, stop in _runs(forward):
        yield _lengthened(points[start : stop + 1], agent)
    for start, stop in _runs(~forward):
        yield _lengthened(points[start : stop + 1][::-1], agent)


def _runs(mask: NDArray[np.bool_]) -> list[list[int]]:
    """Start and stop of every run of True."""
    edges: list[list[int]] = np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]]))).reshape(-1, 2).tolist()
    return edges


def _lengthened(points: Array, agent: Agent) -> Array:
    """A path (N, 3), N >= 2, with half the agent's length and points in between added."""
    reach = agent.size_m[0] / 2 + MARGIN_M
    first, last = points[0] - points[1], points[-1] - points[-2]
    ends = points[0] + first * reach / np.linalg.norm(first), points[-1] + last * reach / np.linalg.norm(last)
    return _dense(np.vstack([ends[0], points, ends[1]]))


def _dense(points: Array) -> Array:
    """A polyline (N, k) with points added, so that none are much more than `SPACING_M` apart."""
    length = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    count = np.maximum(np.round(length / SPACING_M).astype(int), 1)
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(points[:-1], points[1:], count)]
    return np.vstack([*pieces, points[-1:]])


def _new_parts(path: Array, found: list[Lane]) -> Iterator[slice]:
    """Parts of a path that no lane covers, each with the point where it leaves a lane or comes back to one."""
    for start, stop in _runs(~_covered(path, found)):
        part = slice(max(start - 1, 0), min(stop + 1, len(path)))
        if np.linalg.norm(np.diff(path[part, :2], axis=0), axis=1).sum() >= SHORTEST_M:
            yield part


def _covered(path: Array, found: list[Lane]) -> NDArray[np.bool_]:
    """Which points (N,) of a path lie on a lane that leads the same way."""
    from scipy.spatial import cKDTree

    if not found:
        return np.zeros(len(path), dtype=bool)
    distance, _ = cKDTree(np.vstack([_place(lane.points_m) for lane in found])).query(_place(path))
    return np.asarray(distance < LEAVES_M)


def _place(points: Array) -> Array:
    """Points with their direction of driving (N, 4), scaled so that a turn by `TURNED_RAD` is as far as `LEAVES_M`."""
    step = np.gradient(points[:, :2], axis=0)
    direction = step / np.linalg.norm(step, axis=1, keepdims=True)
    return np.hstack([points[:, :2], direction * LEAVES_M / (2 * np.sin(TURNED_RAD / 2))])
