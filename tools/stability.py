"""Print the table of extremes: case, outcome, condition number, error. Ends with 1 when an outcome is not the required one.

python tools/stability.py [--json FILE] [--only WORDS] [--quick]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from extremes import CASES, Case, Outcome, outcome_of


def main(arguments: list[str] | None = None) -> int:
    """Run the cases and print a row for each; 0 when all outcomes are the required ones, else 1."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    parser.add_argument("--only", default="", help="cases whose name holds these words")
    parser.add_argument("--quick", action="store_true", help="leave out cases that take 20 s each")
    options = parser.parse_args(arguments)
    chosen = [c for c in CASES if options.only in c.name and (c.run_by == "tests" or not options.quick)]
    if not chosen:
        parser.error(f"no case holds '{options.only}'")
    print(f"{'':5}{'case':58} {'condition':>9} {'error':>16}  outcome (required)")
    rows = []
    for case in chosen:
        start = time.perf_counter()
        outcome = outcome_of(case)
        rows.append({
            "case": case.name, "required": case.required, "ok": outcome.ok, "found": outcome.found,
            "condition": outcome.condition, "error": outcome.error, "unit": outcome.unit,
            "seconds": round(time.perf_counter() - start, 3),
        })  # fmt: skip
        print(line(case, outcome))
    missed = sum(not r["ok"] for r in rows)
    print(f"{len(rows)} cases, {missed} not as required")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 1 if missed else 0


def line(case: Case, outcome: Outcome) -> str:
    """A case as a line of the table."""
    condition = "" if outcome.condition is None else f"{outcome.condition:.3g}"
    error = "" if outcome.error is None else f"{outcome.error:.2g} {outcome.unit}"
    mark = "ok" if outcome.ok else "MISS"
    return f"{mark:5}{case.name:58} {condition:>9} {error:>16}  {outcome.found} ({case.required})"


if __name__ == "__main__":
    sys.exit(main())
