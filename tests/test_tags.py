"""Tags: maneuvers that are known in closed form are found, whatever the road, the side of traffic and the rate."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from statistics import NormalDist

import numpy as np
import pytest
from benchmarks.tag_worlds import Stage, crossing, route, scripted, traffic, variants
from benchmarks.tags import compare, f1, score
from metric_scenes import agent, scenario
from scipy.signal import savgol_filter

from log2sim.datatypes import TAGS, MapFeatures, Scenario
from log2sim.edit import Remove, edit
from log2sim.errors import ScenarioError
from log2sim.geometry import fit_windows, wrap_angle
from log2sim.scenarios import criticality as c
from log2sim.scenarios.tagging import criticality_table, find_tags, tag
from log2sim.scenarios.traffic import Traffic, latched, runs

# What has to be reached on the truth.
LEAST_F1 = {"cut_in": 0.95, "overtaking": 0.97}


def figures(worlds):
    return score(worlds, [find_tags(w.scenario) for w in worlds])


def test_maneuvers_of_random_traffic_are_found_and_no_others() -> None:
    found = figures(list(variants(8, 0.0, first=1000)))
    assert set(found) == {"cut_in", "cut_out", "overtaking", "hard_braking", "lane_change"}
    for name, (true, invented, missed, error_s, wrong) in found.items():
        assert true >= 10, name
        assert f1(true, invented, missed) >= LEAST_F1.get(name, 0.95), wrong
        assert error_s < 0.5, name


def test_scripted_maneuvers_are_found_and_no_others() -> None:
    found = figures(list(scripted(3, 0.0, first=50)))
    rare = "turning_across merging stepping_out oncoming_in_lane standing_at_light u_turn approaching"
    assert set(rare.split()) <= set(found)
    for true, invented, missed, _, wrong in found.values():
        assert f1(true, invented, missed) >= 0.95 or true + invented + missed == 0, wrong


def test_what_a_reconstruction_lacks_is_counted_by_whether_sensors_show_it() -> None:
    truth = traffic(3).scenario
    whole = compare(truth, truth)["overtaking"]
    assert len(whole[0]) > 1
    assert whole[1:] == [[], []]
    (first, *_) = [g for g in find_tags(truth) if g.tag == "overtaking" and g.start_s > 0.2 and g.end_s < 13.8]
    for visible, seen in ((lambda t: t < 0, 0), (lambda t: abs(t - first.t_s) > 0.3, 1), (lambda t: t >= 0, 2)):
        agents = tuple(
            replace(a, waypoints=replace(a.waypoints, visible=visible(a.waypoints.t_s))) if a.id == first.agent else a
            for a in truth.agents
        )
        lost = replace(truth, agents=tuple(a for a in truth.agents if a.id != first.agent))
        missed = compare(lost, replace(truth, agents=agents))["overtaking"][2]
        assert [s for s, line in missed if line.startswith(f"overtaking {first.agent} {first.other} {first.start_s}")] == [seen]  # fmt: skip


@pytest.mark.slow
def test_noise_of_known_sigma_costs_few_maneuvers() -> None:
    found = figures(list(variants(24, 0.2, first=1000)))
    wanted = {"cut_in": 0.9, "overtaking": 0.93, "cut_out": 0.85, "hard_braking": 0.9, "lane_change": 0.95}
    for name, least in wanted.items():
        true, invented, missed, _, wrong = found[name]
        assert f1(true, invented, missed) >= least, wrong


def moved(s: Scenario, turn: float, dx: float, dy: float) -> Scenario:
    """The same scenario in a map whose axes are turned, far from its origin."""

    def place(x, y):
        return np.cos(turn) * x - np.sin(turn) * y + dx, np.sin(turn) * x + np.cos(turn) * y + dy

    def lines(points):
        return np.column_stack([*place(points[:, 0], points[:, 1]), points[:, 2]])

    agents = []
    for a in s.agents:
        x, y = place(a.waypoints.x_m, a.waypoints.y_m)
        agents.append(
            replace(a, waypoints=replace(a.waypoints, x_m=x, y_m=y, yaw_rad=wrap_angle(a.waypoints.yaw_rad + turn)))
        )
    features = s.map_features.moved(lines) if s.map_features is not None else None
    return replace(s, agents=tuple(agents), map_features=features)


def test_tags_depend_neither_on_the_axes_nor_on_the_origin_of_the_map() -> None:
    for world in (traffic(3, lanes=True), *islice(scripted(1, 0.0, first=7), 3)):
        here, there = find_tags(world.scenario), find_tags(moved(world.scenario, 2.1, 4.0e5, -3.0e5))
        assert here
        assert [(g.tag, g.agent, g.other, g.lane) for g in here] == [(g.tag, g.agent, g.other, g.lane) for g in there]
        for one, two in zip(here, there):
            assert two.t_s == pytest.approx(one.t_s, abs=0.11)
            assert two.probability == pytest.approx(one.probability, abs=0.01)


def test_the_order_of_agents_does_not_matter() -> None:
    s = traffic(5).scenario
    assert find_tags(s) == find_tags(replace(s, agents=s.agents[::-1]))


def test_probabilities_are_those_of_the_defining_inequality() -> None:
    """Two cross with a post-encroachment time of a known distribution; the limit is 5 s."""
    stage = Stage(np.random.default_rng(0), 10.0, False, 0.0)
    # The rear of the first leaves the path of the other, 1.8 m wide, at 0.9 + 2.2 m; the other's front comes 3.1 m before.
    stage.add("ego", route([(-200, 0), (300, 0)], 5.0), 10.0, start_m=200 - 40)
    stage.add("car-1", route([(0, -200), (0, 300)], 5.0), 8.0, start_m=200 - 8.0 * (4.0 + 5.2))
    s = stage.world("", [], ()).scenario
    sigma_m = 2.0
    agents = tuple(
        replace(a, waypoints=replace(a.waypoints, sigma_xy_m=np.full(len(a.waypoints), sigma_m))) for a in s.agents
    )
    (found,) = [g for g in find_tags(replace(s, agents=agents)) if g.tag == "crossing_path"]
    pet_s = 5.2 - 3.1 / 10.0 - 3.1 / 8.0
    assert found.quantities["pet_s"] == pytest.approx(pet_s, abs=0.02)
    expected = NormalDist(0.0, np.hypot(sigma_m / 10.0, sigma_m / 8.0)).cdf(5.0 - pet_s)
    assert found.probability == pytest.approx(expected, abs=0.01)
    doubted = tuple(replace(a, confidence=0.5) for a in agents)
    (half,) = [g for g in find_tags(replace(s, agents=doubted)) if g.tag == "crossing_path"]
    assert half.probability == pytest.approx(found.probability / 4, abs=1e-3)


def test_who_crosses_long_after_is_not_tagged() -> None:
    stages = [Stage(np.random.default_rng(k), 10.0, False, 0.0) for k in range(8)]
    worlds = [crossing(s) for s in stages]
    assert {bool(w.events) for w in worlds} == {True, False}


@pytest.mark.parametrize(
    "agents", [(), (agent("ego", 0.0),), (agent("a", 0.0, t_s=np.zeros(1)),)], ids=["nobody", "standing", "once"]
)
def test_scenarios_without_motion_have_no_tags(agents) -> None:
    assert find_tags(scenario(*agents)) == ()
    assert len(criticality_table(scenario(*agents))["t_s"]) == 0


def test_tags_are_kept_in_the_file_and_dropped_where_they_may_not_hold(tmp_path) -> None:
    tagged = tag(traffic(3, lanes=True).scenario)
    assert {g.tag for g in tagged.tags} >= {"in_lane", "lane_change"}
    assert {g.tag for g in tagged.tags} <= set(TAGS)
    tagged.save(tmp_path / "s.json")
    assert Scenario.load(tmp_path / "s.json").tags == tagged.tags
    assert tagged.to_dict().keys() - traffic(3, lanes=True).scenario.to_dict().keys() == {"tags"}
    assert edit(tagged, [Remove(agent="car-1")]).scenario.tags is None
    with pytest.raises(ScenarioError, match="probability"):
        replace(tagged, tags=(replace(tagged.tags[0], probability=1.5),)).save(tmp_path / "bad.json")


def test_measures_have_their_closed_forms() -> None:
    gap, closing = np.array([20.0, 20.0, 0.0, 10.0]), np.array([5.0, -1.0, 3.0, 10.0])
    assert c.time_to_collision(gap, closing) == pytest.approx([4.0, np.inf, 0.0, 1.0])
    assert c.time_headway(gap, np.array([10.0, 0.0, 10.0, 5.0])) == pytest.approx([2.0, np.inf, 0.0, 2.0])
    assert c.deceleration_to_avoid(gap, closing) == pytest.approx([0.625, 0.0, np.inf, 5.0])
    # Braking so from the gap, after the reaction for MDRAC, leads to the speed of the one ahead in touch with it.
    assert c.modified_deceleration(gap, closing)[0] == pytest.approx(5.0**2 / (2 * (20.0 - 5.0 * 1.0)))
    assert c.modified_deceleration(gap, closing)[3] == np.inf
    assert c.braking_required(gap, closing, np.array([-1.0, 0.0, 0.0, 2.0])) == pytest.approx([1.625, 0.0, np.inf, 3.0])
    assert c.brake_threat_number(gap, closing, np.zeros(4))[3] == pytest.approx(0.625)
    # Within 2 s, 1.8 m less 0.5 m aside are to be gained: a t^2 / 2.
    steer = c.steer_threat_number(np.array([2.0]), np.array([0.5]), np.array([0.0]), np.array([1.8]))
    assert steer == pytest.approx(1.3 / 2.0 / 8.0)
    assert c.encroachment_time(np.array([4.0]), np.array([6.0])) == pytest.approx(1.5)


def test_measures_are_those_of_commonroad_crime() -> None:
    """Its version 0.4.1 for the same two vehicles at four moments; it rounds to two digits, and brakes with 11.5 m/s2 for BTN."""
    t = np.arange(41) / 10
    s = scenario(
        agent("b", 15.0 * t, speed=15.0, t_s=t), agent("a", 45.0 + 9.0 * t, 0.0, speed=9.0, t_s=t), duration_s=4.0
    )
    table = criticality_table(s)
    assert set(table["agent"]) == {"b"}
    assert table["t_s"] == pytest.approx(t, abs=1e-6)
    assert table["gap_m"] == pytest.approx(45.0 - 4.4 - 6.0 * t, abs=1e-3)
    at = np.array([0, 5, 10, 15])
    assert table["ttc_s"][at] == pytest.approx([6.77, 6.27, 5.77, 5.27], abs=0.005)
    assert table["braking_required_mps2"][at] == pytest.approx([0.44, 0.48, 0.52, 0.57], abs=0.005)
    assert table["btn"][at] * c.BRAKES_MPS2 / 11.5 == pytest.approx([0.0383, 0.0417, 0.0452, 0.0496], abs=5e-4)
    assert table["stn"][at] * c.BRAKES_MPS2 == pytest.approx([0.08, 0.09, 0.11, 0.13], abs=0.006)


def test_states_are_held_between_their_limits() -> None:
    v = np.array([0, 1, 5, 9, 5, 1, 5, 9, 9, 0])
    assert latched(v > 8, v < 2, v > 4).tolist() == [False, False, False, True, True, False, False, True, True, False]
    assert latched(v > 10, v < -1, v > 4).tolist() == (v > 4).tolist()
    assert runs(np.array([1, 1, 0, 1, 0, 0, 1], dtype=bool)) == [(0, 1), (3, 3), (6, 6)]
    assert runs(np.array([1, 1, 0, 1, 0, 0, 1], dtype=bool), 2, 1) == [(0, 3)]
    assert runs(np.zeros(3, dtype=bool)) == []


def test_lanes_inferred_from_paths_alone_are_no_edges() -> None:
    world = traffic(3, lanes=True)
    guessed = tuple(replace(lane, inferred_from="paths") for lane in world.scenario.map_features.lanes)
    assert Traffic(replace(world.scenario, map_features=MapFeatures(lanes=guessed))).lanes == []


def test_who_is_lost_from_sight_before_a_crossing_still_crosses_with_a_time_that_is_less_certain() -> None:
    rng = np.random.default_rng(3)
    stage = Stage(rng, 10.0, False, 0.1)
    stage.add("ego", route([(-200, 0), (300, 0)], 5.0), 10.0, start_m=150.0)  # at the crossing at 5 s
    stage.add("car-1", route([(0, -200), (0, 300)], 5.0), 8.0, start_m=200 - 8.0 * 6.6)  # at 6.6 s
    whole = stage.world("crossing", [], ()).scenario

    def cut(seconds: float) -> Scenario:
        w = whole["car-1"].waypoints
        return replace(
            whole, agents=(whole["ego"], replace(whole["car-1"], waypoints=w.take(np.flatnonzero(w.t_s < seconds))))
        )

    def of(name: str, world: Scenario) -> list:
        return [g for g in find_tags(world) if g.tag == name]

    (seen,), (lost,) = of("crossing_path", whole), of("crossing_path", cut(5.0))
    assert lost.quantities["pet_s"] == pytest.approx(seen.quantities["pet_s"], abs=0.15)
    assert (lost.agent, lost.other) == (seen.agent, seen.other) == ("ego", "car-1")
    near, unsure = of("near_miss", whole), of("near_miss", cut(5.0))
    assert near[0].probability > 0.9
    assert 0.5 < unsure[0].probability < near[0].probability
    assert not of("crossing_path", cut(3.5))  # too long ago


def test_who_is_lost_while_it_passes_overtakes_with_a_probability_that_falls_with_the_time_out_of_sight() -> None:
    stage = Stage(np.random.default_rng(5), 10.0, False, 0.1)
    line = route([(-300, 0), (300, 0)], 5.0)
    stage.add("ego", line, 10.0, start_m=200.0)
    stage.add("car-1", line + np.array([0.0, 3.5]), 16.0, start_m=200.0 - 24.0)  # beside it at 4 s, past it at 4.7 s
    whole = stage.world("passes", [], ()).scenario

    def overtakes(until_s: float) -> list:
        w = whole["car-1"].waypoints
        lost = replace(whole["car-1"], waypoints=w.take(np.flatnonzero(w.t_s < until_s)))
        return [g for g in find_tags(replace(whole, agents=(whole["ego"], lost))) if g.tag == "overtaking"]

    (seen,), (lost,) = overtakes(12.0), overtakes(4.0)
    assert (lost.agent, lost.other) == (seen.agent, seen.other) == ("car-1", "ego")
    assert lost.t_s == pytest.approx(seen.t_s, abs=0.15)
    assert lost.end_s == pytest.approx(seen.end_s, abs=0.25)
    assert 0.5 < lost.probability <= seen.probability
    assert not overtakes(2.5)  # 4.7 s are more than 2 s on


@pytest.mark.parametrize("lost_one", ["ego", "car-1"])
def test_who_is_lost_while_it_changes_lanes_cuts_in_with_a_probability_that_falls_with_the_time_out_of_sight(
    lost_one,
) -> None:
    t = np.linspace(0.0, 12.0, 121)
    across = 3.5 * (1.0 - np.clip((t - 4.5) / 3.0, 0.0, 1.0))  # it crosses the edge of the lane at 6 s, at 1.2 m/s
    sure = np.full(len(t), 0.1)
    ego, ahead = (agent(id, x + 20.0 * t, speed=20.0, t_s=t) for id, x in (("ego", 0.0), ("car-2", 70.0)))
    car = agent("car-1", 20.0 + 20.0 * t, across, -np.arctan(3.5 / 3.0 / 20.0) * ((t > 4.5) & (t < 7.5)), 20.0, t_s=t)
    agents = (replace(a, waypoints=replace(a.waypoints, sigma_xy_m=sure)) for a in (ego, car, ahead))
    whole = scenario(*agents, duration_s=12.0)

    def cuts_in(until_s: float) -> list:
        w = whole[lost_one].waypoints
        lost = replace(whole[lost_one], waypoints=w.take(np.flatnonzero(w.t_s < until_s)))
        agents = [lost if a.id == lost_one else a for a in whole.agents]
        return [g for g in find_tags(replace(whole, agents=tuple(agents))) if g.tag == "cut_in"]

    (seen,), (soon,), (late,) = cuts_in(13.0), cuts_in(5.8), cuts_in(5.4)
    for lost in (soon, late):
        assert (lost.agent, lost.other) == (seen.agent, seen.other) == ("car-1", "ego")
        assert lost.t_s == pytest.approx(seen.t_s, abs=0.45)
        assert lost.quantities["gap_m"] == pytest.approx(seen.quantities["gap_m"], abs=0.3)
    assert 0.3 < late.probability < soon.probability < seen.probability
    assert not cuts_in(3.5)  # who has not begun to change lanes keeps its own


@pytest.mark.parametrize("noise_m", [0.0, 0.15, 0.5])
def test_places_that_jitter_without_sigmas_are_as_uncertain_as_they_jitter(noise_m) -> None:
    world = traffic(3, noise_m=noise_m).scenario
    bare = [replace(a, waypoints=replace(a.waypoints, sigma_xy_m=0 * a.waypoints.sigma_xy_m)) for a in world.agents]
    found = Traffic(replace(world, agents=tuple(bare))).sigma_m
    assert np.nanmedian(found) == pytest.approx(noise_m, rel=0.1, abs=0.005)
    told = Traffic(world).sigma_m  # sigmas that are told are believed
    assert np.nanmedian(told) == pytest.approx(noise_m, abs=1e-9 if noise_m else 0.005)


def test_speeds_and_headings_of_labels_that_jump_are_no_braking_and_no_turning_back() -> None:
    stage = Stage(np.random.default_rng(4), 10.0, False, 0.0)
    line = route([(-300, 0), (300, 0)], 5.0)
    jumps = np.where((stage.t > 3.0) & (stage.t < 3.5), 18.5, 15.0)  # half a second between two keyframes
    brakes = np.clip(15.0 - 5.0 * np.maximum(stage.t - 6.0, 0.0), 9.0, None)
    stage.add("ego", line, jumps)
    stage.add("car-1", line + np.array([0.0, 50.0]), brakes)
    creeps = np.where((stage.t > 4.0) & (stage.t < 5.0), 2.5, 0.0)
    stage.add("car-2", line + np.array([0.0, 100.0]), creeps, start_m=300.0)
    world = stage.world("jumps", [], ()).scenario
    w = world["car-2"].waypoints
    flips = replace(
        world["car-2"], waypoints=replace(w, yaw_rad=np.where((w.t_s > 4.4) & (w.t_s < 4.8), np.pi - 1e-6, w.yaw_rad))
    )
    found = find_tags(replace(world, agents=(*world.agents[:2], flips)))
    assert [g.agent for g in found if g.tag == "hard_braking"] == ["car-1"]
    assert not [g for g in found if g.tag in ("u_turn", "turning")]


@pytest.mark.parametrize(("window", "order"), [(5, 1), (9, 2), (21, 2)])
def test_polynomials_through_windows_are_those_of_savitzky_and_golay(window, order):
    values = np.random.default_rng(5).normal(size=(2, 60)).cumsum(axis=1)
    expected = savgol_filter(values, window, order)
    np.testing.assert_allclose(fit_windows(values[0] + 1j * values[1], window, order), expected[0] + 1j * expected[1])
    np.testing.assert_allclose(
        fit_windows(values[0, :window], window, order), savgol_filter(values[0, :window], window, order)
    )
