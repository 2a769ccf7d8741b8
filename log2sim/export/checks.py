"""Checks before an export: what players of scenario formats rely on and their own checkers miss."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MARGIN_S, Agent, AgentTable, Scenario, explain_doubt, list_doubtful
from log2sim.errors import ScenarioError
from log2sim.geometry import Array, rectangle_iou, rectangles_overlap, wrap_angle

# Players that compute in float32 resolve 4 mm at this distance from the center; beyond, agents jitter.
MAX_EXTENT_M = 65_536.0
# Steps shorter than STEP_M have no direction; the direction of agents that move less than MOVED_M is not checked.
STEP_M, MOVED_M = 0.05, 2.0
# Boxes of a scenario may touch; a smaller overlap is within their errors.
TOUCHING_IOU = 0.02
# Placed elsewhere than in the scenario: by more than an export rounds, in m and rad.
SAME_PLACE = 0.001
# Overlaps that are listed; a scenario with more of them has one cause.
MAX_NOTES = 100
# States, and pairs that are compared, at a time, which bounds memory to some 100 MB.
MAX_STATES = 1_000_000
# Pairs of which areas are computed at a time, so that a caller who needs only the first does not wait for all.
BATCH = 2_000
# Names are escaped in XML; a projection must stay as it is.
_NO_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def require_exportable(scenario: Scenario) -> None:
    """Raise `ScenarioError` with all defects of a scenario, naming the agents."""
    wrong = [] if scenario.agents else ["it has no agents"]
    for agent in scenario.agents:
        problem = agent.waypoints.problem()
        found = [] if problem is None else [problem]
        if not (np.isfinite(agent.size_m).all() and min(agent.size_m) > 0):
            found.append(f"size {agent.size_m} m, expected positive lengths")
        wrong += [f"agent '{agent.id}': {text}" for text in found or _back_to_front(agent)]
    wrong += [
        f"name or id {text!a}: holds half a surrogate pair, which no file can; give it another"
        for text in (scenario.name, *(a.id for a in scenario.agents))
        if any("\ud800" <= c <= "\udfff" for c in text)
    ]
    projection = scenario.map.projection
    if projection is not None and _NO_XML.search(projection):
        wrong.append(f"map.projection {projection[:60]!a}: holds characters that no XML file can; write a PROJ string")
    ids = [a.id for a in scenario.agents]
    twice = sorted({name for name in ids if ids.count(name) > 1})
    wrong += [f"agent '{name}': the id occurs twice; ids must be unique" for name in twice]
    if not wrong:  # too far from the center of all for float32
        xyz = [np.column_stack([a.waypoints.x_m, a.waypoints.y_m, a.waypoints.z_m]) for a in scenario.agents]
        every = np.concatenate(xyz)
        middle = (every.min(axis=0) + every.max(axis=0)) / 2
        for agent, points in zip(scenario.agents, xyz):
            if (far_m := float(np.abs(points - middle).max())) > MAX_EXTENT_M:
                wrong.append(
                    f"agent '{agent.id}': is {far_m / 1000:.0f} km from the middle of the scenario, expected at most"
                    f" {MAX_EXTENT_M / 1000:.0f} km: it would jitter in players that compute in float32; export parts of the scenario"
                )
    if wrong:
        raise ScenarioError(f"scenario '{scenario.name}' cannot be exported:\n  " + "\n  ".join(wrong))


def export_notes(scenario: Scenario) -> list[str]:
    """Return notes on what can be exported but may surprise: agents that overlap when one of them appears."""
    found = []
    for a, b, share in islice(overlaps_at_entry(scenario.agents), MAX_NOTES + 1):
        first, second = scenario.agents[a], scenario.agents[b]
        found.append(
            f"agents '{first.id}' and '{second.id}' overlap by {share:.0%} at {second.waypoints.t_s[0]:g} s,"
            " as in the scenario; a simulator with physics pushes them apart"
        )
    more = f"more than {MAX_NOTES} pairs of agents overlap when one of them appears; only the first are listed"
    return found if len(found) <= MAX_NOTES else [*found[:MAX_NOTES], more]


def doubtful_note(source: Scenario, exported: Scenario) -> str:
    """Say how many agents of a scenario are doubtful, which, and whether the export has them."""
    kept_ids = {a.id for a in exported.agents}
    ego, doubtful, total = source.ego, [a for a in source.others if a.is_doubtful], len(source.others)
    gone = [a for a in doubtful if a.id not in kept_ids]
    there = [a for a in doubtful if a.id in kept_ids]
    parts = [
        f"{len(gone)} of {total} agents left out as doubtful: {list_doubtful(gone)}" if gone else "",
        f"{len(there)} of {total} agents are doubtful: {list_doubtful(there)}" if there else "",
        f"the ego is doubtful: {explain_doubt(ego)}" if ego is not None and ego.is_doubtful else "",
    ]
    return "; ".join(part for part in parts if part)


def require_start_as_in_scenario(agents: Sequence[Agent], placed: Array) -> None:
    """Raise when agents overlap at the start of an export, states (A, 4), that do not in the scenario.

    `placed` holds x, y, z of the box center and yaw, NaN for agents that appear later.
    """
    start_s = max(0.0, min(float(a.waypoints.t_s[0]) for a in agents))
    there = _Boxes.of(agents, _states(agents, np.array([start_s]))[:, 0])
    # Mark (A,) the boxes that other states (4, A) place elsewhere
    change = placed.T - there.states
    change[3] = wrap_angle(change[3])
    same = (np.abs(change) <= SAME_PLACE).all(axis=0)  # False for NaN
    moved = np.flatnonzero(np.asarray(~same & ~np.isnan(placed.T).any(axis=0)))
    everybody = np.arange(len(agents))
    first = np.where(np.isin(everybody, moved), len(agents), 0) + everybody  # pairs of which one was moved, once
    boxes = _Boxes.of(agents, placed.T)
    for a, b, _ in boxes.overlapping(moved, everybody, first):
        for k in np.flatnonzero(there.iou(a, b) <= TOUCHING_IOU)[:1]:
            one, two = sorted((a[k], b[k]))
            raise ScenarioError(
                f"agents '{agents[one].id}' and '{agents[two].id}' would overlap at the start, which they do not in the scenario"
            )


def overlaps_at_entry(agents: Sequence[Agent]) -> Iterator[tuple[int, int, float]]:
    """Yield pairs of agents (indices) whose boxes overlap when the later of both appears, with their IoU.

    Cost: A samples for every block of times at which agents appear, then each agent that appears against those present.
    Pairs are compared in batches, and only as far as the caller asks for them.
    """
    first_s = np.array([a.waypoints.t_s[0] for a in agents])
    last_s = np.array([a.waypoints.t_s[-1] for a in agents])
    rank = np.empty(len(agents), dtype=np.intp)
    rank[np.argsort(first_s, kind="stable")] = np.arange(len(agents))
    times = np.unique(first_s)
    size = max(1, MAX_STATES // max(len(agents), 1))
    for t_s in np.split(times, range(size, len(times), size)):
        alive = np.flatnonzero((first_s <= t_s[-1]) & (last_s >= t_s[0] - MARGIN_S))
        states = np.full((4, len(t_s), len(agents)), np.nan)
        states[:, :, alive] = _states([agents[k] for k in alive.tolist()], t_s)
        for k, t in enumerate(t_s):
            boxes = _Boxes.of(agents, states[:, k])
            present = alive[~np.isnan(states[0, k, alive])]
            for a, b, share in boxes.overlapping(np.flatnonzero(first_s == t), present, rank):
                yield from zip(a.tolist(), b.tolist(), share.tolist())


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes of agents at one moment: x, y, z and yaw (4, A), NaN where absent, and sizes (A, 3)."""

    states: Array
    size_m: Array

    @classmethod
    def of(cls, agents: Sequence[Agent], states: Array) -> _Boxes:
        return cls(states, np.array([a.size_m for a in agents]).reshape(-1, 3))

    def overlapping(
        self, rows: NDArray[np.intp], others: NDArray[np.intp], rank: NDArray[np.intp]
    ) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Array]]:
        """Yield pairs (P,), (P,) of one of `others` with one of `rows` of a higher rank (A,) whose boxes overlap, and their IoU."""
        x, y, z, yaw = self.states
        reach = np.hypot(self.size_m[:, 0], self.size_m[:, 1]) / 2
        step = max(1, MAX_STATES // max(len(others), 1))
        for begin in range(0, len(rows), step):
            k = rows[begin : begin + step, None]
            near = np.hypot(x[others] - x[k], y[others] - y[k]) <= reach[others] + reach[k]  # False for NaN
            near &= np.abs(z[others] - z[k]) <= (self.size_m[others, 2] + self.size_m[k, 2]) / 2
            near &= rank[others] < rank[k]
            row, column = np.nonzero(near)
            a, b = others[column], rows[begin + row]
            for batch in range(0, len(a), BATCH):
                one, two = a[batch : batch + BATCH], b[batch : batch + BATCH]
                # A hundred times faster than the areas, and most pairs in reach do not overlap.
                meet = rectangles_overlap(
                    x[two] - x[one], y[two] - y[one], yaw[one], yaw[two], self.size_m[one], self.size_m[two]
                )
                one, two = one[meet], two[meet]
                share = self.iou(one, two)
                over = share > TOUCHING_IOU
                yield one[over], two[over], share[over]

    def iou(self, a: NDArray[np.intp], b: NDArray[np.intp]) -> Array:
        """Compute the IoU (P,) of pairs seen from above; 0 where one is absent or at another height."""
        x, y, z, yaw = self.states
        boxes = (np.column_stack([x[k], y[k], self.size_m[k, :2], yaw[k]]) for k in (a, b))
        level = np.abs(z[a] - z[b]) <= (self.size_m[a, 2] + self.size_m[b, 2]) / 2  # False for NaN
        return np.where(level, rectangle_iou(*boxes), 0.0)


def _states(agents: Sequence[Agent], t_s: Array) -> Array:
    """Return x, y, z, yaw (4, T, A) of all agents at times (T,), NaN for absent ones."""
    table = AgentTable.of(agents, t_s)
    return np.concatenate([table.center_m, table.yaw_rad[..., None]], axis=2).transpose(2, 1, 0)


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
            f"goes backward on {wrong:.1f} of {moved:.1f} m while its speed says forward; if its box is"
            " labeled back to front, turn yaw_rad by half a turn, and if it reverses, make speed_mps negative"
        )
