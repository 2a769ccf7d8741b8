"""How many agents are wrong, whether the scenario doubts them, and how well confidence is calibrated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import CATEGORIES, GROUPS, MIN_TRUSTED_CONFIDENCE, Agent
from log2sim.evaluation.metrics.comparison import Comparison, Mask, StateTable
from log2sim.evaluation.metrics.verdicts import (
    MAX_WRONG_SHARE,
    REPORTED,
    Verdicts,
    correctness_rules,
    judge_against_truth,
)
from log2sim.geometry import Array
from log2sim.geometry.statistics import CHI2_2DOF_95

BINS = 10
# 95 % quantiles of the chi-square distribution by degrees of freedom: 1.96^2, and -2 ln 0.05.
CHI2_95 = {1: 3.841, 2: CHI2_2DOF_95}


def reliability(confidence: Array, right: Mask) -> dict[str, Any]:
    """Compare confidences (N,) in [0, 1] with what is right (N,).

    Returns "count", "expected_calibration_error" (None without any), "error_by_chance" (likewise), which right confidences of as
    many that are independent would have on average, and "bins" of equal width from 0 to 1 with "low", "high", "count",
    "mean_confidence" and "right" (None in empty bins).

    Expected calibration error (Naeini, Cooper, Hauskrecht, AAAI 2015; Guo et al., ICML 2017): the mean over all of the
    difference between the mean confidence and the share of right ones in their bin. What lies outside 0 to 1 is in the
    outermost bins. The number of right ones in a bin is nearly normal, whose mean absolute deviation is sqrt(2 / pi) sigma.
    """
    of_bin = np.clip((confidence * BINS).astype(np.int64), 0, BINS - 1)
    count = np.bincount(of_bin, minlength=BINS)
    sums, rights = (np.bincount(of_bin, weights=v, minlength=BINS) for v in (confidence, right))
    bins = []
    for k, n in enumerate(count.tolist()):
        mean, share = (float(column[k] / n) if n else None for column in (sums, rights))
        span = {"low": k / BINS, "high": (k + 1) / BINS}
        bins.append({**span, "count": n, "mean_confidence": mean, "right": share})
    variance = np.bincount(of_bin, weights=np.clip(confidence * (1 - confidence), 0, None), minlength=BINS)
    error, chance = (
        float(off.sum() / len(right)) if len(right) else None
        for off in (np.abs(sums - rights), np.sqrt(2 / np.pi * variance))
    )
    return {"count": len(right), "expected_calibration_error": error, "error_by_chance": chance, "bins": bins}


def normalized_errors(error: Array, sigma: Array) -> dict[str, Any]:
    """Compare errors (N, D) with their standard deviations (N,), which hold for each of the D = 1 or 2 axes.

    Rows with an error of NaN are left out.

    Returns "count"; "without_sigma", those with a sigma of 0 or NaN, left out of all else; "nees", the mean of e^T P^-1
    e / D with P = sigma^2 I, 1 where sigmas are right, above where they are too small; "median", 0.69 = ln 2 for D = 2
    and 0.45 for D = 1 where errors are Gaussian too; "within_95", the share inside of the 95 % circle or interval.

    Normalized estimation error squared (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and
    Navigation", 2001, section 5.4.2). A few gross errors dominate the mean, the other two describe the rest. The noise of
    the labels is part of the errors. Errors of positions end at the gate of the matching.
    """
    there = np.isfinite(error).all(axis=1)
    known, axes = there & (sigma > 0), error.shape[1]
    squared = (error[known] ** 2).sum(axis=1) / sigma[known] ** 2
    return {
        "count": int(known.sum()),
        "without_sigma": int((there & ~known).sum()),
        "nees": float(squared.mean() / axes) if known.any() else None,
        "median": float(np.median(squared) / axes) if known.any() else None,
        "within_95": float((squared <= CHI2_95[axes]).mean()) if known.any() else None,
    }


RANGES_M = ((0.0, 15.0), (15.0, 30.0), (30.0, 50.0), (50.0, np.inf))


def correctness(c: Comparison, agents: Sequence[Agent], ticks_s: Array, ego: StateTable | None) -> dict[str, Any]:
    """Judge the reconstructed agents and summarize by kind, category and range.

    `agents`: the B reconstructed agents of the comparison. `ticks_s` (T,), s. `ego`: one row; without it there are no
    figures by range. Returns the part `correctness` of a document of `schemas/metrics-1.json`.
    """
    v = judge_against_truth(c, ego)
    wrong, confidences = v.wrong, np.array([a.confidence for a in agents], dtype=np.float64)
    # Agents of low confidence are doubted at all times.
    doubted = np.repeat(confidences[:, None] < MIN_TRUSTED_CONFIDENCE, len(ticks_s), axis=1)
    for k, agent in enumerate(agents):
        for doubt in agent.doubts:
            doubted[k] |= doubt.holds(ticks_s)
    # (B, T) standard deviations, for each axis of positions; NaN where the scenario states none.
    sigmas = {name: np.full(wrong.shape, np.nan) for name in ("sigma_xy_m", "sigma_yaw_rad", "sigma_speed_mps")}
    for name, out in sigmas.items():
        for k, agent in enumerate(agents):
            if (sigma := getattr(agent.waypoints, name)) is not None:
                out[k] = np.interp(ticks_s, agent.waypoints.t_s, sigma)

    def share(ticks: Mask, mask: Mask) -> dict[str, Any]:
        # Of one measure: of the ticks, and the agents that are wrong by it.
        hit = int((ticks & mask).sum())
        return {"share": _mean(mask[ticks]), "ticks": hit, "agents": int(_wrong_agents(ticks, mask).sum())}

    def figures(selected: Mask) -> dict[str, Any]:
        ticks = v.judged & selected
        wrong_agents, doubted_agents = _wrong_agents(ticks, wrong), np.asarray((doubted & ticks).any(axis=1))
        matched = ticks & (v.matched >= 0)
        xy, yaw, speed = (sigma[matched] for sigma in sigmas.values())
        return {
            "agents": int(ticks.any(axis=1).sum()),
            "ticks": int(ticks.sum()),
            "undecided_ticks": int((v.undecided & selected).sum()),
            "matched_ticks": int(matched.sum()),
            **{name: share(ticks, mask) for name, mask in v.measures.items()},
            "wrong": share(ticks, wrong),
            "doubted": {
                "wrong_ticks": _mean(doubted[ticks & wrong]),
                "right_ticks": _mean(doubted[ticks & ~wrong]),
                "wrong_agents": _mean(doubted_agents[wrong_agents]),
                "right_agents": _mean(doubted_agents[ticks.any(axis=1) & ~wrong_agents]),
            },
            "sigma": normalized_errors(v.error_m[matched], xy),
            "sigma_yaw": normalized_errors(v.error_rad[matched][:, None], yaw),
            "sigma_speed": normalized_errors(v.error_mps[matched][:, None], speed),
        }

    def detailed(selected: Mask) -> dict[str, Any]:  # with calibration, and by range
        ticks, range_m = v.judged & selected, c.other.range_m
        judged = ticks.any(axis=1)
        by_range = {
            f"{low:g}-{high:g}".removesuffix("inf"): figures(selected & (range_m >= low) & (range_m < high))
            for low, high in RANGES_M
        }
        of_ticks = np.broadcast_to(confidences[:, None], ticks.shape)[ticks]
        return {
            **figures(selected),
            "calibration": {
                "ticks": reliability(of_ticks, ~wrong[ticks]),
                "agents": reliability(confidences[judged], ~_wrong_agents(ticks, wrong)[judged]),
            },
            "by_range": by_range if ego is not None else None,
        }

    rows, everything = [], np.ones_like(v.judged)
    for k in np.flatnonzero(v.judged.any(axis=1)).tolist():
        ticks, low = v.judged[k], ["confidence"] if agents[k].confidence < MIN_TRUSTED_CONFIDENCE else []
        reasons = [*low, *dict.fromkeys(doubt.kind for doubt in agents[k].doubts)]
        there, count = np.unique(v.taken_for[k, ticks], return_counts=True)
        rows.append({
            "id": c.other.agents[k].id, "category": str(c.other.category[k]), "ticks": int(ticks.sum()),
            "wrong_ticks": int((wrong[k] & ticks).sum()),
            **{f"{name}_ticks": int((v.measures[name][k] & ticks).sum()) for name in REPORTED},
            "taken_for": {c.truth.agents[i].id if i >= 0 else "nothing": int(n) for i, n in zip(there, count)},
            "confidence": float(confidences[k]), "doubted": bool(reasons), "doubts": reasons,
            "mean_range_m": float(c.other.range_m[k, ticks].mean()),
        })  # fmt: skip
    shown = (v.judged | v.undecided).any(axis=1)
    kinds, categories = (set(column[shown].tolist()) for column in (c.other.group, c.other.category))
    return {
        "rules": correctness_rules(),
        **detailed(everything),
        "by_kind": {k: detailed(over_ticks(c.other.group == k, everything)) for k in GROUPS if k in kinds},
        "by_category": {
            k: figures(over_ticks(c.other.category == k, everything)) for k in CATEGORIES if k in categories
        },
        "confusion": _confusion(v, c.other.category, c.truth.category),
        "judged_agents": rows,
    }


def over_ticks(which: Mask, like: Mask) -> Mask:
    """Spread (A,) over the ticks of a mask (A, T)."""
    return np.broadcast_to(which[:, None], like.shape)


def _wrong_agents(ticks: Mask, mask: Mask) -> Mask:
    """Mark (B,) the agents of which more than `MAX_WRONG_SHARE` of the ticks are marked."""
    return np.asarray((ticks & mask).sum(axis=1) > MAX_WRONG_SHARE * ticks.sum(axis=1))


def _mean(values: Mask) -> float | None:
    return float(values.mean()) if len(values) else None


def _confusion(v: Verdicts, category: NDArray[np.str_], true_category: NDArray[np.str_]) -> dict[str, Any]:
    """Count, by category of the agent and of what is there, judged ticks, and agents by what is there most of the time."""
    names = np.array([*CATEGORIES, "nothing"])
    place = {str(name): k for k, name in enumerate(names)}
    true_place = np.array([*(place[str(c)] for c in true_category), len(CATEGORIES)], dtype=np.int64)
    ours = np.array([place[str(c)] for c in category], dtype=np.int64)
    judged = v.judged
    row, _ = np.nonzero(judged)
    counts = np.zeros((len(ours), len(names)), dtype=np.int64)
    np.add.at(counts, (row, true_place[v.taken_for[judged]]), 1)
    rows = np.flatnonzero(judged.any(axis=1))
    ticks, agents = (np.zeros((len(CATEGORIES), len(names)), dtype=np.int64) for _ in range(2))
    np.add.at(ticks, ours, counts)
    np.add.at(agents, (ours[rows], counts[rows].argmax(axis=1)), 1)
    return {
        what: {
            str(names[r]): {str(names[k]): int(matrix[r, k]) for k in np.flatnonzero(matrix[r])}
            for r in np.flatnonzero(matrix.any(axis=1))
        }
        for what, matrix in (("ticks", ticks), ("agents", agents))
    }
