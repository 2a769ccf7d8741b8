"""Train the LiDAR detector on simulated clouds and on labeled logs: generate, fit, export, check, in one command that resumes.

    pip install 'log2sim[train]'
    python tools/train.py lidar roadside DIR            # the first two rounds of the shipped weights, as of `vehicle`
    python tools/train.py lidar vehicle DIR --scenes 200 --steps 300 --quantize-steps 100      # a toy
    python tools/train.py lidar vehicle DIR --scenes 200 --steps 300 --start FILE.onnx         # goes on from a network that is there
    python tools/train.py lidar vehicle DIR --data LOGS --steps 2000     # half of each batch from labeled logs of any format
    python tools/train.py lidar vehicle DIR --data LOGS --scenes 0 --steps 2000                # from these alone
    python tools/train.py refinement vehicle DIR        # the second stage, which looks at the points of boxes, of the shipped first one
    python tools/train.py zou2021|two_stream --help     # the networks of two papers

The shipped weights went on from those of such rounds (their cards tell all), the last time as a wider network (`WIDTHS`; 16, 32, 48 and
64 channels until then) that computed the same at first, and were quantized then:

    python tools/train.py lidar vehicle E --scenes 8000 --steps 30000 --seed 31 --start D/vehicle.onnx --examples 500
    python tools/train.py lidar vehicle F --scenes 2000 --steps 0 --seed 61 --start E/vehicle.onnx --examples 500

--data, of which every n-th sweep is taken, may be given several times; --only does one of generate, fit and finish; --seed holds with --scenes or
--steps; --quantize-steps of quantization-aware training follow; scores are calibrated and tested with so many --examples.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from subprocess import Popen

import numpy as np
import torch
from torch import Tensor, nn

from log2sim.batch.discovery import find_logs
from log2sim.config import LidarConfig
from log2sim.errors import ConfigError, LogError
from log2sim.logs.opening import open_log
from log2sim.perception.detect3d.detectors import open_network
from log2sim.synth.traffic import Mount
from training import fitting
from training.clouds import (
    REPORTED_KINDS,
    Example,
    Sample,
    Shard,
    augmented,
    draw_example,
    draw_sample,
    grid_of,
    sample_of,
    window_of,
    write_shard,
)
from training.export import calibrate, describe, description, export_onnx, import_onnx, report, widened
from training.fitting import FitPlan
from training.network import BevNetwork, Widths, loss_of, targets_of
from training.quantization import distillation_loss, quantized_network
from training.real_logs import example_of, read_sweeps

PER_SHARD = 100
# Of the sweeps of each log the last are not trained on, half to calibrate the scores with and half to test.
HELD_OUT_SHARE = 0.2
FIRST_SHARDS, STEPS_PER_SHARD = 4, 100
BATCH = 4
WARM_UP_STEPS = 100
# Of quantization-aware training, toward what the network computes in floats.
QUANTIZE_STEPS, QUANTIZE_RATE = 3_000, 5e-4
# To find the moments of the layers of a network that training starts from; and the greatest learning rate from there.
START_BATCHES, START_RATE = 4, 1.5e-3
# Side of the square grids of training; a roadside sensor sees cars to some 25 m.
CELLS = {"vehicle": 256, "roadside": 192}
# Wider at long strides, where cells are few: a vehicle's sweep takes a fifth longer with 80 and 112 channels than with 48 and 64.
WIDTHS: dict[str, Widths] = {"vehicle": (16, 32, 80, 112), "roadside": (16, 48, 80, 112)}
CELL_M = {"vehicle": 0.25, "roadside": 0.1875}
# Largest distance of a grid's middle from the sensor along an axis: with half a grid, as far as the network is to look.
SHIFT_M = {"vehicle": 22.0, "roadside": 10.0}


@dataclass(frozen=True)
class Round:
    """A part of the training: it starts with the averaged weights of the one before and draws from all scenes so far."""

    seed: int  # of its scenes and of its order
    scenes: int  # generated for it
    steps: int
    rate: float = 2.5e-3  # greatest learning rate; it falls to zero as a cosine


# The second round of the vehicle has scenes with a second LiDAR and more clutter, which pictures of misses asked for.
ROUNDS = {
    "vehicle": (Round(1, 4_000, 5_500), Round(2, 2_000, 4_000, rate=1.2e-3)),
    "roadside": (Round(1, 3_000, 4_500), Round(2, 400, 5_000, rate=1.2e-3)),
}
# Largest |x| and |y| from the sensor at run time; the roadside sensor sees cars to some 25 m.
RANGE_M = {"vehicle": 54.0, "roadside": 30.0}


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


def read_own(folders: Sequence[Path], out: Path, every: int) -> tuple[list[Path], list[Example]]:
    """Write the labeled sweeps of the logs below some folders into shards, which are kept, and return the held-out ones as examples."""
    out.mkdir(parents=True, exist_ok=True)
    paths, held_out = [], []
    for found in [found for folder in folders for found in find_logs(folder)]:
        log = open_log(found.path, format=found.format, sequence=found.sequence or None)
        try:
            sweeps = read_sweeps(log, every)
        except LogError as error:
            print(f"left out: {error}", flush=True)
            continue
        first_held = max(math.ceil(len(sweeps) * (1 - HELD_OUT_SHARE)), 1)
        held_out += [example_of(sweep) for sweep in sweeps[first_held:]]
        paths.append(out / f"own-{hashlib.sha256(f'{log.digest} {every}'.encode()).hexdigest()[:16]}.npz")
        if not paths[-1].exists():
            write_shard(paths[-1], [sample_of(example_of(sweep)) for sweep in sweeps[:first_held]])
            print(f"{found.id}: {first_held} sweeps to train on, {len(sweeps) - first_held} held out", flush=True)
    if not paths:
        raise LogError(f"{', '.join(map(str, folders))}: no log with labeled sweeps")
    return paths, held_out


class Pool:
    """Samples of the shards that a step may use; waits for those that are still being generated by another process, if there is one.

    How many these are depends on the step alone, so that fitting beside generating gives the same weights as after it.
    """

    def __init__(
        self, folder: Path, mount: str, rounds: Sequence[Round], own: Sequence[Path], generator: Popen[bytes] | None
    ) -> None:
        self._generator = generator
        self._own = [Shard(path) for path in own]
        self._paths = [
            folder / shard_name(mount, r.seed, k) for r in rounds for k in range(math.ceil(r.scenes / PER_SHARD))
        ]
        earlier = sum(math.ceil(r.scenes / PER_SHARD) for r in rounds[:-1])
        self._first = earlier + FIRST_SHARDS
        self._shards: list[Shard] = []

    def prepare(self, step: int) -> None:
        """Load what a step may use."""
        while len(self._shards) < min(len(self._paths), self._first + step // STEPS_PER_SHARD):
            self._shards.append(Shard(fitting.wait_for(self._paths[len(self._shards)], self._generator)))

    def draw(self, rng: np.random.Generator) -> Sample:
        """Draw a sample: from each kind of shards as often where there are both."""
        of_logs = bool(self._own) and (not self._shards or rng.random() < 0.5)
        shards = self._own if of_logs else self._shards
        shard = shards[rng.integers(len(shards))]
        return shard[int(rng.integers(len(shard)))]


QUANTIZED = "quantized.pt"  # where the state of the quantized network is kept


def checkpoint_path(out: Path, number: int) -> Path:
    """Return where the state of a round is kept."""
    return out / f"round-{number}.pt"


def shard_name(mount: str, seed: int, number: int) -> str:
    return f"{mount}-{seed}-{number:04d}.npz"


def draw_batch(pool: Pool, mount: str, rng: np.random.Generator) -> tuple[list[Sample], list[np.ndarray], Tensor]:
    """Draw samples, the lower corners of their windows, and their grids (B, 12, H, W)."""
    cells, cell_m = CELLS[mount], CELL_M[mount]
    samples = [augmented(pool.draw(rng), rng) for _ in range(BATCH)]
    lows = [window_of(rng, cells, cell_m, SHIFT_M[mount]) for _ in range(BATCH)]
    grids = [grid_of(sample, low, cells, cell_m) for sample, low in zip(samples, lows, strict=True)]
    return samples, lows, torch.from_numpy(np.stack(grids)).to(memory_format=torch.channels_last)


def fit(
    mount: str,
    data: Path,
    out: Path,
    rounds: Sequence[Round],
    own: Sequence[Path] = (),
    *,
    start: Path | None = None,
    generator: Popen[bytes] | None = None,
) -> None:
    """Train the last of some rounds, or go on from its checkpoint in `out`; the earlier ones are complete.

    The first starts from the network in an ONNX file, if one is given.
    """
    this, number = rounds[-1], len(rounds)
    torch.manual_seed(this.seed)
    network = BevNetwork(WIDTHS[mount])
    pool = Pool(data, mount, rounds, own, generator)
    if number > 1:
        before = torch.load(checkpoint_path(out, number - 1), weights_only=True)
        network.load_state_dict(before["mean"])
    elif start is not None:
        network = widened(import_onnx(start, first_grids(pool, mount, this.seed)), WIDTHS[mount]).train()
    network = network.to(memory_format=torch.channels_last)

    def step_loss(network: nn.Module, rng: np.random.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        pool.prepare(step)
        samples, lows, grid = draw_batch(pool, mount, rng)
        return loss_of(network(grid), targets_of(samples, lows, CELLS[mount], CELL_M[mount]), grid)

    plan = FitPlan(this.steps, this.seed, this.rate, checkpoint_path(out, number), WARM_UP_STEPS)
    fitting.fit(network, step_loss, plan)


def first_grids(pool: Pool, mount: str, seed: int) -> Tensor:
    """Draw grids by which the layers of a network that is there are scaled."""
    pool.prepare(0)
    rng = np.random.default_rng(seed)
    return torch.cat([draw_batch(pool, mount, rng)[2] for _ in range(START_BATCHES)])


def fit_quantized(
    mount: str, data: Path, out: Path, rounds: Sequence[Round], steps: int, own: Sequence[Path] = (), generator: Popen[bytes] | None = None
) -> None:  # fmt: skip
    """Train the averaged weights of the last round on as a quantized network, or go on from the checkpoint of that in `out`."""
    seed, pool = rounds[-1].seed, Pool(data, mount, rounds, own, generator)
    exact = BevNetwork(WIDTHS[mount]).eval()
    exact.load_state_dict(torch.load(checkpoint_path(out, len(rounds)), weights_only=True)["mean"])
    exact = exact.to(memory_format=torch.channels_last)
    network = quantized_network(exact).train()
    with torch.no_grad():
        network(first_grids(pool, mount, seed))

    def step_loss(network: nn.Module, rng: np.random.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        pool.prepare(rounds[-1].steps + step)
        grid = draw_batch(pool, mount, rng)[2]
        with torch.no_grad():
            wanted = exact(grid)
        return distillation_loss(network(grid), wanted, grid)

    fitting.fit(network, step_loss, FitPlan(steps, seed, QUANTIZE_RATE, out / QUANTIZED, WARM_UP_STEPS))


def finish(
    mount: str, out: Path, rounds: Sequence[Round], quantize_steps: int, examples: int, held_out: Sequence[Example] = (), start: Path | None = None
) -> None:  # fmt: skip
    """Export, calibrate and report; the files that ship are in `out` afterwards.

    The card tells the rounds of `start`, too. Without simulated scenes the scores are calibrated and tested on the held-out sweeps; with both, on both.
    """
    seed, simulated = rounds[0].seed, any(r.scenes for r in rounds)
    before = None if start is None else open_network(start, LidarConfig(), name=mount).network.info
    only_quantized = before is not None and not any(r.steps for r in rounds)  # its scores are those of the one before
    calibration, test = list(held_out[::2]), list(held_out[1::2])
    if simulated:
        draws = range(0 if only_quantized else examples)
        calibration += [draw_example(mount, (seed, 1_000_000, k), REPORTED_KINDS) for k in draws]
        test = [draw_example(mount, (seed, 2_000_000, k)) for k in range(examples)]
    if not test or not (calibration or only_quantized):
        raise ConfigError("--data: too few labeled sweeps to hold any out; give more of them, or --scenes")
    path = out / f"{mount}.onnx"
    info = description(mount, CELL_M[mount], RANGE_M[mount])
    export_onnx(out / QUANTIZED, path, info)
    info["calibration"] = before.calibration if before and only_quantized else calibrate(path, calibration)
    trained = [*(before.card.get("rounds", []) if before else []), *(asdict(r) for r in rounds if r.steps)]
    info["card"] = {
        "mount": mount,
        "rounds": [*trained, {"seed": seed, "quantize_steps": quantize_steps}],
        "batch": BATCH,
        "widths": WIDTHS[mount],
        "torch": torch.__version__,
    }
    describe(path, info)
    detector = open_network(path, LidarConfig(), name=mount)
    card = info["card"] | {"simulated" if simulated else "own": report(detector, test, range_m=RANGE_M[mount])}
    if simulated and held_out[1::2]:
        card["own"] = report(detector, held_out[1::2], range_m=RANGE_M[mount])
    (out / f"{mount}.json").write_text(json.dumps(card, indent=1) + "\n")
    print(f"{path.stat().st_size / 1e6:.2f} MB", json.dumps(card), flush=True)


def main(
    mount: Mount, out: Path, data: list[Path] = [], scenes: int | None = None, steps: int | None = None, seed: int = 1, every: int = 1,
    only: str = "", start: Path | None = None, quantize_steps: int = QUANTIZE_STEPS, examples: int = 150,
) -> None:  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    rounds: Sequence[Round] = ROUNDS[mount]
    if steps is not None or scenes is not None:
        first = rounds[0]
        rate = START_RATE if start else first.rate
        rounds = (
            Round(seed, first.scenes if scenes is None else scenes, first.steps if steps is None else steps, rate),
        )
    if scenes == 0 and not data:
        raise ConfigError("--scenes 0 needs --data")
    shards = out / "data"
    own, held_out = read_own(data, shards, every) if data and only != "generate" else ([], [])
    if only == "generate":
        for this in rounds:
            generate(mount, shards, this.scenes, this.seed)
    # Drawing scenes takes as long as training on them, so both are done side by side.
    generator = None if only else Popen([sys.executable, *sys.argv, "--only", "generate"])
    try:
        for number in range(1, len(rounds) + 1) if only in ("", "fit") else ():
            fit(mount, shards, out, rounds[:number], own, start=start, generator=generator)
        if only in ("", "fit"):
            fit_quantized(mount, shards, out, rounds, quantize_steps, own, generator)
    finally:
        if generator is not None:
            generator.terminate()
    if only in ("", "finish"):
        finish(mount, out, rounds, quantize_steps, examples, held_out, start)
