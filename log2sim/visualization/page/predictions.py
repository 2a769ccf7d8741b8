"""Predictions of a page: for each mover short columns of where it was expected to go."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.datatypes import STANDSTILL_MPS, Scenario
from log2sim.errors import ConfigError
from log2sim.prediction.prediction import DEFAULT_METHOD, predict_scenario
from log2sim.visualization.page.columns import SCALES, second_differences

EVERY_TICKS = 2
"""A page shows a new prediction five times a second, which looks steady and takes half as much room as one at every tick."""

MAX_PREDICTIONS = 1_000_000
"""Of all agents together: 30 MB of a page for 3 s each."""


def predicted_columns(scenario: Scenario, horizon_s: float) -> dict[str, dict[str, Any]]:
    """Predict agents while they move: by agent, paths relative to where it was, and the ellipse at their ends.

    Raises
    ------
    ConfigError
        For a horizon that predictions do not have, or more predictions than a browser can be expected to hold.
    """
    found = predict_scenario(scenario, horizon_s, methods=(DEFAULT_METHOD,))
    table, forecast = found.table, found.forecasts[DEFAULT_METHOD]
    moves = np.abs(table.velocity_mps[found.row, found.tick]) >= STANDSTILL_MPS
    shown = moves & (found.tick % EVERY_TICKS == 0)
    if shown.sum() > MAX_PREDICTIONS:
        raise ConfigError(
            f"{shown.sum()} predictions are more than the {MAX_PREDICTIONS} that a page can hold; take fewer agents, such as "
            f"with `log2sim edit --only`, or leave predictions out"
        )
    out = {}
    for agent in scenario.agents:
        rows = found.rows_of(agent.id)
        rows = rows[shown[rows]]
        if len(rows):
            way = forecast.position_m[rows] - table.position_m[found.row[rows], found.tick[rows], None]
            columns = {
                "course_rad": np.unwrap(np.angle(forecast.course[rows, -1])),
                "along_m": forecast.sigma_m[rows, -1, 0],
                "across_m": forecast.sigma_m[rows, -1, 1],
            }
            out[agent.id] = {
                "t_s": second_differences(table.t_s[found.tick[rows]], SCALES["t_s"]),
                "dx_m": [second_differences(column, SCALES["dx_m"]) for column in way.real.T],
                "dy_m": [second_differences(column, SCALES["dy_m"]) for column in way.imag.T],
                **{name: second_differences(column, SCALES[name]) for name, column in columns.items()},
            }
    return out
