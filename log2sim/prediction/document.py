"""Predictions as a JSON document, and their figures as a table for the terminal."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.geometry import Array
from log2sim.prediction.displacement import measure_predictions
from log2sim.prediction.prediction import METHODS, Predictions

VERSION = 1

_DIGITS = 3


def prediction_document(
    scenario: Scenario, predictions: Predictions, *, with_positions: bool = False
) -> dict[str, Any]:
    """Return the document of `schemas/prediction-1.json`; the predicted positions only where asked for."""
    document = {
        "prediction_version": VERSION,
        "scenario": scenario.name,
        "scenario_sha256": scenario.digest,
        "tick_s": predictions.table.tick_s,
        "lead_s": [round(float(lead), _DIGITS) for lead in predictions.lead_s],
        "methods": {name: METHODS[name] for name in predictions.forecasts},
        "agents": [_constants(predictions, k) for k in range(len(predictions.table.agents))],
        "figures": measure_predictions(predictions),
    }
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
        "id": agent.id,
        "category": agent.category,
        "ticks": len(rows),
        "velocity_constant_s": velocity_s,
        "turn_constant_s": turn_s,
    }


def _positions(predictions: Predictions, agent: str) -> dict[str, Any]:
    """Return the predictions of an agent, a row for each tick and a column for each lead."""
    rows = predictions.rows_of(agent)
    methods = {}
    for name, forecast in predictions.forecasts.items():
        position = forecast.position_m[rows]
        methods[name] = {
            "x_m": _listed(position.real),
            "y_m": _listed(position.imag),
            "course_rad": _listed(np.angle(forecast.course[rows])),
            "sigma_along_m": _listed(forecast.sigma_m[rows, :, 0]),
            "sigma_across_m": _listed(forecast.sigma_m[rows, :, 1]),
        }
    return {"id": agent, "t_s": _listed(predictions.table.t_s[predictions.tick[rows]]), "methods": methods}


def _listed(values: Array) -> Any:
    return np.round(values, _DIGITS).tolist()
