"""What corrections by hand tell: kinds of errors, and how right confidence was of the agents that a person judged.

    python tools/learn_corrections.py SCENARIO.json ... [--out FILE.json]

Each scenario is one as it was reconstructed, with its corrections beside it as the studio writes them (`SCENARIO.corrections.json`). An agent
that was confirmed or got another color was right; one that was deleted, merged, split, turned, moved, or of another size or category was
wrong. Those that nobody judged count for nothing: who looks at the doubtful alone learns about the doubtful alone.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.table import markdown
from entry import parser_of

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


def learn(paths: list[Path]) -> dict[str, Any]:
    """Count over scenarios with corrections; `kinds` by category, `confidence` as `evaluate` measures its calibration."""
    kinds: dict[str, Counter[str]] = {}
    without: Counter[str] = Counter()
    confidence: list[float] = []
    right: list[bool] = []
    told = Counter[str]()
    for path in paths:
        scenario = Scenario.load(path)
        found, missing = judged_agents(scenario, load_corrections(path.with_name(f"{path.stem}.corrections.json")))
        without += missing
        for agent, kind in found:
            kinds.setdefault(agent.category, Counter())[kind] += 1
        for agent in {agent.id: agent for agent, _ in found}.values():
            wrong = any(other is agent and kind not in RIGHT for other, kind in found)
            confidence.append(agent.confidence)
            right.append(not wrong)
            doubtful = agent.confidence < MIN_TRUSTED_CONFIDENCE or bool(agent.doubts)
            told[f"{'wrong' if wrong else 'right'}, {'doubted' if doubtful else 'not doubted'}"] += 1
    calibration = reliability(np.array(confidence), np.array(right, dtype=bool))
    return {
        "scenarios": len(paths),
        "kinds": kinds,
        "without_agent": without,
        "agents": told,
        "confidence": calibration,
    }


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("scenarios", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, help="JSON file with all counts")
    options = parser.parse_args(arguments)
    found = learn(options.scenarios)
    names = sorted({kind for counts in found["kinds"].values() for kind in counts})
    print(markdown(["category", *names], [[c, *(str(n[k]) for k in names)] for c, n in sorted(found["kinds"].items())]))
    print(
        f"\nof no agent of the scenarios (added, drawn, later ones): {dict(found['without_agent'])}\nagents: {dict(found['agents'])}\n"
    )
    bins = [b for b in found["confidence"]["bins"] if b["count"]]
    print(markdown(["confidence", "agents", "mean", "right"], [
        [f"{b['low']:.1f} to {b['high']:.1f}", str(b["count"]), f"{b['mean_confidence']:.2f}", f"{b['right']:.2f}"] for b in bins
    ]))  # fmt: skip
    error = found["confidence"]["expected_calibration_error"]
    print(f"\nexpected calibration error of those judged: {'-' if error is None else f'{error:.3f}'}")
    if options.out is not None:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
