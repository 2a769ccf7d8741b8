"""What corrections by hand are worth: the doubtful and the wrong agents corrected as a person would who sees the truth.

    python tools/bench.py corrections SCENARIO TRUTH --range 40

TRUTH is a log with labels, or a scenario. Each agent that the scenario doubts, or that is wrong at more than a fifth of its ticks, gets what a person would
give it: confirmed, deleted, merged, turned round, of another category or size (to 0.1 m), moved by key poses with errors of 5 cm, one a second.
Agents that are found at less than a fifth of their ticks are added: by a click, key poses while the truth says that they are seen, and a size.
Figures are those of `log2sim evaluate` before and after. Seconds an agent are those of the keystroke-level model (Card, Moran, Newell,
Communications of the ACM 23, 1980: 0.28 s a key, 1.1 s to point, 0.1 s a button) for carrying it out in the studio, without the looking and thinking.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.table import markdown
from log2sim.datatypes import GROUP_OF, Agent, Scenario
from log2sim.edit.corrections import correct
from log2sim.evaluation.metrics.correctness import MAX_WRONG_SHARE
from log2sim.evaluation.metrics.evaluator import evaluate, place_truth
from log2sim.evaluation.metrics.truth import load_truth
from log2sim.geometry import NS_PER_S, wrap_angle

HAND_M, HAND_RAD = 0.05, 0.02
MOVED_M = 0.5  # a person moves what is farther off, a quarter of a car's width
KEY_S, POINT_S, BUTTON_S = 0.28, 1.1, 0.1
FIGURES = ("recall", "precision", "hota", "position_rmse_m", "speed_rmse_mps")
MEASURES = ("wrong", "invented", "duplicate", "backwards", "wrong_size", "wrong_speed", "wrong_motion", "wrong_class")
Step = tuple[str, dict[str, Any]]  # id of the agent, "" of a new one, and the correction


def steps_of(
    scenario: Scenario, truth: Scenario, max_range_m: float | None, rng: np.random.Generator
) -> list[list[Step]]:
    """The corrections of a person, by agent."""
    found = evaluate(scenario, truth, max_range_m=max_range_m)
    placed, _ = place_truth(load_truth(truth, scenario), scenario)
    shift, later_s = placed.shift_to(scenario), (scenario.t0_ns - placed.t0_ns) / NS_PER_S
    true = {agent.id: agent for agent in placed.others}
    rows = {row["id"]: row for row in found["correctness"]["judged_agents"]}
    owner = {
        name: max(row["matched_ids"], key=row["matched_ids"].get)
        for name, row in ((r["id"], r) for r in found["agents"])
        if row["matched_ids"]
    }
    out, gone = [], set()
    for agent in sorted(scenario.others, key=lambda a: not a.is_doubtful):
        row = rows.get(agent.id)
        if (
            row is None
            or agent.id in gone
            or agent.quarantined
            or not (agent.is_doubtful or row["wrong_ticks"] > MAX_WRONG_SHARE * row["ticks"])
        ):
            continue
        name = max(row["taken_for"], key=row["taken_for"].get)
        same = true.get(name)
        if same is None:
            out.append([_step(scenario, agent, "delete")])
        elif owner.get(name, agent.id) != agent.id:
            other = scenario[owner[name]]
            alike = GROUP_OF.get(agent.category) == GROUP_OF.get(other.category) and other.id not in gone
            more = {"other": _reference(scenario, other)} if alike else {}
            out.append([_step(scenario, agent, "merge" if alike else "delete", **more)])
            gone |= {other.id} if alike else set()
        else:
            sure = [_step(scenario, agent, "confirm")] if agent.is_doubtful else []
            out.append([*sure, *_of_known(scenario, agent, same, row, (shift, later_s), rng)])
        gone.add(agent.id)
    out += [
        list(_of_missed(scenario, true[row["id"]], (shift, later_s), rng))
        for row in found["agents"]
        if row["matched"] <= MAX_WRONG_SHARE * row["ticks"] and not row["matched_ids"].keys() & gone
    ]
    return [own for own in out if own]


def _of_missed(scenario: Scenario, true: Agent, place: tuple[Any, float], rng: np.random.Generator) -> Iterator[Step]:
    """Corrections that add an agent: where it is first seen, along its way, and as large as it is."""
    shift, later_s = place
    w = true.waypoints
    seen_s = (w.t_s if w.visible is None or not w.visible.any() else w.t_s[w.visible]) - later_s
    seen_s = seen_s[(seen_s >= 0) & (seen_s <= scenario.duration_s)]
    if not len(seen_s):
        return
    count = 1 if true.static else int(np.ceil(np.ptp(seen_s))) + 1
    t_s = np.linspace(seen_s[0], seen_s[-1], count) if count > 1 else np.full(1, np.median(seen_s))
    at = true.at(t_s + later_s)
    poses = _key_poses(scenario, t_s, at, shift, np.flatnonzero(at.valid), rng)
    here = {k: poses[0][k] for k in ("t_ns", "x_m", "y_m")}
    yield "", {"kind": "add", "category": true.category, "poses": [{**here, "yaw_rad": 0.0}]}
    yield "", {"kind": "move", "agent": here, "poses": poses}
    yield "", {"kind": "size", "agent": here, "size_m": [max(round(float(v), 1), 0.1) for v in true.size_m]}


def _of_known(
    scenario: Scenario,
    agent: Agent,
    true: Agent,
    row: dict[str, Any],
    place: tuple[Any, float],
    rng: np.random.Generator,
) -> Iterator[Step]:
    """Corrections of an agent whose object is known."""
    much = MAX_WRONG_SHARE * row["ticks"]
    if row["wrong_class_ticks"] > much:
        yield _step(scenario, agent, "category", category=true.category)
    if row["wrong_size_ticks"] > much or GROUP_OF.get(agent.category) != GROUP_OF.get(true.category):
        yield _step(scenario, agent, "size", size_m=[max(round(float(v), 1), 0.1) for v in true.size_m])
    if row["backwards_ticks"] > much:
        yield _step(scenario, agent, "flip")
    shift, later_s = place
    w = agent.waypoints
    t_s = np.linspace(w.t_s[0], w.t_s[-1], int(np.ceil(np.ptp(w.t_s))) + 1)
    t_s = t_s[true.at(t_s + later_s).valid]
    if agent.static and true.static:
        t_s = t_s[len(t_s) // 2 :][:1]
    at, ours = true.at(t_s + later_s), agent.at(t_s)
    off = np.hypot(at.x_m + shift[0] - ours.x_m, at.y_m + shift[1] - ours.y_m)
    there = at.valid & ours.valid
    if there.any() and (off[there].mean() > MOVED_M or row["wrong_speed_ticks"] + row["wrong_motion_ticks"] > much):
        poses = _key_poses(scenario, t_s, at, shift, np.flatnonzero(there), rng)
        yield _step(scenario, agent, "move", poses=poses)


def _key_poses(
    scenario: Scenario, t_s: Any, at: Any, shift: Any, rows: Any, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Poses of the true states `at` as a hand puts them."""
    return [
        {
            "t_ns": scenario.t0_ns + round(float(t_s[k]) * NS_PER_S),
            "x_m": float(at.x_m[k] + shift[0] + rng.normal(0, HAND_M)),
            "y_m": float(at.y_m[k] + shift[1] + rng.normal(0, HAND_M)),
            "yaw_rad": float(wrap_angle(at.yaw_rad[k] + rng.normal(0, HAND_RAD))),
        }
        for k in rows
    ]


