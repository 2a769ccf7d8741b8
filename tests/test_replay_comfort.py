"""Comfort, off-path, commands and limits of a replay."""

from __future__ import annotations

import json

import numpy as np
import pytest
from command_line import run
from replay_maneuvers import MANEUVERS, agent_from, driven, ramp, scenario_of
from scipy.signal import savgol_filter

from log2sim.errors import CheckFailed
from log2sim.files.documents import write_json
from log2sim.simulation.metrics.all_metrics import (
    LIMITS,
    _derivative,
    check_limits,
    check_strict,
    comfort,
    parse_limits,
    require_strict,
)
from log2sim.simulation.policy import Controls
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay

T_S = np.arange(0, 121) * 0.05


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize(("radius", "speed"), [(20.0, 6.0), (-50.0, 12.0)])
def test_on_a_circle_all_acceleration_is_across_and_the_jerk_turns_it(radius, speed, offset):
    angle = speed / radius * T_S
    felt = comfort(T_S, offset + radius * np.sin(angle), offset - radius * np.cos(angle), angle)
    rate, across = speed / abs(radius), speed**2 / abs(radius)
    assert felt["lat_accel_max_mps2"] == pytest.approx(across, rel=0.01)
    assert felt["lat_accel_rms_mps2"] == pytest.approx(across, rel=0.01)
    assert felt["lon_accel_rms_mps2"] < 0.02 * across
    assert felt["jerk_max_mps3"] == pytest.approx(across * rate, rel=0.02)
    assert felt["yaw_rate_max_radps"] == pytest.approx(rate, rel=0.001)
    assert felt["comfortable"]


@pytest.mark.parametrize("spacing_s", [0.04, 0.05, 0.1])
@pytest.mark.parametrize("heading", [0.0, 2.5])
def test_a_swing_along_the_heading_has_its_acceleration_and_jerk(spacing_s, heading):
    t = np.arange(0, 8, spacing_s)
    way, rate = 2.0, 1.1
    s = 5 * t + way * np.sin(rate * t)
    felt = comfort(t, s * np.cos(heading), s * np.sin(heading), np.full(len(t), heading))
    assert felt["lon_accel_max_mps2"] == pytest.approx(way * rate**2, rel=0.02)
    assert felt["lon_decel_max_mps2"] == pytest.approx(way * rate**2, rel=0.02)
    assert felt["lon_jerk_max_mps3"] == pytest.approx(way * rate**3, rel=0.08)
    assert felt["lon_accel_rms_mps2"] == pytest.approx(way * rate**2 / np.sqrt(2), rel=0.1)
    assert felt["lat_accel_max_mps2"] < 1e-6


@pytest.mark.parametrize(
    ("key", "x", "y", "yaw"),
    [
        ("lon_accel_max_mps2", 1.25 * T_S**2, 0 * T_S, 0 * T_S),
        ("lon_decel_max_mps2", 30 * T_S - 2.1 * T_S**2, 0 * T_S, 0 * T_S),
        ("lat_accel_max_mps2", 10 * T_S, 2.5 * T_S**2, 0 * T_S),
        ("yaw_rate_max_radps", 0 * T_S, 0 * T_S, 1.0 * T_S),
        ("yaw_accel_max_radps2", 0 * T_S, 0 * T_S, 0.26 * np.sin(3.0 * T_S)),
        ("lon_jerk_max_mps3", 0.5 * np.sin(2.2 * T_S), 0 * T_S, 0 * T_S),
    ],
)
def test_each_limit_of_comfort_counts(key, x, y, yaw):
    broken = [k for k, limit in LIMITS.items() if comfort(T_S, x, y, yaw)[k] > limit]
    assert broken == [key]
    assert not comfort(T_S, x, y, yaw)["comfortable"]


@pytest.mark.parametrize("count", [5, 8, 16, 90])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_derivatives_are_those_of_scipy(count, order):
    values = np.cumsum(np.random.default_rng(count).normal(size=count))
    window = min(2 * round(0.75 / 0.05 / 2) + 1, count - (count + 1) % 2)
    expected = savgol_filter(values, window, 3, deriv=order, delta=0.05)
    np.testing.assert_allclose(_derivative(values, order, 0.75, 0.05), expected, rtol=1e-8, atol=1e-6)


