"""Lanes, markings, borders and traffic lights in pictures and on the page, and colors of vehicles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, DRIVER, Browser, browsing
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.figure import Figure

from log2sim import Scenario
from log2sim.datatypes import Agent, MapFeatures, MapLane, Marking, RoadBorder, Signal, Waypoints
from log2sim.geometry import Array
from log2sim.visualization.page.document import SCALES, feature_columns
from log2sim.visualization.page.writer import write_page
from log2sim.visualization.plot import style
from log2sim.visualization.plot.layers import SignalLights, draw_road, lane_arrows, lane_outline, road_rows
from log2sim.visualization.plot.tracks import plot_tracks, still
from log2sim.visualization.plot.viewport import Viewport, assign_roles

X_M = np.linspace(-10.0, 40.0, 51)


def line(y_m: float, *, reverse: bool = False) -> Array:
    points = np.column_stack([X_M, np.full(len(X_M), y_m), np.zeros(len(X_M))])
    return points[::-1] if reverse else points


def world() -> Scenario:
    t = np.arange(5.0)
    flat = np.zeros(5)
    waypoints = Waypoints(t, 2 * t, flat - 1.75, flat + 0.8, flat, flat + 2.0, np.ones(5, bool), flat)
    red = {"rgb": [200, 20, 30], "name": "red", "confidence": 0.9}
    car = Agent("car", "car", (4.0, 2.0, 1.6), waypoints, color=red)
    markings = (
        Marking("middle", "dashed", line(0.0), 0.12, "white"),
        Marking("side", "solid", line(3.5), 0.12, "yellow", confidence=0.3),
        Marking("walk", "crosswalk", np.array([[20.0, -3, 0], [23, -3, 0], [23, 3, 0], [20, 3, 0]]), 3.0),
    )
    lanes = (
        MapLane("east", line(-1.75), np.full(51, 3.5), left="middle", opposite="west"),
        MapLane("west", line(1.75, reverse=True), np.full(51, 3.0), left="middle", opposite="east", inferred_from="paths"),
    )  # fmt: skip
    features = MapFeatures(markings, (RoadBorder("curb", "curb", line(-5.0)),), lanes)
    signal = Signal("light", np.array([11.3, -4.3, 5.0]), 0.0, np.array([0.0, 2.5]), np.array(["red", "green"]))
    return Scenario("made", 0, 4.0, (car,), map_features=features, signals=(signal,))


def test_a_lane_is_as_wide_as_it_is_and_its_arrows_point_ahead() -> None:
    east, west = world().map_features.lanes  # type: ignore[union-attr]
    np.testing.assert_allclose(np.unique(lane_outline(east)[:, 1]), [-3.5, 0.0])
    np.testing.assert_allclose(np.unique(lane_outline(west)[:, 1]), [0.25, 3.25])
    for lane, sign in ((east, 1), (west, -1)):
        arrows = lane_arrows(lane)
        assert len(arrows) == 3
        assert all(sign * (tip[0] - left[0]) > 1 and tip[1] == lane.points_m[0, 1] for tip, left, _ in arrows)
    assert lane_arrows(replace(east, points_m=east.points_m[:3])) == []


@pytest.mark.parametrize(("over_picture", "faces"), [(False, 2), (True, 0)])
def test_faces_of_lanes_do_not_hide_a_picture_of_the_ground(over_picture: bool, faces: int) -> None:
    ax = Figure().add_subplot()
    draw_road(ax, world(), Viewport(-10, 40, -8, 8), over_picture=over_picture)
    shown = [c for c in ax.collections if isinstance(c, PolyCollection) and len(c.get_facecolor())]
    lanes = [c for c in shown if np.allclose(c.get_facecolor()[0], to_rgba(style.LANE_FACE))]
    assert sum(len(c.get_paths()) for c in lanes) == faces


def test_a_scenario_without_features_is_drawn_without_them() -> None:
    ax = Figure().add_subplot()
    bare = replace(world(), map_features=None, signals=())
    draw_road(ax, bare, Viewport(-10, 40, -8, 8), over_picture=False)
    assert not ax.collections
    assert road_rows(bare) == []


def test_the_legend_tells_what_there_is() -> None:
    texts = [text for _, text in road_rows(world())]
    assert texts[0] == "2 lanes, 1 from paths alone"
    assert {"yellow marking", "border of a road", "traffic light"} < set(texts)


def test_traffic_lights_change_with_time() -> None:
    figure = Figure()
    ax = figure.add_subplot()
    FigureCanvasAgg(figure).draw()
    lights = SignalLights(ax, world().signals)
    (mark,) = ax.lines
    for t_s, state in ((0.0, "red"), (2.4, "red"), (2.5, "green")):
        lights.show(t_s)
        assert mark.get_markerfacecolor() == style.SIGNAL_COLOR[state]


def test_the_heading_mark_has_the_color_of_the_vehicle() -> None:
    def marks(scenario: Scenario) -> list[tuple[float, ...]]:
        layout = still(scenario, assign_roles(scenario))
        polygons = [c for c in layout.ax.collections if isinstance(c, PolyCollection)]
        return [tuple(np.round(c.get_facecolor()[0], 3)) for c in polygons if len(c.get_facecolor()) == 1]

    red = tuple(np.round([200 / 255, 20 / 255, 30 / 255, 1.0], 3))
    scenario = world()
    assert red in marks(scenario)
    plain = replace(scenario, agents=tuple(replace(a, color=None) for a in scenario.agents))
    assert red not in marks(plain)


def test_columns_of_the_page_give_back_the_lines() -> None:
    columns = feature_columns(world())
    middle = columns["markings"][0]
    restored = np.cumsum(np.cumsum(middle["x_m"])) / SCALES["x_m"]
    np.testing.assert_allclose(restored, [-10.0, 40.0])  # a straight line needs its ends alone
    assert [m["doubtful"] for m in columns["markings"]] == [False, True, False]
    assert len(columns["lanes"]) == 2
    assert columns["signals"][0]["state"] == ["red", "green"]
    x_m = np.linspace(0, 60, 200)
    bent = Marking("bent", "solid", np.column_stack([x_m, 10 * np.sin(x_m / 15), 0 * x_m]), 0.1)
    (column,) = feature_columns(replace(world(), map_features=MapFeatures((bent,))))["markings"]
    x, y = (np.cumsum(np.cumsum(column[key])) / SCALES[key] for key in ("x_m", "y_m"))
    assert len(x) < 100
    assert np.abs(np.interp(x_m, x, y) - 10 * np.sin(x_m / 15)).max() < 0.03


def test_animations_show_them_too(tmp_path: Path) -> None:
    plot_tracks(replace(world(), duration_s=0.5), tmp_path / "tracks.gif")
    assert (tmp_path / "tracks.gif").stat().st_size > 1000


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("Chromium and chromedriver are not installed")
    with browsing(tmp_path_factory.mktemp("profile")) as window:
        yield window


@pytest.mark.slow
def test_the_page_shows_and_hides_them(browser: Browser, tmp_path: Path) -> None:
    write_page(world(), tmp_path / "page.html")
    browser.open((tmp_path / "page.html").as_uri() + "#t=1")

    def pixel(x_m: float, y_m: float) -> tuple[float, ...]:
        script = """const [x, y, done] = arguments;
            requestAnimationFrame(() => requestAnimationFrame(() => {
                const [left, top] = log2sim.placeOf("car"), scale = log2sim.pixelsPerMeter;
                const pen = new OffscreenCanvas(1, 1).getContext("2d", {willReadFrequently: true});
                const place = [left + scale * (x - 2 * log2sim.time), top - scale * (y + 1.75)].map(Math.round);
                pen.drawImage(document.getElementById("map"), -place[0], -place[1]);
                done([...pen.getImageData(0, 0, 1, 1).data]);
            }));"""
        return tuple(browser.run_async(script, x_m, y_m))[:3]

    def rgb(color: str) -> tuple[float, ...]:
        return tuple(round(255 * c) for c in to_rgb(color))

    assert pixel(9.0, -0.9) == rgb("#ECEFF3")
    assert pixel(11.3, -4.3) == rgb(style.SIGNAL_COLOR["red"])
    browser.run("log2sim.time = 3")
    assert pixel(11.3, -4.3) == rgb(style.SIGNAL_COLOR["green"])
    browser.run("document.getElementById('layer-lanes').click()")
    assert pixel(9.0, -0.9) == pixel(11.3, -4.3) == (251, 252, 253)
    browser.run("log2sim.choose('car')")
    shown = browser.run("return [...document.querySelectorAll('#agent-now dd')].map((row) => row.textContent)")
    assert "red (0.90)" in shown
