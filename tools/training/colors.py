"""Train the network that names the colors of vehicles on rendered pictures: draw, fit, calibrate, report, in one command that resumes.

pip install 'log2sim[train]'
python tools/train.py colors DIR                                # everything, with the settings of the shipped weights
python tools/train.py colors DIR --worlds 2000 --steps 500      # a toy
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from log2sim.datatypes import COLOR_NAMES
from log2sim.evaluation.metrics.correctness import reliability
from log2sim.road.colors import LAB_SCALE, METADATA_KEY, SIDE_PX, ColorNetwork, open_color_network
from training import fitting
from training.color_pictures import draw_shape, draw_view, draw_world
from training.export import describe, export_checked
from training.fitting import FitPlan, draw_once
from training.network import conv

WORLDS, STEPS, BATCH, RATE = 80_000, 20_000, 64, 3e-3
PER_FILE, SHAPES_PER_FILE = 2_000, 150
NETWORKS = 3
TRACKS, VIEWS = 600, 4  # to calibrate with, and as many to report
LAB_WEIGHT = 0.5
PARTS = {"train": 0, "tune": 1, "report": 2}  # parts of the seed: other shapes, paints and lights in each


def draw(out: Path, part: str, number: int, worlds: int, views: int, seed: int) -> Path:
    """Draw pictures of worlds into a file, which is kept."""

    def rows() -> Iterator[dict[str, Any]]:
        rng = np.random.default_rng([seed, PARTS[part], number])
        shapes = [draw_shape(rng) for _ in range(SHAPES_PER_FILE)]
        for _ in range(worlds):
            world = draw_world(rng)
            pictures = [draw_view(world, shapes[int(rng.integers(len(shapes)))], rng) for _ in range(views)]
            yield {"picture": pictures, "name": COLOR_NAMES.index(world.name), "lab": world.lab, "light": world.light}

    return draw_once(out / f"{part}-{seed}-{number:03d}.npz", rows())


class Names(nn.Module):
    """Logits of the names and the color in CIELAB (B, 13) of pictures (B, 3, 48, 48), RGB from 0 to 1; where to look is learned too."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(
            conv(3, 24, stride=2), conv(24, 24, 1), conv(24, 40, stride=2), conv(40, 40, 1), conv(40, 52, stride=2), conv(52, 52)
        )  # fmt: skip
        self.where = nn.Conv2d(52, 1, 1)
        self.mixed = nn.Conv2d(3 * 52, 64, 1)
        self.head = nn.Conv2d(64, len(COLOR_NAMES) + 3, 1)

    def forward(self, picture: Tensor) -> Tensor:
        features = self.body(picture * 2 - 1)
        share = torch.softmax(self.where(features).flatten(2), dim=2)
        seen = (features.flatten(2) * share).sum(dim=2)
        pooled = torch.cat([seen, features.mean(dim=(2, 3)), features.amax(dim=(2, 3))], dim=1)[..., None, None]
        return self.head(torch.relu(self.mixed(pooled))).flatten(1)


