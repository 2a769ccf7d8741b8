"""Checks before anything is written: what stops an export, what is only remarked, and what is neither."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from export_paths import agent, bend, line, scenario

from log2sim.datatypes import Agent, Scenario
from log2sim.errors import MissingExtra, ScenarioError
from log2sim.export.checks import export_notes, require_exportable, require_start_as_in_scenario
from log2sim.export.exporters import export

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"


def spoiled(key: str, index: int, value: float) -> Agent:
    """The agent "bad", one number of whose waypoints is another."""
    good = agent(line(), "bad")
    column = getattr(good.waypoints, key).copy()
    column[index] = value
    return replace(good, waypoints=replace(good.waypoints, **{key: column}))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (spoiled("t_s", 4, 0.3), r"agent 'bad': waypoints\.t_s does not increase at index 4 \(0\.3 s\)"),
        (spoiled("x_m", 4, np.nan), "agent 'bad': waypoints.x_m is not finite at index 4"),
        (agent(line(), "bad", size_m=(4.0, 0.0, 1.5)), r"agent 'bad': size \(4\.0, 0\.0, 1\.5\) m, expected positive"),
        (agent(line(), "bad", size_m=(4.0, np.nan, 1.5)), "agent 'bad': size"),
        (agent(line(), "bad", yaw_rad=np.pi, speed_mps=np.full(31, 10.0)), "agent 'bad': goes backward on 30"),
        (agent(line(), "bad", yaw_rad=0.0, speed_mps=np.full(31, -10.0)), "agent 'bad': goes backward on 30"),
        (agent(line(), "ego"), "agent 'ego': the id occurs twice"),
        (agent(line(start=(0.0, 4e5)), "bad"), "agent 'bad': is 200 km from the middle of the scenario, expected at most 66 km"),
    ],
)  # fmt: skip
def test_what_no_player_can_use_stops_the_export_and_names_the_agent(bad: Agent, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        require_exportable(scenario(agent(line()), bad))


@pytest.mark.parametrize(
    "fine",
    [
        agent(line(), yaw_rad=np.pi),  # reverses and says so
        agent(bend(), yaw_rad=np.linspace(0, np.pi / 2, 60) + 1.5),  # nearly sideways, as pedestrians are labeled
        agent(np.random.default_rng(0).normal(0, 0.02, (200, 2)), yaw_rad=0.0, speed_mps=np.full(200, 0.1)),  # trembles
        agent(np.concatenate([line(20.0, 21), line(5.0, 11, np.pi, (20.0, 0.0))[1:]]), yaw_rad=0.0, speed_mps=np.full(31, 5.0)),
        agent([[0.0, 0.0]], yaw_rad=0.0),
        agent(line(start=(1e7, -1e7))),
    ],
)  # fmt: skip
def test_what_logs_hold_is_no_error(fine: Agent) -> None:
    require_exportable(scenario(fine))


def test_the_sample_has_nothing_to_remark() -> None:
    world = Scenario.load(SAMPLE)
    require_exportable(world)
    assert export_notes(world) == []


def test_a_start_that_puts_agents_into_one_another_is_refused_unless_the_log_did() -> None:
    agents = [agent(line()), agent(line(start=(0.0, 5.0)), "beside")]
    apart = np.array([[0.0, 0.0, 0.8, 0.0], [0.0, 5.0, 0.8, 0.0]])
    require_start_as_in_scenario(agents, apart)
    together = apart * [1, 0.1, 1, 1]
    with pytest.raises(ScenarioError, match="agents 'ego' and 'beside' would overlap at the start"):
        require_start_as_in_scenario(agents, together)
    require_start_as_in_scenario(agents, together * [[1, 1, 1, 1], [np.nan, 1, 1, 1]])
    require_start_as_in_scenario([agent(line()), agent(line(start=(0.0, 0.5)), "beside")], together)


def test_one_waypoint_far_in_the_future_is_refused_before_samples_are_made(tmp_path: Path) -> None:
    import tracemalloc

    ego, late = agent(line()), agent(line(start=(0.0, 8.0)), "late")
    t_s = late.waypoints.t_s.copy()
    t_s[-1] = 1e6
    long = scenario(ego, replace(late, waypoints=replace(late.waypoints, t_s=t_s)), duration_s=1e6)
    for name in ("carla", "scenarionet", "commonroad", "osi"):
        tracemalloc.start()
        try:
            export(long, name, tmp_path / name)
        except (ScenarioError, MissingExtra) as problem:
            assert_one_line_about_length(problem)
        else:
            assert name == "scenarionet", "only that one ends with the ego"
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
        tracemalloc.stop()


def assert_one_line_about_length(problem: Exception) -> None:
    assert "\n" not in str(problem)
    assert isinstance(problem, MissingExtra) or "cut the scenario into parts" in str(problem)
