"""How far the agents of a reconstruction can be trusted, log by log.

    python tools/bench.py agents LOG|SCENE.toml ... [--detector NAME] [--range 30] [--categories vehicle] [--keep DIR] [--out FILE.md]

Every log is reconstructed and compared with its labels; a scene file is rendered first, with exact truth. One row a log:
recall and precision, the shares of agent-ticks that are wrong by each measure of `evaluate`, the shares of wrong and right ticks
that the scenario doubts, the calibration error of confidence and the normalized squared position error (1 expected). `--keep`
stores rendered logs and scenarios, and takes what is there already.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from entry import parser_of

from benchmarks.table import cell, markdown
from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import Scenario
from log2sim.errors import Log2SimError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import truth_from_log
from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import write_synthetic

SHARES = ("invented", "duplicate", "in_ego", "wrong_speed", "wrong_motion", "backwards", "wrong_size", "wrong")
HEADER = ["log", "agents", "ticks", "recall", "precision", *(s.replace("_", " ") for s in SHARES),
          "wrong doubted", "right doubted", "ECE", "NEES"]  # fmt: skip


def log_of(path: Path, keep: Path) -> Path:
    """The log of a path: itself, or a folder with what a scene file describes."""
    if path.suffix != ".toml":
        return path
    folder = keep / path.stem
    if not folder.exists():
        print(f"rendering {path}", file=sys.stderr)
        write_synthetic(load_scene(path), folder)
    return folder


def row_of(name: str, figures: dict[str, Any]) -> list[str]:
    """Format one row of the table."""
    c = figures["correctness"]
    shares = [*(c[key]["share"] for key in SHARES), *(c["doubted"][key] for key in ("wrong_ticks", "right_ticks"))]
    percent = [cell(value and 100 * value, 1, " %") for value in shares]
    error = c["calibration"]["agents"]["expected_calibration_error"]
    return [
        name, str(c["agents"]), str(c["ticks"]), cell(figures["recall"]), cell(figures["precision"]), *percent,
        cell(error), cell(c["sigma"]["nees"]),
    ]  # fmt: skip


def run(path: Path, options: argparse.Namespace, keep: Path) -> list[str]:
    """Reconstruct and evaluate one log."""
    log = open_log(log_of(path, keep))
    kept = keep / f"{path.stem}.{options.detector.replace('/', '_')}.json"
    if options.keep and kept.exists():
        scenario = Scenario.load(kept)
    else:
        scenario = reconstruct(log, Config.load(detect={"name": options.detector})).scenario
        if options.keep:
            scenario.save(kept)
    categories: Sequence[str] | None = options.categories.split(",") if options.categories else None
    found = evaluate(scenario, truth_from_log(log), max_range_m=options.range, categories=categories)
    return row_of(path.stem or path.name, found)


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG|SCENE.toml")
    parser.add_argument("--detector", default="auto")
    parser.add_argument("--range", type=float, default=None)
    parser.add_argument("--categories")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        keep = options.keep or Path(scratch)
        keep.mkdir(parents=True, exist_ok=True)
        rows = []
        for path in options.logs:
            try:
                rows.append(run(path, options, keep))
            except Log2SimError as error:
                print(f"{path}: {error}", file=sys.stderr)
    table = markdown(HEADER, rows)
    print(table)
    if options.out:
        options.out.write_text(table + "\n", encoding="utf-8")
