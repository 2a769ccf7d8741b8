"""What corrections by hand tell: kinds of errors, and how right confidence was of the agents that a person judged.

    python tools/learn_corrections.py SCENARIO.json ...

Each scenario is one as it was reconstructed, with its corrections beside it as the studio writes them (`SCENARIO.corrections.json`). An agent
that was confirmed or got another color was right; one that was deleted, merged, split, turned, moved, or of another size or category was
wrong. Those that nobody judged count for nothing: who looks at the doubtful alone learns about the doubtful alone.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.table import cell, markdown
from entry import run

from log2sim.datatypes import EGO, MIN_TRUSTED_CONFIDENCE, Agent, Scenario
from log2sim.edit.corrections import load_corrections, nearest_agent
from log2sim.evaluation.metrics.correctness import reliability
from log2sim.geometry import NS_PER_S

RIGHT = ("confirm", "color")


def judged_agents(scenario: Scenario, corrections: dict[str, Any]) -> tuple[list[tuple[Agent, str]], Counter[str]]:
    """Agents of a scenario with the kind of each correction of them, and how many corrections concern none of them, by kind."""
    others = [agent for agent in scenario.agents if agent.id != EGO]
    shift = np.array(corrections.get("map_offset_m", scenario.map.offset_m)) - np.array(scenario.map.offset_m)
    found, without = [], Counter[str]()
    for entry in corrections["corrections"]:
        places = [entry[key] for key in ("agent", "other") if key in entry]
        t_s = [(at["t_ns"] - scenario.t0_ns) / NS_PER_S for at in places]
        ids = [nearest_agent(others, t, at["x_m"] + shift[0], at["y_m"] + shift[1]) for t, at in zip(t_s, places)]
        found += [(scenario[name], entry["kind"]) for name in ids if name is not None]
        if not any(ids):
            without[entry["kind"]] += 1
    return found, without


def main(paths: list[Path]) -> None:
    """Count over scenarios with corrections: kinds by category, what was doubted, and the calibration of confidence as `evaluate` measures it."""
    kinds: dict[str, Counter[str]] = {}
    without, told, judged = Counter[str](), Counter[str](), []
    for path in paths:
        scenario = Scenario.load(path)
        found, missing = judged_agents(scenario, load_corrections(path.with_name(f"{path.stem}.corrections.json")))
        without += missing
        for agent, kind in found:
            kinds.setdefault(agent.category, Counter())[kind] += 1
        for agent in {agent.id: agent for agent, _ in found}.values():
            right = not any(other is agent and kind not in RIGHT for other, kind in found)
            judged.append((agent.confidence, right))
            doubtful = agent.confidence < MIN_TRUSTED_CONFIDENCE or bool(agent.doubts)
            told[f"{'right' if right else 'wrong'}, {'doubted' if doubtful else 'not doubted'}"] += 1
    names = sorted({kind for counts in kinds.values() for kind in counts})
    print(markdown(["category", *names], [[c, *(str(n[k]) for k in names)] for c, n in sorted(kinds.items())]))
    print(f"\nof no agent of the scenarios (added, drawn, later ones): {dict(without)}\nagents: {dict(told)}\n")
    confidence, right = np.array(judged, dtype=float).reshape(-1, 2).T
    found = reliability(confidence, right.astype(bool))
    rows = [
        [f"{b['low']:.1f} to {b['high']:.1f}", str(b["count"]), f"{b['mean_confidence']:.2f}", f"{b['right']:.2f}"]
        for b in found["bins"] if b["count"]
    ]  # fmt: skip
    print(markdown(["confidence", "agents", "mean", "right"], rows))
    print(f"\nexpected calibration error of those judged: {cell(found['expected_calibration_error'], 3)}")


if __name__ == "__main__":
    run(main, __doc__)
