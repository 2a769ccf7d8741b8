"""Realism of simulated agents as the Waymo Open Sim Agents Challenge measures it, on any scenarios with known motion.

    python tools/bench.py realism SCENARIO.json|SCENE.toml|LOG|KITTI_TRACKING ... [--each]

Logs are taken by their labels, and so are the sequences of the KITTI tracking benchmark with `ego_motion`. From moments every 8 s all
agents are simulated, of whom the second before is known. Each row is the mean over moments; the last says what "drivers" reaches above
"idm"; with --each there is such a table for each scenario, too. Components of the map are left out where a scenario has no lanes.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from benchmarks.table import markdown
from benchmarks.warnings import scenarios
from log2sim.datatypes import Scenario
from log2sim.simulation.drivers import MODELS, roll_out
from log2sim.simulation.metrics.realism import COMPONENTS, Realism, Road, realism
from log2sim.simulation.prediction.motion_table import TICK_S
from log2sim.simulation.present import HISTORY_S, judged, recorded

COUNT, HORIZON_S, EVERY_S = 32, 8.0, 8.0

Results = dict[str, list[Realism]]


def moments(scenario: Scenario) -> list[float]:
    """Return times from which agents can be simulated: with a past, and half the horizon at least to compare with."""
    w = max(scenario.agents, key=lambda a: len(a.waypoints)).waypoints
    wanted = np.arange(w.t_s[0] + HISTORY_S, w.t_s[-1] - min(HORIZON_S, w.t_s[-1] - w.t_s[0] - HISTORY_S) / 2, EVERY_S)
    # Where others have waypoints, too, so that nothing is taken from later ones.
    rows = np.unique(np.searchsorted(w.t_s, wanted - TICK_S / 4))
    return [float(t) for t in w.t_s[rows]]


def main(logs: list[Path], each: bool = False) -> None:
    """Measure all models by 32 rollouts of 8 s and print the table."""
    found: Results = {model: [] for model in MODELS}
    spent, agents = dict.fromkeys(MODELS, 0.0), 0
    for name, scenario in (pair for path in logs for pair in scenarios(path)):
        before = {model: len(results) for model, results in found.items()}
        lanes = scenario.map_features.lanes if scenario.map_features else ()
        road = Road(lanes) if lanes else None
        for now_s in moments(scenario):
            log, now = recorded(scenario, now_s, HORIZON_S)
            who = judged(log, now)
            agents += len(who)
            for model in MODELS if who else ():
                begin = time.process_time()
                rng = np.random.default_rng(0)
                drawn = roll_out(scenario, now_s, model, horizon_s=HORIZON_S, count=COUNT, rng=rng)
                spent[model] += time.process_time() - begin
                found[model].append(realism(log, drawn, who, now, road))
        if each:
            print(f"{name}\n\n{table({model: r[before[model] :] for model, r in found.items()})}\n")
    print(table(found))
    count = len(found[MODELS[0]])
    times = ", ".join(f"{model} {1000 * s / max(COUNT * count, 1):.1f}" for model, s in spent.items())
    print(f"\n{count} moments, {agents} agents; ms of processor time a rollout: {times}")


def table(found: Results) -> str:
    """Return the table of the means of all models."""
    columns, lines = {}, []
    for model, results in ((m, r) for m, r in found.items() if r):
        known = [[r.likelihood[name] for r in results if name in r.likelihood] for name in COMPONENTS]
        columns[model] = np.array([np.mean(values) if values else np.nan for values in known])
        whole = f"{np.mean([r.realism for r in results]):.3f}", f"{np.mean([r.min_ade_m for r in results]):.2f}"
        lines.append((model, *(f"{v:.3f}" for v in columns[model]), *whole))
    if columns:
        lines.append(("drivers - idm", *(f"{v:+.3f}" for v in columns["drivers"] - columns["idm"]), "", ""))
    return markdown(("agents", *COMPONENTS, "realism", "minADE m"), lines)
