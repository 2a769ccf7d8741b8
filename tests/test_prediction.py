"""Short predictions: closed forms, invariances, no knowledge of the future, honest sigmas, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks import prediction as prediction_worlds
from command_line import run
from replay_maneuvers import agent_from
from replay_scenes import line, parked, walker

from log2sim.datatypes import Agent, MapFeatures, MapLane, Scenario
from log2sim.simulation.prediction.motion_table import table_of
from log2sim.simulation.prediction.prediction import (
    ACCELERATION_S,
    METHODS,
    Predictions,
    drift_variance,
    measure_predictions,
    predict_scenario,
)

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
