"""Scores of a reconstructed scenario: figures against the truth, and figures that need none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from log2sim.datatypes import Agent, Scenario
from log2sim.errors import ConfigError
from log2sim.evaluation.bench.bootstrap import ErrorSums, error_of
from log2sim.evaluation.metrics.evaluator import evaluate

CUTOFF_M = 2.0
"""Cutoff distance of GOSPA, m; the metrics match objects up to it."""

HORIZON_S = 1.0
EVALUATE_KEYS = (
    "recall",
    "precision",
    "position_rmse_m",
    "position_median_m",
    "speed_rmse_mps",
    "yaw_median_deg",
    "hota",
    "id_switches",
)
"""Figures of `evaluate` that a score keeps."""


@dataclass(frozen=True)
class Scope:
    """Which objects are compared with the truth: within `max_range_m` of the ego, of these `categories`; None for all."""

    max_range_m: float | None = None
    categories: tuple[str, ...] | None = None


EVERYTHING = Scope()


def check_scope(truth: Scenario | None, scope: Scope) -> None:
    """Raise `ConfigError` for an invalid scope before any work is done."""
    if truth is not None:
        evaluate(truth, truth, max_range_m=scope.max_range_m, categories=scope.categories)
    elif scope != EVERYTHING:
        raise ConfigError("a range or categories are given, but without truth nothing is compared; give --truth")


@dataclass(frozen=True)
class Score:
    """Figures of a run.

    Attributes
    ----------
    figures : dict
    by_object : mapping of str to ErrorSums
        Contributions of single objects, for figures that are errors.
    """

    figures: dict[str, Any]
    by_object: Mapping[str, ErrorSums] = field(default_factory=dict)


def score_scenario(scenario: Scenario, truth: Scenario | None, tick_s: float, scope: Scope = EVERYTHING) -> Score:
    """Score a scenario; without truth only by figures that need none.

    Notes
    -----
    - `error_m`: root mean square position error; a missed and a false object together count as one at `CUTOFF_M`.
    - `state_error_m`: position error after extrapolation by `HORIZON_S`, from the errors of position and speed.
    - `jitter_m`: see `jitter`.
    - `gap_share`: fraction of the agents' ticks without a detection.
    - `smoothing_residual_m`: median over agents of the distance of measurements from the smoothed trajectory.
    """
    out: dict[str, Any] = {
        "agents": len(scenario.others),
        "jitter_m": jitter(scenario, tick_s),
        "gap_share": _gap_share(scenario, tick_s),
        "smoothing_residual_m": _smoothing_residual(scenario),
    }
    if truth is None:
        return Score(out)
    found = evaluate(scenario, truth, max_range_m=scope.max_range_m, categories=scope.categories)
    parts = {"error_m": _error_parts(found), "state_error_m": _state_parts(found)}
    out |= {key: found[key] for key in EVALUATE_KEYS} | {key: error_of(p) for key, p in parts.items()}
    return Score(out, parts)


def _error_parts(found: Mapping[str, Any]) -> ErrorSums:
    """Compute the contribution of each object to `error_m`.

    Notes
    -----
    GOSPA (Rahmathullah et al., 2017) with p = 2 and alpha = 2, divided by the number of objects so that it is a distance:
    0 for a perfect result, the cutoff for one without a match.
    """
    parts = {}
    for row in found["agents"]:
        lost = (row["ticks"] - row["matched"]) / 2
        parts[row["id"]] = (
            row["matched"] * (row["position_rmse_m"] or 0.0) ** 2 + CUTOFF_M**2 * lost,
            row["matched"] + lost,
        )
    for row in found["false_agents"]:
        parts[f"false {row['id']}"] = CUTOFF_M**2 * row["false_ticks"] / 2, row["false_ticks"] / 2
    return parts


def _state_parts(found: Mapping[str, Any]) -> ErrorSums:
    rows = [row for row in found["agents"] if row["matched"]]
    return {
        row["id"]: (
            row["matched"] * (row["position_rmse_m"] ** 2 + (HORIZON_S * row["speed_rmse_mps"]) ** 2),
            row["matched"],
        )
        for row in rows
    }


def jitter(scenario: Scenario, tick_s: float) -> float | None:
    """Estimate the noise of waypoints, m: median over moving agents; None when none moves for long enough.

    Notes
    -----
    Third differences vanish for constant acceleration; of white noise with variance s^2 they have variance 20 s^2. Between
    waypoints farther apart than a tick, motion is the cubic Hermite spline through their positions and velocities.
    """
    if tick_s <= 0:
        return None
    values = [_third_differences(a, tick_s) for a in scenario.others if not a.static and len(a.waypoints) > 1]
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None


def _third_differences(agent: Agent, tick_s: float) -> float | None:
    from scipy.interpolate import CubicHermiteSpline

    w = agent.waypoints
    ticks = round((w.t_s[-1] - w.t_s[0]) / tick_s) + 1
    if ticks < 5:
        return None
    xy = np.column_stack([w.x_m, w.y_m])
    velocity = w.speed_mps[:, None] * np.column_stack([np.cos(w.yaw_rad), np.sin(w.yaw_rad)])
    at = CubicHermiteSpline(w.t_s, xy, velocity)(np.linspace(w.t_s[0], w.t_s[-1], ticks))
    return float(np.sqrt(np.mean(np.diff(at, n=3, axis=0) ** 2) / 20))


def _gap_share(scenario: Scenario, tick_s: float) -> float | None:
    lives = [
        (a.quality["detections"], a.waypoints.t_s[-1] - a.waypoints.t_s[0])
        for a in scenario.others
        if "detections" in a.quality
    ]
    if not lives or tick_s <= 0:
        return None
    detected, ticks = (sum(v) for v in zip(*((n, life / tick_s + 1) for n, life in lives)))
    return float(np.clip(1 - detected / ticks, 0.0, 1.0))


def _smoothing_residual(scenario: Scenario) -> float | None:
    known = [a.quality.get("smoothing_residual_rms_m") for a in scenario.others]
    values = [v for v in known if v is not None]
    return float(np.median(values)) if values else None
