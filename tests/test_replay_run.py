"""Replays as a library: modes, policies, files, degenerate scenarios, determinism."""

from __future__ import annotations

import json
from dataclasses import replace as changed

import numpy as np
import pytest
from replay_maneuvers import MANEUVERS, agent_from, driven, scenario_of

from log2sim.errors import ConfigError, ScenarioError
from log2sim.files.documents import check, write_json
from log2sim.simulation.policy import Controls, load_policy
from log2sim.simulation.result import Replay, to_scenario
from log2sim.simulation.runner import replay


def straight(id="a", y=0.0, speed=5.0, duration_s=3.0, **options):
    t = np.arange(round(duration_s * 10) + 1) * 0.1
    return agent_from(t, speed * t, np.full(len(t), y), 0 * t, np.full(len(t), speed), id=id, **options)


def test_exact_mode_goes_through_the_waypoints():
    agent = MANEUVERS["turn of radius 8 m"]()
    agent = changed(agent, waypoints=changed(agent.waypoints, t_s=agent.waypoints.t_s + 0.013))
    result = replay(scenario_of(agent), mode="exact")
    w, r = agent.waypoints, result.agents[0]
    assert (r.driver, r.model) == ("exact", "none")
    rows = np.isin(np.round(r.t_s, 6), np.round(w.t_s, 6))
    assert rows.sum() == len(w)
    for key in ("x_m", "y_m", "yaw_rad", "speed_mps"):
        np.testing.assert_allclose(getattr(r, key)[rows], getattr(w, key), atol=1e-6)
    between = ~rows
    angle = np.unwrap(w.yaw_rad)
    np.testing.assert_allclose(r.yaw_rad[between], np.interp(r.t_s[between], w.t_s, angle), atol=1e-5)
    assert result.metrics["followers"] == 0


@pytest.mark.slow
def test_the_same_scenario_gives_the_same_bytes():
    scene = scenario_of(*(changed(f(), id=name) for name, f in MANEUVERS.items()))
    one, two = (json.dumps(replay(scene, dt_s=0.05).to_dict()) for _ in range(2))
    assert one == two


def test_agents_do_not_influence_each_other_nor_does_their_order():
    agents = [changed(MANEUVERS[k](), id=k) for k in ("straight", "reversing", "slow start from rest")]
    together = replay(scenario_of(*agents), dt_s=0.02)
    backward = replay(scenario_of(*agents[::-1]), dt_s=0.02)
    for agent in agents:
        alone = replay(scenario_of(agent), dt_s=0.02).agents[0]
        for result in (together, backward):
            np.testing.assert_allclose(result.agent(agent.id).x_m, alone.x_m, atol=1e-6)
    with pytest.raises(KeyError):
        together.agent("nobody")


def test_a_replay_reads_back_as_it_was_written(tmp_path):
    result = replay(
        scenario_of(
            MANEUVERS["lane change"](),
            straight("b", y=9),
            agent_from([0.0], [5.0], [3.0], [1.0], [0.0], id="p", static=True),
        )
    )
    path = tmp_path / "replay.json"
    result.save(path)
    check(json.loads(path.read_text()), "replay-1", ScenarioError)
    back = Replay.load(path)
    assert back.to_dict() == result.to_dict()
    assert [a.driver for a in back.agents] == ["pid", "pid", "static"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.update(replay_version=2), "replay_version is 2"),
        (lambda d: d.pop("metrics"), "metrics"),
        (lambda d: d["agents"][0]["states"]["x_m"].pop(), "states.x_m has"),
        (lambda d: d["agents"][0].update(driver="ghost"), "driver"),
        (lambda d: d["agents"][0]["states"].update(y_m=["a"]), "y_m"),
    ],
)
def test_broken_replay_files_are_refused_by_field(tmp_path, change, said):
    document = replay(scenario_of(straight())).to_dict()
    change(document)
    path = tmp_path / "broken.json"
    write_json(path, document)
    with pytest.raises(ScenarioError, match=said) as caught:
        Replay.load(path)
    assert "broken.json" in str(caught.value)


def test_a_replay_becomes_a_scenario_again(tmp_path):
    scene = scenario_of(MANEUVERS["lane change"]())
    result = replay(scene)
    again = to_scenario(result, scene)
    again.save(tmp_path / "again.json")
    np.testing.assert_array_equal(again.agents[0].waypoints.x_m, result.agents[0].x_m)
    assert not again.agents[0].waypoints.observed.any()


@pytest.mark.parametrize(
    "options",
    [{"mode": "fast"}, {"model": "kinematics"}, {"dt_s": 0.0}, {"dt_s": 1.1}, {"dt_s": float("nan")}, {"ego": print}],
)
def test_arguments_out_of_range_are_refused(options):
    with pytest.raises(ConfigError):
        replay(scenario_of(straight()), **options)


