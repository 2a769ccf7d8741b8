"""Lanes out of paths: links, neighbors and what does not change when the world is turned, moved or told in another order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from export_paths import agent, bend, line, scenario
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from log2sim.datatypes import Agent, MapFeatures, MapLane, Scenario
from log2sim.geometry import Array
from log2sim.road.lane_graph import find_covered, infer_lanes
from log2sim.road.polyline import Polyline, collect_paths


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
