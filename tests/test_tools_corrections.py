"""The tools about corrections: a person's corrections bring a scenario back to its truth, and are counted as what they were."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_edit import parked, scenario, straight

from log2sim.datatypes import Finding, Scenario
from log2sim.edit.corrections import correct
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.geometry import wrap_angle


@pytest.fixture(autouse=True)
def _tools_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[1] / "tools"))


def truth() -> Scenario:
    return scenario(straight("ego", speed_mps=5.0), straight("a", y_m=6.0), parked("b"), straight("c", y_m=-10.0))


def spoiled() -> Scenario:
    """A car that stands and is turned round, one that is too long and doubted, one in two parts, and one that is not there."""
    ego, a, b, c = truth().agents
    w = b.waypoints
    turned = replace(b, waypoints=replace(w, yaw_rad=wrap_angle(w.yaw_rad + np.pi)))
    long = replace(a, size_m=(12.0, *a.size_m[1:]), doubts=(Finding("heading_ambiguous"),), confidence=0.3)
    first = replace(c, id="c-1", waypoints=c.waypoints.take(c.waypoints.t_s <= 2.5))
    last = replace(
        c, id="c-2", waypoints=c.waypoints.take(c.waypoints.t_s > 1.5), doubts=(Finding("heading_ambiguous"),)
    )
    ghost = replace(b, id="ghost", waypoints=replace(w, y_m=w.y_m - 20.0), confidence=0.45)
    return scenario(ego, long, turned, first, last, ghost)


def test_a_person_who_sees_the_truth_makes_every_agent_right() -> None:
    from benchmarks.corrections import steps_of

    steps = steps_of(spoiled(), truth(), None, np.random.default_rng(0))
    made = [entry for own in steps for _, entry in own]
    assert sorted(entry["kind"] for entry in made) == ["confirm", "delete", "flip", "merge", "size"]
    after = correct(spoiled(), {"corrections": made})
    assert after.unmatched == ()
    before, found = (evaluate(s, truth()) for s in (spoiled(), after.scenario))
    assert before["correctness"]["wrong"]["agents"] == 4
    assert (found["correctness"]["wrong"]["share"], found["precision"], found["recall"]) == (0.0, 1.0, 1.0)


def test_corrections_are_counted_and_confidence_is_compared_with_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import learn_corrections
    from benchmarks.corrections import steps_of

    made = [entry for own in steps_of(spoiled(), truth(), None, np.random.default_rng(0)) for _, entry in own]
    spoiled().save(tmp_path / "s.json")
    document = {"format": "log2sim-corrections", "version": 1, "corrections": made}
    (tmp_path / "s.corrections.json").write_text(json.dumps(document))
    learn_corrections.main([tmp_path / "s.json"])
    head, _, counts, *rest = capsys.readouterr().out.splitlines()
    kinds = dict(zip(head.split(" | ")[1:], counts.split(" | ")[1:]))
    assert {k.strip(" |"): n.strip(" |") for k, n in kinds.items()} == {
        "confirm": "1",
        "size": "1",
        "flip": "1",
        "delete": "1",
        "merge": "2",
    }
    # Five agents, all of them wrong: confidences 0.3, 1, 1, 1 and 0.45.
    assert rest[-1] == f"expected calibration error of those judged: {(0.3 + 1 + 1 + 1 + 0.45) / 5:.3f}"