def jittered(x: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Change tones, black level, saturation and white balance of pictures (B, 48, 48, 3): cameras process theirs in ways that no renderer knows."""
    one = (len(x), 1, 1, 1)
    gray = x.mean(axis=-1, keepdims=True)
    x = np.clip(gray + np.exp(rng.normal(0, 0.2, one)) * (x - gray), 0, 1) ** np.exp(rng.normal(0, 0.2, one))
    lift = rng.uniform(0, 0.1, one)
    return np.clip(lift + (1 - lift) * x * np.exp(rng.normal(0, 0.05, (len(x), 1, 1, 3))), 0, 1).astype(np.float32)


class Mean(nn.Module):
    """Mean of networks that began with other weights: on pictures unlike those of training they err apart (Lakshminarayanan et al., NeurIPS 2017)."""

    def __init__(self, networks: list[nn.Module]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)

    def forward(self, picture: Tensor) -> Tensor:
        return torch.stack([network(picture) for network in self.networks]).mean(dim=0)


def fit(paths: list[Path], out: Path, steps: int, seed: int) -> nn.Module:
    """Fit networks to the pictures of some files, or go on from their checkpoints, and return their mean."""
    files = [np.load(path) for path in paths]
    pictures = np.concatenate([f["picture"].reshape(-1, SIDE_PX, SIDE_PX, 3) for f in files])
    name, lab = np.concatenate([f["name"] for f in files]), np.concatenate([f["lab"] for f in files])

    def step_loss(network: nn.Module, rng: np.random.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        rows = rng.integers(0, len(pictures), BATCH)
        x = pictures[rows][..., ::-1].astype(np.float32) / 255
        flip = rng.random(BATCH) < 0.5
        x[flip] = x[flip, :, ::-1]
        shift = rng.integers(-3, 4, 2)
        x = jittered(np.roll(x, shift, axis=(1, 2)), rng)
        out = network(torch.from_numpy(np.ascontiguousarray(x.transpose(0, 3, 1, 2))))
        truth = torch.from_numpy(name[rows])
        logits, color = out[:, : len(COLOR_NAMES)], out[:, len(COLOR_NAMES) :]
        named = nn.functional.cross_entropy(logits, truth)
        away = nn.functional.smooth_l1_loss(color, torch.from_numpy((lab[rows] / LAB_SCALE).astype(np.float32)))
        right = (logits.argmax(dim=1) == truth).float().mean()
        return named + LAB_WEIGHT * away, {"names": named.item(), "lab": away.item(), "right": right.item()}

    networks = list[nn.Module]()
    for k in range(NETWORKS):
        torch.manual_seed(seed + k)
        network = Names().to(memory_format=torch.channels_last)
        plan = FitPlan(steps, seed + k, RATE, out / f"colors-{k}.pt", 100)
        network.load_state_dict(fitting.fit(network, step_loss, plan))
        networks.append(network)
    return Mean(networks).eval()


def calibrate(network: ColorNetwork, path: Path) -> tuple[float, float]:
    """Return what logits of a picture are multiplied by, and the power of their number that the sum over pictures is divided by, by
    the likelihood of the names."""
    data = np.load(path)
    logits = np.stack([network.raw(list(track))[:, : len(COLOR_NAMES)] for track in data["picture"]])

    def loss(scale: float, power: float, views: int) -> float:
        joined = scale * logits[:, :views].sum(axis=1) / views**power
        joined -= joined.max(axis=1, keepdims=True)
        log = joined - np.log(np.exp(joined).sum(axis=1, keepdims=True))
        return float(-log[np.arange(len(log)), data["name"]].mean())

    scale = min(np.arange(0.4, 1.6, 0.05), key=lambda s: loss(s, 1.0, 1))
    power = min(np.arange(0.0, 1.01, 0.1), key=lambda p: loss(scale, p, VIEWS))
    return round(float(scale), 2), round(float(power), 1)


def report(network: ColorNetwork, path: Path) -> dict[str, object]:
    """Measure names on pictures, by light, and on tracks."""
    data = np.load(path)
    single = np.array([network.decide(network.raw([track[0]]))[1] for track in data["picture"]])
    joined = np.array([network.decide(network.raw(list(track)))[1] for track in data["picture"]])
    rank = (single > np.take_along_axis(single, data["name"][:, None], 1)).sum(axis=1)
    sure, right = single.max(axis=1), rank == 0
    return {
        "pictures": len(rank), "top1": share(right), "top2": share(rank < 2),
        "top1_by_light": {str(k): share(right[data["light"] == k]) for k in np.unique(data["light"])},
        "top1_by_name": {k: share(right[data["name"] == i]) for i, k in enumerate(COLOR_NAMES)},
        f"top1_of_{VIEWS}_views": share(joined.argmax(axis=1) == data["name"]), "calibration_error": round(reliability(sure, right)["expected_calibration_error"], 4),
    }  # fmt: skip


def share(right: NDArray[np.bool_]) -> float:
    """Return the share of right names, rounded."""
    return round(float(right.mean()), 4)


def main(out: Path, worlds: int = WORLDS, steps: int = STEPS, seed: int = 1) -> None:
    """Run the steps in a folder of pictures, checkpoint and results."""
    out.mkdir(parents=True, exist_ok=True)
    each = min(PER_FILE, worlds)
    paths = [draw(out, "train", k, each, 1, seed) for k in range(worlds // each)]
    tune, test = (draw(out, part, 0, min(TRACKS, each), VIEWS, seed) for part in ("tune", "report"))
    begun = time.process_time()
    network, path = fit(paths, out, steps, seed), out / "colors.onnx"
    inputs = {"picture": torch.rand((2, 3, SIDE_PX, SIDE_PX), generator=torch.Generator().manual_seed(0))}
    axes = {"picture": {0: "batch"}, "names": {0: "batch"}}
    export_checked(network, path, inputs, ("names",), axes, bits=16)
    info = {"version": 1, "scale": 1.0, "power": 1.0}
    describe(path, info, METADATA_KEY)
    info["scale"], info["power"] = calibrate(open_color_network(path), tune)
    describe(path, info, METADATA_KEY)
    card = {
        "seed": seed, "worlds": worlds, "networks": NETWORKS, "steps": steps, "batch": BATCH, "rate": RATE, "torch": torch.__version__,
        "cpu_s": round(time.process_time() - begun), "calibration": info, "simulated": report(open_color_network(path), test),
    }  # fmt: skip
    (out / "colors.json").write_text(json.dumps(card, indent=1) + "\n")
    print(f"{path.stat().st_size / 1e3:.0f} kB", json.dumps(card), flush=True)
