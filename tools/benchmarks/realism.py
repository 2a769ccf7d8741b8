"""Realism of simulated agents as the Waymo Open Sim Agents Challenge measures it, on any scenarios with known motion.

    python tools/bench.py realism SCENARIO.json ... [--models drivers idm constant-velocity log] [--count 32] [--horizon 8] [--out FILE.json]

From moments every `--every` seconds all agents are simulated, of whom the second before is known. Each row is the mean over moments; the
last says what "drivers" reaches above "idm". Components of the map are left out where a scenario has no lanes.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
from entry import parser_of

from benchmarks.table import markdown
from log2sim.datatypes import Scenario
from log2sim.simulation.drivers import MODELS, roll_out
from log2sim.simulation.metrics.realism import COMPONENTS, Realism, Road, realism
from log2sim.simulation.present import judged, moments, recorded


def main(arguments: list[str] | None = None) -> int:
    """Measure all models on the scenarios and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("scenarios", nargs="+", type=Path, help="scenario files")
    parser.add_argument("--models", nargs="*", choices=MODELS, default=MODELS)
    parser.add_argument("--count", type=int, default=32, help="rollouts")
    parser.add_argument("--horizon", type=float, default=8.0, help="s")
    parser.add_argument("--every", type=float, default=8.0, help="s between the moments")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="also write the figures of each moment here")
    options = parser.parse_args(arguments)
    found: dict[str, list[Realism]] = {model: [] for model in options.models}
    spent, rows = dict.fromkeys(options.models, 0.0), []
    agents = 0
    for path in options.scenarios:
        scenario = Scenario.load(path)
        lanes = scenario.map_features.lanes if scenario.map_features else ()
        road = Road(lanes) if lanes else None
        for now_s in moments(scenario, options.every, options.horizon):
            log, now = recorded(scenario, now_s, options.horizon)
            who = judged(log, now)
            if not who:
                continue
            agents += len(who)
            for model in options.models:
                begin = time.process_time()
                rng = np.random.default_rng(options.seed)
                drawn = roll_out(scenario, now_s, model, horizon_s=options.horizon, count=options.count, rng=rng)
                spent[model] += time.process_time() - begin
                result = realism(log, drawn, who, now, road)
                found[model].append(result)
                rows.append(
                    {"scenario": scenario.name, "now_s": now_s, "model": model, "agents": len(who), **result._asdict()}
                )
    print(table(found, spent, options.count))
    print(f"\n{len(next(iter(found.values())))} moments, {agents} agents")
    if options.out is not None:
        options.out.write_text(json.dumps(rows, indent=1))
    return 0


def table(found: dict[str, list[Realism]], spent: dict[str, float], count: int) -> str:
    """Return the means of each model by component, and the difference of drivers and the intelligent driver model."""

    def mean(model: str, name: str) -> float:
        known = [r.likelihood[name] for r in found[model] if name in r.likelihood]
        return float(np.mean(known)) if known else float("nan")

    columns = {model: [mean(model, name) for name in COMPONENTS] for model in found}
    lines = [
        (model, *(f"{v:.3f}" for v in columns[model]), f"{np.mean([r.realism for r in results]):.3f}", f"{np.mean([r.min_ade_m for r in results]):.2f}",
         f"{1000 * spent[model] / max(count * len(results), 1):.1f}")
        for model, results in found.items() if results
    ]  # fmt: skip
    if {"drivers", "idm"} <= set(found):
        gain = np.array(columns["drivers"]) - columns["idm"]
        lines.append(("drivers - idm", *(f"{v:+.3f}" for v in gain), "", "", ""))
    return markdown(("agents", *COMPONENTS, "realism", "minADE m", "ms a rollout"), lines)


if __name__ == "__main__":
    raise SystemExit(main())