@pytest.mark.parametrize(
    ("key", "values", "said"),
    [("x_m", np.nan, "x_m is not finite at index 2"), ("t_s", 0.05, "t_s does not increase at index 2")],
)
def test_scenarios_built_by_hand_are_checked(key, values, said):
    agent = straight()
    column = getattr(agent.waypoints, key).copy()
    column[2] = values
    with pytest.raises(ScenarioError, match=said):
        replay(scenario_of(changed(agent, waypoints=changed(agent.waypoints, **{key: column}))))


# Policies.


class Recorder:
    """A driver that holds its controls and keeps what it saw."""

    def __init__(self, controls):
        self.controls, self.seen = controls, []

    def __call__(self, observation):
        self.seen.append(observation)
        return self.controls


def test_a_policy_drives_the_ego_from_its_first_state():
    ego = straight("ego", speed=10.0, duration_s=4.0)
    driver = Recorder(Controls(-4.0, 0.0))
    result = replay(scenario_of(ego, straight("b", y=8)), ego=driver)
    r = result.agent("ego")
    assert r.driver == "policy"
    assert r.speed_mps[0] == pytest.approx(10.0)
    assert r.speed_mps[-1] == 0.0
    # 10 m/s stop within v^2 / 2a and what is driven while the pedal takes hold.
    assert 12.5 < r.x_m[-1] - r.x_m[0] < 12.5 + 10 * 0.15
    assert result.agent("b").driver == "pid"
    assert result.metrics["followers"] == 1
    assert "ego" in result.metrics["by_agent"]


def test_a_policy_that_holds_its_steering_drives_a_circle():
    driver = Recorder(Controls(0.0, 0.3))
    r = replay(scenario_of(straight("ego", speed=5.0, duration_s=6.0)), ego=driver, model="kinematic").agent("ego")
    ego = driver.seen[0].ego
    late = slice(40, None)  # the wheels have turned by then
    rear_x, rear_y = r.x_m - 1.3 * np.cos(r.yaw_rad), r.y_m - 1.3 * np.sin(r.yaw_rad)
    columns = np.stack([2 * rear_x[late], 2 * rear_y[late], np.ones(len(rear_x[late]))], axis=1)
    cx, cy, c = np.linalg.lstsq(columns, rear_x[late] ** 2 + rear_y[late] ** 2, rcond=None)[0]
    assert np.sqrt(c + cx**2 + cy**2) == pytest.approx(ego.wheelbase_m / np.tan(0.3), rel=1e-3)


def test_an_observation_shows_ego_others_and_the_route():
    driver = Recorder(Controls(0.0, 0.0))
    far = agent_from([0.0], [150.0], [0.0], [0.0], [0.0], id="far", static=True)
    near = agent_from(
        [0.0], [12.0], [4.0], [0.5], [0.0], id="near", category="truck", size_m=(7.0, 2.4, 3.0), static=True
    )
    late = straight("late", y=-3)
    late = changed(late, waypoints=changed(late.waypoints, t_s=late.waypoints.t_s + 1.0))
    replay(scenario_of(straight("ego"), far, near, late), ego=driver)
    first, later = driver.seen[0], driver.seen[150]
    assert (first.ego.x_m, first.ego.speed_mps, first.dt_s) == pytest.approx((0.0, 5.0, 0.01))
    assert list(first.others.id) == ["near"]
    assert (first.others.x_m[0], first.others.yaw_rad[0], first.others.length_m[0]) == (12.0, 0.5, 7.0)
    assert later.t_s == pytest.approx(1.5)
    assert list(later.others.id) == ["late", "near"]
    assert list(driver.seen[200].others.id) == ["near", "late"]
    assert later.others.speed_mps[0] == pytest.approx(5.0, abs=0.01)
    np.testing.assert_allclose(later.route.x_m, 5 * later.route.t_s, atol=1e-6)
    assert later.route.t_s[-1] == pytest.approx(3.0)


@pytest.mark.parametrize("answer", [None, (1.0, 0.0), Controls(np.nan, 0.0), Controls(0.0, np.inf)])
def test_answers_that_are_no_controls_are_refused(answer):
    with pytest.raises(ConfigError, match="policy at 0 s"):
        replay(scenario_of(straight("ego")), ego=Recorder(answer))


def test_a_policy_that_raises_is_named_with_the_time():
    def stumbles(seen):
        raise ZeroDivisionError("no lead vehicle")

    with pytest.raises(ConfigError, match="policy at 0 s: raised ZeroDivisionError: no lead vehicle"):
        replay(scenario_of(straight("ego")), ego=stumbles)


