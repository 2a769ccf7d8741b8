"""Short predictions: closed forms, invariances, no knowledge of the future, honest sigmas, and the command."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import bench_prediction
import numpy as np
import prediction_worlds
import pytest
from command_line import run
from hypothesis import given, settings
from hypothesis import strategies as st
from replay_maneuvers import agent_from, driven
from replay_scenes import line, parked, walker

from log2sim.datatypes import Agent, MapFeatures, MapLane, Scenario
from log2sim.errors import ConfigError, ScenarioError
from log2sim.files.documents import check
from log2sim.prediction import motion_table
from log2sim.prediction.displacement import format_figures, measure_predictions, prediction_document
from log2sim.prediction.motion_table import table_of, tabulate
from log2sim.prediction.prediction import (
    ACCELERATION_S,
    METHODS,
    Predictions,
    drift_variance,
    leads_of,
    predict_scenario,
    predict_table,
)

ROOT = Path(__file__).resolve().parents[1]
Array = np.ndarray


def scene(*agents: Agent, duration_s: float = 20.0) -> Scenario:
    return Scenario("made", 0, duration_s, tuple(agents))


def circle(radius_m: float, speed: float, duration_s: float = 10.0, **options) -> Agent:
    """An agent whose center goes around the origin to the left."""
    t = np.arange(round(duration_s * 10) + 1) * 0.1
    angle = speed / radius_m * t
    xy = radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    return agent_from(t, *xy.T, angle + np.pi / 2, np.full(len(t), speed), offset_m=0.0, **options)


def corner(id: str, delay_s: float, **options) -> Agent:
    """A car that drives east to the origin, turns left on 10 m and goes north, all at 6 m/s; `delay_s` later at each place."""
    t = np.arange(0, 24.05, 0.1)
    way = 6.0 * (t - delay_s) - 60.0
    arc = np.pi / 2 * 10.0
    turned = np.clip(way / 10.0, 0.0, np.pi / 2)
    x = np.where(way < 0, way, 10.0 * np.sin(turned))
    y = np.where(way < 0, 0.0, 10.0 * (1 - np.cos(turned)) + np.maximum(way - arc, 0.0))
    return agent_from(t, x, y, turned, np.full(len(t), 6.0), id=id, offset_m=0.0, **options)


def errors(predictions: Predictions, agent: str, method: str, lead_s: float) -> Array:
    """Distances (K,) of predictions from where the agent was, as far as that is known."""
    rows = predictions.rows_of(agent)
    h = int(np.argmin(np.abs(predictions.lead_s - lead_s)))
    later, _ = predictions.table.later(round(lead_s / predictions.table.tick_s))
    off = predictions.forecasts[method].position_m[rows, h] - later[predictions.row[rows], predictions.tick[rows]]
    return np.abs(off[np.isfinite(off)])


def moved(agent: Agent, turn: float, x_m: float, y_m: float) -> Agent:
    w = agent.waypoints
    xy = (w.x_m + 1j * w.y_m) * np.exp(1j * turn) + complex(x_m, y_m)
    return replace(agent, waypoints=replace(w, x_m=xy.real, y_m=xy.imag, yaw_rad=w.yaw_rad + turn))


def test_straight_on_every_method_is_right() -> None:
    found = predict_scenario(scene(line("a", 0.0, speed=12.0, yaw=0.7), walker("b", 5.0, 3.0, 1.4, 20.0, -2.0)))
    for method in METHODS:
        for agent in "ab":
            assert errors(found, agent, method, 3.0).max() < 1e-6


def test_on_a_circle_the_turn_is_kept_and_constant_velocity_leaves_by_the_tangent() -> None:
    radius, speed = 25.0, 8.0
    found = predict_scenario(scene(circle(radius, speed)))
    assert errors(found, "a", "turn", 3.0)[5:].max() < 0.02
    assert errors(found, "a", "smoothed", 3.0)[40:].max() < 0.02
    angle = 3.0 * speed / radius
    tangent = radius * abs(1 + 1j * angle - np.exp(1j * angle))
    assert errors(found, "a", "velocity", 3.0)[5:] == pytest.approx(tangent, abs=0.02)


def test_a_brake_is_not_foreseen() -> None:
    """Constant velocity is off by half the deceleration times the squared lead, and by nothing once the car stands."""
    car = driven(lambda t: np.clip(12.0 - 3.0 * np.maximum(t - 4.0, 0.0), 0.0, None), lambda s: 0.0 * s, 14.0)
    off = errors(predict_scenario(scene(car)), "a", "velocity", 2.0)
    assert off[:20].max() < 1e-3
    assert off[45] == pytest.approx(3.0 * 2.0**2 / 2, abs=0.05)
    assert off[90:].max() < 1e-3


@pytest.mark.slow
@settings(max_examples=5, deadline=None)
@given(turn=st.floats(-3, 3), x=st.floats(-1e5, 1e5), y=st.floats(-1e5, 1e5))
def test_turned_and_shifted_worlds_are_predicted_alike(turn: float, x: float, y: float) -> None:
    agents = [corner("a", 0.0), corner("b", 2.0), walker("c", 5.0, 30.0, 1.4, 20.0, -2.0)]
    here = predict_scenario(scene(*agents))
    there = predict_scenario(scene(*(moved(a, turn, x, y) for a in agents)))
    for method, forecast in here.forecasts.items():
        expected = forecast.position_m * np.exp(1j * turn) + complex(x, y)
        assert np.abs(there.forecasts[method].position_m - expected).max() < 1e-4
        assert there.forecasts[method].sigma_m == pytest.approx(forecast.sigma_m, abs=1e-4)


def test_at_half_the_pace_the_same_places_are_predicted_in_twice_the_time() -> None:
    agent = corner("a", 0.0)
    w = agent.waypoints
    slow = replace(agent, waypoints=replace(w, t_s=2 * w.t_s, speed_mps=w.speed_mps / 2))
    methods = ("velocity", "turn")
    fast_found = predict_table(tabulate([agent], np.arange(200) * 0.1, 0.1), np.array([1.0, 3.0]), methods)
    slow_found = predict_table(tabulate([slow], np.arange(200) * 0.2, 0.2), np.array([2.0, 6.0]), methods)
    for method in methods:
        assert slow_found.forecasts[method].position_m == pytest.approx(
            fast_found.forecasts[method].position_m, abs=1e-6
        )


def test_the_future_is_not_known() -> None:
    """Whatever happens after a tick changes no prediction made until then."""
    agents = [corner("a", 0.0), corner("b", 2.0), circle(12.0, 5.0, 20.0, id="c"), parked("d", 3.0, 9.0)]
    agents.append(moved(corner("e", -2.0), 0.0, 0.0, 0.8))  # "b", which comes later, is nearer to the path of "a"
    whole = predict_scenario(scene(*agents))
    for cut_s in (4.0, 11.0, 13.5):
        until = [replace(a, waypoints=a.waypoints.take(a.waypoints.t_s <= cut_s + 1e-6)) for a in agents]
        part = predict_scenario(scene(*until, duration_s=cut_s))
        known = whole.table.t_s[whole.tick] < cut_s - 0.05  # the slope at a last waypoint has only one side
        known_part = part.table.t_s[part.tick] < cut_s - 0.05
        for method, forecast in part.forecasts.items():
            expected = whole.forecasts[method]
            assert forecast.position_m[known_part] == pytest.approx(expected.position_m[known], abs=1e-9)
            assert forecast.sigma_m[known_part] == pytest.approx(expected.sigma_m[known], abs=1e-9)


def test_the_order_of_agents_does_not_matter() -> None:
    agents = [corner("a", 0.0), corner("b", 2.0), walker("c", 5.0, 30.0, 1.4, 20.0, -2.0)]
    here, there = predict_scenario(scene(*agents)), predict_scenario(scene(*agents[::-1]))
    for method in METHODS:
        for agent in "abc":
            assert there.forecasts[method].position_m[there.rows_of(agent)] == pytest.approx(
                here.forecasts[method].position_m[here.rows_of(agent)]
            )


def test_who_follows_is_predicted_along_the_path_of_the_one_ahead() -> None:
    """The second car comes 4 s later; from 1 s before the bend on, the first car's path tells it."""
    found = predict_scenario(scene(corner("a", 0.0), corner("b", 4.0)))
    rows = found.rows_of("b")
    at = found.table.t_s[found.tick[rows]]
    before = rows[(at > 11.5) & (at < 13.5)]  # the bend begins at 14 s
    later, _ = found.table.later(30)
    truth = later[found.row[before], found.tick[before]]
    off = {m: np.abs(found.forecasts[m].position_m[before, -1] - truth).mean() for m in METHODS}
    assert off["path"] < 0.25 * off["smoothed"]
    assert found.on_path[before].all()
    assert not found.on_path[found.rows_of("a")].any()  # nobody was there before


