"""How far predictions are from where agents went: ADE, FDE, and whether their sigmas are honest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import CATEGORIES, EGO, STANDSTILL_MPS
from log2sim.documents import rounded
from log2sim.geometry import Array
from log2sim.prediction.prediction import Forecast, Predictions

MOTIONS = ("moving", "standing")
"""Whether an agent is faster than `STANDSTILL_MPS` when it is predicted."""

CHI2_95 = 5.991
"""95 % quantile of chi-squared with two degrees of freedom."""

Mask = NDArray[np.bool_]


def figure_leads(lead_s: Array) -> list[int]:
    """Return the indices of the leads that figures are given for: whole seconds and the horizon."""
    whole = np.isclose(lead_s, np.rint(lead_s))
    return np.flatnonzero(whole | (np.arange(len(lead_s)) == len(lead_s) - 1)).tolist()


def measure_predictions(predictions: Predictions) -> list[dict[str, Any]]:
    """Compare predictions with the trajectories of their agents, by kind of agent and motion.

    Returns
    -------
    The `figures` of a document of `schemas/prediction-1.json`.

    Notes
    -----
    Compared are ticks at which an agent was observed, with positions at which it was observed too. Agents that the scenario
    says never move are left out: it keeps one pose for each, so that nothing can be off. ADE is the mean distance over all
    leads up to one, FDE the distance at it (Pellegrini et al., ICCV 2009). NEES is the mean squared error over the squared
    sigma for each axis, 1 when sigmas are honest.
    """
    truth, seen = _outcome(predictions)
    out = []
    for name, motion, rows in _selections(predictions):
        methods = {}
        for method, forecast in predictions.forecasts.items():
            error = (truth[rows] - forecast.position_m[rows]) * forecast.course[rows].conj()
            figures = _figures(predictions, error, forecast, rows, seen[rows])
            if figures:
                methods[method] = figures
        if methods:
            out.append({"agents": name, "motion": motion, "methods": methods})
    return out


def _outcome(predictions: Predictions) -> tuple[NDArray[np.complex128], Mask]:
    """Where agents were (N, H) at the predicted times, and whether they were observed then and at the prediction."""
    table, row, tick = predictions.table, predictions.row, predictions.tick
    where = np.full((len(row), len(predictions.lead_s)), np.nan, dtype=complex)
    seen = np.zeros(where.shape, dtype=bool)
    for h, lead in enumerate(predictions.lead_s):
        position, observed = table.later(round(lead / table.tick_s))
        where[:, h], seen[:, h] = position[row, tick], observed[row, tick]
    return where, seen


def _selections(predictions: Predictions) -> Iterator[tuple[str, str, NDArray[np.intp]]]:
    """Name the kinds of predictions to compare, with their indices: all but the ego, by category, the ego, those on paths."""
    table, row = predictions.table, predictions.row
    category = np.array([a.category for a in table.agents], dtype=object)[row]
    is_ego = np.array([a.id == EGO for a in table.agents], dtype=bool)[row]
    mobile = ~np.array([a.static for a in table.agents], dtype=bool)[row]
    moving = np.abs(table.velocity_mps[row, predictions.tick]) >= STANDSTILL_MPS
    kinds: list[tuple[str, Any]] = [("all", ~is_ego), *((c, ~is_ego & (category == c)) for c in CATEGORIES)]
    for name, chosen in [*kinds, ("ego", is_ego), ("on a path", predictions.on_path)]:
        for motion, there in zip(MOTIONS, (moving, ~moving)):
            yield name, motion, np.flatnonzero(chosen & mobile & there)


def _figures(
    predictions: Predictions, error: NDArray[np.complex128], forecast: Forecast, rows: NDArray[np.intp], seen: Mask
) -> list[dict[str, Any]]:
    """Compute the figures of errors (K, H) in the frames of the predicted courses; one entry for each lead with any."""
    out = []
    distance = np.abs(error)
    for h in figure_leads(predictions.lead_s):
        there = seen[:, h]
        if not there.any():
            continue
        sigma = forecast.sigma_m[rows[there], h]
        off = np.stack([error[there, h].real, error[there, h].imag], axis=-1)
        known = (sigma > 0).all(axis=1)
        squared = ((off[known] / sigma[known]) ** 2).sum(axis=1)
        upto = seen[there, : h + 1]
        out.append(
            {
                "lead_s": round(float(predictions.lead_s[h]), 3),
                "ticks": int(there.sum()),
                "agents": len(np.unique(predictions.row[rows[there]])),
                "ade_m": rounded(float(distance[there, : h + 1][upto].mean()), 4),
                "fde_m": rounded(float(distance[there, h].mean()), 4),
                "nees": rounded(float(squared.mean()) / 2, 4) if known.any() else None,
                "within_95": rounded(float((squared < CHI2_95).mean()), 4) if known.any() else None,
            }
        )
    return out
