"""Train the two-stream network of Lin et al. (2021) on simulated pictures and clouds, and compare it with lidar:vehicle.

pip install 'log2sim[train]'
log2sim synth --traffic vehicle --layout kitti --scenes 300 --out PAIRS
python tools/train_lidar.py two_stream --data PAIRS --out OUT --steps 1500 --test KITTI=DRIVE --write BENCHMARKS.md
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarks.table import markdown, replace_section
from entry import parser_of
from lidar_training.fitting import FitPlan, fit
from lidar_training.real_logs import read_sweeps

from log2sim.config import LidarConfig
from log2sim.logs.opening import open_log
from log2sim.perception.detect3d.detectors import WEIGHTS, open_network
from two_stream.network import (
    CRITERIA,
    Batch,
    Pair,
    TwoStream,
    TwoStreamDetector,
    compare,
    export_two_stream,
    inputs_of,
    loss_of_anchors,
    pairs_of,
    search_by_lidar,
)

TEST_SHARE = 0.15
PEAK_RATE = 2e-3
MIN_SCORE = 0.05


def read_pairs(path: Path, every: int = 1) -> list[Pair]:
    """Read the pairs of a log, with the camera in whose pictures it is labeled."""
    log = open_log(path)
    only = None if log.labels is None else log.labels.cameras
    camera = next(iter(only)) if only else (log.reference_camera or next(iter(log.cameras)))
    return list(pairs_of(log, camera, read_sweeps(log, every)))


def train(pairs: list[Pair], out: Path, *, steps: int, seed: int) -> Path:
    """Train, or go on from the checkpoint in `out`, and export the averaged weights; returns the ONNX file."""
    torch.manual_seed(seed)
    network = TwoStream().to(memory_format=torch.channels_last)

    def step(n: torch.nn.Module, rng: np.random.Generator, _: int) -> Any:
        pair = pairs[int(rng.integers(len(pairs)))]
        batch = Batch.of(inputs_of(pair, mirrored=bool(rng.random() < 0.5)), rng)
        return loss_of_anchors(*batch.run(n), batch)

    mean = fit(network, step, FitPlan(steps, seed, PEAK_RATE, out / "checkpoint.pt"))
    network.load_state_dict(mean)
    path = out / "two_stream.onnx"
    export_two_stream(network, path)
    return path


def table(results: dict[str, dict[str, dict[str, Any]]], pairs: dict[str, int]) -> str:
    """Write average precision by test, detector, class and criterion."""
    columns = [(kind, str(c)) for kind, criteria in CRITERIA.items() for c in criteria]
    head = ["tested on", "detector", *[f"{kind}, {c}" for kind, c in columns], "truths", "CPU ms"]
    rows = []
    for test, by_detector in results.items():
        for name, row in by_detector.items():
            values = [row[kind][c] for kind, c in columns]
            cells = ["-" if v is None else f"{v:.3f}" for v in values]
            truths = " / ".join(str(row[kind]["truths"]) for kind in CRITERIA)
            rows.append([f"{test} ({pairs[test]})", name, *cells, truths, f"{row['ms']:.0f}"])
    return markdown(head, rows)


def main(arguments: list[str] | None = None) -> None:
    """Read the command line, train and compare."""
    parser = parser_of(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder in KITTI's object layout")
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the checkpoint, the ONNX file and the results"
    )
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--test", action="append", default=[], metavar="NAME=PATH", help="another labeled log")
    parser.add_argument("--every", type=int, default=3, help="every n-th sweep of other logs")
    parser.add_argument("--write", type=Path, help="Markdown file whose section two-stream is replaced")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    pairs = read_pairs(options.data)
    held = max(1, round(len(pairs) * TEST_SHARE))
    path = train([p.in_picture_only() for p in pairs[:-held]], options.out, steps=options.steps, seed=options.seed)
    tests = {"simulated": pairs[-held:]}
    tests |= {name: read_pairs(Path(log), options.every) for name, log in (t.split("=", 1) for t in options.test)}
    lidar = open_network(WEIGHTS / "vehicle.onnx", LidarConfig(min_score=MIN_SCORE), name="lidar:vehicle")
    searches = {"two-stream": TwoStreamDetector.open(path), "`lidar:vehicle`": search_by_lidar(lidar)}
    results = {name: compare(searches, frames) for name, frames in tests.items()}
    (options.out / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    text = table(results, {name: len(frames) for name, frames in tests.items()})
    print(text)
    if options.write:
        replace_section(options.write, "two-stream", text)
