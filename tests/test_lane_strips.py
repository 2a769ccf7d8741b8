"""Lanes between markings: which lines belong together, which way lanes lead, and what happens where lines end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from export_paths import agent, line, scenario
from test_lane_graph import require_consistent

from log2sim.datatypes import MapFeatures, MapLane, Marking, RoadBorder, Scenario
from log2sim.geometry import Array
from log2sim.road.lane_graph import find_side_of_traffic, infer_lanes
from log2sim.road.polyline import collect_paths


def along(y_m: float, first_m: float = 0.0, last_m: float = 100.0, radius_m: float = np.inf) -> Array:
    """A line along x, or along a left bend around (0, radius)."""
    x = np.linspace(first_m, last_m, 60)
    if np.isfinite(radius_m):
        angle, r = x / radius_m, radius_m - y_m
        return np.column_stack([r * np.sin(angle), radius_m - r * np.cos(angle), 0 * x])
    return np.column_stack([x, np.full(60, y_m), np.zeros(60)])


def paint(name: str, y_m: float, kind: str = "solid", *, span: tuple[float, float] = (0.0, 100.0), turn: bool = False, color: str = "white", radius_m: float = np.inf) -> Marking:  # fmt: skip
    points = along(y_m, *span, radius_m)
    return Marking(name, kind, points[::-1] if turn else points, 0.12, color, 0.9)


def country_road(radius_m: float = np.inf) -> list[Marking]:
    """Two lanes of 3.5 m; lines are told in either direction."""
    return [
        paint("right", 0.0, radius_m=radius_m),
        paint("middle", 3.5, "dashed", turn=True, radius_m=radius_m),
        paint("left", 7.0, radius_m=radius_m),
    ]


def inferred(markings: Sequence[Marking], borders: Sequence[RoadBorder], world: Scenario) -> list[MapLane]:
    lanes, _ = infer_lanes(markings, borders, world)
    require_consistent(lanes, MapFeatures(tuple(markings), tuple(borders)))
    return list(lanes)


@pytest.mark.parametrize("radius_m", [np.inf, 60.0])
def test_two_lanes_between_three_lines(radius_m: float) -> None:
    ego, oncoming = (agent(along(y, radius_m=radius_m)[::way, :2], name) for y, way, name in ((1.6, 1, "ego"), (5.5, -1, "b")))  # fmt: skip
    one, two = inferred(country_road(radius_m), [], scenario(ego, oncoming))
    assert (one.left, one.right, two.left, two.right) == ("middle", "right", "middle", "left")
    assert (one.opposite, two.opposite) == (two.id, one.id)
    assert {one.inferred_from, two.inferred_from} == {"both"}
    for lane, y_m in ((one, 1.75), (two, 5.25)):
        off = lane.points_m[:, 1] - y_m
        if np.isfinite(radius_m):
            off = radius_m - y_m - np.hypot(lane.points_m[:, 0], lane.points_m[:, 1] - radius_m)
        assert np.abs(off).max() < 0.02
        np.testing.assert_allclose(lane.width_m, 3.5, atol=0.03)


@pytest.mark.parametrize(("side", "expected"), [(1.0, 1), (-1.0, -1)])
def test_the_side_of_traffic_is_that_of_who_comes_towards_each_other(side: float, expected: int) -> None:
    world = scenario(agent(line() * [1, side]), agent(line(30.0, 31, np.pi, (35.0, 3.6)) * [1, side], "oncoming"))
    assert find_side_of_traffic(collect_paths(world)) == expected
    assert find_side_of_traffic(collect_paths(scenario(agent(line())))) == 0


@pytest.mark.parametrize(
    ("kind", "color", "count", "same"),
    [
        ("dashed", "white", 2, False),
        ("dashed", "white", 3, True),
        ("solid", "white", 3, False),
        ("dashed", "yellow", 3, False),
    ],
)
def test_an_empty_lane_towards_oncoming_traffic_leads_as_the_line_says(
    kind: str, color: str, count: int, same: bool
) -> None:
    """A dashed line parts the directions of a road with two lanes, and the lanes of one with more."""
    lines = [paint("right", 0.0), paint("middle", 3.5, kind, color=color), paint("left", 7.0, "dashed", turn=True)]
    lines += [paint("farthest", 10.5)] if count > 2 else []
    lanes = inferred(lines, [], scenario(agent(line(100.0, 101, 0.0, (0.0, 1.75)))))
    driven, empty = sorted(lanes, key=lambda lane: lane.points_m[0, 1])[:2]
    assert driven.confidence > 0.9 > empty.confidence
    assert (driven.inferred_from, empty.inferred_from) == ("both", "markings")
    assert (driven.left_lane == empty.id) is same
    assert (driven.opposite == empty.id) is not same


def test_a_lane_goes_on_along_the_path_where_its_lines_end() -> None:
    lanes = inferred(country_road(), [], scenario(agent(line(140.0, 141, 0.0, (-20.0, 1.6)))))
    own = sorted((lane for lane in lanes if lane.points_m[0, 1] < 3.0), key=lambda lane: lane.points_m[0, 0])
    assert [lane.inferred_from for lane in own] == ["paths", "both", "paths"]
    assert own[0].successors == (own[1].id,)
    assert own[1].successors == (own[2].id,)
    np.testing.assert_allclose([own[1].points_m[0, 0], own[1].points_m[-1, 0]], [0.0, 100.0], atol=0.6)
