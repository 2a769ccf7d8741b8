"""Train the LiDAR detector on simulated clouds: generate, fit, export, check, in one command that resumes.

pip install 'log2sim[train]'
python tools/train_lidar.py vehicle --out DIR             # everything, with the settings of the shipped weights
python tools/train_lidar.py vehicle --out DIR --scenes 200 --steps 300     # a toy
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).parent))

from lidar_training import fitting
from lidar_training.clouds import draw_example
from lidar_training.export import calibrate, describe, description, export_onnx, quantize
from lidar_training.fitting import FitPlan
from lidar_training.losses import loss_of
from lidar_training.network import BevNetwork
from lidar_training.report import report
from lidar_training.samples import Sample, Shard, augmented, draw_sample, grid_of, window_of, write_shard
from lidar_training.targets import targets_of

from log2sim.config_sections import LidarConfig
from log2sim.perception.detect3d.network import load_network
from log2sim.perception.detect3d.network_detector import open_network

PER_SHARD = 100
FIRST_SHARDS, STEPS_PER_SHARD = 4, 100
BATCH = 4
WARM_UP_STEPS = 100
# Side of the square grids of training; a roadside sensor sees cars to some 25 m.
CELLS = {"vehicle": 256, "roadside": 192}
CELL_M = {"vehicle": 0.25, "roadside": 0.1875}


@dataclass(frozen=True)
class Round:
    """A part of the training: it starts with the averaged weights of the one before and draws from all scenes so far.

    Attributes
    ----------
    seed : int
        Of its scenes and of its order.
    scenes : int
        Generated for it.
    steps : int
    rate : float
        Greatest learning rate; it falls to zero as a cosine.
    """

    seed: int
    scenes: int
    steps: int
    rate: float = 2.5e-3


# The second round of the vehicle has scenes with a second LiDAR and more clutter, which pictures of misses asked for.
ROUNDS = {
    "vehicle": (Round(1, 4_000, 5_500), Round(2, 2_000, 4_000, rate=1.2e-3)),
    "roadside": (Round(1, 3_000, 4_500), Round(2, 400, 5_000, rate=1.2e-3)),
}
# Largest |x| and |y| from the sensor at run time; the roadside sensor sees cars to some 25 m.
RANGE_M = {"vehicle": 40.0, "roadside": 30.0}
QUANTIZATION_CLOUDS = 24
# Integer weights ship where they cost less F1 than this.
MAX_QUANTIZATION_LOSS = 0.004


def generate(mount: str, out: Path, scenes: int, seed: int) -> None:
    """Draw scenes into shards; those that are there already are kept."""
    out.mkdir(parents=True, exist_ok=True)
    for shard in range(math.ceil(scenes / PER_SHARD)):
        path = out / shard_name(mount, seed, shard)
        if path.exists():
            continue
        begun = time.process_time()
        write_shard(path, [draw_sample(mount, (seed, shard, k)) for k in range(PER_SHARD)])
        print(f"{path.name}: {(time.process_time() - begun) / PER_SHARD * 1e3:.0f} ms of CPU a scene", flush=True)


class Pool:
    """Samples of the shards that a step may use; waits for those that are still being generated.

    How many these are depends on the step alone, so that fitting beside generating gives the same weights as after it.
    """

    def __init__(self, folder: Path, mount: str, rounds: Sequence[Round]) -> None:
        self._paths = [
            folder / shard_name(mount, r.seed, k) for r in rounds for k in range(math.ceil(r.scenes / PER_SHARD))
        ]
        earlier = sum(math.ceil(r.scenes / PER_SHARD) for r in rounds[:-1])
        self._first = earlier + FIRST_SHARDS
        self._shards: list[Shard] = []

    def prepare(self, step: int) -> None:
        """Load what a step may use."""
        while len(self._shards) < min(len(self._paths), self._first + step // STEPS_PER_SHARD):
            path = self._paths[len(self._shards)]
            while not path.exists():
                time.sleep(2)
            self._shards.append(Shard(path))

    def draw(self, rng: np.random.Generator) -> Sample:
        """Draw a sample."""
        shard = self._shards[rng.integers(len(self._shards))]
        return shard[int(rng.integers(len(shard)))]


def checkpoint_path(out: Path, number: int) -> Path:
    """Return where the state of a round is kept."""
    return out / f"round-{number}.pt"


def shard_name(mount: str, seed: int, number: int) -> str:
    """Name a file of samples."""
    return f"{mount}-{seed}-{number:04d}.npz"


def batch_of(pool: Pool, mount: str, rng: np.random.Generator):
    """Draw a batch: grids and targets."""
    cells, cell_m = CELLS[mount], CELL_M[mount]
    samples, lows, grids = [], [], []
    for _ in range(BATCH):
        sample = augmented(pool.draw(rng), rng)
        low = window_of(rng, cells, cell_m)
        samples.append(sample)
        lows.append(low)
        grids.append(grid_of(sample, low, cells, cell_m))
    return torch.from_numpy(np.stack(grids)), targets_of(samples, lows, cells, cell_m)


def fit(mount: str, data: Path, out: Path, rounds: Sequence[Round]) -> None:
    """Train the last of some rounds, or go on from its checkpoint in `out`; the earlier ones are complete."""
    this, number = rounds[-1], len(rounds)
    torch.manual_seed(this.seed)
    network = BevNetwork().to(memory_format=torch.channels_last)
    if number > 1:
        before = torch.load(checkpoint_path(out, number - 1), weights_only=True)
        network.load_state_dict(before["mean"])
    pool = Pool(data, mount, rounds)

    def step_loss(network: nn.Module, rng: np.random.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        pool.prepare(step)
        grid, targets = batch_of(pool, mount, rng)
        return loss_of(network(grid.to(memory_format=torch.channels_last)), targets, grid)

    plan = FitPlan(this.steps, this.seed, this.rate, checkpoint_path(out, number), WARM_UP_STEPS)
    fitting.fit(network, step_loss, plan)


def finish(mount: str, out: Path, rounds: Sequence[Round], examples: int) -> None:
    """Export, calibrate, quantize and report; the files that ship are in `out` afterwards."""
    seed = rounds[0].seed
    calibration = [draw_example(mount, (seed, 1_000_000, k)) for k in range(examples)]
    test = [draw_example(mount, (seed, 2_000_000, k)) for k in range(examples)]
    info, exact = description(mount, CELL_M[mount], RANGE_M[mount]), out / f"{mount}-float32.onnx"
    export_onnx(checkpoint_path(out, len(rounds)), exact, info)
    info["calibration"] = calibrate(exact, calibration)
    describe(exact, info)
    small = out / f"{mount}-int8.onnx"
    quantize(exact, small, calibration[:QUANTIZATION_CLOUDS])
    card = {"mount": mount, "rounds": [asdict(r) for r in rounds], "batch": BATCH, "torch": torch.__version__}
    reports = {}
    for path in (exact, small):
        # Eight bits shift the scores a little, so each file has its own calibration.
        info["calibration"] = calibrate(path, calibration) if path is small else info["calibration"]
        describe(path, info)
        detector = open_network(path, LidarConfig(), name=mount)
        reports[path.name] = report(detector, test, range_m=RANGE_M[mount])
        line = {
            k: {m: v[m] and round(v[m], 4) for m in ("precision", "recall", "f1")}
            for k, v in reports[path.name].items()
            if isinstance(v, dict)
        }
        print(path.name, f"{path.stat().st_size / 1e6:.2f} MB", json.dumps(line), flush=True)
    loss = (reports[exact.name]["all"]["f1"] or 0.0) - (reports[small.name]["all"]["f1"] or 0.0)
    chosen = small if loss < MAX_QUANTIZATION_LOSS else exact
    card |= {
        "file": "int8" if chosen is small else "float32",
        "loss_of_f1_by_int8": round(loss, 4),
        "simulated": reports[chosen.name],
    }
    info = json.loads(load_network(chosen).info.model_dump_json()) | {"card": {k: card[k] for k in ("rounds", "file")}}
    (out / f"{mount}.onnx").write_bytes(chosen.read_bytes())
    describe(out / f"{mount}.onnx", info)
    (out / f"{mount}.json").write_text(json.dumps(card, indent=1) + "\n")


def main() -> None:
    """Run the steps that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mount", choices=("vehicle", "roadside"))
    parser.add_argument("--out", type=Path, required=True, help="folder of shards, checkpoints and results")
    parser.add_argument("--scenes", type=int, help="a single round with as many scenes")
    parser.add_argument("--steps", type=int, help="a single round with as many steps")
    parser.add_argument("--seed", type=int, default=1, help="with --scenes or --steps")
    parser.add_argument("--only", choices=("generate", "fit", "finish"))
    parser.add_argument("--examples", type=int, default=150, help="scenes to calibrate with, and as many to test with")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rounds = ROUNDS[options.mount]
    if options.steps or options.scenes:
        first = rounds[0]
        rounds = (Round(options.seed, options.scenes or first.scenes, options.steps or first.steps),)
    data = options.out / "data"
    for number in range(1, len(rounds) + 1):
        if options.only in (None, "generate"):
            generate(options.mount, data, rounds[number - 1].scenes, rounds[number - 1].seed)
        if options.only in (None, "fit"):
            fit(options.mount, data, options.out, rounds[:number])
    if options.only in (None, "finish"):
        finish(options.mount, options.out, rounds, options.examples)


if __name__ == "__main__":
    main()
