"""What players of scenario formats rely on and their own checkers miss, looked at before anything is written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import ScenarioError
from log2sim.geometry import Array, bev_iou, box_corners_bev
from log2sim.scenario import Agent, Scenario

# Players that count in float32 place what is this far from the middle to 4 mm; beyond, it shakes.
FARTHEST_M = 65_536.0
# Steps shorter than this have no direction, and agents that move less none that could be wrong.
STEP_M, MOVED_M = 0.05, 2.0
# Boxes of a log touch; what overlaps by less is taken for that.
TOUCHING_IOU = 0.02


def require_exportable(scenario: Scenario) -> None:
    """Raise `ScenarioError` with all that is wrong with a scenario, naming the agents."""
    wrong = [problem for agent in scenario.agents for problem in _problems(agent)]
    if not scenario.agents:
        wrong = ["it has no agents"]
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


def overlaps_at_entry(agents: Sequence[Agent]) -> list[tuple[int, int, float]]:
    """Pairs of agents (indices) whose boxes overlap at the moment when the later of both appears, with their IoU."""
    first_s = np.array([a.waypoints.t_s[0] for a in agents])
    size = np.array([a.size_m for a in agents]).reshape(-1, 3)
    reach = np.hypot(size[:, 0], size[:, 1]) / 2
    found = []
    for t_s in np.unique(first_s):
        x, y, z, yaw = _states(agents, t_s)
        corners = box_corners_bev(np.column_stack([x, y]), size[:, 0], size[:, 1], yaw)
        for k in np.flatnonzero(first_s == t_s):
            near = np.hypot(x - x[k], y - y[k]) <= reach + reach[k]  # False where an agent is not there: NaN
            near &= np.abs(z - z[k]) <= (size[:, 2] + size[k, 2]) / 2
            for other in np.flatnonzero(near & ((first_s < t_s) | (np.arange(len(agents)) < k))):
                share = bev_iou(corners[k], corners[other])
                if share > TOUCHING_IOU:
                    found.append((int(other), int(k), share))
    return found


def _states(agents: Sequence[Agent], t_s: float) -> Array:
    """x, y, z, yaw (4, A) of all agents at a time, NaN for those that are not there."""
    states = [a.at(t_s) for a in agents]
    return np.array([[getattr(s, key)[0] for s in states] for key in ("x_m", "y_m", "z_m", "yaw_rad")])


def _problems(agent: Agent) -> list[str]:
    where, w = f"agent '{agent.id}'", agent.waypoints
    if len(w) == 0:
        return [f"{where}: has no waypoints, expected at least one"]
    wrong = []
    if np.any(np.diff(w.t_s) <= 0):
        k = int(np.argmax(np.diff(w.t_s) <= 0)) + 1
        wrong.append(f"{where}: waypoints.t_s does not increase at index {k} ({w.t_s[k]:g} s)")
    if not all(np.isfinite(getattr(w, key)).all() for key in w.FLOATS):
        wrong.append(f"{where}: a waypoint is not finite")
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
        f"agent '{name}': the id stands twice; ids must be unique"
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
