"""What players of scenario formats rely on and their own checkers miss, looked at before anything is written."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Scenario
from log2sim.errors import ScenarioError
from log2sim.geometry import Array, bev_iou, box_corners_bev

# Players that count in float32 place what is this far from the middle to 4 mm; beyond, it shakes.
FARTHEST_M = 65_536.0
# Steps shorter than this have no direction, and agents that move less none that could be wrong.
STEP_M, MOVED_M = 0.05, 2.0
# Boxes of a log touch; what overlaps by less is taken for that.
TOUCHING_IOU = 0.02
# Names are escaped where XML needs it; a projection has to stay as it is.
_NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def require_exportable(scenario: Scenario) -> None:
    """Raise `ScenarioError` with all that is wrong with a scenario, naming the agents."""
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
    wrong += _repeated(scenario) or ([] if wrong else _scattered(scenario))
    if wrong:
        raise ScenarioError(f"scenario '{scenario.name}' cannot be exported:\n  " + "\n  ".join(wrong))


def remarks(scenario: Scenario) -> list[str]:
    """What can be exported and yet may surprise: agents that stand in one another when one of them appears."""
    found = []
    for a, b, share in overlaps_at_entry(scenario.agents):
        first, second = scenario.agents[a], scenario.agents[b]
        found.append(
            f"agents '{first.id}' and '{second.id}' stand in one another at {second.waypoints.t_s[0]:g} s (overlap {share:.0%}),"
            " as in the scenario; a simulator with physics pushes them apart"
        )
    return found


def require_start_as_in_log(agents: Sequence[Agent], placed: Array) -> None:
    """Raise unless agents that an export places in one another at its start (A, 4) are so in the scenario too.

    `placed` holds x, y, z of the box center and yaw, NaN for agents that it does not place yet.
    """
    there = overlaps(agents, _states(agents, max(0.0, min(float(a.waypoints.t_s[0]) for a in agents))))
    for a, b in overlaps(agents, placed.T).keys() - there.keys():
        raise ScenarioError(
            f"agents '{agents[a].id}' and '{agents[b].id}' would start in one another, which they do not in the scenario"
        )


def overlaps_at_entry(agents: Sequence[Agent]) -> list[tuple[int, int, float]]:
    """Pairs of agents (indices) whose boxes overlap at the moment when the later of both appears, with their IoU."""
    first_s = np.array([a.waypoints.t_s[0] for a in agents])
    found = []
    for t_s in np.unique(first_s):
        for (a, b), share in overlaps(agents, _states(agents, t_s)).items():
            if max(first_s[a], first_s[b]) == t_s:
                found.append((a, b, share) if first_s[a] <= first_s[b] else (b, a, share))
    return found


def overlaps(agents: Sequence[Agent], states: Array) -> dict[tuple[int, int], float]:
    """IoU by pair of agents (indices, the lower first) whose boxes overlap in states (4, A) x, y, z, yaw; NaN is absent."""
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
    """x, y, z, yaw (4, A) of all agents at a time, NaN for those that are not there."""
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
    """Say when most of the way goes against the heading although the speed says otherwise."""
    w = agent.waypoints
    heading = np.unwrap(w.yaw_rad)
    middle = (heading[1:] + heading[:-1]) / 2
    dx, dy = np.diff(w.x_m), np.diff(w.y_m)
    step = np.hypot(dx, dy)
    forward = np.where(w.speed_mps[1:] + w.speed_mps[:-1] < 0, -1.0, 1.0)
    against = (step >= STEP_M) & (forward * (dx * np.cos(middle) + dy * np.sin(middle)) < 0)
    moved, wrong = step[step >= STEP_M].sum(), step[against].sum()
    reach = np.hypot(np.ptp(w.x_m), np.ptp(w.y_m))  # a box that trembles in its place goes far and gets nowhere
    if reach >= MOVED_M and wrong > moved / 2:
        yield (
            f"agent '{agent.id}': goes backward on {wrong:.1f} of {moved:.1f} m while its speed says forward; if its box is"
            " labeled back to front, turn yaw_rad by half a turn, and if it reverses, make speed_mps negative"
        )


def _repeated(scenario: Scenario) -> list[str]:
    ids = [a.id for a in scenario.agents]
    return [
        f"agent '{name}': the id occurs twice; ids must be unique"
        for name in sorted({n for n in ids if ids.count(n) > 1})
    ]


def _scattered(scenario: Scenario) -> list[str]:
    """Agents too far from the middle of all for float32, whatever offset is taken."""
    xyz = [np.column_stack([a.waypoints.x_m, a.waypoints.y_m, a.waypoints.z_m]) for a in scenario.agents]
    every = np.concatenate(xyz)
    middle = (every.min(axis=0) + every.max(axis=0)) / 2
    far: NDArray[np.float64] = np.array([np.abs(points - middle).max() for points in xyz])
    return [
        f"agent '{scenario.agents[k].id}': is {far[k] / 1000:.0f} km from the middle of the scenario, expected at most"
        f" {FARTHEST_M / 1000:.0f} km: players that count in float32 would let it shake; export parts of the scenario"
        for k in np.flatnonzero(far > FARTHEST_M)
    ]  # fmt: skip
