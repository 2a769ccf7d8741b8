"""Train a network that finds paint in maps of the ground on drawn maps: draw, fit, report, in one command that resumes.

pip install 'log2sim[train]'
python tools/train_lanes.py DIR                                # everything: a quarter of an hour of one core
python tools/train_lanes.py DIR --files 1 --steps 200          # a toy

It writes DIR/paint.onnx and its card DIR/paint.json. log2sim itself finds markings by rules (`log2sim/road/ridges.py`).
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from entry import run
from lane_training.maps import CELL_M, KINDS, SIDE, UNKNOWN_DIRECTION, draw_map
from lidar_training import fitting
from lidar_training.export import describe, export_checked
from lidar_training.fitting import FitPlan, draw_once
from numpy.typing import NDArray
from torch import Tensor, nn

from log2sim.road.ground_map import GroundMap
from log2sim.road.ridges import iterate_tiles

FILES, MAPS_PER_FILE, STEPS, BATCH, RATE = 14, 200, 16_000, 6, 3e-3
PARTS = {"train": 0, "report": 2}  # parts of the seed
HALF, CROP = SIDE // 2, 128  # coarse cells along the edge of a map, and of the part of it that a step takes
LAYERS, STEPS_PER_UNIT = 7, 31.0  # maps are stored in steps of their layers
AROUND_CELLS = 81  # of 0.1 m: edge of the square whose mean is subtracted
HEIGHT_SCALE_M = 0.1
MIN_COVER = 0.3  # share of a coarse cell that is painted
# Paint is on one cell in 30.
PAINT_WEIGHT, IGNORED = 2.0, 255
# Contrast of half a meter of paint: in its standard errors, and the least noise, as logarithms.
MIN_CONTRAST_SIGMAS, MIN_SIGMA = 4.0, 0.05
METADATA_KEY = "log2sim.paint"


def draw(out: Path, part: str, number: int, maps: int, seed: int) -> Path:
    """Draw maps into a file, which is kept."""

    def rows() -> Iterator[dict[str, NDArray[np.generic]]]:
        rng = np.random.default_rng([seed, PARTS[part], number])
        for _ in range(maps):
            ground, kind, direction = draw_map(rng)
            layers = np.rint(layers_of(ground) * STEPS_PER_UNIT).astype(np.int8)
            kind, direction = coarsen(kind, direction)
            yield {"layers": layers, "kind": leave_out_unseen(layers, kind), "direction": direction}

    return draw_once(out / f"{part}-{seed}-{number:03d}.npz", rows())


def layers_of(ground: GroundMap) -> NDArray[np.float32]:
    """Compute what the network sees of a map that is one tile, in coarse cells: (7, R, C).

    Contrast of paint to the surroundings; how much brighter and darker than that the brightest and darkest cell of the map is; the
    share that cameras saw; contrast of intensity; where LiDAR hit; height over the surroundings.
    """
    rows, columns = (size // 2 for size in ground.alpha.shape)
    out = np.zeros((LAYERS, rows, columns), np.float32)
    for tile in iterate_tiles(ground, 0):
        out[3], out[5] = tile.seen, tile.hit
        out[0] = contrast(tile.paint, tile.seen) * 2
        out[1], out[2] = (tile.peak - tile.paint) * 4, (tile.paint - tile.dip) * 4
        out[4] = contrast(tile.intensity, tile.hit)
    known = np.isfinite(ground.height_m).astype(np.float32)
    height, share = (
        cv2.resize(a, (columns, rows), interpolation=cv2.INTER_AREA) for a in (np.nan_to_num(ground.height_m), known)
    )
    height = np.divide(height, share, out=np.zeros_like(height), where=share > 0)
    out[6] = contrast(height, share) / HEIGHT_SCALE_M
    return np.clip(out, -4, 4)


def contrast(values: NDArray[np.float32], valid: NDArray[np.float32]) -> NDArray[np.float32]:
    """Subtract the mean around; 0 where nothing is known."""
    share, total = (cv2.blur(a, (AROUND_CELLS, AROUND_CELLS)) for a in (valid, values * valid))
    mean = np.divide(total, share, out=np.zeros_like(values), where=share > 1e-6)
    return np.where(valid > 0, values - mean, 0).astype(np.float32)


def coarsen(kind: NDArray[np.uint8], direction: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the kind (R / 2, C / 2) of paint on squares of 2 x 2 cells, and its direction."""
    four, angle = (a.reshape(HALF, 2, HALF, 2).transpose(0, 2, 1, 3).reshape(HALF, HALF, 4) for a in (kind, direction))
    best, on = np.argmax(four > 0, axis=2)[..., None], (four > 0).mean(axis=2) > MIN_COVER
    first, turned = (np.take_along_axis(a, best, 2)[..., 0] for a in (four, angle))
    return np.where(on, first, 0).astype(np.uint8), np.where(on, turned, UNKNOWN_DIRECTION).astype(np.uint8)


