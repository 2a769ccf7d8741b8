"""The gymnasium environment."""

from __future__ import annotations

import builtins
import sys
from pathlib import Path

import numpy as np
import pytest
from replay_maneuvers import scenario_of
from replay_scenes import line, parked

from log2sim.errors import MissingExtra

gymnasium = pytest.importorskip("gymnasium")
SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"


def made(scene, **options):
    from log2sim.simulation.env import ScenarioEnv

    return ScenarioEnv(scene, **options)


def test_it_passes_gymnasiums_own_checker_without_a_warning():
    from gymnasium.utils.env_checker import check_env

    import log2sim.simulation.env

    env = gymnasium.make(log2sim.simulation.env.ID, scenario=SAMPLE, render_mode="rgb_array")
    check_env(env.unwrapped)


def test_the_ego_drives_along_its_path_to_the_end_and_is_paid_by_the_meter():
    env = made(scenario_of(line("ego", 0, speed=10, duration_s=6), parked("p", 20, 6)))
    seen, info = env.reset(seed=1)
    assert info["t_s"] == 0.0
    np.testing.assert_allclose(seen["ego"], [10, 0, 0, 0, 0], atol=1e-5)
    np.testing.assert_allclose(seen["path"], [[5 * k, 0, 10] for k in range(1, 11)], atol=1e-4)
    np.testing.assert_allclose(seen["others"][0], [20, 6, 0, 0, 0, 4.4, 1.8], atol=1e-5)
    assert seen["others_mask"].tolist() == [1] + 15 * [0]
    total, ended, cut = 0.0, False, False
    while not (ended or cut):
        seen, reward, ended, cut, info = env.step(np.array([0.1, 0.0], np.float32))
        total += reward
        assert reward == pytest.approx(sum(info["reward"].values()))
        assert env.observation_space.contains(seen)
    assert (ended, cut, info["collision"]) == (True, False, False)
    assert total == pytest.approx(60, abs=2.0)
    assert info["t_s"] < 6.0  # it accelerated


def test_a_collision_ends_the_episode_and_costs():
    env = made(scenario_of(line("ego", 0, speed=10, duration_s=6), parked("p", 20, 1)))
    env.reset()
    for _ in range(40):
        _, reward, ended, cut, info = env.step([0.0, 0.0])
        if ended or cut:
            break
    assert (ended, cut, info["collision"]) == (True, False, True)
    assert reward < -90
    assert info["t_s"] == pytest.approx((20 - 4.4) / 10, abs=0.1)


def test_episodes_repeat_and_actions_are_shares_of_what_the_vehicle_can_do():
    scene = scenario_of(line("ego", 0, speed=10, duration_s=6), line("f", -20, speed=10, duration_s=6))
    env = made(scene, agents="reactive")
    runs = []
    for _ in range(2):
        env.reset(seed=3)
        runs.append([env.step([-1.0, 0.2])[0] for _ in range(15)])
    for a, b in zip(*runs):
        assert all(np.array_equal(a[k], b[k]) for k in a)
    brake, _ = env.accel_limits_mps2
    assert runs[0][5]["ego"][1] == pytest.approx(-brake, rel=0.05)
    assert runs[0][8]["ego"][2] == pytest.approx(0.2 * env.max_steer_rad, rel=0.05)
    assert env.world.traffic.rate[1] < 1  # the follower brakes too


def test_without_gymnasium_the_extra_is_named(monkeypatch):
    real = builtins.__import__

    def missing(name, *rest):
        if name.split(".")[0] == "gymnasium":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.delitem(sys.modules, "log2sim.simulation.env", raising=False)
    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(MissingExtra, match="needs the extra 'gym'"):
        import log2sim.simulation.env  # noqa: F401