def _reference(scenario: Scenario, agent: Agent) -> dict[str, Any]:
    """The place of an agent in the middle of its life, as the studio names it."""
    t_s = float(np.mean(agent.waypoints.t_s[[0, -1]]))
    at = agent.at(t_s)
    return {"t_ns": scenario.t0_ns + round(t_s * NS_PER_S), "x_m": float(at.x_m[0]), "y_m": float(at.y_m[0])}


def _step(scenario: Scenario, agent: Agent, kind: str, **more: Any) -> Step:
    return agent.id, {"kind": kind, "agent": _reference(scenario, agent), **more}


# Keys, clicks and drags in the studio by kind of correction; a key pose is sought, begun, dragged, turned and accepted.
ACTIONS = {
    "add": (1, 4, 0), "merge": (1, 1, 0), "size": (9, 4, 0), "category": (1, 1, 0), "confirm": (1, 0, 0), "delete": (1, 0, 0), "flip": (1, 0, 0),
}  # fmt: skip
POSE_ACTIONS = (2, 1, 2)


def effort(steps: list[list[Step]]) -> tuple[float, float]:
    """Actions and seconds an agent."""
    made = [ACTIONS[entry["kind"]] for own in steps for _, entry in own if entry["kind"] in ACTIONS]
    made += [POSE_ACTIONS for own in steps for _, entry in own if entry["kind"] == "move" for _ in entry["poses"]]
    made += [(0, 2, 0) for own in steps if own[0][1]["kind"] != "add"]  # the time, and the agent
    keys, clicks, drags = np.sum(made, axis=0) / max(len(steps), 1)
    return keys + clicks + drags, KEY_S * keys + (POINT_S + BUTTON_S) * (clicks + 2 * drags)


def figures(scenario: Scenario, truth: Any, max_range_m: float | None) -> dict[str, Any]:
    found = evaluate(scenario, truth, max_range_m=max_range_m)
    judged = found["correctness"]
    agents = {name: judged[name]["agents"] for name in MEASURES}
    return {
        **{k: found[k] for k in FIGURES},
        "wrong_share": judged["wrong"]["share"],
        **agents,
        "doubtful": len(scenario.doubtful),
    }


def main(scenario_path: Path, truth_path: Path, range: float | None = None) -> None:
    """Print figures before and after, of agents up to `range` m from the ego."""
    scenario = Scenario.load(scenario_path)
    truth = load_truth(truth_path, scenario, points=True)
    steps = steps_of(scenario, truth, range, np.random.default_rng(0))
    made = [entry for own in steps for _, entry in own]
    after = correct(scenario, {"corrections": made, "map_offset_m": list(scenario.map.offset_m)})
    columns = [figures(s, truth, range) for s in (scenario, after.scenario)]
    rows = [[k, *("-" if c[k] is None else f"{c[k]:.3g}" for c in columns)] for k in columns[0]]
    print(markdown(["figure", "before", "corrected"], rows))
    kinds, new = Counter(entry["kind"] for entry in made), sum(own[0][1]["kind"] == "add" for own in steps)
    actions, seconds = effort(steps)
    print(f"\n{len(steps) - new} of {len(scenario.others)} agents, {new} added, {dict(kinds)}, {len(after.unmatched)} without their agent; "
          f"an agent: {actions:.0f} actions, {seconds:.0f} s")  # fmt: skip
