"""How far predictions are from where agents went, as figures and as a document."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import CATEGORIES, EGO, STANDSTILL_MPS, Scenario
from log2sim.files.documents import rounded
from log2sim.simulation.prediction.prediction import METHODS, Forecast, Predictions

MOTIONS = ("moving", "standing")
"""Whether an agent is faster than `STANDSTILL_MPS` when it is predicted."""

CHI2_95 = 5.991
"""95 % quantile of chi-squared with two degrees of freedom."""

Mask = NDArray[np.bool_]


def measure_predictions(predictions: Predictions) -> list[dict[str, Any]]:
    """Return the `figures` of a document of `schemas/prediction-1.json`, by kind of agent and motion.

    Compared with the trajectories of their agents are ticks at which an agent was observed, with positions at which it was
    observed too. Agents that the scenario says never move are left out: it keeps one pose for each, so that nothing can be off.
    ADE is the mean distance over all leads up to one, FDE the distance at it (Pellegrini et al., ICCV 2009). NEES is the mean
    squared error over the squared sigma for each axis, 1 when sigmas are honest.
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
    distance, lead_s = np.abs(error), predictions.lead_s
    whole = np.isclose(lead_s, np.rint(lead_s)) | (np.arange(len(lead_s)) == len(lead_s) - 1)
    for h in np.flatnonzero(whole).tolist():  # whole seconds and the horizon
        there = seen[:, h]
        if not there.any():
            continue
        sigma = forecast.sigma_m[rows[there], h]
        off = np.stack([error[there, h].real, error[there, h].imag], axis=-1)
        known = (sigma > 0).all(axis=1)
        squared = ((off[known] / sigma[known]) ** 2).sum(axis=1)
        upto = seen[there, : h + 1]
        ade_m, fde_m = distance[there, : h + 1][upto].mean(), distance[there, h].mean()
        nees, within = (squared.mean() / 2, (squared < CHI2_95).mean()) if known.any() else (None, None)
        agents = len(np.unique(predictions.row[rows[there]]))
        figures = {"ade_m": ade_m, "fde_m": fde_m, "nees": nees, "within_95": within}
        out.append({
            "lead_s": round(float(lead_s[h]), 3), "ticks": int(there.sum()), "agents": agents,
            **{key: None if value is None else rounded(float(value), 4) for key, value in figures.items()},
        })  # fmt: skip
    return out


VERSION = 1

_DIGITS = 3


def prediction_document(
    scenario: Scenario, predictions: Predictions, *, with_positions: bool = False
) -> dict[str, Any]:
    """Return the document of `schemas/prediction-1.json`; the predicted positions only where asked for."""
    document = {
        "prediction_version": VERSION, "scenario": scenario.name, "scenario_sha256": scenario.digest,
        "tick_s": predictions.table.tick_s, "lead_s": [round(float(lead), _DIGITS) for lead in predictions.lead_s],
        "methods": {name: METHODS[name] for name in predictions.forecasts},
        "agents": [_constants(predictions, k) for k in range(len(predictions.table.agents))],
        "figures": measure_predictions(predictions),
    }  # fmt: skip
    if not with_positions:
        return document
    return {**document, "predictions": [_positions(predictions, a.id) for a in predictions.table.agents]}


def format_figures(document: dict[str, Any]) -> str:
    """Format the figures of a document: a line for each kind of agent, motion and method."""
    lead_s = sorted({f["lead_s"] for entry in document["figures"] for m in entry["methods"].values() for f in m})
    if not lead_s:
        return "nothing to compare with: no agent is observed for a second or longer"
    heads = [f"{name} {lead:g} s" for name in ("ADE", "FDE") for lead in lead_s]
    cells = [["errors in m", "method", *heads, "NEES", "in 95 %", "ticks"]]
    for entry in document["figures"]:
        name = f"{entry['agents']}, {entry['motion']}"
        for method, figures in entry["methods"].items():
            at = {f["lead_s"]: f for f in figures}
            errors = [f"{at[s][key]:.2f}" if s in at else "-" for key in ("ade_m", "fde_m") for s in lead_s]
            last = figures[-1]
            honest = ["-" if last[key] is None else f"{last[key]:.2f}" for key in ("nees", "within_95")]
            cells.append([name, method, *errors, *honest, str(last["ticks"])])
            name = ""
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    return "\n".join(
        "  ".join([*(c.ljust(w) for c, w in zip(row[:2], widths)), *(c.rjust(w) for c, w in zip(row[2:], widths[2:]))])
        for row in cells
    )


def _constants(predictions: Predictions, k: int) -> dict[str, Any]:
    """Return an agent with the time constants that its whole past chose; null without predictions, or for infinity."""
    agent = predictions.table.agents[k]
    rows = np.flatnonzero(predictions.row == k)
    chosen = predictions.constants_s[rows[-1]] if len(rows) else np.full(2, np.inf)
    velocity_s, turn_s = (float(c) if np.isfinite(c) else None for c in chosen)
    return {
        "id": agent.id, "category": agent.category, "ticks": len(rows), "velocity_constant_s": velocity_s,
        "turn_constant_s": turn_s,
    }  # fmt: skip


def _positions(predictions: Predictions, agent: str) -> dict[str, Any]:
    """Return the predictions of an agent, a row for each tick and a column for each lead."""
    rows = predictions.rows_of(agent)
    methods = {}
    for name, forecast in predictions.forecasts.items():
        position, sigma = forecast.position_m[rows], forecast.sigma_m[rows]
        columns = {
            "x_m": position.real, "y_m": position.imag, "course_rad": np.angle(forecast.course[rows]),
            "sigma_along_m": sigma[:, :, 0], "sigma_across_m": sigma[:, :, 1],
        }  # fmt: skip
        methods[name] = {key: np.round(values, _DIGITS).tolist() for key, values in columns.items()}
    t_s = np.round(predictions.table.t_s[predictions.tick[rows]], _DIGITS).tolist()
    return {"id": agent, "t_s": t_s, "methods": methods}