def test_a_lane_is_a_path_that_is_known_beforehand() -> None:
    ahead = corner("lane", 0.0).waypoints
    lane = np.column_stack([ahead.x_m, ahead.y_m])
    found = predict_scenario(scene(corner("a", 0.0)), lanes=[lane])
    free = predict_scenario(scene(corner("a", 0.0)))
    assert errors(found, "a", "path", 3.0).mean() < 0.3 * errors(free, "a", "path", 3.0).mean()


@pytest.mark.parametrize(("origin", "known"), [("markings", True), ("both", True), ("paths", False)])
def test_lanes_between_markings_are_known_and_those_out_of_paths_are_not(origin: str, known: bool) -> None:
    """Lanes out of paths are where agents went later."""
    ahead = corner("lane", 0.0).waypoints
    points = np.column_stack([ahead.x_m, ahead.y_m, 0 * ahead.x_m])
    lane = MapLane("lane", points, np.full(len(points), 3.5), inferred_from=origin)
    world = scene(corner("a", 0.0))
    found = predict_scenario(replace(world, map_features=MapFeatures(lanes=(lane,))))
    free = predict_scenario(world)
    share = errors(found, "a", "path", 3.0).mean() / errors(free, "a", "path", 3.0).mean()
    assert bool(share < 0.3) == known
    assert bool(share == 1.0) != known


