"""Damage every kind of log, scenario and OpenSCENARIO file, run the commands on it, and print what came of it.

    python tools/mutate.py [--seed N] [--count N] [--start N] [--only KIND]
    python tools/mutate.py --seed N --start INDEX --count 1 --keep      # one input again, whose folder is kept
    python tools/mutate.py --kill N                                     # end commands at random moments; nothing torn may be left

Exit code 1 when an input crashed, hung, took more than 2 GiB, made a command read or write outside of it, or changed a result
without a word though the damage can be seen.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.table import markdown
from entry import parser_of
from mutation import killing
from mutation.bases import KINDS
from mutation.harness import BAD, GOOD, Harness, Row, indices, kind_of


def main(arguments: list[str] | None = None) -> int:
    """Run the command; 1 when anything is as it must not be."""
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--start", type=int, default=0, help="index to begin with")
    parser.add_argument("--only", action="append", choices=KINDS, default=[], help="kind of input; may be repeated")
    parser.add_argument("--keep", action="store_true", help="keep the folder, with the last input")
    parser.add_argument("--kill", type=int, metavar="N")
    options = parser.parse_args(arguments)
    folder = Path(tempfile.mkdtemp(prefix="mutate-")).resolve()  # not a link
    if options.kill:
        bad = kill(folder, options.kill, options.seed)
    else:
        numbers = list(indices(options.count, options.only, options.start))
        harness = Harness(folder, options.seed, sorted({kind_of(i) for i in numbers}, key=KINDS.index))
        rows = []
        for number in numbers:
            rows.append(row := harness.run(number))
            if row.verdict in BAD or options.keep:
                print(f"{row.verdict}: {options.seed}:{row.index} {row.kind}: {row.damage}: {row.reason}", flush=True)
        bad = any(row.verdict in BAD for row in rows)
        print(table(rows))
        print("\n".join(f"{name}: {text}" for name, text in BAD.items() if any(row.verdict == name for row in rows)))
    print(f"kept: {folder}") if options.keep else shutil.rmtree(folder, ignore_errors=True)
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


def kill(folder: Path, count: int, seed: int) -> bool:
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
    sys.exit(main())