def leave_out_unseen(layers: NDArray[np.int8], kind: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the kinds (R, C) with `IGNORED` where paint stands out neither in color nor in intensity within half a meter.

    A network that is asked for paint that nothing shows learns to guess where roads usually have it.
    """
    paint, clear = (kind > 0).astype(np.float32), np.zeros(kind.shape, bool)
    bare = 1 - cv2.dilate(paint, np.ones((3, 3)))
    for values, known in ((layers[0], layers[3] > 0), (layers[4], layers[5] > 0)):
        value = values.astype(np.float32) / np.float32(STEPS_PER_UNIT)
        n, total = (cv2.blur(a * known, (9, 9), borderType=cv2.BORDER_REPLICATE) * 81 for a in (paint, paint * value))
        beside = [cv2.blur(a * known, (7, 7)) * 49 for a in (bare, bare * value, bare * value * value)]
        # One side is enough: beyond a line there may be a pavement that is as bright.
        for shift, axis in ((5, 0), (-5, 0), (5, 1), (-5, 1)):
            m, b, square = (np.roll(a, shift, axis) for a in beside)
            some = (n > 2) & (m > 10)
            mean = np.divide(b, m, out=np.zeros_like(b), where=some)
            variance = np.divide(square, m, out=np.ones_like(b), where=some) - mean**2
            above = np.divide(total, n, out=np.zeros_like(b), where=some) - mean
            clear |= some & (above * np.sqrt(n) > MIN_CONTRAST_SIGMAS * np.sqrt(np.maximum(variance, MIN_SIGMA**2)))
    return np.where((kind > 0) & ~clear, IGNORED, kind).astype(np.uint8)


class Paint(nn.Module):
    """Logits of the kinds (B, 6, H, W) and cosine and sine of twice the direction (B, 2, H / 2, W / 2) of layers (B, 7, H, W).

    A U-Net on squares of 2 x 2 cells; height and width are multiples of 16.
    """

    def __init__(self, widths: tuple[int, ...] = (16, 32, 48, 64)) -> None:
        super().__init__()

        def layer(inner: int, outer: int, stride: int = 1) -> nn.Sequential:
            return nn.Sequential(nn.Conv2d(inner, outer, 3, stride, 1, bias=False), nn.BatchNorm2d(outer), nn.ReLU())

        self.down, self.up, self.joined = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        for k, (inner, width) in enumerate(zip((4 * LAYERS, *widths), widths)):
            self.down.append(nn.Sequential(layer(inner, width, 1 if k == 0 else 2), layer(width, width)))
        for wide, width in zip(widths[:0:-1], widths[-2::-1]):
            self.up.append(nn.Sequential(nn.Conv2d(wide, width, 1, bias=False), nn.Upsample(scale_factor=2.0)))
            self.joined.append(layer(width, width))
        self.head = nn.Conv2d(widths[0], 4 * len(KINDS) + 2, 1)

    def forward(self, layers: Tensor) -> tuple[Tensor, Tensor]:
        x, seen = nn.functional.pixel_unshuffle(layers, 2), []
        for down in self.down:
            x = down(x)
            seen.append(x)
        for up, joined, other in zip(self.up, self.joined, seen[-2::-1]):
            x = joined(up(x) + other)
        out = self.head(x)
        return nn.functional.pixel_shuffle(out[:, : 4 * len(KINDS)], 2), out[:, 4 * len(KINDS) :]


def seen_in(layers: Tensor) -> Tensor:
    """Return 1 where a sensor saw the ground, or within 0.2 m as between rings of a LiDAR, (B, H, W)."""
    seen = ((layers[:, 3] > 0) | (layers[:, 5] > 0)).float()
    return nn.functional.max_pool2d(seen[:, None], 5, 1, 2)[:, 0]


def loss_of(
    outputs: tuple[Tensor, Tensor], layers: Tensor, kind: Tensor, direction: Tensor
) -> tuple[Tensor, dict[str, float]]:
    """Cross entropy of kinds where a sensor saw the ground, and error of the direction where there is paint."""
    (kinds, turned), seen = outputs, seen_in(layers)
    weight = torch.full((len(KINDS),), PAINT_WEIGHT)
    weight[0] = 1.0
    each = nn.functional.cross_entropy(kinds, kind, weight=weight, reduction="none", ignore_index=IGNORED)
    named = (each * seen).sum() / seen.sum().clamp(min=1)
    angle, on = direction[:, ::2, ::2] * (2 * np.pi / 180), seen[:, ::2, ::2] * (direction[:, ::2, ::2] < 180)
    off = ((turned[:, 0] - angle.cos()).square() + (turned[:, 1] - angle.sin()).square()) * on
    off = off.sum() / on.sum().clamp(min=1)
    return named + off, {"kinds": named.item(), "direction": off.item()}


def fit(paths: list[Path], out: Path, steps: int, seed: int) -> nn.Module:
    """Fit the network to the maps of some files, or go on from its checkpoint."""
    files = [np.load(path) for path in paths]
    layers, kind, direction = (np.concatenate([f[key] for f in files]) for key in ("layers", "kind", "direction"))
    torch.manual_seed(seed)
    network = Paint().to(memory_format=torch.channels_last)

    def step_loss(network: nn.Module, rng: np.random.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        parts = []
        for row in rng.integers(0, len(layers), BATCH):
            r, c = rng.integers(0, (HALF - CROP) // 2 + 1, 2) * 2
            part = (slice(r, r + CROP), slice(c, c + CROP))
            x, k, a = layers[row][:, *part].astype(np.float32), kind[row][part], direction[row][part].astype(np.int64)
            if rng.random() < 0.5:
                x, k, a = (
                    x[:, :, ::-1],
                    k[:, ::-1],
                    np.where(a[:, ::-1] < 180, (180 - a[:, ::-1]) % 180, UNKNOWN_DIRECTION),
                )
            if rng.random() < 0.5:
                x, k, a = x.transpose(0, 2, 1), k.T, np.where(a.T < 180, (270 - a.T) % 180, UNKNOWN_DIRECTION)
            gain = np.ones((LAYERS, 1, 1), np.float32)
            gain[:3], gain[4] = np.exp(rng.normal(0, 0.2)), np.exp(rng.normal(0, 0.15))
            parts.append((x * gain / np.float32(STEPS_PER_UNIT), k.astype(np.int64), a))
        x, k, a = (torch.from_numpy(np.ascontiguousarray(np.stack(each))) for each in zip(*parts))
        x = x.to(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16):  # a third faster where the processor has it
            kinds, turned = network(x)
        return loss_of((kinds.float(), turned.float()), x, k, a)

    mean = fitting.fit(network, step_loss, FitPlan(steps, seed, RATE, out / "paint.pt", 100))
    network.load_state_dict(mean)
    return network.eval()


def report(network: nn.Module, path: Path) -> dict[str, object]:
    """Measure cells of maps that were not trained on: precision and recall of paint by what is more likely than not, and kinds."""
    data = np.load(path)
    right, found, true, named = np.zeros(4)
    for layers, kind in zip(data["layers"], data["kind"]):
        x = torch.from_numpy(layers[None].astype(np.float32) / np.float32(STEPS_PER_UNIT))
        with torch.no_grad():
            best = network(x)[0][0].softmax(dim=0)
        counted = (seen_in(x)[0].numpy() > 0) & (kind != IGNORED)
        paint = (best[0].numpy() < 0.5) & counted
        both = paint & (kind > 0)
        right, found, true = right + both.sum(), found + paint.sum(), true + ((kind > 0) & counted).sum()
        named += (best[1:].argmax(dim=0).numpy() + 1 == kind)[both].sum()
    return {
        "maps": len(data["kind"]), "precision": round(float(right / max(found, 1)), 4),
        "recall": round(float(right / max(true, 1)), 4), "kind_right": round(float(named / max(right, 1)), 4),
    }  # fmt: skip


def main(out: Path, *, files: int = FILES, maps: int = MAPS_PER_FILE, steps: int = STEPS, seed: int = 1) -> None:
    """Run the steps in a folder of maps, checkpoint and results, with `files` of `maps` maps each."""
    out.mkdir(parents=True, exist_ok=True)
    paths = [draw(out, "train", k, maps, seed) for k in range(files)]
    test = draw(out, "report", 0, maps, seed)
    begun = time.process_time()
    network, path = fit(paths, out, steps, seed), out / "paint.onnx"
    inputs = {"layers": torch.rand((1, LAYERS, 64, 96), generator=torch.Generator().manual_seed(0))}
    axes = {name: {0: "batch", 2: f"{name}_rows", 3: f"{name}_columns"} for name in ("layers", "kinds", "turned")}
    export_checked(network, path, inputs, ("kinds", "turned"), axes, halved=True)
    describe(path, {"version": 1, "kinds": list(KINDS), "cell_m": 2 * CELL_M}, METADATA_KEY)
    card = {
        "seed": seed, "maps": files * maps, "steps": steps, "batch": BATCH, "rate": RATE,
        "torch": torch.__version__, "cpu_s": round(time.process_time() - begun), "drawn": report(network, test),
    }  # fmt: skip
    (out / "paint.json").write_text(json.dumps(card, indent=1) + "\n")
    print(f"{path.stat().st_size / 1e3:.0f} kB", json.dumps(card), flush=True)


if __name__ == "__main__":
    run(main, __doc__)
