"""Corrections of a person bring a scenario back to its truth, and `tools/learn_corrections.py` counts them as what they were."""

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
from log2sim.geometry import NS_PER_S, wrap_angle


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


def test_corrections_are_counted_and_confidence_is_compared_with_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import learn_corrections

    found = spoiled()

    def place(name: str) -> dict[str, float]:
        agent = found[name]
        t_s = float(np.mean(agent.waypoints.t_s[[0, -1]]))
        at = agent.at(t_s)
        return {"t_ns": found.t0_ns + round(t_s * NS_PER_S), "x_m": float(at.x_m[0]), "y_m": float(at.y_m[0])}

    made: list[dict[str, object]] = [
        {"kind": kind, "agent": place(name)} for kind, name in (("confirm", "a"), ("flip", "b"), ("delete", "ghost"))
    ]
    made += [
        {"kind": "size", "agent": place("a"), "size_m": list(truth()["a"].size_m)},
        {"kind": "merge", "agent": place("c-1"), "other": place("c-2")},
    ]
    after = correct(found, {"corrections": made})
    assert after.unmatched == ()
    before, corrected = (evaluate(s, truth()) for s in (found, after.scenario))
    assert before["correctness"]["wrong"]["agents"] == 4
    assert (corrected["correctness"]["wrong"]["share"], corrected["precision"], corrected["recall"]) == (0.0, 1.0, 1.0)
    found.save(tmp_path / "s.json")
    document = {"format": "log2sim-corrections", "version": 1, "corrections": made}
    (tmp_path / "s.corrections.json").write_text(json.dumps(document))
    learn_corrections.main([tmp_path / "s.json"])
    head, _, counts, *rest = capsys.readouterr().out.splitlines()
    kinds = dict(zip(head.split(" | ")[1:], counts.split(" | ")[1:]))
    counted = {"confirm": "1", "size": "1", "flip": "1", "delete": "1", "merge": "2"}
    assert {k.strip(" |"): n.strip(" |") for k, n in kinds.items()} == counted
    # Five agents, all of them wrong: confidences 0.3, 1, 1, 1 and 0.45.
    assert rest[-1] == f"expected calibration error of those judged: {(0.3 + 1 + 1 + 1 + 0.45) / 5:.3f}"
