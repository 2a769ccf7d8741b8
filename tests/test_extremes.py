"""The table of extremes, one test a row; `tools/stability.py` prints the same rows."""

from __future__ import annotations

import pytest
from extremes import CASES, Case, outcome_of

# The default suite runs every fourth.
BY_DEFAULT = [c for c in CASES if c.run_by == "tests"][::4]


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c.name, marks=[] if c in BY_DEFAULT else [pytest.mark.slow])
        for c in CASES
        if c.run_by != "tool"
    ],
)
def test_extreme(case: Case) -> None:
    outcome = outcome_of(case)
    assert outcome.ok, f"{outcome.found}, error {outcome.error} {outcome.unit}; required: {case.required}"
