"""Checks before anything is written: what stops an export, what is only remarked, and what is neither."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from export_paths import agent, bend, line, scenario

from log2sim.datatypes import Agent, Scenario
from log2sim.errors import MissingExtra, ScenarioError
from log2sim.export import checks
from log2sim.export.checks import export_notes, overlaps_at_entry, require_exportable, require_start_as_in_scenario
from log2sim.export.exporters import export, step_times

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
        (spoiled("sigma_xy_m", 4, np.inf), "agent 'bad': waypoints.sigma_xy_m is not finite at index 4"),
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


def test_an_agent_without_waypoints_and_a_scenario_without_agents_are_named() -> None:
    good = agent(line(), "empty")
    none = {key: values[:0] for key, values in vars(good.waypoints).items() if values is not None}
    empty = replace(good, waypoints=replace(good.waypoints, **none))
    with pytest.raises(ScenarioError, match="agent 'empty': has no waypoints"):
        require_exportable(scenario(agent(line()), empty, duration_s=1.0))
    with pytest.raises(ScenarioError, match="it has no agents"):
        require_exportable(scenario())


def test_all_that_is_wrong_is_said_at_once() -> None:
    with pytest.raises(ScenarioError) as raised:
        require_exportable(scenario(spoiled("x_m", 0, np.nan), agent(line(), "flat", size_m=(1.0, 1.0, 0.0))))
    assert str(raised.value).count("\n  agent '") == 2


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


def test_agents_in_one_another_when_the_later_one_appears_are_remarked() -> None:
    ego, late = agent(line()), agent(np.full((5, 2), [10.0, 0.5]), "late", yaw_rad=0.3, first_s=1.0)
    assert next(overlaps_at_entry([ego, late]))[:2] == (0, 1)
    (note,) = export_notes(scenario(late, ego))
    assert note.startswith("agents 'ego' and 'late' overlap by ")
    assert " at 1 s, " in note
    for apart in (
        replace(late, waypoints=replace(late.waypoints, t_s=late.waypoints.t_s + 1.0)),  # the ego has passed
        replace(late, waypoints=replace(late.waypoints, t_s=late.waypoints.t_s + 9.0)),  # the ego is gone
        replace(late, waypoints=replace(late.waypoints, z_m=late.waypoints.z_m + 5.0)),  # on a bridge
    ):
        assert export_notes(scenario(ego, apart)) == []


def test_overlaps_at_entry_agree_with_looking_at_every_pair() -> None:
    """Against counting the points of a fine grid that lie in both boxes."""
    from matplotlib.path import Path as Outline

    from log2sim.geometry import box_corners_bev

    rng = np.random.default_rng(2)
    agents = [
        agent(
            rng.uniform(0, 30, (1, 2)) + np.zeros((20, 2)), f"a{k}", yaw_rad=rng.uniform(-3, 3), first_s=0.2 * (k % 3)
        )
        for k in range(25)
    ]
    grid = np.stack(np.meshgrid(np.arange(-4, 34, 0.04), np.arange(-4, 34, 0.04)), axis=-1).reshape(-1, 2)
    corners = [
        box_corners_bev([a.waypoints.x_m[0], a.waypoints.y_m[0]], 4.6, 1.9, a.waypoints.yaw_rad[0])[0] for a in agents
    ]
    inside = [Outline(c).contains_points(grid) for c in corners]
    pairs = [
        (i, j)
        for i in range(25)
        for j in range(i)
        if (inside[i] & inside[j]).sum() > 0.02 * (inside[i] | inside[j]).sum()
    ]
    expected = {frozenset(pair) for pair in pairs}
    found = list(overlaps_at_entry(agents))
    assert {frozenset(pair[:2]) for pair in found} == expected
    assert len(found) == len(expected)
    assert len(expected) > 5
    assert all(agents[a].waypoints.t_s[0] <= agents[b].waypoints.t_s[0] for a, b, _ in found)


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


def stacked(count: int, later_s: float = 0.0) -> list[Agent]:
    """Agents in one place, each of which appears a little later than the one before."""
    base = agent(line())
    first = replace(base.waypoints, t_s=base.waypoints.t_s[:2], **{k: v[:2] for k, v in vars(base.waypoints).items() if v is not None and k != "t_s"})  # fmt: skip
    return [replace(base, id=f"a{k}", waypoints=replace(first, t_s=first.t_s + later_s * k)) for k in range(count)]


@pytest.mark.slow
@pytest.mark.parametrize("later_s", [0.0, 1e-5], ids=["at once", "one after the other"])
def test_many_agents_in_one_place_are_listed_up_to_a_limit(later_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """4.5 million pairs overlap; the areas of one batch of them are computed."""
    compared = []

    def counted(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        compared.append(len(a))
        return np.ones(len(a))

    monkeypatch.setattr(checks, "bev_iou", counted)
    notes = export_notes(scenario(*stacked(3000, later_s)))
    assert len(notes) == 101
    assert notes[-1] == "more than 100 pairs of agents overlap when one of them appears; only the first are listed"
    assert sum(compared) < 10_000


def test_what_an_export_leaves_in_place_is_not_compared_again(monkeypatch: pytest.MonkeyPatch) -> None:
    agents = stacked(3000)
    placed = np.array(
        [[a.waypoints.x_m[0], a.waypoints.y_m[0], a.waypoints.z_m[0], a.waypoints.yaw_rad[0]] for a in agents]
    )
    monkeypatch.setattr(checks, "bev_iou", lambda *_: pytest.fail("nothing was moved"))
    require_start_as_in_scenario(agents, placed + 1e-5)
    monkeypatch.undo()
    apart = [*agents[:50], replace(agent(line(start=(500.0, 0.0))), id="far")]
    there = np.vstack([placed[:50], [500.0, 0.0, 0.8, 0.0]])
    require_start_as_in_scenario(apart, there)
    there[-1] = placed[0]
    with pytest.raises(ScenarioError, match="agents 'a0' and 'far' would overlap at the start"):
        require_start_as_in_scenario(apart, there)


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


def test_the_samples_of_all_agents_together_are_limited() -> None:
    assert len(step_times(0.0, 9000.0, 0.1, agents=100)) == 90_001
    with pytest.raises(
        ScenarioError, match=r"^2000 agents over 9000 s: their samples take 16\.1 GiB, at most 1\.5 GiB"
    ):
        step_times(0.0, 9000.0, 0.1, agents=2000)