@pytest.mark.parametrize(
    ("ahead", "behind", "follows"),
    [
        ("pedestrian", "car", False),
        ("cyclist", "car", False),
        ("truck", "car", True),
        ("car", "cyclist", True),
        ("motorcycle", "cyclist", True),
        ("car", "pedestrian", False),
        ("pedestrian", "pedestrian", True),
    ],
)
def test_agents_follow_their_own_kind_and_riders_vehicles_too(ahead: str, behind: str, follows: bool) -> None:
    found = predict_scenario(scene(corner("a", 0.0, category=ahead), corner("b", 4.0, category=behind)))
    assert found.on_path.any() == follows


def test_noisy_positions_choose_longer_averages() -> None:
    rng = np.random.default_rng(3)
    exact = line("a", 0.0, speed=8.0)
    w = exact.waypoints
    shaken = replace(w, speed_mps=w.speed_mps + rng.normal(0, 0.8, len(w)), yaw_rad=rng.normal(0, 0.08, len(w)))
    noisy = replace(exact, waypoints=shaken)
    found = predict_scenario(scene(noisy))
    velocity_s, turn_s = found.constants_s[-1]
    assert velocity_s > 0.0
    assert turn_s > 1.0
    assert errors(found, "a", "smoothed", 3.0)[30:].mean() < 0.7 * errors(found, "a", "turn", 3.0)[30:].mean()
    assert predict_scenario(scene(circle(20.0, 6.0))).constants_s[-1, 1] < 1.0


