"""Where an agent is within its lane over time, and the summary of a scenario in numbers."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, MapFeatures, MapLane, Scenario
from log2sim.geometry import Array, Polyline
from log2sim.road.lane_graph import infer_lanes
from log2sim.road.routes import MAX_TURN_RAD

# Times at which positions are taken: a vehicle drifts within its lane by centimeters in that time.
STEP_S = 0.1
# An agent is in the next lane when its middle is so far beyond the line between both: it does not go to and fro with noise.
CROSSED_M = 0.2
# Positions of agents that move less say nothing of how they drive.
MIN_MOVED_M = 1.0


@dataclass(frozen=True, eq=False)
class LanePosition:
    """Positions of an agent in lanes."""

    t_s: Array  # (T,)
    lane: NDArray[np.intp]  # (T,): index of the lane, -1 where it is in none
    aside_m: Array  # (T,): of the box center to the left of the lane's middle; NaN in no lane
    width_m: Array  # (T,): of the lane there

    @property
    def known(self) -> NDArray[np.bool_]:
        """Where it is in a lane (T,)."""
        return np.asarray(self.lane >= 0)


@dataclass(frozen=True)
class LaneChange:
    """A change to the lane beside: when the agent's middle crosses the line between, and to which side."""

    t_s: float
    origin: str
    target: str
    side: str


def locate_in_lanes(agent: Agent, lanes: Sequence[MapLane], t_s: Array | None = None) -> LanePosition:
    """Find the lane of an agent and its lateral position in it at times (T,), by default every `STEP_S` of its life.

    Of several lanes that hold it, it stays in the one where it is, or goes on into a successor of that; else the lane with the
    nearest middle is taken. In junctions lanes overlap.
    """
    w = agent.waypoints
    if t_s is None:
        t_s = np.arange(w.t_s[0], w.t_s[-1] + 1e-9, STEP_S)
    state = agent.at(t_s)
    xy, heading = np.column_stack([state.x_m, state.y_m]), state.yaw_rad
    there = np.flatnonzero(state.valid)
    shape = (len(lanes), len(t_s))
    aside, width = np.full(shape, np.inf), np.full(shape, np.nan)
    for k, lane in enumerate(lanes):
        line = Polyline(lane.points_m)
        if len(there):
            at = Polyline.through(lane.points_m).project(xy[there], heading[there])
            own = np.interp(at.s_m, line.s_m, lane.width_m)
            held = at.inside & (np.abs(at.turn_rad) <= MAX_TURN_RAD) & (np.abs(at.aside_m) <= own / 2 + CROSSED_M)
            aside[k, there[held]], width[k, there] = at.aside_m[held], own
    if not lanes:
        return LanePosition(t_s, np.full(len(t_s), -1), np.full(len(t_s), np.nan), np.full(len(t_s), np.nan))
    number, distance = {lane.id: k for k, lane in enumerate(lanes)}, np.abs(aside)
    chosen, current = np.full(len(t_s), -1), -1
    for t in range(len(t_s)):
        if current < 0 or not np.isfinite(distance[current, t]):
            onward = [number[name] for name in lanes[current].successors if name in number] if current >= 0 else []
            half = np.where(np.isnan(width[:, t]), 0.0, width[:, t]) / 2
            inside = np.flatnonzero(distance[:, t] <= half).tolist()
            candidates = [k for k in onward if np.isfinite(distance[k, t])] or inside
            current = min(candidates, key=lambda k: distance[k, t]) if candidates else -1
        chosen[t] = current
    pick = np.maximum(chosen, 0), np.arange(len(t_s))
    return LanePosition(t_s, chosen, *(np.where(chosen >= 0, column[pick], np.nan) for column in (aside, width)))


def find_lane_changes(position: LanePosition, lanes: Sequence[MapLane]) -> list[LaneChange]:
    """Return the changes of an agent to lanes beside its own, in order of time."""
    found = []
    rows = np.flatnonzero(position.known)
    for a, b in itertools.pairwise(rows):
        one, two = lanes[position.lane[a]], lanes[position.lane[b]]
        for side, names in (("left", _beside(one, "left_lane", lanes)), ("right", _beside(one, "right_lane", lanes))):
            if b == a + 1 and two.id in names:
                found.append(LaneChange(float(position.t_s[b]), one.id, two.id, side))
    return found


def _beside(lane: MapLane, side: str, lanes: Sequence[MapLane]) -> set[str]:
    """Return the lane on a side and those that follow it."""
    name = getattr(lane, side)
    follows = next((other.successors for other in lanes if other.id == name), ())
    return set() if name is None else {name, *follows}


def summarize_lane_keeping(agent: Agent, lanes: Sequence[MapLane]) -> dict[str, Any] | None:
    """Return figures of an agent's lateral position in its lane, None when it does not move or is in no lane.

    Offsets are told of lanes between markings alone: the middle of lanes out of paths is where the agent itself drove.
    """
    position = locate_in_lanes(agent, lanes)
    w = agent.waypoints
    known = position.known
    if max(np.ptp(w.x_m), np.ptp(w.y_m)) < MIN_MOVED_M or not known.any():
        return None
    marked = known.copy()
    marked[known] = [lanes[k].inferred_from != "paths" for k in position.lane[known]]
    found: dict[str, Any] = {"in_lane": round(float(known.mean()), 3), "in_marked_lane": round(float(marked.mean()), 3)}
    if marked.any():
        aside, width = position.aside_m[marked], position.width_m[marked]
        over = np.abs(aside) + agent.size_m[1] / 2 > width / 2
        figures = {"mean": aside.mean(), "sd": aside.std(), "leftmost": aside.max(), "rightmost": aside.min()}
        found["aside_m"] = {key: round(float(value), 3) for key, value in figures.items()}
        found["width_m"], found["over_line"] = round(float(np.median(width)), 2), round(float(over.mean()), 3)
    return found | {"changes": [vars(change) for change in find_lane_changes(position, lanes)]}


def summarize_scenario(scenario: Scenario) -> dict[str, Any]:
    """Summarize a scenario as a JSON document: agents without the ego; lanes that it does not hold are inferred from paths."""
    features = scenario.map_features or MapFeatures()
    lanes, notes = features.lanes, features.notes
    if not lanes:
        lanes, more = infer_lanes(features.markings, features.borders, scenario)
        notes = (*notes, *more)
    agents = scenario.others
    return {
        "name": scenario.name,
        "t0_ns": scenario.t0_ns,
        "duration_s": scenario.duration_s,
        "agents": {
            "count": len(agents),
            "moving": sum(not agent.static for agent in agents),
            "doubtful": sum(agent.is_doubtful for agent in agents),
            "categories": dict(sorted(Counter(agent.category for agent in agents).items())),
            "colors": dict(sorted(Counter(a.color["name"] for a in agents if a.color is not None).items())),
        },
        "ego": None if scenario.ego is None else {"doubtful": scenario.ego.is_doubtful},
        "markings": dict(sorted(Counter(marking.kind for marking in features.markings).items())),
        "borders": dict(sorted(Counter(border.kind for border in features.borders).items())),
        "lanes": {
            "count": len(lanes),
            "junctions": len({lane.junction for lane in lanes} - {None}),
            "inferred_from": dict(sorted(Counter(lane.inferred_from for lane in lanes).items())),
            "in_file": bool(features.lanes),
        },
        "signals": len(scenario.signals),
        "ego_in_lane": None if scenario.ego is None else summarize_lane_keeping(scenario.ego, lanes),
        "notes": list(notes),
    }
