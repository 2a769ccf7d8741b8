"""Train the network of Zou et al. (2021), a roadside LiDAR's, on shards of tools/train_lidar.py, and export it.

pip install 'log2sim[train]'
python tools/train_lidar.py roadside --out DIR --only generate
python tools/train_lidar.py zou2021 --data DIR/data --out OUT --steps 1500
log2sim reconstruct LOG --detector lidar:OUT/zou2021.onnx --set lidar.decode=votes
"""

from __future__ import annotations

from pathlib import Path

import torch
from entry import parser_of
from lidar_training.fitting import FitPlan, fit

from zou2021.network import Mixture, Zou2021Network, export_zou2021, shards_in, zou2021_loss

PEAK_RATE = 2e-3


def train(data: list[Path], out: Path, *, steps: int, seed: int, start: Path | None, share: float = 1.0) -> Path:
    """Train, or go on from the checkpoint in `out`, and export the averaged weights; returns the ONNX file."""
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(seed)
    network = Zou2021Network(share).to(memory_format=torch.channels_last)
    if start is not None:
        network.load_state_dict(torch.load(start, weights_only=True)["mean"])
    mixture = Mixture(shards_in(data))
    plan = FitPlan(steps, seed, PEAK_RATE, out / "checkpoint.pt")
    mean = fit(network, lambda n, rng, _: zou2021_loss(n, mixture.draw(rng), rng), plan)
    network.load_state_dict(mean)
    path = out / "zou2021.onnx"
    export_zou2021(
        network, path, {"steps": steps, "seed": seed, "share": share, "samples": sum(map(len, mixture.simulated))}
    )
    return path


def main(arguments: list[str] | None = None) -> None:
    """Read the command line and train."""
    parser = parser_of(__doc__)
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="folders of shards")
    parser.add_argument("--out", type=Path, required=True, help="folder of the checkpoint and the ONNX file")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--share", type=float, default=1.0, help="share of the paper's channels")
    parser.add_argument("--start", type=Path, help="checkpoint of another run to start from")
    options = parser.parse_args(arguments)
    path = train(
        options.data, options.out, steps=options.steps, seed=options.seed, start=options.start, share=options.share
    )
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