def test_an_average_over_a_steady_circle_does_not_lag(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(motion_table, "CONSTANTS_S", ((0.6, 0.6),))
    table = table_of(scene(circle(20.0, 6.0)))
    velocity = motion_table.smooth_motion(table).velocity_mps[0, 60:100]
    assert velocity == pytest.approx(table.velocity_mps[0, 60:100], abs=0.02)


def test_turn_rates_are_what_drivers_can_do() -> None:
    table = table_of(scene(circle(20.0, 6.0), line("b", 0.0, speed=0.2)))
    rates = motion_table.turn_rates(table)
    assert rates[0, 5:90] == pytest.approx(6.0 / 20.0, rel=0.01)
    assert not rates[1].any()
    backing = agent_from(np.arange(4) * 0.1, [0, 0.5, 0.4, 0.9], [0, 0.4, 0, 0.4], np.zeros(4), [5, 5, -5, 5.0])
    assert np.abs(motion_table.turn_rates(table_of(scene(backing), 0.1))).max() <= 8.8 / 0.5


def test_sigmas_grow_with_the_lead_and_shrink_while_an_agent_stands() -> None:
    found = predict_scenario(scene(line("a", 0.0, speed=12.0), parked("b", 0.0, 9.0)), 5.0)
    for forecast in found.forecasts.values():
        assert (np.diff(forecast.sigma_m, axis=1) > 0).all()
    stands = found.forecasts["path"].sigma_m[found.rows_of("b"), -1, 0]
    assert (np.diff(stands) < 0).all()
    assert np.abs(found.forecasts["path"].position_m[found.rows_of("b")] - 9j).max() == 0


def test_the_way_of_lasting_accelerations_equals_a_double_integral() -> None:
    s = np.linspace(0.0, 3.0, 1201)
    weight = (3.0 - s)[:, None] * (3.0 - s) * np.exp(-np.abs(s[:, None] - s) / ACCELERATION_S)
    assert float(drift_variance(np.array(3.0))) == pytest.approx(np.trapezoid(np.trapezoid(weight, s), s), rel=1e-4)
    near = drift_variance(np.array([0.05 - 1e-9, 0.05 + 1e-9]) * ACCELERATION_S)
    assert near[0] == pytest.approx(near[1], rel=1e-4)


def test_what_jumps_is_another_object() -> None:
    agent = line("a", 0.0, speed=8.0)
    w = agent.waypoints
    jumped = replace(agent, waypoints=replace(w, x_m=w.x_m + np.where(w.t_s > 9.95, 60.0, 0.0)))
    found = predict_scenario(scene(jumped))
    assert errors(found, "a", "smoothed", 3.0).max() < 0.5
    assert len(errors(found, "a", "smoothed", 3.0)) == 201 - 2 * 30


def test_on_random_traffic_sigmas_are_honest_and_the_past_helps() -> None:
    """Predicted from states smoothed as a reconstruction smooths them, compared with the truth."""
    squared, off = [], {m: [] for m in METHODS}
    for seed in range(2):
        courses = prediction_worlds.courses(seed)
        found = predict_scenario(prediction_worlds.smoothed_scenario(courses, seed))
        later, _ = table_of(prediction_worlds.true_scenario(courses)).later(30)
        truth = later[found.row, found.tick]
        moves = np.isfinite(truth) & (np.abs(found.table.velocity_mps[found.row, found.tick]) > 0.15)
        for method, forecast in found.forecasts.items():
            off[method].append((forecast.position_m[:, -1] - truth)[moves])
        error = off["path"][-1] * forecast.course[moves, -1].conj()
        squared.append((np.column_stack([error.real, error.imag]) / forecast.sigma_m[moves, -1]) ** 2)
    nees = np.concatenate(squared)
    assert 0.3 < nees.mean() < 1.2
    assert 0.92 < (nees.sum(axis=1) < 5.991).mean() <= 1.0
    mean = {m: np.abs(np.concatenate(e)).mean() for m, e in off.items()}
    assert mean["path"] < mean["smoothed"] < 0.95 * mean["velocity"]


def test_differences_of_measured_positions_are_smoothed() -> None:
    """Chen's scheme: velocities are differences of noisy positions, off by a meter per second and more."""
    courses = prediction_worlds.courses(0)
    truth = table_of(prediction_worlds.true_scenario(courses))
    found = predict_table(bench_prediction.difference_table(truth, courses, 0), leads_of(3.0))
    later, _ = truth.later(30)
    known = np.isfinite(later[found.row, found.tick]) & (found.table.t_s[found.tick] > 3.0)
    off = {
        m: np.abs(f.position_m[:, -1] - later[found.row, found.tick])[known].mean() for m, f in found.forecasts.items()
    }
    assert off["smoothed"] < 0.5 * off["velocity"] < 0.5 * off["turn"]


def test_ten_thousand_agent_ticks_take_well_under_a_second() -> None:
    agents = [line(f"a{k}", 7.0 * k, 4.0 * k, 5.0 + k % 7, duration_s=20.0) for k in range(50)]
    world = scene(*agents)
    predict_scenario(scene(*agents[:2]))  # imports
    start = time.process_time()
    assert len(predict_scenario(world).row) == 50 * 201
    assert time.process_time() - start < 1.0


def test_the_figures_hold_what_is_known_by_hand() -> None:
    """A car that turns around a circle: each lead's distance from the tangent, and their mean."""
    radius, speed = 25.0, 8.0
    (entry,) = (
        e
        for e in measure_predictions(predict_scenario(scene(circle(radius, speed, 8.0), duration_s=8.0), 2.0))
        if e["agents"] == "car"
    )
    assert entry["motion"] == "moving"
    last = entry["methods"]["velocity"][-1]
    angle = np.array([0.5, 1.0, 1.5, 2.0]) * speed / radius
    tangent = radius * np.abs(1 + 1j * angle - np.exp(1j * angle))
    assert last["lead_s"] == 2.0
    assert (last["ticks"], last["agents"]) == (61, 1)
    assert last["fde_m"] == pytest.approx(tangent[-1], abs=0.03)
    assert last["ade_m"] == pytest.approx(tangent.mean(), abs=0.03)


def test_filled_gaps_and_static_agents_are_not_compared() -> None:
    agent = line("a", 0.0, speed=8.0)
    w = agent.waypoints
    gap = replace(agent, waypoints=replace(w, observed=(w.t_s < 5.0) | (w.t_s > 9.0)))
    found = predict_scenario(scene(gap, parked("b", 0.0, 9.0)), 1.0)
    entries = measure_predictions(found)
    assert {e["motion"] for e in entries} == {"moving"}
    seen = (found.table.t_s < 4.95) | (found.table.t_s > 9.05)
    assert entries[0]["methods"]["path"][0]["ticks"] == int((seen[:-10] & seen[10:]).sum())


def test_the_document_keeps_its_schema() -> None:
    world = scene(corner("a", 0.0), corner("ego", 3.0), parked("b", 0.0, 9.0))
    found = predict_scenario(world, 2.2)
    for positions in (False, True):
        document = prediction_document(world, found, with_positions=positions)
        check(document, "prediction-1", ScenarioError)
        assert ("predictions" in document) is positions
    assert document["lead_s"] == [0.5, 1.0, 1.5, 2.0, 2.2]
    entry = document["predictions"][0]
    assert np.shape(entry["methods"]["path"]["x_m"]) == (len(entry["t_s"]), 5)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    text = format_figures(document)
    assert "ego, moving" in text
    assert "FDE 2.2 s" in text


def test_nothing_to_predict_is_no_error() -> None:
    for world in (scene(), scene(parked("a", 0.0, 0.0)), scene(line("a", 0.0, duration_s=0.0), duration_s=0.0)):
        found = predict_scenario(world)
        document = prediction_document(world, found, with_positions=True)
        check(document, "prediction-1", ScenarioError)
        assert format_figures(document).startswith("nothing to compare")


@pytest.mark.parametrize("duration_s", [0.1, 0.2, 0.5])
def test_a_way_too_short_for_a_path_is_none(duration_s: float) -> None:
    brief = line("a", 0.0, speed=1.0, duration_s=duration_s)
    found = predict_scenario(scene(brief, line("b", -3.0, speed=1.0), duration_s=duration_s))
    assert not found.on_path.any()
    assert errors(found, "b", "path", 3.0).max() < 1e-6


def test_a_prediction_is_found_by_time_and_agent() -> None:
    found = predict_scenario(scene(line("a", 0.0), line("b", 0.0, 9.0, duration_s=5.0)))
    assert found.row[found.rows_at(3.04)].tolist() == [0, 1]
    assert found.row[found.rows_at(7.0)].tolist() == [0]
    assert found.table.t_s[found.tick[found.rows_at(3.04)]] == pytest.approx(3.0)
    assert len(found.rows_of("nobody")) == 0


def test_horizons_are_from_a_tick_to_ten_seconds() -> None:
    assert leads_of(0.26) == pytest.approx([0.3])
    assert leads_of(1.0) == pytest.approx([0.5, 1.0])
    for wrong in (0.0, -1.0, 11.0, float("nan")):
        with pytest.raises(ConfigError, match=r"expected 0\.1 to 10 s"):
            leads_of(wrong)


def test_the_velocity_of_a_trajectory_is_the_slope_of_its_positions() -> None:
    path = corner("a", 0.0).trajectory
    t = np.linspace(0.3, 19.7, 83)
    after, before = (np.array(path.relative(t + dt)[:2]) for dt in (1e-5, -1e-5))
    assert np.array(path.velocity(t)) == pytest.approx((after - before) / 2e-5, abs=1e-4)


def test_the_command_prints_the_figures_and_writes_them(tmp_path: Path) -> None:
    scene(corner("a", 0.0), corner("b", 3.0)).save(tmp_path / "scenario.json")
    out = tmp_path / "prediction.json"
    ran = run("predict", tmp_path / "scenario.json", "--horizon", "2", "--method", "smoothed,velocity", "--out", out)
    assert ran.code == 0
    assert "car, moving" in ran.out
    assert "FDE 2 s" in ran.out
    assert list(json.loads(out.read_text())["methods"]) == ["smoothed", "velocity"]
    assert "valid" in run("validate", out).out
    assert "exists already" in run("predict", tmp_path / "scenario.json", "--out", out).line
    quiet = run("predict", tmp_path / "scenario.json", "--out", out, "--overwrite", "--positions", "--quiet")
    assert (quiet.code, quiet.out) == (0, "")
    assert "predictions" in json.loads(out.read_text())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--horizon", "60"], "horizon: 60 s, expected 0.1 to 10 s"),
        (["--method", "kalman"], "method: 'kalman' is not known; known: velocity, turn, smoothed, path"),
        (["--positions"], "--positions: there is no file"),
    ],
)
def test_wrong_options_say_what_is_expected(options: list[str], message: str, tmp_path: Path) -> None:
    scene(corner("a", 0.0)).save(tmp_path / "scenario.json")
    ran = run("predict", tmp_path / "scenario.json", *options)
    assert message in ran.line
    assert ran.code == 2
