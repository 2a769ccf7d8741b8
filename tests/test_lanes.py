"""Lanes out of paths: links, neighbors and what does not change when the world is turned, moved or told in another order."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from export_paths import agent, bend, line, scenario
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from log2sim.datatypes import Agent, MapFeatures, MapLane, Marking, RoadBorder, Scenario
from log2sim.geometry import Array, Polyline
from log2sim.road.curves import fit_curve
from log2sim.road.lane_graph import find_covered, find_side_of_traffic, find_strips, infer_lanes
from log2sim.road.lane_keeping import find_lane_changes, locate_in_lanes, summarize_lane_keeping
from log2sim.road.routes import collect_paths


def turn_left(radius_m: float = 9.0) -> Array:
    """Points from the south to the west."""
    curve = bend(radius_m, np.pi / 2, 20)
    before = line(30.0, 31, 0.0, (-30.0, 0.0))
    after = line(30.0, 31, np.pi / 2, (radius_m, radius_m))
    xy = np.concatenate([before[:-1], curve, after[1:]])
    return np.column_stack([-xy[:, 1], xy[:, 0]]) + np.array([1.75, -7.25])


def cross(side: float = 1.0) -> Scenario:
    """A crossing with traffic from three sides that goes on straight and turns; `side` -1 is its mirror image."""
    paths = {
        "ego": line(80.0, 81, np.pi / 2, (1.75, -40.0)),
        "follower": line(60.0, 61, np.pi / 2, (1.95, -40.0)),
        "left": turn_left(),
        "east": line(80.0, 81, 0.0, (-40.0, -1.75)),
        "west": line(80.0, 81, np.pi, (40.0, 1.75)),
        "south": line(80.0, 81, -np.pi / 2, (-1.75, 40.0)),
    }
    return scenario(*(agent(xy * [side, 1.0], name) for name, xy in paths.items()))


def motorway() -> Scenario:
    """Three lanes in a wide curve; one vehicle changes from the left to the middle one."""
    angle = np.linspace(0.0, 0.25, 201)

    def lane(aside_m: Array | float) -> Array:
        radius = 800.0 - np.asarray(aside_m)
        return np.column_stack([radius * np.sin(angle), 800.0 - radius * np.cos(angle)])

    share = np.clip((angle - 0.08) / 0.1, 0.0, 1.0)
    change = 3.6 * (1 - share**2 * (3 - 2 * share))
    names = {"ego": 0.0, "left": 3.6, "right": -3.6, "ahead": 0.2}
    return scenario(*(agent(lane(a), name) for name, a in names.items()), agent(lane(change), "changing"))


WORLDS = {"crossing": cross(), "left-hand crossing": cross(-1.0), "motorway": motorway()}


def lanes_of(world: Scenario) -> tuple[MapLane, ...]:
    return infer_lanes((), (), world)[0]


def moved(world: Scenario, turn_rad: float, shift: tuple[float, float]) -> Scenario:
    c, s = np.cos(turn_rad), np.sin(turn_rad)

    def put(a: Agent) -> Agent:
        w = a.waypoints
        x, y = c * w.x_m - s * w.y_m + shift[0], s * w.x_m + c * w.y_m + shift[1]
        return replace(
            a, waypoints=replace(w, x_m=x, y_m=y, yaw_rad=(w.yaw_rad + turn_rad + np.pi) % (2 * np.pi) - np.pi)
        )

    return replace(world, agents=tuple(put(a) for a in world.agents))


def require_consistent(lanes: Sequence[MapLane], features: MapFeatures = MapFeatures()) -> None:  # noqa: B008
    """Links lead back and lanes meet; those side by side know each other."""
    by_id = {lane.id: lane for lane in lanes}
    assert len(by_id) == len(lanes)
    for lane in lanes:
        assert lane.points_m.shape == (len(lane.width_m), 3)
        assert np.hypot(*np.diff(lane.points_m[:, :2], axis=0).T).min() > 0
        assert 2.0 < lane.width_m.min() <= lane.width_m.max() < 6.0
        for name in lane.successors:
            assert lane.id in by_id[name].predecessors
            np.testing.assert_array_equal(by_id[name].points_m[0], lane.points_m[-1])
            assert by_id[name].width_m[0] == pytest.approx(lane.width_m[-1], abs=0.02)
        assert all(lane.id in by_id[name].successors for name in lane.predecessors)
        assert lane.left_lane is None or by_id[lane.left_lane].right_lane == lane.id
        assert lane.right_lane is None or by_id[lane.right_lane].left_lane == lane.id
        assert lane.opposite is None or by_id[lane.opposite].opposite == lane.id
    MapFeatures.from_dict(replace(features, lanes=tuple(lanes)).to_dict())


@pytest.mark.parametrize("name", WORLDS)
def test_lanes_are_linked_both_ways_and_hold_every_path(name: str) -> None:
    lanes = lanes_of(WORLDS[name])
    require_consistent(lanes)
    for path in collect_paths(WORLDS[name]):
        assert find_covered(lanes, path.line).all()


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_crossing_is_one_junction_with_a_lane_for_every_way_through(side: float) -> None:
    lanes = lanes_of(cross(side))
    inside = [lane for lane in lanes if lane.junction is not None]
    assert {lane.junction for lane in inside} == {"junction-1"}
    assert len(inside) == 5  # four straight on, of which two vehicles share one, and the turn
    assert len(lanes) == 5 + 4 + 4  # and the arms: four lanes in, four out
    fork = [lane for lane in lanes if len(lane.successors) == 2]
    join = [lane for lane in lanes if len(lane.predecessors) == 2]
    assert (len(fork), len(join)) == (1, 1)
    assert fork[0].confidence > inside[0].confidence  # three vehicles came that way
    assert fork[0].opposite is not None


def test_left_hand_traffic_is_the_mirror_image() -> None:
    for one, two in zip(lanes_of(cross()), lanes_of(cross(-1.0)), strict=True):
        np.testing.assert_allclose(one.points_m * [-1, 1, 1], two.points_m, atol=1e-6)


@settings(max_examples=4, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(turn=st.floats(-3.1, 3.1), east=st.floats(-5e5, 5e5), north=st.floats(-5e6, 5e6))
def test_lanes_turn_and_move_with_the_world(turn: float, east: float, north: float) -> None:
    lanes, others = lanes_of(WORLDS["crossing"]), lanes_of(moved(WORLDS["crossing"], turn, (east, north)))
    assert [lane.successors for lane in lanes] == [lane.successors for lane in others]
    c, s = np.cos(turn), np.sin(turn)
    for one, two in zip(lanes, others):
        x, y, z = one.points_m.T
        turned = Polyline(np.column_stack([c * x - s * y + east, s * x + c * y + north, z]))
        at = turned.project(two.points_m[:, :2], Polyline(two.points_m).heading_rad)
        assert np.abs(at.aside_m).max() < 0.1
        np.testing.assert_allclose(
            at.s_m[[0, -1]], [0.0, turned.length_m], atol=0.6
        )  # a sample of a path at a threshold


def test_paths_of_several_vehicles_in_one_lane_make_one_middle() -> None:
    rng = np.random.default_rng(4)
    world = scenario(
        *(agent(line(80.0, 81, start=(0.0, a)), f"car-{k}") for k, a in enumerate(rng.uniform(-0.6, 0.6, 9)))
    )
    (lane,) = lanes_of(world)
    middle = np.median([a.waypoints.y_m[0] for a in world.agents])
    np.testing.assert_allclose(lane.points_m[:, 1], middle, atol=0.01)
    assert lane.confidence == 0.95


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


def test_a_lane_with_parked_cars_in_it_is_as_wide_as_its_lines_are_apart() -> None:
    ego, oncoming = agent(along(3.5)[:, :2], "ego"), agent(along(7.1)[::-1, :2], "b")  # past cars at both sides
    lines = [paint("right", 0.0), paint("middle", 5.3, "dashed"), paint("left", 10.6)]
    one, two = inferred(lines, [], scenario(ego, oncoming))
    assert (one.left, one.right, two.left, two.right) == ("middle", "right", "middle", "left")
    assert np.median(one.width_m) == pytest.approx(5.3, abs=0.05)
    # Room for two narrow lanes, whose line was not seen, is no lane.
    assert {lane.inferred_from for lane in inferred([paint("right", 0.0), paint("left", 5.8)], [], scenario(ego))} == {
        "paths"
    }


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


@pytest.mark.parametrize("shift", [(50.0, 20.0), (-4000.0, 10000.0)])
def test_a_curve_through_two_dashes_far_apart_is_nearly_straight_wherever_it_lies(shift: tuple[float, float]) -> None:
    dashes = np.array([[0.0, 0.0], [1.5, 0.01], [30.0, 0.0], [31.5, 0.02]])
    at_origin = fit_curve(dashes).xy
    assert np.abs(at_origin[:, 1]).max() < 0.05
    assert np.allclose(fit_curve(dashes + np.array(shift)).xy - shift, at_origin, atol=1e-6)


def road() -> tuple[MapLane, ...]:
    """Two lanes of 3.5 m side by side, each in two pieces."""
    lanes = []
    for side, y in (("right", 1.75), ("left", 5.25)):
        for k in (0, 1):
            points = np.column_stack([line(50.0, 3, 0.0, (50.0 * k, y)), np.zeros(3)])
            other = {"left_lane" if side == "right" else "right_lane": f"{'left' if side == 'right' else 'right'}-{k}"}
            links = {"successors": (f"{side}-1",)} if k == 0 else {"predecessors": (f"{side}-0",)}
            lanes.append(MapLane(f"{side}-{k}", points, np.full(3, 3.5), **other, **links))
    return tuple(lanes)


def test_the_offset_is_that_of_the_path() -> None:
    x = np.linspace(2.0, 98.0, 193)
    driver = agent(np.column_stack([x, 1.75 + 0.4 * np.sin(x / 15.0)]))
    position = locate_in_lanes(driver, road(), driver.waypoints.t_s)
    np.testing.assert_allclose(position.aside_m, 0.4 * np.sin(x / 15.0), atol=1e-3)
    assert [road()[k].id for k in dict.fromkeys(position.lane.tolist())] == ["right-0", "right-1"]
    assert find_lane_changes(position, road()) == []


def test_a_change_of_lane_is_told_once_and_to_its_side() -> None:
    x = np.linspace(0.0, 100.0, 201)
    y = 1.75 + 3.5 * np.clip((x - 30.0) / 40.0, 0.0, 1.0)
    driver = agent(np.column_stack([x, y]))
    (change,) = find_lane_changes(locate_in_lanes(driver, road()), road())
    assert (change.origin, change.target, change.side) == ("right-1", "left-1", "left")
    at = driver.at(change.t_s)
    assert 3.5 < at.y_m[0] < 3.5 + 0.2 + 0.1
    back = agent(np.column_stack([x, 7.0 - y]))
    assert [c.side for c in find_lane_changes(locate_in_lanes(back, road()), road())] == ["right"]


def test_the_summary_tells_how_far_over_the_line_a_vehicle_is() -> None:
    summary = summarize_lane_keeping(agent(line(90.0, 91, 0.0, (5.0, 2.75)), size_m=(4.6, 1.9, 1.6)), road())
    assert summary is not None
    assert summary["aside_m"] == {"mean": 1.0, "sd": 0.0, "leftmost": 1.0, "rightmost": 1.0}
    assert (summary["in_lane"], summary["over_line"], summary["width_m"]) == (1.0, 1.0, 3.5)


def test_inspect_describes_a_scenario(tmp_path: Path) -> None:
    world = scenario(agent(line(90.0, 91, 0.0, (5.0, 2.0))), map_features=MapFeatures(lanes=road(), notes=("night",)))
    world.save(tmp_path / "scenario.json")
    document = json.loads(run("inspect", tmp_path / "scenario.json", "--json").out)
    assert (document["agents"]["count"], document["ego"]) == (0, {"doubtful": False})
    assert document["lanes"] == {"count": 4, "junctions": 0, "inferred_from": {"markings": 4}, "in_file": True}
    assert document["ego_in_lane"]["aside_m"]["mean"] == pytest.approx(0.25, abs=1e-3)
    assert document["notes"] == ["night"]


def test_worn_lines_are_bridged_and_long_gaps_are_not() -> None:
    lines = [
        paint("right", 0.0),
        paint("a", 3.5, "dashed", span=(0, 40)),
        paint("b", 3.5, "dashed", span=(52, 100), turn=True),
    ]
    assert [round(s.line.length_m) for s in find_strips(lines, [])] == [100]
    lines[2] = paint("b", 3.5, "dashed", span=(60, 100))
    assert sorted(round(s.line.length_m) for s in find_strips(lines, [])) == [40, 40]
