"""The table of extremes: named cases with the outcome that each must have. `stability.py` runs all of them, tests those that are theirs.

A case says what it found and whether that is what is required; it never raises for a wrong outcome.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

RunBy = Literal["tests", "slow tests", "tool"]
FAR_M = np.array([691_000.0, 5_334_000.0])


@dataclass(frozen=True)
class Outcome:
    """What a case found: whether it is as required, in words, and the condition number and error where there are any."""

    ok: bool
    found: str
    condition: float | None = None
    error: float | None = None
    unit: str = "m"


@dataclass(frozen=True)
class Case:
    """A named extreme, what is required of it, how to run it, and by what: of the cases that take long, tests run some."""

    name: str
    required: str
    run: Callable[[], Outcome]
    run_by: RunBy = "tests"


CASES: list[Case] = []


def outcome_of(case: Case) -> Outcome:
    """Run a case; an exception that it does not expect is an outcome too, and never the required one."""
    try:
        return case.run()
    except Exception as error:
        return Outcome(False, f"raised {type(error).__name__}: {error}")


def case(
    name: str, required: str, *, run_by: RunBy = "tests"
) -> Callable[[Callable[[], Outcome]], Callable[[], Outcome]]:
    """Put a function into the table."""

    def add(run: Callable[[], Outcome]) -> Callable[[], Outcome]:
        CASES.append(Case(name, required, run, run_by))
        return run

    return add
