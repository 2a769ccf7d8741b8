"""Predictions in pictures and on the page: where they are drawn, for whom and when."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import names, run
from matplotlib.collections import LineCollection, PolyCollection
from test_prediction import circle, corner, line, parked, scene

from log2sim.datatypes import STANDSTILL_MPS
from log2sim.errors import ConfigError
from log2sim.prediction.prediction import DEFAULT_METHOD, predict_scenario
from log2sim.visualization.page import document as page_predictions
from log2sim.visualization.page.document import EVERY_TICKS, SCALES, page_document, predicted_columns
from log2sim.visualization.plot.layers import Overlays, PredictedPaths, draw_predictions
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


def test_who_stands_or_is_absent_has_no_way() -> None:
    stops = line("a", 0.0, speed=0.0, duration_s=9.0)
    ways = PredictedPaths(scene(stops, line("b", 0.0, 9.0, duration_s=2.0)), 3.0)
    assert ways.at("a", 5.0) is None
    assert ways.at("b", 1.0) is not None
    assert ways.at("b", 3.0) is None
    assert ways.at("b", -1.0) is None


@pytest.mark.slow
def test_the_legend_tells_what_is_drawn(tmp_path: Path) -> None:
    world = scene(corner("ego", 3.0), corner("a", 0.0))
    legend = still(world, assign_roles(world), Overlays(predicted=PredictedPaths(world, 2.5))).figure.legends[0]
    assert "predicted for 2.5 s, 1 sigma" in [text.get_text() for text in legend.get_texts()]
    world.save(tmp_path / "scenario.json")
    sizes = {}
    for name, options in (("plain.png", []), ("one.png", ["--predict", 3]), ("two.png", ["--predict", 3])):
        assert run("plot", tmp_path / "scenario.json", "--out", tmp_path / name, *options).code == 0
        sizes[name] = (tmp_path / name).read_bytes()
    assert sizes["one.png"] == sizes["two.png"] != sizes["plain.png"]


def test_a_wrong_horizon_leaves_no_file(tmp_path: Path) -> None:
    scene(corner("a", 0.0)).save(tmp_path / "scenario.json")
    for command, out in (("plot", "a.png"), ("view", "a.html")):
        ran = run(command, tmp_path / "scenario.json", "--out", tmp_path / out, "--predict", 99)
        assert "horizon: 99 s, expected 0.1 to 10 s" in ran.line
    assert names(tmp_path) == ["scenario.json"]


@pytest.mark.slow
def test_animations_show_what_is_expected_at_each_moment(tmp_path: Path) -> None:
    world = scene(circle(12.0, 5.0, 1.0), duration_s=1.0)
    world.save(tmp_path / "scenario.json")
    sizes = []
    for name, options in (("a.gif", []), ("b.gif", ["--predict", 2])):
        assert run("plot", tmp_path / "scenario.json", "--out", tmp_path / name, *options).code == 0
        sizes.append((tmp_path / name).stat().st_size)
    assert sizes[1] > sizes[0]


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


def test_more_predictions_than_a_page_holds_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_predictions, "MAX_PREDICTIONS", 50)
    with pytest.raises(ConfigError, match="101 predictions are more than the 50"):
        predicted_columns(scene(line("a", 0.0)), 3.0)
