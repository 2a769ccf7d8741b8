"""Checks before an export: what players of scenario formats rely on and their own checkers miss."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Scenario, list_doubtful
from log2sim.errors import ScenarioError
from log2sim.geometry import Array, bev_iou, box_corners_bev

# Players that compute in float32 resolve 4 mm at this distance from the center; beyond, agents jitter.
MAX_EXTENT_M = 65_536.0
# Steps shorter than STEP_M have no direction; the direction of agents that move less than MOVED_M is not checked.
STEP_M, MOVED_M = 0.05, 2.0
# Boxes of a scenario may touch; a smaller overlap is within their errors.
TOUCHING_IOU = 0.02
# Names are escaped in XML; a projection must stay as it is.
_NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def require_exportable(scenario: Scenario) -> None:
    """Raise `ScenarioError` with all defects of a scenario, naming the agents."""
    wrong = [problem for agent in scenario.agents for problem in _problems(agent)]
    if not scenario.agents:
        wrong = ["it has no agents"]
    wrong += [
        f"name or id {text!a}: holds half a surrogate pair, which no file can; give it another"
        for text in (scenario.name, *(a.id for a in scenario.agents))
        if not _is_text(text)
    ]
    projection = scenario.map.projection
    if projection is not None and _NO_XML.search(projection):
        wrong.append(f"map.projection {projection[:60]!a}: holds characters that no XML file can; write a PROJ string")
    wrong += _duplicate_ids(scenario) or ([] if wrong else _too_far_apart(scenario))
    if wrong:
        raise ScenarioError(f"scenario '{scenario.name}' cannot be exported:\n  " + "\n  ".join(wrong))


def export_notes(scenario: Scenario) -> list[str]:
    """Return notes on what can be exported but may surprise: agents that overlap when one of them appears."""
    found = []
    for a, b, share in overlaps_at_entry(scenario.agents):
        first, second = scenario.agents[a], scenario.agents[b]
        found.append(
            f"agents '{first.id}' and '{second.id}' overlap by {share:.0%} at {second.waypoints.t_s[0]:g} s,"
            " as in the scenario; a simulator with physics pushes them apart"
        )
    return found


def doubtful_note(source: Scenario, exported: Scenario) -> str:
    """Say how many agents of a scenario are doubtful, which, and whether the export has them."""
    left_out = {a.id for a in source.agents} - {a.id for a in exported.agents}
    gone = [a for a in source.doubtful if a.id in left_out]
    there = [a for a in source.doubtful if a.id not in left_out]
    counts = f"{len(gone)} of {len(source.agents)} agents left out as doubtful: {list_doubtful(gone)}" if gone else ""
    kept = f"{len(there)} of {len(source.agents)} agents are doubtful: {list_doubtful(there)}" if there else ""
    return "; ".join(part for part in (counts, kept) if part)


def require_start_as_in_scenario(agents: Sequence[Agent], placed: Array) -> None:
    """Raise when agents overlap at the start of an export, states (A, 4), that do not in the scenario.

    `placed` holds x, y, z of the box center and yaw, NaN for agents that appear later.
    """
    there = overlaps(agents, _states(agents, max(0.0, min(float(a.waypoints.t_s[0]) for a in agents))))
    for a, b in overlaps(agents, placed.T).keys() - there.keys():
        raise ScenarioError(
            f"agents '{agents[a].id}' and '{agents[b].id}' would overlap at the start, which they do not in the scenario"
        )


def overlaps_at_entry(agents: Sequence[Agent]) -> list[tuple[int, int, float]]:
    """Return pairs of agents (indices) whose boxes overlap when the later of both appears, with their IoU."""
    first_s = np.array([a.waypoints.t_s[0] for a in agents])
    found = []
    for t_s in np.unique(first_s):
        for (a, b), share in overlaps(agents, _states(agents, t_s)).items():
            if max(first_s[a], first_s[b]) == t_s:
                found.append((a, b, share) if first_s[a] <= first_s[b] else (b, a, share))
    return found


def overlaps(agents: Sequence[Agent], states: Array) -> dict[tuple[int, int], float]:
    """Return the IoU by pair of agents (indices, the lower first) whose boxes overlap in states (4, A); NaN is absent."""
    size = np.array([a.size_m for a in agents]).reshape(-1, 3)
    x, y, z, yaw = states
    reach = np.hypot(size[:, 0], size[:, 1]) / 2
    corners = box_corners_bev(np.column_stack([x, y]), size[:, 0], size[:, 1], yaw)
    found = {}
    for k in range(len(agents)):
        near = np.hypot(x[:k] - x[k], y[:k] - y[k]) <= reach[:k] + reach[k]  # False for NaN
        near &= np.abs(z[:k] - z[k]) <= (size[:k, 2] + size[k, 2]) / 2
        others = np.flatnonzero(near)
        for other, share in zip(others, bev_iou(corners[k], corners[others])):
            if share > TOUCHING_IOU:
                found[int(other), k] = float(share)
    return found


def _states(agents: Sequence[Agent], t_s: float) -> Array:
    """Return x, y, z, yaw (4, A) of all agents at a time, NaN for absent ones."""
    states = [a.at(t_s) for a in agents]
    return np.array([[getattr(s, key)[0] for s in states] for key in ("x_m", "y_m", "z_m", "yaw_rad")])


def _is_text(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _problems(agent: Agent) -> list[str]:
    where = f"agent '{agent.id}'"
    problem = agent.waypoints.problem()
    wrong = [] if problem is None else [f"{where}: {problem}"]
    if not (np.isfinite(agent.size_m).all() and min(agent.size_m) > 0):
        wrong.append(f"{where}: size {agent.size_m} m, expected positive lengths")
    return wrong or list(_back_to_front(agent))


def _back_to_front(agent: Agent) -> Iterator[str]:
    """Describe an agent that mostly moves against its heading although its speed is positive."""
    w = agent.waypoints
    heading = np.unwrap(w.yaw_rad)
    middle = (heading[1:] + heading[:-1]) / 2
    dx, dy = np.diff(w.x_m), np.diff(w.y_m)
    step = np.hypot(dx, dy)
    forward = np.where(w.speed_mps[1:] + w.speed_mps[:-1] < 0, -1.0, 1.0)
    against = (step >= STEP_M) & (forward * (dx * np.cos(middle) + dy * np.sin(middle)) < 0)
    moved, wrong = step[step >= STEP_M].sum(), step[against].sum()
    reach = np.hypot(np.ptp(w.x_m), np.ptp(w.y_m))  # the steps of a box that jitters add up without getting anywhere
    if reach >= MOVED_M and wrong > moved / 2:
        yield (
            f"agent '{agent.id}': goes backward on {wrong:.1f} of {moved:.1f} m while its speed says forward; if its box is"
            " labeled back to front, turn yaw_rad by half a turn, and if it reverses, make speed_mps negative"
        )


def _duplicate_ids(scenario: Scenario) -> list[str]:
    ids = [a.id for a in scenario.agents]
    return [
        f"agent '{name}': the id occurs twice; ids must be unique"
        for name in sorted({n for n in ids if ids.count(n) > 1})
    ]


def _too_far_apart(scenario: Scenario) -> list[str]:
    """Describe agents too far from the center of all for float32."""
    xyz = [np.column_stack([a.waypoints.x_m, a.waypoints.y_m, a.waypoints.z_m]) for a in scenario.agents]
    every = np.concatenate(xyz)
    middle = (every.min(axis=0) + every.max(axis=0)) / 2
    far: NDArray[np.float64] = np.array([np.abs(points - middle).max() for points in xyz])
    return [
        f"agent '{scenario.agents[k].id}': is {far[k] / 1000:.0f} km from the middle of the scenario, expected at most"
        f" {MAX_EXTENT_M / 1000:.0f} km: it would jitter in players that compute in float32; export parts of the scenario"
        for k in np.flatnonzero(far > MAX_EXTENT_M)
    ]  # fmt: skip
