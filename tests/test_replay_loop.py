"""The closed loop: worlds that are moved by steps, what a policy sees, how it is found, and the example egos."""

from __future__ import annotations

import math
import sys
from dataclasses import replace as changed
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from replay_maneuvers import MANEUVERS, scenario_of
from replay_scenes import LENGTH_M, Speed, gap, line, parked

from log2sim.errors import ConfigError
from log2sim.simulation.policy import Controls, load_policy
from log2sim.simulation.runner import open_world, replay

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "samples" / "crossing" / "truth.json"
EGOS = ROOT / "samples" / "egos.py"


# Stepping.


@pytest.mark.parametrize("controls", [Controls(math.nan, 0.0), Controls(0.0, math.inf)], ids=["pedal", "steering"])
def test_a_world_is_not_steered_by_what_is_no_number(controls):
    world = open_world(scenario_of(line("ego", 0, duration_s=1)))
    with pytest.raises(ValueError, match="expected finite numbers"):
        world.steer(controls)


# Observations.


def test_the_path_ahead_begins_beside_the_ego_however_late_it_is():
    # The log turns with 5 m/s; the ego goes slowly along the same straight beginning.
    turn = changed(MANEUVERS["turn of radius 8 m"](), id="ego")
    slow = Speed(lambda t: 1.0)
    seen = []
    replay(scenario_of(turn), ego=lambda s: (seen.append(s), slow(s))[1], dt_s=0.05)
    for s in seen[:150:10]:  # until the log turns off
        p = s.path
        assert np.hypot(p.x_m[0] - s.ego.x_m, p.y_m[0] - s.ego.y_m) < 0.05
        np.testing.assert_allclose(p.distance_m, np.arange(101.0))
        assert p.progress_m == pytest.approx(s.ego.x_m - 1.3, abs=0.05)
        spacing = np.hypot(np.diff(p.x_m), np.diff(p.y_m))
        np.testing.assert_allclose(spacing, 1.0, atol=0.02)
        logged = ~np.isnan(p.t_s)
        np.testing.assert_allclose(np.diff(p.t_s[logged]), 0.2, atol=0.02)  # a meter at 5 m/s
        assert np.abs(np.diff(np.unwrap(p.yaw_rad))).max() < 0.2
        assert p.yaw_rad[-1] == pytest.approx(p.yaw_rad[np.flatnonzero(logged)[-1] + 1])  # straight on
        np.testing.assert_allclose(p.speed_mps, 5.0, atol=0.01)


# Policies.


def test_a_policy_with_reset_is_told_the_scenario_before_each_replay():
    class Twice:
        scenarios: list = []  # noqa: RUF012

        def __call__(self, seen):
            return Controls(0.0, 0.0)

        def reset(self, scenario):
            if len(self.scenarios) == 2:
                raise RuntimeError("no map")
            self.scenarios.append(scenario.name)

    driver, scene = Twice(), scenario_of(line("ego", 0, duration_s=0.5))
    for _ in range(2):
        replay(scene, ego=driver, dt_s=0.05)
    assert driver.scenarios == ["maneuver", "maneuver"]
    with pytest.raises(ConfigError, match="reset raised RuntimeError: no map"):
        replay(scene, ego=driver)


def test_policies_are_found_in_files_and_classes_are_made(tmp_path):
    (tmp_path / "beside_of_tests.py").write_text("VALUE = 7\n")
    (tmp_path / "my driver.py").write_text(
        "from dataclasses import dataclass\nimport beside_of_tests\n"
        "@dataclass\nclass Drive:\n    gain: float = 2.0\n    def __call__(self, seen):\n"
        "        return beside_of_tests.VALUE * self.gain\n"
        "class Needs:\n    def __init__(self, wheel): ...\n"
    )
    before = list(sys.path)
    assert load_policy(f"{tmp_path}/my driver.py:Drive")(None) == 14.0
    assert sys.path == before
    for name, said in (
        (f"{tmp_path}/my driver.py:Needs", "cannot be made"),
        (f"{tmp_path}/absent.py:Drive", "cannot be imported: FileNotFoundError"),
        (f"{tmp_path}/my driver.py", "expected module:attribute"),
    ):
        with pytest.raises(ConfigError, match=said):
            load_policy(name)


# The example egos.


def test_the_ego_that_brakes_in_time_brakes_hard_and_stops_short_of_what_stands():
    scene = scenario_of(
        line("ego", 0, speed=12, duration_s=12), line("f", -25, speed=12, duration_s=12), parked("p", 80, 0)
    )
    driver = load_policy(f"{EGOS}:BrakeInTime")
    result = replay(scene, ego=driver, agents="reactive", dt_s=0.05)
    ego = result.agent("ego")
    assert result.metrics["collisions"] == []
    assert -8.5 < ego.accel_mps2.min() < -4.9
    assert ego.speed_mps[-1] == 0.0
    assert 0.5 < 80 - ego.x_m[-1] - LENGTH_M < 3.5
    braking = ego.accel_mps2 < -0.5
    assert 80 - ego.x_m[braking][0] - LENGTH_M < 35  # 18 m/s, for it is in a hurry, need 32 m at 5 m/s2
    assert ego.speed_mps.max() > 15
    assert gap(result, "f").min() > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["BrakeInTime", "ChangeLane"])
def test_the_example_egos_drive_the_sample(name, tmp_path):
    ran = run("replay", SAMPLE, "--ego", f"{EGOS}:{name}", "--agents", "reactive", "--dt", 0.05, "--strict",
              "--out", tmp_path / "r.json")  # fmt: skip
    assert ran.code == 0, ran.err