def test_policies_are_found_by_name(tmp_path, monkeypatch):
    (tmp_path / "my_driver_of_tests.py").write_text(
        "class Kind:\n    @staticmethod\n    def drive(seen):\n        return 1\nnumber = 3\n"
    )
    (tmp_path / "broken_driver_of_tests.py").write_text("raise OSError('no such wheel')\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert load_policy("my_driver_of_tests:Kind.drive")(None) == 1
    for name, said in (
        ("my_driver_of_tests", "expected module:attribute"),
        ("my_driver_of_tests:absent", "there is no 'absent' in 'my_driver_of_tests'"),
        ("my_driver_of_tests:number", "expected a callable"),
        ("broken_driver_of_tests:drive", "no such wheel"),
        ("no_module_of_tests:drive", "cannot be imported"),
    ):
        with pytest.raises(ConfigError, match=said):
            load_policy(name)


# Degenerate scenarios.


def test_a_scenario_without_agents_replays_to_nothing():
    result = replay(scenario_of())
    assert result.agents == ()
    assert result.metrics["collisions"] == []
    assert result.metrics["cross_track_rms_m"] == 0.0


def test_one_waypoint_is_one_state():
    result = replay(scenario_of(agent_from([1.0], [3.0], [4.0], [0.5], [2.0], id="seen once"), straight()))
    r = result.agent("seen once")
    assert r.driver == "exact"
    assert (r.t_s[0], r.x_m[0], r.y_m[0], r.yaw_rad[0], r.speed_mps[0]) == (1.0, 3.0, 4.0, 0.5, 2.0)
    assert len(r) == 1


def test_a_life_shorter_than_a_stored_step_still_has_a_state():
    brief = agent_from([1.011, 1.012], [3.0, 3.005], [4.0, 4.0], [0.0, 0.0], [5.0, 5.0], id="brief")
    r = replay(scenario_of(brief, straight())).agent("brief")
    assert len(r) == 1
    assert r.x_m[0] == pytest.approx(3.0, abs=0.01)


def test_static_agents_keep_their_pose_and_are_there_all_the_time():
    parked = agent_from([0.5], [10.0], [0.0], [0.2], [0.0], id="parked", static=True)
    result = replay(scenario_of(straight(duration_s=4.0), parked))
    r = result.agent("parked")
    assert set(r.x_m) == {10.0}
    assert (r.t_s[0], r.t_s[-1]) == (0.0, 4.0)
    (event,) = result.metrics["collisions"]  # the log drives through it
    assert event["in_log"]


def test_two_agents_in_one_place_are_told_apart_and_collide():
    result = replay(scenario_of(straight("a"), straight("b")))
    np.testing.assert_array_equal(result.agent("a").x_m, result.agent("b").x_m)
    (event,) = result.metrics["collisions"]
    assert (event["agents"], event["t_s"], event["until_s"], event["in_log"]) == (["a", "b"], 0.0, 3.0, True)


@pytest.mark.parametrize("gap_s", [1e-6, 1e-3, 30.0])
def test_waypoints_a_microsecond_or_half_a_minute_apart_are_followed(gap_s):
    t = np.array([0.0, 0.1, 0.2, 0.2 + gap_s, 0.3 + gap_s, 0.4 + gap_s])
    r = replay(scenario_of(agent_from(t, 4 * t, 0 * t, 0 * t, np.full(6, 4.0)))).agents[0]
    assert np.abs(r.x_m - 4 * r.t_s).max() < 0.05
    assert np.abs(r.y_m).max() < 1e-6


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(6))
def test_nonsense_gives_finite_states(seed):
    rng = np.random.default_rng(seed)
    n = 25
    t = np.cumsum(10 ** rng.uniform(-3, 0, n))
    agent = agent_from(
        t,
        rng.normal(0, 10.0 ** (seed - 1), n),
        rng.normal(0, 5, n),
        rng.uniform(-4, 4, n),
        rng.normal(0, 10, n),
        category=("car", "cyclist", "bus")[seed % 3],
    )
    r = replay(scenario_of(agent), dt_s=0.05).agents[0]
    for key in r.COLUMNS:
        assert np.all(np.isfinite(getattr(r, key)))
    assert np.abs(r.steer_rad).max() <= 0.86  # the widest lock


def test_hours_between_agents_are_refused_before_they_are_simulated():
    t = np.array([0.0, 1e9])
    with pytest.raises(ScenarioError, match="steps"):
        replay(scenario_of(agent_from(t, t, 0 * t, 0 * t, np.ones(2))), dt_s=0.01)


def test_many_agents_are_all_replayed():
    agents = [
        driven(lambda t: np.full_like(t, 8.0), np.zeros_like, 1.0, start=(0, 5.0 * k, 0), id=f"a{k}") for k in range(50)
    ]
    result = replay(scenario_of(*agents), dt_s=0.02)
    assert result.metrics["followers"] == 50
    assert result.metrics["cross_track_max_m"] < 1e-3
    assert result.metrics["collisions"] == []


def test_progress_is_told_to_the_end():
    told = []
    replay(scenario_of(straight(duration_s=25.0)), dt_s=0.05, progress=lambda done, steps: told.append((done, steps)))
    assert [d for d, _ in told] == sorted({d for d, _ in told})
    assert len(told) > 1
    assert told[-1] == (501, 501)
