"""Damage every kind of log, scenario and OpenSCENARIO file, run the commands on it, and print what came of it.

python tools/mutate.py [--seed N] [--count N] [--only KIND] [--json FILE]
python tools/mutate.py --replay SEED:INDEX      one input in detail; its folder is kept
python tools/mutate.py --kill N                 end commands at random moments; nothing torn may be left

Exit code 1 when an input crashed, hung, took more than 2 GiB, made a command read or write outside of it, or changed a result
without a word though the damage can be seen.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from mutation.bases import KINDS
from mutation.running import BAD, CLASSES, MEANING, temporary_folder
from mutation.supervising import Harness, Row, indices, kind_of, run_many


def main(arguments: list[str] | None = None) -> int:
    """Run the command; 1 when anything is as it must not be."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--start", type=int, default=0, help="index to begin with")
    parser.add_argument("--only", action="append", choices=KINDS, default=[], help="kind of input; may be repeated")
    parser.add_argument("--replay", metavar="SEED:INDEX")
    parser.add_argument("--kill", type=int, metavar="N")
    parser.add_argument("--json", type=Path, help="also write a row for each input here")
    options = parser.parse_args(arguments)
    folder = temporary_folder()
    if options.kill is not None:
        from mutation.killing import main as kill

        return kill(folder, options.kill, options.seed)
    if options.replay:
        seed, index = map(int, options.replay.split(":"))
        return replay(folder, seed, index)
    rows = run(folder, options)
    print(table(rows))
    if options.json:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")
    return int(any(row.verdict in BAD for row in rows))


def run(folder: Path, options: argparse.Namespace) -> list[Row]:
    """Run all inputs; bad ones are printed at once."""
    numbers = list(indices(options.count, options.only, options.start))
    harness = Harness(folder, sorted({kind_of(i) for i in numbers}, key=KINDS.index))
    rows: list[Row] = []
    start = time.monotonic()
    for row in run_many(harness, options.seed, numbers):
        rows.append(row)
        if row.verdict in BAD:
            print(f"{row.verdict}: {row.replay} {row.kind}: {row.damage}: {row.reason}", flush=True)
        if len(rows) % 500 == 0:
            print(f"{len(rows)} inputs, {len(rows) / (time.monotonic() - start):.1f} per second", flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    return rows


def table(rows: Sequence[Row]) -> str:
    """Kinds by classes, with the greatest time and memory of each kind."""
    lines = [
        "| kind | " + " | ".join((*CLASSES, "inputs", "longest s", "peak MiB")) + " |",
        "|---|" + "---|" * (len(CLASSES) + 3),
    ]
    for kind in (*KINDS, "all"):
        of_kind = [row for row in rows if kind in (row.kind, "all")]
        if not of_kind:
            continue
        counts = Counter(row.verdict for row in of_kind)
        longest, peak = max(row.seconds for row in of_kind), max(row.peak_bytes for row in of_kind) / 2**20
        cells = [*(str(counts[c]) for c in CLASSES), str(len(of_kind)), f"{longest:.1f}", f"{peak:.0f}"]
        lines.append(f"| {kind} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def replay(folder: Path, seed: int, index: int) -> int:
    """Run one input in detail."""
    harness = Harness(folder, [kind_of(index)])
    row = next(iter(run_many(harness, seed, [index])))
    for key, value in asdict(row).items():
        print(f"{key:10} {value}")
    print(f"{row.verdict}: {MEANING[row.verdict]}")
    print(f"input      {harness.make(seed, index)[0]}")
    return int(row.verdict in BAD)


if __name__ == "__main__":
    sys.exit(main())
