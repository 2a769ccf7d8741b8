"""Predictions in pictures and on the page: where they are drawn, for whom and when."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from test_prediction import corner, line, parked, scene

from log2sim.datatypes import STANDSTILL_MPS
from log2sim.prediction.prediction import DEFAULT_METHOD, predict_scenario
from log2sim.visualization.page.document import EVERY_TICKS, SCALES, page_document
from log2sim.visualization.plot.layers import PredictedPaths, draw_predictions
from log2sim.visualization.plot.tracks import still
from log2sim.visualization.plot.viewport import assign_roles


def drawn(world, horizon_s: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Ways and ellipses that a still picture adds."""
    roles = assign_roles(world)
    ax = still(world, roles).ax
    before = set(ax.collections)
    draw_predictions(ax, roles, PredictedPaths(world, horizon_s))
    added = [c for c in ax.collections if c not in before]
    (lines,) = (c for c in added if isinstance(c, LineCollection))
    (rims,) = (c for c in added if isinstance(c, PolyCollection))
    return lines.get_segments(), [p.vertices for p in rims.get_paths()]


def test_a_still_picture_shows_every_way_from_the_track_to_its_ellipse() -> None:
    world = scene(line("a", 0.0, speed=10.0, duration_s=7.0), parked("b", 0.0, 9.0), duration_s=7.0)
    ways, rims = drawn(world, 3.0)
    assert [way[0, 0] for way in ways] == pytest.approx([30.0, 70.0])  # at 3 s and the end; 6 s is too near to it
    for way, rim in zip(ways, rims):
        assert way[-1] - way[0] == pytest.approx([30.0, 0.0], abs=1e-6)
        assert rim[:-1].mean(axis=0) == pytest.approx(way[-1], abs=1e-6)
        along, across = np.ptp(rim, axis=0)
        assert along > across > 0.0


def test_the_page_holds_the_predictions_of_movers() -> None:
    world = scene(corner("ego", 3.0), corner("a", 0.0), parked("b", 0.0, 9.0))
    found = predict_scenario(world, 3.0)
    entries = {e["id"]: e for e in page_document(world, predict_s=3.0)["layers"]["scenario"]}
    assert "predicted" not in entries["b"]
    assert "predicted" not in page_document(world)["layers"]["scenario"][0]
    columns = entries["a"]["predicted"]
    rows = found.rows_of("a")
    speed = np.abs(found.table.velocity_mps[found.row[rows], found.tick[rows]])
    rows = rows[(found.tick[rows] % EVERY_TICKS == 0) & (speed >= STANDSTILL_MPS)]
    from_start = found.forecasts[DEFAULT_METHOD].position_m[rows] - found.table.position_m[1, found.tick[rows], None]
    for name, part in (("dx_m", from_start.real), ("dy_m", from_start.imag)):
        restored = np.array([np.cumsum(np.cumsum(c)) for c in columns[name]]).T / SCALES[name]
        assert restored == pytest.approx(part, abs=0.0051)
    assert np.cumsum(np.cumsum(columns["t_s"])) / SCALES["t_s"] == pytest.approx(found.table.t_s[found.tick[rows]])
