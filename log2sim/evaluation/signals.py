"""Traffic lights against true ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from log2sim.datatypes import Scenario

MAX_DISTANCE_M = 3.0
"""Between a found and a true signal head; those of one approach stand farther apart."""
STEP_S = 0.05


def signal_figures(scenario: Scenario, truth: Scenario) -> dict[str, Any] | None:
    """Compare the traffic lights of a scenario with those of its truth; None where none are true.

    `state_right` is the share of the time at which a found signal states something in which it is right, `state_known` the
    share of time in which it states something.
    """
    if not truth.signals:
        return None
    found, true = scenario.signals, truth.aligned_to(scenario).signals
    ours, theirs = (np.array([s.position_m for s in side]).reshape(-1, 3) for side in (found, true))
    away = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(away, 2 * MAX_DISTANCE_M))
    pairs = [(i, k) for i, k in zip(rows, columns) if away[i, k] <= MAX_DISTANCE_M]
    t_s = np.arange(0.0, scenario.duration_s + 1e-9, STEP_S)
    known, right = [], []
    for i, k in pairs:
        states, actual = found[i].at(t_s), true[k].at(t_s)
        stated, judged = states != "unknown", actual != "unknown"
        known.append((stated & judged).sum() / max(int(judged.sum()), 1))
        right += (states == actual)[stated & judged].tolist()
    return {
        "true": len(true),
        "found": len(pairs),
        "false": len(found) - len(pairs),
        "position_median_m": float(np.median([away[p] for p in pairs])) if pairs else None,
        "state_known": float(np.mean(known)) if known else None,
        "state_right": float(np.mean(right)) if right else None,
    }
