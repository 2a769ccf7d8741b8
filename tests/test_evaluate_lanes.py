"""Figures of map features, colors and traffic lights: closed forms on a straight road, invariances, and what counts where."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from worlds import CAR, PARKED, tiny_log

from log2sim.datatypes import MapFeatures, MapLane, Marking, Scenario, Signal
from log2sim.errors import ScenarioError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.road import Area, map_figures, seen_ground, signal_figures

ROAD = {"line": [[-60.0, 0.0], [80.0, 0.0]], "width_m": 8.0, "marking": "solid", "color": "white"}


@pytest.fixture(scope="module")
def truth() -> Scenario:
    extras: dict[str, Any] = {
        "zebra": [{"line": [[30.0, -4.0], [30.0, 4.0]]}],
        "stop_line": [{"line": [[27.0, -3.8], [27.0, -0.1]]}],
        "arrow": [{"position": [15.0, -2.0]}],
    }
    return tiny_log(observe=False, road=[ROAD], **extras)[1]


def line(y: float, x: tuple[float, float] = (-60.0, 80.0), kind: str = "solid", **more: Any) -> Marking:
    return Marking(f"{y}{x}{kind}", kind, np.array([[x[0], y, 0.0], [x[1], y, 0.0]]), 0.14, **more)


def with_markings(truth: Scenario, *markings: Marking) -> Scenario:
    return replace(truth, map_features=MapFeatures(markings))


def lane_lines(scenario: Scenario, truth: Scenario) -> dict[str, Any]:
    figures = map_figures(scenario, truth)
    assert figures is not None
    return dict(figures["lane_lines"])


def test_shares_and_errors_follow_from_lengths_and_offsets(truth: Scenario) -> None:
    # The ego's middle drives 3 m from x = 1.4, so lines count over 83 m near it: x from -38.6 to 44.4 on its own line.
    found = with_markings(
        truth, line(0.1, (-40.0, 1.5), color="yellow"), line(0.5, (1.5, 43.0)), line(20.0, (0, 10), "dashed")
    )
    true = replace(truth, map_features=MapFeatures((line(0.0, color="white"), line(4.0))))
    figures = lane_lines(found, true)
    assert figures["found_m"] == pytest.approx(40.1 + 41.5 + 10, abs=0.3)
    assert figures["precision"] == pytest.approx(40.1 / 91.6, abs=0.005)
    assert figures["recall"] == pytest.approx(40.1 / (83 + 82.6), abs=0.005)
    assert figures["lateral_median_m"] == pytest.approx(0.1, abs=0.001) or figures["lateral_median_m"] == pytest.approx(
        0.5
    )
    assert figures["lateral_p95_m"] == pytest.approx(0.5, abs=1e-6)
    assert figures["kind_accuracy"] == 1
    assert figures["color_accuracy"] == 0
    assert figures["false_m_per_100_m"] == pytest.approx(100 * 51.5 / 3, rel=0.02)


def test_runs_of_cells_reach_from_their_first_cell_along_x(truth: Scenario) -> None:
    seen = {"cell_m": 0.5, "runs": [[6, -4, 8], [0, 2, 1]]}
    ground = seen_ground(replace(truth, provenance={"seen_ground": seen}), np.array([10.0, -20.0, 3.0]))
    assert ground is not None
    assert ground.bounds == (10.0, -22.0, 17.0, -18.5)
    assert ground.area == pytest.approx(9 * 0.25)


def test_what_no_sensor_saw_is_not_missed_but_what_is_found_there_counts(truth: Scenario) -> None:
    seen = {"cell_m": 1.0, "runs": [[0, y, 20] for y in range(-6, 6)]}
    hidden = replace(truth, provenance={**truth.provenance, "seen_ground": seen})
    true = replace(hidden, map_features=MapFeatures((line(0.5),)))
    figures = lane_lines(with_markings(truth, line(0.5, (0.0, 10.0)), line(3.0, (30.0, 40.0))), true)
    assert figures["true_m"] == pytest.approx(20, abs=0.2)
    assert figures["recall"] == pytest.approx(0.5, abs=0.03)
    assert figures["precision"] == pytest.approx(0.5, abs=0.03)
    for spoiled in ({}, {"cell_m": 1.0, "runs": [[1, 2]]}, {"cell_m": -1.0, "runs": [[0, 0, 1]]}, [1]):
        with pytest.raises(ScenarioError, match="seen_ground"):
            Area.of(truth, replace(truth, provenance={"seen_ground": spoiled}), np.zeros(3))


def test_shapes_are_the_same_where_they_share_half_and_each_only_once(truth: Scenario) -> None:
    own = truth.map_features
    assert own is not None
    walk = next(m for m in own.markings if m.kind == "crosswalk")
    stop = next(m for m in own.markings if m.kind == "stop_line")

    def figures(*markings: Marking) -> dict[str, Any]:
        found = map_figures(with_markings(truth, *markings), truth)
        assert found is not None
        return found

    near = replace(walk, points_m=walk.points_m + np.array([0.5, 0.0, 0.0]))
    far = replace(walk, points_m=walk.points_m + np.array([1.5, 0.0, 0.0]))
    assert figures(near)["crosswalks"] == {"true": 1, "found": 1, "false": 0, "partly_seen": 0}
    assert figures(far)["crosswalks"] == {"true": 1, "found": 0, "false": 1, "partly_seen": 0}
    assert figures(walk, near)["crosswalks"]["false"] == 1
    aside = replace(stop, points_m=stop.points_m + np.array([0.4, 0.3, 0.0]))
    assert figures(aside)["stop_lines"]["found"] == 1
    assert figures(replace(stop, points_m=stop.points_m + np.array([0.6, 0.0, 0.0])))["stop_lines"]["found"] == 0
    half = replace(stop, points_m=stop.points_m * [1.0, 0.4, 1.0])
    assert figures(half)["stop_lines"]["found"] == 0


def test_lanes_count_in_their_direction_and_paths_where_they_lie_in_one(truth: Scenario) -> None:
    def lane(y: float, *, back: bool = False, width: float = 4.0) -> MapLane:
        x = np.array([80.0, -60.0] if back else [-60.0, 80.0])
        points = np.column_stack([x, np.full(2, y), np.zeros(2)])
        return MapLane(f"lane{y}{back}", points, np.full(2, width))

    def figures(*lanes: MapLane) -> dict[str, Any]:
        found = map_figures(replace(truth, map_features=MapFeatures(lanes=lanes)), truth)
        assert found is not None
        return dict(found["lanes"])

    # The true lanes lie at -1.9 (east) and 1.9 (west); the ego and a car that drives east at y = 2 both face east.
    assert figures(lane(-1.95), lane(1.95, back=True))["precision"] == 1
    assert figures(lane(-1.95), lane(1.95))["precision"] == pytest.approx(0.5, abs=0.01)
    assert figures(lane(-2.15))["recall"] == pytest.approx(0.5, abs=0.01)
    assert figures(lane(-2.15))["center_median_m"] == pytest.approx(0.2, abs=0.06)
    inside = {y: figures(lane(y))["inside"] for y in (0.0, 2.0, 30.0)}
    assert inside[30.0] == 0
    assert 0 < inside[2.0] < inside[0.0] + 1
    assert figures(lane(1.0, width=6.0))["inside"] == 1
    assert figures(lane(1.0, width=6.0, back=True))["inside"] == 0


def test_colors_are_those_of_the_agents_that_match(truth: Scenario) -> None:
    log_truth = tiny_log([CAR, PARKED], duration_s=1.2)[1]
    gray = {"rgb": [110, 110, 112], "name": "gray"}
    agents = tuple(a if a.id != "car" else replace(a, color=gray) for a in log_truth.agents)
    result = evaluate(replace(log_truth, agents=agents), log_truth)["colors"]
    assert result["right"] == result["named"] - 1
    assert list(result["confused"].values()) == [1]
    without = tuple(replace(a, color=None) for a in log_truth.agents)
    result = evaluate(replace(log_truth, agents=without), log_truth)["colors"]
    assert (result["with_color"], result["accuracy"]) == (0, None)
    assert result["vehicles"] >= 1
    assert evaluate(log_truth, replace(log_truth, agents=without))["colors"] is None


def test_signals_are_judged_by_where_they_are_and_what_they_say_when(truth: Scenario) -> None:
    true = Signal("a", np.array([10.0, 0.0, 4.0]), 0.0, np.array([0.0, 0.5]), np.array(["red", "green"]))
    late = replace(true, id="b", position_m=true.position_m + np.array([0.5, 0.0, 0.0]), t_s=np.array([0.25, 0.75]))
    world = replace(truth, signals=(true,), duration_s=1.0)
    assert signal_figures(truth, truth) is None
    result = signal_figures(replace(world, signals=(late, replace(true, position_m=true.position_m + 9.0))), world)
    assert result is not None
    assert (result["found"], result["false"], result["position_median_m"]) == (1, 1, 0.5)
    assert result["state_known"] == pytest.approx(0.76, abs=0.03)
    assert result["state_right"] == pytest.approx(0.67, abs=0.05)
    missing = signal_figures(replace(world, signals=()), world)
    assert missing is not None
    assert (missing["found"], missing["state_right"]) == (0, None)
