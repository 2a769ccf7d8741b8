"""Lanes, markings, borders and traffic lights in pictures and on the page, and colors of vehicles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from worlds import waypoints

from log2sim import Scenario
from log2sim.datatypes import Agent, MapFeatures, MapLane, Marking, RoadBorder, Signal
from log2sim.geometry import Array
from log2sim.visualization.page.document import SCALES, feature_columns
from log2sim.visualization.plot import style
from log2sim.visualization.plot.layers import SignalLights, lane_arrows, lane_outline

X_M = np.linspace(-10.0, 40.0, 51)


def line(y_m: float, *, reverse: bool = False) -> Array:
    points = np.column_stack([X_M, np.full(len(X_M), y_m), np.zeros(len(X_M))])
    return points[::-1] if reverse else points


def world() -> Scenario:
    t = np.arange(5.0)
    way = waypoints(t, 2 * t, -1.75, 0.8, 0.0, 2.0, sigma_m=0.0)
    red = {"rgb": [200, 20, 30], "name": "red", "confidence": 0.9}
    car = Agent("car", "car", (4.0, 2.0, 1.6), way, color=red)
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


def test_traffic_lights_change_with_time() -> None:
    figure = Figure()
    ax = figure.add_subplot()
    FigureCanvasAgg(figure).draw()
    lights = SignalLights(ax, world().signals)
    (mark,) = ax.lines
    for t_s, state in ((0.0, "red"), (2.4, "red"), (2.5, "green")):
        lights.show(t_s)
        assert mark.get_markerfacecolor() == style.SIGNAL_COLOR[state]


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
