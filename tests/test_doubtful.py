"""Doubtful agents: who they are, and what edits, replays, exports and imports do with them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from export_worlds import straight, world

from log2sim.datatypes import Agent, Doubt, Scenario, list_doubtful, why_doubtful
from log2sim.edit.apply import edit
from log2sim.edit.edits import DropDoubtful, Lateral, Only, Shift, Speed
from log2sim.errors import ConfigError, ScenarioError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.export.exporters import Options, export, formats, with_doubtful
from log2sim.export.openscenario.read import load
from log2sim.simulation.metrics.all_metrics import summarize
from log2sim.simulation.result import Replay
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


def test_a_confidence_is_asked_for_by_its_value_alone() -> None:
    scenario = doubted()
    assert ids(scenario.trusted(0.499)) == ids(scenario)
    assert ids(scenario.trusted(0.5)) == ["ego", "sure", "phantom"]
    assert ids(replace(scenario, agents=(replace(scenario.agents[0], confidence=0.1),)).trusted(1.0)) == ["ego"]
    for wrong in (-0.1, 1.1, float("nan")):
        with pytest.raises(ConfigError, match="expected a number from 0 to 1"):
            scenario.trusted(wrong)


def test_why_an_agent_is_doubtful_is_said_in_words() -> None:
    _, sure, phantom, low = doubted().agents
    assert why_doubtful(sure) == ""
    assert why_doubtful(phantom) == "passes through parked at 1.2 s, 2.8 m wide"
    assert why_doubtful(low) == "confidence 0.49"  # not 0.50, which would be no reason
    assert list_doubtful([low] * 7).endswith("unsure (confidence 0.49) and 2 more")
    assert list_doubtful([low, phantom]).startswith("phantom (passes through parked at 1.2 s, 2.8 m wide), unsure")


def test_beside_another_scenario_doubts_have_its_time() -> None:
    scenario = doubted()
    aligned = scenario.aligned_to(replace(scenario, t0_ns=scenario.t0_ns - 2_000_000_000))
    first, second = aligned.agents[2].doubts
    assert (first.start_s, first.end_s) == (3.0, 3.5)
    assert second == NARROW


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


def test_a_reason_says_that_its_time_is_the_old_one() -> None:
    after = edit(doubted(), [Speed("phantom", 2.0), Shift("phantom", 1.0)]).scenario
    assert [d.reason for d in after.agents[2].doubts] == [
        "passes through parked at 1.2 s, before it was moved in time", "2.8 m wide",
    ]  # fmt: skip


def test_the_command_edits_without_them(tmp_path: Path) -> None:
    doubted().save(tmp_path / "s.json")
    ran = run("edit", tmp_path / "s.json", "--drop-doubtful", "--shift", "sure=1", "--out", tmp_path / "out.json")
    assert ran.code == 0
    assert "left out as doubtful: phantom (passes through parked at 1.2 s, 2.8 m wide), unsure (conf" in ran.out
    assert "out.json: 2 edits, 1 agent and the ego" in ran.out
    assert ids(Scenario.load(tmp_path / "out.json")) == ["ego", "sure"]
    again = run("edit", tmp_path / "out.json", "--drop-doubtful", "--out", tmp_path / "again.json")
    assert "left out as doubtful: none" in again.out


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


def test_a_replay_file_without_the_field_reads_as_nobody_left_out() -> None:
    document = replay(doubted(), mode="exact", dt_s=0.1).to_dict()
    assert document.pop("left_out") == {}
    read = Replay.from_dict(document)
    assert read.left_out == {}
    assert "left out" not in summarize(read)


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


def test_another_choice_is_refused() -> None:
    with pytest.raises(ConfigError, match="--doubtful: 'maybe', expected keep, drop, all"):
        with_doubtful(doubted(), "maybe")


def test_the_table_has_sigmas_and_doubts_at_their_times(tmp_path: Path) -> None:
    scenario = doubted()
    phantom = scenario.agents[2]
    w = replace(phantom.waypoints, sigma_speed_mps=np.linspace(0.1, 0.7, len(phantom.waypoints)))
    agents = (*scenario.agents[:2], replace(phantom, waypoints=w))
    (file,) = export(replace(scenario, agents=agents), "csv", tmp_path)
    with file.open(newline="", encoding="utf-8") as opened:
        rows = [row for row in csv.DictReader(opened) if row["id"] in ("sure", "phantom")]
    sure, own = ([row for row in rows if row["id"] == name] for name in ("sure", "phantom"))
    np.testing.assert_array_equal([float(row["sigma_speed_mps"]) for row in own], w.sigma_speed_mps)
    assert {(row["sigma_yaw_rad"], row["sigma_speed_mps"], row["doubts"]) for row in sure} == {("", "", "")}
    flags = ["passes_through unlikely_size" if 1.0 <= t <= 1.5 else "unlikely_size" for t in w.t_s]
    assert [row["doubts"] for row in own] == flags
    assert len(set(flags)) == 2


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


@pytest.mark.parametrize("spoiled", ["nonsense", "{}", "[{}]"])
def test_spoiled_doubts_in_openscenario_are_refused(spoiled: str, tmp_path: Path) -> None:
    export(doubted(), "openscenario", tmp_path)
    file = tmp_path / "scenario.xosc"
    text = file.read_text(encoding="utf-8")
    begin = text.index('value="', text.index("log2sim.doubts")) + len('value="')
    file.write_text(text[:begin] + spoiled + text[text.index('"', begin) :], encoding="utf-8")
    with pytest.raises(ScenarioError, match="doubts"):
        load(file)


def test_viewers_say_why_agents_are_doubtful(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    (file,) = export(doubted(), "mcap", tmp_path)
    with file.open("rb") as opened:
        about = next(iter(reader.make_reader(opened).iter_metadata())).metadata
    assert json.loads(about["doubtful"])["unsure"] == "confidence 0.49"
    with file.open("rb") as opened:
        read = reader.make_reader(opened, decoder_factories=[decoder.DecoderFactory()])
        _, _, _, update = next(iter(read.iter_decoded_messages(topics=["/agents"])))
    told = {entity.id: {pair.key: pair.value for pair in entity.metadata}.get("doubtful") for entity in update.entities}
    assert told["phantom"] == "passes through parked at 1.2 s, 2.8 m wide"
    assert told["sure"] is None


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
