"""Print the table of extremes: case, outcome, condition number, error. Ends with 1 when an outcome is not the required one.

    python tools/stability.py [--only WORDS] [--quick]

--only runs the cases whose name holds these words, --quick leaves out those that take 20 s each.
"""

from __future__ import annotations

from entry import run
from extremes import CASES, outcome_of


def main(only: str = "", quick: bool = False) -> int:
    """Run the cases and print a row for each; 0 when all outcomes are the required ones, else 1."""
    missed, chosen = 0, [c for c in CASES if only in c.name and (c.run_by == "tests" or not quick)]
    print(f"{'':5}{'case':58} {'condition':>9} {'error':>16}  outcome (required)")
    for case in chosen:
        outcome = outcome_of(case)
        missed += not outcome.ok
        condition = "" if outcome.condition is None else f"{outcome.condition:.3g}"
        error = "" if outcome.error is None else f"{outcome.error:.2g} {outcome.unit}"
        mark = "ok" if outcome.ok else "MISS"
        print(f"{mark:5}{case.name:58} {condition:>9} {error:>16}  {outcome.found} ({case.required})")
    print(f"{len(chosen)} cases, {missed} not as required")
    return int(missed > 0 or not chosen)


if __name__ == "__main__":
    run(main, __doc__)