def test_comfort_of_a_replay_is_that_of_its_maneuver_at_every_step():
    brake = driven(lambda t: ramp(t, (0, 12), (2, 12), (6, 0), (8, 0)), np.zeros_like, 8.0)
    for dt_s in (0.005, 0.02, 0.1):
        felt = replay(scenario_of(brake), dt_s=dt_s).metrics["by_agent"]["a"]["comfort"]
        assert felt["lon_decel_max_mps2"] == pytest.approx(3.0, abs=0.25)
    walker = agent_from(T_S, T_S, 0 * T_S, 0 * T_S, 1 + 0 * T_S, category="pedestrian", offset_m=0)
    leap = agent_from(T_S, 5 * T_S + np.where(T_S > 2.05, 30, 0), 0 * T_S, 0 * T_S, 5 + 0 * T_S)
    for agent in (walker, leap):
        assert replay(scenario_of(agent)).metrics["by_agent"]["a"]["comfort"] is None


def test_a_file_of_the_first_version_still_loads(tmp_path):
    document = replay(scenario_of(MANEUVERS["lane change"]())).to_dict()
    for agent in document["agents"]:
        del agent["commands"], agent["errors"]
    m = document["metrics"]
    for values in (m, m["by_agent"]["a"]):
        for key in ("min_ttc", "min_pet", "conflicts", "off_path_share", "comfort", "min_ttc_s", "min_pet_s"):
            values.pop(key, None)
    write_json(tmp_path / "old.json", document)
    old = Replay.load(tmp_path / "old.json")
    assert old.agents[0].commands is None
    assert check_strict(old, {"min_ttc_s": 1.0, "jerk_max_mps3": 1.0}) == []


def hard_braking():
    stands = agent_from([0.0], [60.0], [0.0], [0.0], [0.0], id="wall", static=True)
    ego = driven(lambda t: ramp(t, (0, 15), (1, 15), (4, 0), (6, 0)), np.zeros_like, 6.0, id="ego")
    other = driven(lambda t: ramp(t, (0, 15), (2, 15), (4, 0), (6, 0)), np.zeros_like, 6.0, start=(0, 30, 0), id="b")
    return scenario_of(ego, other, stands)


def test_limits_are_of_all_agents_or_of_the_ego_that_a_policy_drives():
    followed = replay(hard_braking(), dt_s=0.02)
    assert check_strict(followed) == []
    limits = parse_limits(["lon_decel_max_mps2=4.5", "min_ttc_s = 3"])
    broken = check_limits(followed, limits)
    assert [line.split(":")[0] for line in broken] == ["agent 'ego'", "agent 'ego'", "agent 'b'"]
    assert "lon_decel_max_mps2 4.9" in broken[0] or "lon_decel_max_mps2 5" in broken[0]
    assert "min_ttc_s 2.5" in broken[1]
    assert "at least 3" in broken[1]
    own = replay(hard_braking(), ego=lambda seen: Controls(-3.0, 0.0), dt_s=0.02)
    assert check_limits(own, limits) == []
    with pytest.raises(CheckFailed, match="lon_decel_max_mps2"):
        require_strict(followed, limits)


def test_the_command_lists_collisions_and_broken_limits_and_leaves_with_6_when_strict(tmp_path):
    hard_braking().save(tmp_path / "s.json")
    said = run("replay", tmp_path / "s.json", "--limit", "min_ttc_s=3")
    assert said.code == 0
    assert "least time to collision 2.5" in said.out
    assert "(ego and wall at" in said.out
    assert "limit exceeded: agent 'ego': min_ttc_s" in said.out
    strict = run("replay", tmp_path / "s.json", "--limit", "min_ttc_s=3", "--strict")
    assert strict.code == 6
    assert "min_ttc_s" in strict.err
    assert run("replay", tmp_path / "s.json", "--limit", "min_ttc_s=0.1", "--strict").code == 0
    assert run("replay", tmp_path / "s.json", "--limit", "ttc=1").code == 2
    document = json.loads((tmp_path / "s.json").read_text())
    document["agents"][2]["waypoints"]["x_m"] = [40.0]
    write_json(tmp_path / "s.json", document)
    said = run("replay", tmp_path / "s.json")
    assert "1 collision, 0 of the replay and 1 of the scenario itself ·" in said.out
    assert "ego and wall collide at" in said.out
    assert ", in the scenario itself" in said.out
