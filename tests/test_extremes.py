"""The table of extremes, one test a row; `tools/stability.py` prints the same rows."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import stability
from extremes import CASES, Case, Outcome, outcome_of


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c.name, marks=[pytest.mark.slow] if c.run_by == "slow tests" else [])
        for c in CASES
        if c.run_by != "tool"
    ],
)
def test_extreme(case: Case) -> None:
    outcome = outcome_of(case)
    assert outcome.ok, f"{outcome.found}, error {outcome.error} {outcome.unit}; required: {case.required}"


def test_every_case_has_its_own_name_and_a_requirement() -> None:
    assert len({c.name for c in CASES}) == len(CASES) >= 50
    assert all(c.required and ":" in c.name for c in CASES)


def test_the_tool_prints_a_row_a_case_and_writes_them(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert stability.main(["--only", "horizon", "--json", str(tmp_path / "rows.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [x.split()[0] for x in lines[1:-1]] == ["ok", "ok"]
    assert lines[-1] == "2 cases, 0 not as required"
    assert [r["case"] for r in json.loads((tmp_path / "rows.json").read_text())] == [
        c.name for c in CASES if "horizon" in c.name
    ]


def test_the_tool_ends_with_1_when_an_outcome_is_not_as_required(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken() -> Outcome:
        raise ArithmeticError("no")

    cases = [Case("a: right", "r", lambda: Outcome(True, "f", 3.0, 0.5)), Case("a: wrong", "r", broken)]
    monkeypatch.setattr(stability, "CASES", cases)
    assert stability.main([]) == 1
    out = capsys.readouterr().out
    assert "MISS a: wrong" in out
    assert "raised ArithmeticError: no" in out
    assert "0.5 m" in out
    with pytest.raises(SystemExit):
        stability.main(["--only", "nothing like this"])
