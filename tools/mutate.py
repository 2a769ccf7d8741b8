"""Damage every kind of log, scenario and OpenSCENARIO file, run the commands on it, and print what came of it.

    python tools/mutate.py [--seed N] [--count N] [--start N] [--only KIND]
    python tools/mutate.py --seed N --start INDEX --count 1 --keep      # one input again, whose folder is kept
    python tools/mutate.py --kill N                                     # end commands at random moments; nothing torn may be left

Exit code 1 when an input crashed, hung, took more than 2 GiB, made a command read or write outside of it, or changed a result
without a word though the damage can be seen.
"""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.table import markdown
from entry import run
from mutation import killing
from mutation.bases import KINDS
from mutation.harness import BAD, GOOD, Harness, Row, indices, kind_of


def main(
    seed: int = 0, count: int = 100, start: int = 0, only: list[str] = [], keep: bool = False, kill: int = 0
) -> int:
    """Run the command; 1 when anything is as it must not be."""
    folder = Path(tempfile.mkdtemp(prefix="mutate-")).resolve()  # not a link
    if kill:
        bad = kill_commands(folder, kill, seed)
    else:
        numbers, rows = list(indices(count, only, start)), []
        harness = Harness(folder, seed, sorted({kind_of(i) for i in numbers}, key=KINDS.index))
        for number in numbers:
            rows.append(row := harness.run(number))
            if row.verdict in BAD or keep:
                print(f"{row.verdict}: {seed}:{row.index} {row.kind}: {row.damage}: {row.reason}", flush=True)
        bad = any(row.verdict in BAD for row in rows)
        print(table(rows))
        print("\n".join(f"{name}: {text}" for name, text in BAD.items() if any(row.verdict == name for row in rows)))
    print(f"kept: {folder}") if keep else shutil.rmtree(folder, ignore_errors=True)
    return int(bad)


def table(rows: list[Row]) -> str:
    """Kinds by classes, with the greatest time and memory of each kind."""
    lines = []
    for kind in (*KINDS, "all"):
        if of_kind := [row for row in rows if kind in (row.kind, "all")]:
            counts = Counter(row.verdict for row in of_kind)
            longest, peak = max(row.seconds for row in of_kind), max(row.peak_bytes for row in of_kind) / 2**20
            lines.append(
                [kind, *(str(counts[c]) for c in (*GOOD, *BAD)), str(len(of_kind)), f"{longest:.1f}", f"{peak:.0f}"]
            )
    return markdown(["kind", *GOOD, *BAD, "inputs", "longest s", "peak MiB"], lines)


def kill_commands(folder: Path, count: int, seed: int) -> bool:
    """Print a table of commands by what was left; whether anything was torn."""
    found = []
    for name, left, words in killing.kill_many(folder, count, seed):
        found.append((name, left))
        if left == "torn":
            print(f"torn: {name}: {words}", flush=True)
    names = (*dict.fromkeys(name for name, _ in found), "all")
    counts = {of: Counter(left for name, left in found if of in (name, "all")) for of in names}
    lines = [[of, *(str(n[kind]) for kind in killing.KINDS), str(n.total())] for of, n in counts.items()]
    print(markdown(["command", *killing.KINDS, "kills"], lines))
    return any(left == "torn" for _, left in found)


if __name__ == "__main__":
    run(main, __doc__)
