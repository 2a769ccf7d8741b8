"""The benchmark of followers: its rows are the replay's own figures, and an error beyond its limit is told."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from replay_maneuvers import MANEUVERS, scenario_of

from log2sim.simulation.runner import replay

pytestmark = pytest.mark.slow

TOOLS = Path(__file__).resolve().parents[1] / "tools"


@pytest.fixture(autouse=True)
def _tools_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))


def test_rows_are_those_of_the_replay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from benchmarks import replay as bench_replay

    scene = scenario_of(MANEUVERS["lane change"]())
    scene.save(tmp_path / "scene.json")
    out = tmp_path / "rows.json"
    options = ["--dt", "0.05", "0.1", "--agents", "2", "--models", "kinematic", "--out", str(out)]
    assert bench_replay.main([str(tmp_path / "scene.json"), *options]) == 0
    rows = json.loads(out.read_text())
    assert [row["dt_s"] for row in rows["tracking"]] == [0.05, 0.1]
    metrics = replay(scene, dt_s=0.1).metrics
    for key in bench_replay.LIMITS:
        assert rows["tracking"][1][key] == metrics[key]
        assert rows["tracking"][1]["worst"][key] == {"agent": "a", "value": metrics["by_agent"]["a"][key]}
    (speed,) = rows["speed"]
    assert (speed["agents"], speed["moved_by"]) == (2, ["kinematic"])
    assert speed["agent_steps_per_s"] == pytest.approx(2 / (speed["step_us"] * 1e-6))
    assert speed["times_real_time"] == pytest.approx(0.01 / (speed["step_us"] * 1e-6))
    printed = capsys.readouterr().out
    assert "| scene.json | 100 | 1 |" in printed
    assert "none" in printed
