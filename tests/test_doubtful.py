"""Doubtful agents: who they are, and what edits, replays, exports and imports do with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from export_worlds import straight, world

from log2sim.datatypes import Agent, Doubt, Scenario
from log2sim.edit.apply import edit
from log2sim.edit.edits import DropDoubtful, Lateral, Only, Shift, Speed
from log2sim.errors import ConfigError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.export.exporters import Options, export, formats, with_doubtful
from log2sim.export.openscenario.read import load
from log2sim.simulation.runner import replay

THROUGH = Doubt("passes_through", "passes through parked at 1.2 s", 1.0, 1.5)
NARROW = Doubt("unlikely_size", "2.8 m wide")


def doubted() -> Scenario:
    """An ego that is doubtful itself, an agent without a doubt, one with two and one of low confidence."""
    ego = replace(straight("ego"), doubts=(Doubt("acceleration", "brakes with 14 m/s2", 0.0, 0.2),))
    phantom = replace(straight("phantom", start=(0.0, 20.0)), doubts=(THROUGH, NARROW), confidence=0.9)
    return world(ego, straight("sure", start=(0.0, 10.0)), phantom, unsure(0.499))


def unsure(confidence: float) -> Agent:
    return replace(straight("unsure", start=(0.0, 30.0)), confidence=confidence)


def ids(scenario: Scenario) -> list[str]:
    return [a.id for a in scenario.agents]


def test_doubtful_agents_are_left_out_but_for_the_ego() -> None:
    scenario = doubted()
    assert [a.id for a in scenario.doubtful] == ["ego", "phantom", "unsure"]
    assert ids(scenario.without_doubtful()) == ["ego", "sure"]
    assert ids(world(unsure(0.5)).without_doubtful()) == ["unsure"]


def test_dropping_is_an_edit_that_the_history_keeps() -> None:
    scenario = doubted()
    after = edit(scenario, [Only(("ego", "phantom", "sure")), DropDoubtful(), Shift("sure", 1.0)]).scenario
    assert ids(after) == ["ego", "sure"]
    (entry,) = after.provenance["edits"]
    assert [e["kind"] for e in entry["edits"]] == ["only", "drop_doubtful", "shift"]
    assert entry["source_digest"] == scenario.digest
    assert Scenario.from_dict(after.to_dict()).provenance == after.provenance
    with pytest.raises(ConfigError, match="shift: agent 'phantom' is left out by another edit"):
        edit(scenario, [DropDoubtful(), Shift("phantom", 1.0)])
    with pytest.raises(ConfigError, match="leaves out every agent"):
        edit(world(unsure(0.2)), [DropDoubtful()])


def test_doubts_move_in_time_with_their_agent() -> None:
    scenario = doubted()

    def spans(*edits: Shift | Speed | Lateral) -> list[tuple[float | None, float | None]]:
        phantom = next(a for a in edit(scenario, edits).scenario.agents if a.id == "phantom")
        return [(d.start_s, d.end_s) for d in phantom.doubts]

    assert spans(Shift("phantom", 2.0)) == [(3.0, 3.5), (None, None)]
    assert spans(Shift("phantom", -1.25)) == [(0.0, 0.25), (None, None)]
    assert spans(Shift("phantom", -1.75)) == [(None, None)]  # nothing is left of the time when it passed through
    assert spans(Speed("phantom", 2.0)) == [(0.5, 0.75), (None, None)]
    assert spans(Lateral("phantom", 1.0)) == [(1.0, 1.5), (None, None)]
    late = replace(straight("late", t_s=np.array([2.0, 3.0])), doubts=(Doubt("jump", "jumps", 2.5, 3.0),))
    (fast,) = edit(world(late), [Speed("late", 0.5)]).scenario.agents
    assert (fast.doubts[0].start_s, fast.doubts[0].end_s) == (3.0, 4.0)  # from its first waypoint on


@pytest.mark.parametrize("to", [f for f in formats() if f not in ("mcap", "osi", "rerun")])
def test_an_export_keeps_or_drops_them_and_says_how_many(to: str, tmp_path: Path) -> None:
    doubted().save(tmp_path / "s.json")

    def text(name: str, *options: str) -> tuple[str, str]:
        ran = run("export", tmp_path / "s.json", "--to", to, "--out", tmp_path / name, *options)
        assert ran.code == 0, ran.err
        return ran.out, "".join(f.read_bytes().decode(errors="ignore") for f in (tmp_path / name).iterdir())

    said, kept = text("kept")
    assert "note: 2 of 3 agents are doubtful: phantom (passes" in said
    assert "phantom" in kept
    said, dropped = text("dropped", "--doubtful", "drop")
    assert "note: 2 of 3 agents left out as doubtful: phantom (passes through parked at 1.2 s, 2.8 m wide), uns" in said
    assert "; the ego is doubtful: brakes with 14 m/s2" in said
    assert "phantom" not in dropped
    assert "sure" in dropped


@pytest.mark.parametrize("revision", ["1.0", "1.2"])
def test_openscenario_brings_them_back(revision: str, tmp_path: Path) -> None:
    scenario = doubted()
    phantom = scenario.agents[2]
    w = phantom.waypoints
    odd = Doubt("in_ego", 'within the ego, "50 %" of $it, ünter < & >', None, 1.0)
    w = replace(w, sigma_yaw_rad=np.linspace(0, 0.3, len(w)), sigma_speed_mps=np.full(len(w), 0.25))
    before = replace(phantom, waypoints=w, doubts=(*phantom.doubts, odd))
    export(world(straight("ego"), before), "openscenario", tmp_path, Options(revision=revision))
    ego, after = load(tmp_path / "scenario.xosc").agents
    assert after.doubts == before.doubts
    assert (after.confidence, ego.doubts) == (before.confidence, ())
    np.testing.assert_allclose(after.waypoints.sigma_yaw_rad, w.sigma_yaw_rad, atol=1e-4)
    np.testing.assert_allclose(after.waypoints.sigma_speed_mps, w.sigma_speed_mps, atol=1e-4)
    assert ego.waypoints.sigma_yaw_rad is None


def test_quarantined_agents_stay_in_the_file_and_out_of_replays_and_exports(tmp_path: Path) -> None:
    scenario = world(straight("ego"), straight("sure", start=(0.0, 10.0)), replace(unsure(0.1), quarantined=True))
    assert ids(Scenario.from_dict(scenario.to_dict())) == ["ego", "sure", "unsure"]
    assert [a.quarantined for a in Scenario.from_dict(scenario.to_dict()).agents] == [False, False, True]
    assert ids(scenario.active) == ["ego", "sure"]
    result = replay(scenario, mode="exact")
    assert [a.id for a in result.agents] == ["ego", "sure"]
    assert set(result.left_out) == {"unsure"}
    assert len(replay(scenario, mode="exact", quarantined=True).agents) == 3
    for name, choices in (("a", {}), ("b", {"quarantined": True})):
        export(scenario, "csv", tmp_path / name, **choices)
        rows = next((tmp_path / name).glob("*.csv")).read_text()
        assert ("unsure" in rows) is bool(choices)
    assert ids(with_doubtful(scenario, "keep")) == ["ego", "sure"]
    assert ids(with_doubtful(scenario, "all")) == ids(scenario)
    assert evaluate(scenario, scenario.active)["precision"] == 1.0
    assert evaluate(scenario, scenario.active)["quarantined"] == ["unsure"]
