"""Replays as a library: modes, policies, files, degenerate scenarios, determinism."""

from __future__ import annotations

import json
from dataclasses import replace as changed

import numpy as np
import pytest
from replay_maneuvers import MANEUVERS, agent_from, scenario_of
from replay_scenes import line

from log2sim.errors import ScenarioError
from log2sim.files.documents import check, write_json
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay


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
            line("b", 0.0, 9.0, speed=5.0, duration_s=3.0),
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
    ],
)
def test_broken_replay_files_are_refused_by_field(tmp_path, change, said):
    document = replay(scenario_of(line("a", 0.0, speed=5.0, duration_s=3.0))).to_dict()
    change(document)
    path = tmp_path / "broken.json"
    write_json(path, document)
    with pytest.raises(ScenarioError, match=said) as caught:
        Replay.load(path)
    assert "broken.json" in str(caught.value)


# Degenerate scenarios.


def test_one_waypoint_is_one_state():
    result = replay(
        scenario_of(
            agent_from([1.0], [3.0], [4.0], [0.5], [2.0], id="seen once"), line("a", 0.0, speed=5.0, duration_s=3.0)
        )
    )
    r = result.agent("seen once")
    assert r.driver == "exact"
    assert (r.t_s[0], r.x_m[0], r.y_m[0], r.yaw_rad[0], r.speed_mps[0]) == (1.0, 3.0, 4.0, 0.5, 2.0)
    assert len(r) == 1


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
