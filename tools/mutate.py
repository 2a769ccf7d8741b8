"""Damage every kind of log, scenario and OpenSCENARIO file, run the commands on it, and print what came of it.

    python tools/mutate.py [--seed N] [--count N] [--start N] [--only KIND]
    python tools/mutate.py --seed N --start INDEX --count 1 --keep      # one input again, whose folder is kept

Exit code 1 when an input crashed, hung, took more than 2 GiB, made a command read or write outside of it, or changed a result
without a word though the damage can be seen.
"""

from __future__ import annotations

import itertools
import shutil
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.table import markdown
from entry import run
from mutation.bases import KINDS
from mutation.harness import BAD, GOOD, Harness, Row, kind_of


def main(seed: int = 0, count: int = 100, start: int = 0, only: list[str] = [], keep: bool = False) -> int:
    """Run the command; 1 when anything is as it must not be."""
    if unknown := set(only) - set(KINDS):
        raise SystemExit(f"--only {', '.join(sorted(unknown))}: expected some of {', '.join(KINDS)}")
    folder = Path(tempfile.mkdtemp(prefix="mutate-")).resolve()  # not a link
    wanted = (k for k in itertools.count(start) if not only or kind_of(k) in only)
    numbers, rows = list(itertools.islice(wanted, count)), []
    harness = Harness(folder, seed, sorted({kind_of(i) for i in numbers}, key=KINDS.index))
    for number in numbers:
        rows.append(row := harness.run(number))
        if row.verdict in BAD or keep:
            print(f"{row.verdict}: {seed}:{row.index} {row.kind}: {row.damage}: {row.reason}", flush=True)
    print(table(rows))
    print("\n".join(f"{name}: {text}" for name, text in BAD.items() if any(row.verdict == name for row in rows)))
    print(f"kept: {folder}") if keep else shutil.rmtree(folder, ignore_errors=True)
    return int(any(row.verdict in BAD for row in rows))


def table(rows: list[Row]) -> str:
    """Kinds by classes, with the greatest time and memory of each kind."""
    lines = []
    for kind in (*KINDS, "all"):
        if of_kind := [row for row in rows if kind in (row.kind, "all")]:
            counts = Counter(row.verdict for row in of_kind)
            longest, peak = max(row.seconds for row in of_kind), max(row.peak_bytes for row in of_kind) / 2**20
            verdicts = [str(counts[c]) for c in (*GOOD, *BAD)]
            lines.append([kind, *verdicts, str(len(of_kind)), f"{longest:.1f}", f"{peak:.0f}"])
    return markdown(["kind", *GOOD, *BAD, "inputs", "longest s", "peak MiB"], lines)


if __name__ == "__main__":
    run(main, __doc__)
