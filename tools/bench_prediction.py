"""How far predictions are off in random traffic with known truth, by what they start from and by method.

    python tools/bench_prediction.py [--seeds 4] [--past] [--by-category]

States: those of the truth; noisy positions smoothed over the whole log, as a reconstruction does; with --past smoothed at
each tick over the five seconds before it, as a system does that measures while it drives (20 s a seed); and differences of
noisy positions, as Chen's system smooths them. Compared are agents that move, with where they truly went.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict

import numpy as np
import prediction_worlds as worlds

from log2sim.prediction.displacement import CHI2_95
from log2sim.prediction.motion_table import MotionTable, table_of
from log2sim.prediction.prediction import METHODS, leads_of, predict_table

LEADS_S = (1, 2, 3)
MOVING_MPS = 0.15
# Before, too little is known of an agent for a fair comparison.
BEGIN_S = 3.0


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--past", action="store_true", help="also states smoothed over the past only")
    parser.add_argument("--by-category", action="store_true")
    asked = parser.parse_args()
    sums: dict[tuple[str, str, str, int], list[np.ndarray]] = defaultdict(list)
    spent, count = 0.0, 0
    for seed in range(asked.seeds):
        courses = worlds.courses(seed)
        truth = table_of(worlds.true_scenario(courses))
        tables = {"truth": truth, "whole log": table_of(worlds.smoothed_scenario(courses, seed))}
        if asked.past:
            tables["past only"] = causal_table(truth, courses, seed)
        tables["differences"] = difference_table(truth, courses, seed)
        for source, table in tables.items():
            start = time.process_time()
            found = predict_table(table, leads_of(3.0))
            spent, count = spent + time.process_time() - start, count + len(found.row)
            for method, forecast in found.forecasts.items():
                collect(sums, (source, method), truth, (found.row, found.tick), forecast)
    print(
        f"{'states':12} {'agents':12} {'method':9} "
        + " ".join(f"{f'FDE {s} s':>8} {'NEES':>5} {'in 95':>5}" for s in LEADS_S)
    )
    for source, method, group in dict.fromkeys(key[:3] for key in sums):
        if group != "all" and not asked.by_category:
            continue
        cells = []
        for lead in LEADS_S:
            distance, squared = (np.concatenate(c) for c in zip(*sums[source, method, group, lead]))
            cells.append(f"{distance.mean():8.2f} {squared.mean() / 2:5.2f} {(squared < CHI2_95).mean():5.2f}")
        print(f"{source:12} {group:12} {method:9} " + " ".join(cells))
    print(f"{count} agent-ticks, {len(METHODS)} methods: {1e4 * spent / count:.2f} s for 10,000")


def collect(sums, key, truth: MotionTable, at, forecast) -> None:
    """Add the errors of a method to the sums, by category."""
    row, tick = at
    category = np.array([a.category for a in truth.agents])[row]
    moves = (np.abs(truth.velocity_mps[row, tick]) > MOVING_MPS) & (truth.t_s[tick] >= BEGIN_S)
    for lead in LEADS_S:
        later, _ = truth.later(round(lead / truth.tick_s))
        h = 2 * lead - 1
        error = (forecast.position_m[:, h] - later[row, tick]) * forecast.course[:, h].conj()
        squared = (error.real / forecast.sigma_m[:, h, 0]) ** 2 + (error.imag / forecast.sigma_m[:, h, 1]) ** 2
        there = moves & np.isfinite(error)
        for group in ("all", *dict.fromkeys(category)):
            chosen = there & ((category == group) | (group == "all"))
            sums[(*key, str(group), lead)].append((np.abs(error[chosen]), squared[chosen]))


def causal_table(truth: MotionTable, courses, seed: int) -> MotionTable:
    """States smoothed at each tick over what was measured up to then."""
    position, velocity = np.empty_like(truth.position_m), np.empty_like(truth.velocity_mps)
    ticks = np.arange(len(truth.t_s))
    for k, course in enumerate(courses):
        xy, v = worlds.causal_states(course, k, seed, ticks)
        position[k], velocity[k] = xy @ [1, 1j], v @ [1, 1j]
    return _with(truth, position, velocity, courses)


def difference_table(truth: MotionTable, courses, seed: int) -> MotionTable:
    """Measured positions, with the differences to the ones before as velocities."""
    position = np.array([worlds.noisy(course, k, seed) @ [1, 1j] for k, course in enumerate(courses)])
    velocity = np.diff(position, axis=1, prepend=position[:, :1]) / truth.tick_s
    velocity[:, 0] = velocity[:, 1]
    return _with(truth, position, velocity, courses)


def _with(truth: MotionTable, position, velocity, courses) -> MotionTable:
    sigma = np.array([worlds.SIGMA_M[c.category] for c in courses])[:, None] * np.ones(position.shape)
    center = np.stack([position.real, position.imag, 0.0 * sigma], axis=-1)
    states = truth.t_s, center, np.angle(velocity), np.abs(velocity)
    return MotionTable(truth.agents, *states, truth.tick_s, velocity, sigma, truth.observed, truth.piece)


if __name__ == "__main__":
    main()
