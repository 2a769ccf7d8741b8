"""The closed loop: worlds that are moved by steps, what a policy sees, how it is found, and the example egos."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace as changed
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from replay_maneuvers import MANEUVERS, agent_from, scenario_of
from replay_scenes import LENGTH_M, Speed, gap, line, parked, walker

from log2sim.datatypes import Scenario, Trajectory
from log2sim.edit import Lateral, edit
from log2sim.errors import ConfigError
from log2sim.simulation.corridors import scenario_times_of_positions
from log2sim.simulation.policy import Controls, load_policy
from log2sim.simulation.rollout import rollout
from log2sim.simulation.runner import open_world, replay

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "samples" / "crossing" / "truth.json"
EGOS = ROOT / "samples" / "egos.py"


class Recorder:
    """A driver that holds its controls and keeps what it saw."""

    def __init__(self, controls=Controls(0.0, 0.0)):  # noqa: B008
        self.controls, self.seen = controls, []

    def __call__(self, seen):
        self.seen.append(seen)
        return self.controls


# Stepping.


@pytest.mark.slow
def test_a_world_that_is_stepped_by_hand_gives_the_tracks_of_a_replay():
    scene = scenario_of(line("ego", 30, speed=12, duration_s=12), line("f", 0, speed=12, duration_s=12))
    driver = Speed(lambda t: 12.0 if t < 2 else 5.0)
    world = open_world(scene, dt_s=0.05, agents="reactive")
    steps = [world.step]
    while not world.done:
        if world.ego_lives:
            world.steer(driver(world.observe()))
        world.advance()
        steps.append(world.step)
    assert steps == list(range(241))
    assert world.t_s == pytest.approx(12.0)
    result = replay(scene, ego=driver, agents="reactive", dt_s=0.05)
    for id, (stored, columns) in world.tracks().items():
        np.testing.assert_allclose(columns[0], result.agent(id).x_m, atol=1e-6)
        np.testing.assert_allclose(stored * 0.05, result.agent(id).t_s, atol=1e-9)
    with pytest.raises(ValueError, match="at its end"):
        world.advance()


@pytest.mark.slow
def test_a_world_that_is_restarted_repeats_itself():
    scene = scenario_of(line("ego", 25, speed=12, duration_s=11), line("f", 0, speed=12, duration_s=11))
    world = open_world(scene, dt_s=0.05, agents="reactive")
    driver = Speed(lambda t: 12.0 if t < 2 else 0.0)
    first = rollout(world, driver)
    world.restart()
    assert (world.step, world.tracks()["f"][0].tolist()) == (0, [0])
    second = rollout(world, driver)
    assert first["f"][1][3].min() == 0.0  # it had to stop
    for id in ("ego", "f"):
        np.testing.assert_array_equal(first[id][1], second[id][1])


@pytest.mark.parametrize("controls", [Controls(math.nan, 0.0), Controls(0.0, math.inf)], ids=["pedal", "steering"])
def test_a_world_is_not_steered_by_what_is_no_number(controls):
    world = open_world(scenario_of(line("ego", 0, duration_s=1)))
    with pytest.raises(ValueError, match="expected finite numbers"):
        world.steer(controls)


def test_a_world_without_a_driven_ego_has_nothing_to_observe_or_steer():
    world = open_world(scenario_of(line("ego", 0, duration_s=1)), drives_ego=False)
    assert not world.ego_lives
    for call in (world.observe, lambda: world.steer(Controls(0.0, 0.0))):
        with pytest.raises(ValueError, match="no policy"):
            call()


# Observations.


def test_an_observation_cannot_be_changed():
    driver = Recorder()
    replay(scenario_of(line("ego", 0, duration_s=0.2), parked("p", 20, 4)), ego=driver)
    seen = driver.seen[0]
    for group in (seen.others, seen.route, seen.path):
        for values in vars(group).values():
            if isinstance(values, np.ndarray):
                with pytest.raises(ValueError, match="read-only"):
                    values[0] = values[0]
    with pytest.raises(AttributeError):
        seen.t_s = 1.0


def test_the_velocity_of_others_is_their_speed_along_their_heading():
    north = line("n", 5, -20, 6, 2, np.pi / 2)
    driver = Recorder()
    replay(scenario_of(line("ego", 0, speed=5, duration_s=2), north, walker("w", 8, 8, 1.2, 2, np.pi)), ego=driver)
    others = driver.seen[100].others
    velocity = dict(zip(others.id, zip(others.velocity_x_mps, others.velocity_y_mps)))
    assert velocity["n"] == pytest.approx((0, 6), abs=0.02)
    assert velocity["w"] == pytest.approx((-1.2, 0), abs=0.02)
    assert len(others) == 2


def test_sight_is_from_center_to_center():
    scene = scenario_of(line("ego", 0, speed=0, duration_s=0.2), parked("near", 29.9, 0), parked("far", 30.1, 0))
    for sight_m, ids in ((30.0, ["near"]), (100.0, ["near", "far"]), (0.0, [])):
        driver = Recorder()
        replay(scene, ego=driver, sight_m=sight_m)
        assert list(driver.seen[0].others.id) == ids
    with pytest.raises(ConfigError, match="sight"):
        replay(scene, ego=Recorder(), sight_m=-1.0)


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


@pytest.mark.slow
def test_the_path_of_a_way_that_crosses_itself_does_not_jump_to_the_other_branch():
    t = np.arange(0, 24.01, 0.1)
    yaw = np.clip((t - 4) / 12, 0, 1) * 2.5 * np.pi  # straight, a loop and a quarter, straight
    x, y = (np.concatenate([[0.0], np.cumsum(0.5 * f(yaw[:-1]))]) for f in (np.cos, np.sin))
    loop = agent_from(t, x, y, yaw, np.full(len(t), 5.0), id="ego", offset_m=0.01)
    world = open_world(scenario_of(loop), dt_s=0.05)
    last = 0.0
    while not world.done:
        seen = world.observe()
        assert -0.5 < seen.path.progress_m - last < 1.0
        last = seen.path.progress_m
        # Driven as logged: the curvature of the loop at the log's speed.
        world.steer(Controls(5.0 - seen.ego.speed_mps, float(np.arctan(seen.ego.wheelbase_m * np.interp(seen.t_s, [4, 4.1, 15.9, 16], [0, 2.5 * np.pi / 60, 2.5 * np.pi / 60, 0])))))  # fmt: skip
        world.advance()
    assert last > 110


def uphill(agent, grade=0.1):
    """The agent on a road that rises along x."""
    return changed(agent, waypoints=changed(agent.waypoints, z_m=grade * agent.waypoints.x_m))


@pytest.mark.slow
def test_an_ego_that_falls_behind_its_log_has_the_height_of_its_place_and_is_hit_there():
    flat = [line("ego", 0, speed=10, duration_s=8), line("behind", -40, speed=10, duration_s=8)]
    slope = replay(scenario_of(*map(uphill, flat)), ego=Recorder(Controls(-4.0, 0.0)))
    ego = slope.agent("ego")
    assert ego.x_m[-1] < 20
    np.testing.assert_allclose(ego.z_m, 0.1 * ego.x_m, atol=1e-3)
    level = replay(scenario_of(*flat), ego=Recorder(Controls(-4.0, 0.0)))
    assert slope.metrics["collisions"] == level.metrics["collisions"]
    assert slope.metrics["new_collisions"] == 1


@pytest.mark.slow
def test_an_observation_tells_the_height_of_the_ego_and_of_others_also_of_late_ones():
    agents = [line("ego", 60, speed=10, duration_s=8), line("late", 30, speed=10, duration_s=8)]
    agents += [line("x", 50, 3.5, 10, 8), parked("p", 90, 5)]
    driver = Recorder(Controls(-4.0, 0.0))
    replay(scenario_of(*map(uphill, agents)), ego=driver, agents=["late"])
    for seen in driver.seen[::50]:
        assert seen.ego.z_m == pytest.approx(0.1 * seen.ego.x_m, abs=0.01)
        np.testing.assert_allclose(seen.others.z_m, 0.1 * seen.others.x_m, atol=0.03)
    late = seen.others.x_m[seen.others.id == "late"]
    assert late < 30 + 10 * seen.t_s - 10
    assert set(seen.others.height_m) == {seen.ego.height_m} == {1.5}


@pytest.mark.slow
def test_agents_brake_for_a_late_ego_on_a_slope_as_on_the_flat():
    flat = [line("ego", 60, speed=10, duration_s=12), line("late", 30, speed=10, duration_s=12)]
    on_flat, on_slope = (
        replay(scenario_of(*agents), ego=Recorder(Controls(-4.0, 0.0)), agents="reactive")
        for agents in (flat, map(uphill, flat))
    )
    assert on_slope.metrics["collisions"] == on_flat.metrics["collisions"] == []
    np.testing.assert_allclose(on_slope.agent("late").x_m, on_flat.agent("late").x_m, atol=1e-3)


def test_where_a_way_crosses_over_itself_the_height_is_that_of_the_own_level():
    t = np.arange(0, 24.01, 0.1)
    yaw = np.clip((t - 4) / 12, 0, 1) * 2.5 * np.pi  # a ramp that turns over the road it left
    x, y = (np.concatenate([[0.0], np.cumsum(0.5 * f(yaw[:-1]))]) for f in (np.cos, np.sin))
    loop = agent_from(t, x, y, yaw, np.full(len(t), 5.0), id="ego", offset_m=0.01)
    path = Trajectory.through(changed(loop, waypoints=changed(loop.waypoints, z_m=0.5 * t)).waypoints, 0.01)
    late = np.arange(0, 24, 0.05)
    found = scenario_times_of_positions(path, *path.at(late)[:2])
    np.testing.assert_allclose(found, late, atol=0.25)  # a meter of way


# Policies.


def test_a_policy_with_reset_is_told_the_scenario_before_each_replay():
    class Counter(Recorder):
        scenarios: list = []  # noqa: RUF012

        def reset(self, scenario):
            self.scenarios.append(scenario.name)

    driver, scene = Counter(), scenario_of(line("ego", 0, duration_s=0.5))
    for _ in range(2):
        replay(scene, ego=driver, dt_s=0.05)
    assert driver.scenarios == ["maneuver", "maneuver"]

    class Fails(Recorder):
        def reset(self, scenario):
            raise RuntimeError("no map")

    with pytest.raises(ConfigError, match="reset raised RuntimeError: no map"):
        replay(scene, ego=Fails())


@pytest.mark.parametrize("answer", ["left", Controls("1", 0.0), Controls(1.0, None), Controls(1e400, 0.0)])
def test_nonsense_is_refused_with_the_time(answer):
    def late(seen):
        return Controls(0.0, 0.0) if seen.t_s < 0.25 else answer

    with pytest.raises(ConfigError, match=r"policy at 0\.25 s: answered"):
        replay(scenario_of(line("ego", 0, duration_s=1)), ego=late, dt_s=0.05)


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


@pytest.mark.slow
def test_a_module_in_the_current_folder_is_found_from_a_plain_shell(tmp_path):
    (tmp_path / "my_driver.py").write_text(
        "from log2sim.simulation import Controls\ndef brake_late(seen):\n    return Controls(-5.0 * (seen.t_s > 1), 0.0)\n"
    )
    # As an installed script runs, which does not search the current folder by itself.
    code = "import sys; from log2sim.cli.entry import main; sys.path.remove(''); sys.argv[0] = 'log2sim'; main()"
    ran = subprocess.run(
        [sys.executable, "-c", code, "replay", str(SAMPLE), "--ego", "my_driver:brake_late", "--out", "r.json"],
        cwd=tmp_path, capture_output=True, text=True,
        env={"PYTHONPATH": str(ROOT), "PATH": "", "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    ego = next(a for a in json.loads((tmp_path / "r.json").read_text())["agents"] if a["id"] == "ego")
    assert ego["driver"] == "policy"
    assert ego["states"]["speed_mps"][-1] == 0.0


# The command line.


@pytest.mark.slow
def test_the_command_line_lets_agents_react(tmp_path):
    scene = scenario_of(*(line(k, -30.0 * n, duration_s=6) for n, k in enumerate(("ego", "f", "g"))))
    scene.save(tmp_path / "s.json")
    (tmp_path / "stop.py").write_text(
        "from log2sim.simulation import Controls\ndef drive(seen):\n    return Controls(-8.0, 0.0)\n"
    )

    def drivers(*options):
        ran = run("replay", tmp_path / "s.json", "--ego", f"{tmp_path}/stop.py:drive", "--dt", 0.05, *options,
                  "--out", tmp_path / "r.json", "--overwrite")  # fmt: skip
        assert ran.code == 0, ran.err
        return [a["driver"] for a in json.loads((tmp_path / "r.json").read_text())["agents"]]

    assert drivers() == ["policy", "pid", "pid"]
    assert drivers("--agents", "reactive") == ["policy", "reactive", "reactive"]
    assert drivers("--react", "f") == ["policy", "reactive", "pid"]
    assert run("validate", tmp_path / "r.json").code == 0
    for options, said in (
        (("--agents", "smart"), "expected scenario or reactive"),
        (("--react", "h"), "there is none of that id"),
        (("--react", "f", "--agents", "reactive"), "--react"),
    ):
        ran = run("replay", tmp_path / "s.json", *options)
        assert ran.code == 2
        assert said in ran.line


# The example egos.


def test_the_ego_that_brakes_in_time_brakes_hard_and_stops_short_of_what_stands():
    scene = scenario_of(
        line("ego", 0, speed=12, duration_s=12), line("f", -25, speed=12, duration_s=12), parked("p", 80, 0)
    )
    driver = load_policy(f"{EGOS}:BrakeInTime")
    result = replay(scene, ego=driver, agents="reactive", dt_s=0.02)
    ego = result.agent("ego")
    assert result.metrics["collisions"] == []
    assert -8.5 < ego.accel_mps2.min() < -4.9
    assert ego.speed_mps[-1] == 0.0
    assert 0.5 < 80 - ego.x_m[-1] - LENGTH_M < 3.5
    braking = ego.accel_mps2 < -0.5
    assert 80 - ego.x_m[braking][0] - LENGTH_M < 35  # 18 m/s, for it is in a hurry, need 32 m at 5 m/s2
    assert ego.speed_mps.max() > 15
    assert gap(result, "f").min() > 1.0


@pytest.mark.matrix
@pytest.mark.parametrize("speed", [8.0, 15.0, 25.0])
def test_the_ego_that_changes_lane_moves_by_a_lane_smoothly(speed):
    scene = scenario_of(line("ego", 0, speed=speed, duration_s=12))
    result = replay(scene, ego=load_policy(f"{EGOS}:ChangeLane"), dt_s=0.02)
    ego = result.agent("ego")
    assert ego.y_m[-1] == pytest.approx(3.5, abs=0.03)
    assert ego.y_m.max() < 3.62
    lateral = np.gradient(np.unwrap(ego.yaw_rad), ego.t_s) * ego.speed_mps
    assert np.abs(lateral).max() < 2.0
    # Least jerk: 5.77 d / T^2 sideways at most.
    assert np.abs(lateral).max() == pytest.approx(5.77 * 3.5 / 4.0**2, rel=0.25)
    changing = ego.t_s[(ego.y_m > 0.1) & (ego.y_m < 3.4)]
    assert np.ptp(changing) < 4.0
    assert np.abs(ego.yaw_rad[-20:]).max() < 0.005


@pytest.mark.slow
def test_the_ego_that_changes_lane_takes_the_free_side_or_stays():
    ego = line("ego", 0, speed=12, duration_s=10)
    left, right = line("l", 5, 3.5, 12, 10), line("r", -3, -3.5, 12, 10)
    for others, y in (([left], -3.5), ([right], 3.5), ([left, right], 0.0)):
        result = replay(scenario_of(ego, *others), ego=load_policy(f"{EGOS}:ChangeLane"), dt_s=0.05)
        assert result.agent("ego").y_m[-1] == pytest.approx(y, abs=0.05)
        assert result.metrics["collisions"] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["BrakeInTime", "ChangeLane"])
def test_the_example_egos_drive_the_sample(name, tmp_path):
    ran = run("replay", SAMPLE, "--ego", f"{EGOS}:{name}", "--agents", "reactive", "--dt", 0.05, "--strict",
              "--out", tmp_path / "r.json")  # fmt: skip
    assert ran.code == 0, ran.err


@pytest.mark.slow
def test_of_the_example_egos_one_brakes_too_late_and_one_in_time():
    blocked = edit(Scenario.load(SAMPLE), [Lateral("car_parked", 3.0)]).scenario
    late, in_time = (
        replay(blocked, ego=load_policy(f"{EGOS}:{name}"), dt_s=0.05) for name in ("BrakeLate", "BrakeInTime")
    )
    (hit,) = late.metrics["collisions"]
    assert hit["agents"] == ["ego", "car_parked"]
    assert hit["belongs_to"] == "replay"
    assert in_time.metrics["collisions"] == []
    assert in_time.agent("ego").speed_mps[-1] == 0.0  # it stands, and not because it never came near
    gap_m = 12.6 - 4.1 / 2 - (in_time.agent("ego").x_m[-1] + 4.6 / 2)
    assert 0.3 < gap_m < 2.5
