"""Doubtful agents: who they are, and what edits, replays, exports and imports do with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from command_line import run
from export_worlds import straight, world

from log2sim.agents.moving import motion_doubts, sideways_doubts
from log2sim.cli.reconstruct import doubt_lines
from log2sim.datatypes import (
    CATEGORIES,
    KINDS,
    MAX_SPEED_MPS,
    Agent,
    Detections,
    Finding,
    Measurements,
    Scenario,
    Treatment,
    Waypoints,
)
from log2sim.edit.apply import edit
from log2sim.edit.edits import DropDoubtful, Lateral, Only, Shift, Speed
from log2sim.errors import ConfigError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.export.exporters import Options, export, filter_doubtful, formats
from log2sim.export.openscenario.read import load
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay

THROUGH = Finding("passes_through", text="passes through parked at 1.2 s", start_s=1.0, end_s=1.5)
NARROW = Finding("unlikely_size", text="2.8 m wide")


def doubted() -> Scenario:
    """An ego that is doubtful itself, an agent without a doubt, one with two and one of low confidence."""
    ego = replace(
        straight("ego"), doubts=(Finding("acceleration", text="brakes with 14 m/s2", start_s=0.0, end_s=0.2),)
    )
    phantom = replace(straight("phantom", start=(0.0, 20.0)), doubts=(THROUGH, NARROW), confidence=0.9)
    return world(ego, straight("sure", start=(0.0, 10.0)), phantom, unsure(0.499))


def unsure(confidence: float) -> Agent:
    return replace(straight("unsure", start=(0.0, 30.0)), confidence=confidence)


def ids(scenario: Scenario) -> list[str]:
    return [a.id for a in scenario.agents]


def test_doubtful_agents_are_left_out_but_for_the_ego() -> None:
    scenario = doubted()
    assert [a.id for a in scenario.doubtful] == ["ego", "phantom", "unsure"]
    assert ids(scenario.drop_doubtful()) == ["ego", "sure"]
    assert ids(world(unsure(0.5)).drop_doubtful()) == ["unsure"]


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
    late = replace(
        straight("late", t_s=np.array([2.0, 3.0])), doubts=(Finding("jump", text="jumps", start_s=2.5, end_s=3.0),)
    )
    (fast,) = edit(world(late), [Speed("late", 0.5)]).scenario.agents
    assert (fast.doubts[0].start_s, fast.doubts[0].end_s) == (3.0, 4.0)  # from its first waypoint on


@pytest.mark.parametrize("to", [f for f in formats() if f not in ("lanelet2", "mcap", "osi", "rerun")])
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
    odd = Finding("in_ego", text='within the ego, "50 %" of $it, ünter < & >', start_s=None, end_s=1.0)
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
    assert ids(filter_doubtful(scenario, "keep")) == ["ego", "sure"]
    assert ids(filter_doubtful(scenario, "all")) == ids(scenario)
    assert evaluate(scenario, scenario.active)["precision"] == 1.0
    assert evaluate(scenario, scenario.active)["quarantined"] == ["unsure"]


PASSES = Finding("passes_through", text="passes through car-22 at 1.2 s", start_s=1.0, end_s=1.4)


def agent(name: str, *doubts: Finding, confidence: float = 0.9) -> Agent:
    return replace(straight(name), doubts=doubts, confidence=confidence)


def test_the_agents_are_counted_and_named_with_their_reasons() -> None:
    scenario = world(agent("ego"), agent("car-19", confidence=0.2), agent("car-18", PASSES), agent("car-1"))
    (line,) = doubt_lines(scenario, ())
    assert line == "2 of 3 agents: car-18 (passes through car-22 at 1.2 s), car-19 (confidence 0.20)"


def test_doubts_name_the_option_that_corrects_a_sensor_until_it_is_used() -> None:
    scenario, values = world(agent("ego"), agent("car-1", confidence=0.2)), {"offset_s": 0.1, "offset_sigma_s": 0.01}
    late, corrected = (Finding("time_offset", "top", treatment, values=values) for treatment in ("kept", "corrected"))
    assert "--fix-time" in doubt_lines(scenario, [late])[-1]
    assert doubt_lines(scenario, [corrected]) == doubt_lines(scenario, ())
    assert doubt_lines(world(agent("ego"), agent("car-1")), [late]) == []


@pytest.mark.parametrize("kind", KINDS)
def test_the_sentence_of_every_kind_is_made_of_its_numbers(kind: str) -> None:
    words, values = KINDS[kind].words, dict.fromkeys(KINDS[kind].numbers, 2.0)
    found = [Finding(kind, "top", t, 1.0, 2.0, values, "left") for t in get_args(Treatment)]
    cases = [] if isinstance(words, str) else [case for case in words if case not in get_args(Treatment)]
    found = [f for f in found if isinstance(words, str) or f.treatment in words]
    found += [Finding(kind, "top", values=values, other="left", case=case) for case in cases]
    assert found
    for finding in found:
        assert len(finding.sentence) > 10
        assert str(finding) == f"top: {finding.to_dict()['message']}"
    with pytest.raises(ValueError, match="no such numbers"):
        Finding(kind, values={"nonsense": 1.0})


def moving(speed_mps: np.ndarray, sigma_mps: float | None = None, rate_hz: float = 10.0) -> Waypoints:
    n = len(speed_mps)
    t, zero = np.arange(n) / rate_hz, np.zeros(n)
    x = np.concatenate([[0.0], np.cumsum((speed_mps[1:] + speed_mps[:-1]) / 2 / rate_hz)])
    sigma = None if sigma_mps is None else zero + sigma_mps
    return Waypoints(t, x, zero, zero, zero, speed_mps, zero == 0, zero + 0.1, sigma_speed_mps=sigma)


@pytest.mark.parametrize("category", CATEGORIES)
def test_what_is_faster_than_its_category_is_doubted_while_it_is(category):
    limit = MAX_SPEED_MPS[category]
    assert motion_doubts(category, moving(np.full(20, 0.9 * limit))) == ()
    w = moving(np.where(np.arange(20) < 5, 1.2, 0.9) * limit)
    (doubt,) = motion_doubts(category, w)
    assert doubt.kind == "speed"
    assert doubt.holds(w.t_s).sum() == 5
    assert doubt.sentence == f"moves at {1.2 * limit:.0f} m/s from 0.0 to 0.4 s"
    assert motion_doubts(category, moving(w.speed_mps, sigma_mps=0.2 * limit)) == ()


@pytest.mark.parametrize("rate_hz", [2.0, 10.0, 20.0])
def test_reversing_out_of_a_driveway_is_driving_and_reversing_fast_or_far_is_not(rate_hz):
    def after(seconds: float, speed: float) -> Waypoints:
        t = np.arange(0, 30, 1 / rate_hz)
        return moving(np.where(t < seconds, -speed, 0.0), 0.1, rate_hz)

    assert motion_doubts("car", after(8.0, 2.0)) == ()
    (fast,) = motion_doubts("car", after(3.0, 7.4))
    assert (fast.kind, fast.start_s) == ("reversing", 0.0)
    assert fast.sentence.startswith("reverses at up to 7.4 m/s from 0.0 to ")
    assert fast.end_s == pytest.approx(3.0, abs=1.01 / rate_hz)
    (far,) = motion_doubts("cyclist", after(25.0, 2.0))
    assert far.kind == "reversing"
    assert motion_doubts("pedestrian", after(3.0, 4.0)) == ()


@pytest.mark.parametrize("length_m", [2.0, 6.0])
@pytest.mark.parametrize("turned_deg", [0.0, 20.0, 90.0, 160.0, 180.0])
def test_a_long_side_across_the_way_slides(length_m, turned_deg):
    """A side that may be the width of a vehicle says nothing."""
    t = np.arange(10) / 10
    found = Detections(np.zeros((10, 4)), np.ones(10), np.full(10, "truck"))
    m = replace(
        Measurements.unplaced(found, t_ns=0, camera="", sensor_m=np.zeros(3)),
        yaw_rad=np.full(10, 0.4 + np.deg2rad(turned_deg)),
        low_m=np.zeros((10, 2)),
        high_m=np.tile([length_m, 1.5], (10, 1)),
    )
    doubts = sideways_doubts(m, t, np.full(10, 0.4), np.full(10, 3.6))
    assert [doubt.kind for doubt in doubts] == (["sideways"] if length_m == 6.0 and turned_deg == 90.0 else [])
    assert sideways_doubts(m, t, np.full(10, 0.4), np.full(10, 0.5)) == ()


def test_the_command_replays_without_them(tmp_path: Path) -> None:
    doubted().save(tmp_path / "s.json")
    arguments = ("replay", tmp_path / "s.json", "--dt", "0.1", "--mode", "exact")
    ran = run(*arguments, "--confidence", "0.5", "--out", tmp_path / "r.json")
    assert ran.code == 0
    assert "1 of 3 agents left out: unsure (confidence 0.49)" in ran.out
    loaded = Replay.load(tmp_path / "r.json")
    assert [a.id for a in loaded.agents] == ["ego", "sure", "phantom"]
    assert loaded.left_out == {"unsure": "confidence 0.49"}
    both = run(*arguments, "--confidence", "0.5", "--drop-doubtful")
    assert "2 of 3 agents left out: unsure (confidence 0.49), phantom (passes through parked at 1.2 s" in both.out
    assert "left out" not in run(*arguments).out
    assert run(*arguments, "--confidence", "2").code == 2
