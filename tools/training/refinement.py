"""Train the second stage of a LiDAR detector, a network on the points of boxes, on simulated clouds.

    python tools/train.py refinement roadside DIR --steps 14000                        # that which ships: half an hour of two cores
    python tools/train.py refinement vehicle A --steps 20000                           # 40 minutes; for what ships at commit e1dcbe65
    python tools/train.py refinement vehicle B --steps 6000 --start A/refinement.pt    # and goes on from there
    python tools/train.py refinement vehicle DIR --scenes 200 --steps 300              # a toy

It learns from the boxes that the first stage, the shipped network or that of --first, finds in scenes of its own seed. Generating resumes,
beside the fit in a process of its own, as does the fit. The network is left in DIR with its first stage.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
import time
from pathlib import Path
from subprocess import Popen
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from log2sim.config import LidarConfig
from log2sim.datatypes import GROUP_OF
from log2sim.geometry import Array
from log2sim.perception.detect3d.box_points import PointsOfBoxes, ramp
from log2sim.perception.detect3d.boxes import LevelBoxes
from log2sim.perception.detect3d.detectors import WEIGHTS, NetworkDetector, open_network
from log2sim.perception.detect3d.network import VERSION, level_points, viewpoints_xy
from log2sim.perception.detect3d.refinement import (
    BOX_VALUES,
    MARGIN_M,
    MAX_LOG_SIZE,
    METADATA_KEY,
    MOST_POINTS,
    OUTPUTS,
    POINT_VALUES,
    SUFFIX,
    box_inputs,
    in_box_axes,
    points_around,
    points_within,
    toward_sensor,
)
from log2sim.perception.lidar.cloud import ON_GROUND_M
from log2sim.synth.traffic import Mount
from training.clouds import CALIBRATED_KINDS, REPORTED_KINDS, STEP_M, Example, draw_example
from training.export import CATEGORIES, RAW_CALIBRATION, calibrate, describe, export_checked, report
from training.fitting import FitPlan, fit, wait_for

NAMES = [category for group in CATEGORIES.values() for category in group]
PER_SHARD = 100
STEPS_PER_SHARD = 50
BATCH = 512
RATE, START_RATE = 2e-3, 1e-3
POINTS = 64
WIDTHS = (48, 96, 128, 96)  # channels of three layers for each point, and of two for each box
# What a box is of has its center within this part of its longer side, or this far, m: a neighbor is another.
SAME_SIDES, SAME_M = 0.25, 1.0
# Points are stored this much farther out than the network looks, m, for boxes that are shifted.
STORED_M = 0.5
# Deviations of boxes in training, so that it sees more than the first stage errs by: parts of the width, rad, logarithms, m.
JITTER_WIDTHS, JITTER_RAD, JITTER_LOG_SIZE, JITTER_HEIGHT_M, JITTER_GROUND_M = 0.08, 0.06, 0.04, 0.05, 0.015
# Objects in other sizes, logarithms, with their parts elsewhere and corners inward, parts of half the size; more noise of ranges than
# simulated, m.
RESIZE_LOG_SIZE, MAX_BEND, MAX_ROUNDING, MAX_NOISE_M = 0.06, 0.15, 0.08, 0.03


def rows_of(detector: NetworkDetector, example: Example) -> dict[str, NDArray[Any]]:
    """Return the boxes that the first stage finds in an example, the points around each, and what they are of.

    All positions are relative to the centers of the boxes in the plane and to the ground in height.
    """
    xyz, _ = level_points(example.cloud, detector.range_m)
    xyz = xyz[xyz[:, 2] > ON_GROUND_M]
    found = detector.candidates(example.cloud).boxes
    around = points_around(xyz, found, MARGIN_M + STORED_M)
    some = np.flatnonzero(points_within(around, xyz, found).count > 0)
    boxes, around = found.take(some), around.take(some)
    sampled, center = around.sample(MOST_POINTS), boxes.center_m
    truth = example.truth
    groups = detector.network.info.groups
    of_group = [GROUP_OF.get(c) for c in truth.category.tolist()]
    group = np.array([groups.index(g) if g in groups else -1 for g in of_group], np.intp)
    # The last is that of a box without an object.
    category = np.array([NAMES.index(c) if c in NAMES else -1 for c in (*truth.category.tolist(), "")], np.int8)
    distance = np.hypot(*(center[:, None, :2] - truth.box[:, :2]).T).T
    reach = np.maximum(SAME_M, SAME_SIDES * truth.box[:, 3:5].max(axis=1, initial=0.0))
    # People and riders are confused: a box is of an object of the other group, too, of a size within reach, if none of its own is there.
    changed = np.abs(np.log(truth.box[:, 3:5] / boxes.size_m[:, None, :2])).max(axis=2, initial=0.0)
    same, slim = group == boxes.group[:, None], [k for k, name in enumerate(groups) if name != "vehicle"]
    swapped = np.isin(group, slim) & np.isin(boxes.group, slim)[:, None] & (changed < MAX_LOG_SIZE)
    near = (distance <= reach) & (same | swapped)
    away = np.where(near, distance + np.where(same, 0.0, 2 * reach), np.inf)
    of = away.argmin(axis=1) if len(truth) else np.zeros(len(some), np.intp)
    matched = np.isfinite(away.min(axis=1, initial=np.inf))
    # What is too small a part of an object, or of no group, is neither right nor wrong.
    unclear = ((distance <= 2 * reach) & truth.ignored).any(axis=1)
    if len(truth):
        unclear &= ~matched | truth.ignored[of]
    target = np.zeros((len(some), 7))
    target[matched] = truth.box[of[matched]]
    target[matched, :3] -= np.column_stack([center[matched, :2], example.ground_m[of[matched]]])
    points = xyz[sampled.point].copy()
    points[:, :2] -= center[sampled.box, :2].astype(np.float32)
    return {
        "points": np.rint(points / STEP_M).astype(np.int16),
        "stored": sampled.count.astype(np.int32),
        "counts": around.count.astype(np.int32),
        "box": np.column_stack([center[:, 2], boxes.size_m, boxes.yaw_rad, boxes.heading_score, boxes.heat, boxes.quality]).astype(np.float32),
        "group": boxes.group.astype(np.int8),
        "category": category[np.where(matched, of, -1)],
        "toward": toward_sensor(boxes, viewpoints_xy(example.cloud)).astype(np.float32),
        "truth": target.astype(np.float32),
        "matched": matched,
        "unclear": unclear,
    }  # fmt: skip


def shard_path(out: Path, mount: str, seed: int, shard: int) -> Path:
    return out / "data" / f"boxes-{mount}-{seed}-{shard:04d}.npz"


def generate(mount: Mount, first: Path, out: Path, scenes: int, seed: int) -> None:
    """Draw scenes and write the boxes of the first stage into shards; those that are there already are kept."""
    detector = open_network(first, LidarConfig(), name=mount)
    (out / "data").mkdir(exist_ok=True)
    for shard in range(math.ceil(scenes / PER_SHARD)):
        path = shard_path(out, mount, seed, shard)
        if path.exists():
            continue
        begun = time.process_time()
        seeds = [(seed, shard, k) for k in range(PER_SHARD)]
        rows = [rows_of(detector, draw_example(mount, s, CALIBRATED_KINDS | REPORTED_KINDS)) for s in seeds]
        temporary = path.with_suffix(".part.npz")
        np.savez(temporary, **{name: np.concatenate([row[name] for row in rows]) for name in rows[0]})
        temporary.replace(path)
        print(f"{path.name}: {(time.process_time() - begun) / PER_SHARD * 1e3:.0f} ms of CPU a scene", flush=True)


def drawn(shard: dict[str, NDArray[Any]], rows: NDArray[np.intp], rng: np.random.Generator) -> tuple[Tensor, ...]:
    """Draw inputs and targets of some boxes of a shard, mirrored, in other proportions, partly hidden and shifted at random.

    Returns points (B, n, 7) and box (B, 15) as `box_inputs`, target (B, 9) as `targets_of`; size (B, 2), m, of the truth; category (B,): number of
    its category, from 1 on, 0 for no road user; weight (B,), 0 or 1.
    """
    count, n = len(rows), shard["stored"][rows]
    pair = np.repeat(np.arange(count), n)
    start = np.cumsum(shard["stored"]) - shard["stored"]
    xyz = shard["points"][np.repeat(start[rows], n) + ramp(n)] * np.float32(STEP_M)
    z, length, width, height, yaw, sure, heat, quality = shard["box"][rows].astype(np.float64).T
    truth, toward = shard["truth"][rows].astype(np.float64), shard["toward"][rows].astype(np.float64)
    matched, weight = shard["matched"][rows], ~shard["unclear"][rows]
    center, size, none = np.column_stack([0 * z, 0 * z, z]), np.stack([length, width, height], axis=1), np.zeros(count)
    truth[~matched] = np.column_stack([center, size, yaw])[~matched]
    side = np.where(rng.random(count) < 0.5, -1.0, 1.0)
    for values in (xyz, truth, toward):
        values[:, 1] *= side[pair] if values is xyz else side
    yaw, truth[:, 6] = side * yaw, side * truth[:, 6]
    center = reshaped(xyz, pair, truth, center, rng)
    size = size * truth[:, 3:6] / np.where(matched[:, None], shard["truth"][rows, 3:6], size)
    xyz += rng.uniform(0, MAX_NOISE_M, count)[pair, None] * rng.normal(0, 1, xyz.shape)
    off = rng.random(count) < 0.7
    yaw = yaw + off * rng.normal(0, JITTER_RAD, count)
    size = size * np.exp(off[:, None] * rng.normal(0, JITTER_LOG_SIZE, (count, 3)))
    center[:, :2] += off[:, None] * rng.normal(0, JITTER_WIDTHS, (count, 2)) * width[:, None]
    center[:, 2] += off * rng.normal(0, JITTER_HEIGHT_M, count)
    xyz[:, 2] += rng.normal(0, JITTER_GROUND_M, count)[pair]
    group = shard["group"][rows].astype(np.intp)
    boxes = LevelBoxes(center, size, yaw, sure, group, none.astype(np.str_), heat, quality)
    pairs = PointsOfBoxes(pair, np.arange(len(pair)), count)
    offset = in_box_axes(xyz, pairs, boxes)
    chosen = (np.abs(offset[:, :2]) <= size[pair, :2] / 2 + MARGIN_M).all(axis=1)
    # Half the boxes lose points anywhere, a third those of one side.
    share = np.where(rng.random(count) < 0.5, 1.0, rng.uniform(0.3, 1.0, count))
    angle = rng.uniform(-np.pi, np.pi, count)
    least = np.where(rng.random(count) < 0.33, rng.uniform(-0.9, 0.0, count), -np.inf)
    x, y = (offset[:, :2] / (size[pair, :2] / 2)).T
    chosen &= (rng.random(len(pair)) < share[pair]) & (x * np.cos(angle)[pair] + y * np.sin(angle)[pair] > least[pair])
    chosen[(np.cumsum(n) - n)[np.bincount(pair, chosen, minlength=count) == 0]] = True
    # In another order each time, so that the network takes other points.
    order = np.lexsort((rng.random(len(pair)), pair))
    order = order[chosen[order]]
    pairs = PointsOfBoxes(pair[order], order, count)
    counts = np.maximum(np.rint(shard["counts"][rows] * pairs.count / n), 1).astype(np.int64)
    values, of_box = box_inputs(xyz, pairs, counts, boxes, toward - center[:, :2], POINTS)
    arrays = (values, of_box, targets_of(boxes, truth), truth[:, 3:5], shard["category"][rows] + 1, weight)
    return tuple(torch.from_numpy(np.ascontiguousarray(v, np.float32)) for v in arrays)


def reshaped(
    xyz: NDArray[np.float32], pair: NDArray[np.intp], truth: Array, center: Array, rng: np.random.Generator
) -> Array:
    """Give objects other sizes, proportions and rounder sides, in place, and return where the centers (B, 3) of their boxes are then.

    `xyz`: (K, 3), of the objects `pair` (K,), whose boxes are `truth` (B, 7). Wheels and windscreens of simulated cars are at parts of the
    length that are always alike, and their ends are flat: a network would infer the length from them, and be wrong about other cars. What is around an
    object keeps its distance.
    """
    count = len(truth)
    c, s = np.cos(truth[:, 6]), np.sin(truth[:, 6])
    half = np.column_stack([truth[:, 3:5] / 2, truth[:, 5]])
    factor = np.exp(rng.normal(0, RESIZE_LOG_SIZE, (count, 3)))
    bend, pull = rng.uniform(-MAX_BEND, MAX_BEND, (2, count, 3))
    rounding = rng.uniform(0, MAX_ROUNDING, (count, 4)) * [1, 1, 2, 2]
    widest = rng.uniform(0.2, 0.7, (count, 1))
    base = truth[:, :3] - [0, 0, 1] * truth[:, 5:6] / 2

    def moved(points: Array, of: Any) -> Array:
        dx, dy, dz = (points - base[of]).T
        along = np.stack([dx * c[of] + dy * s[of], dy * c[of] - dx * s[of], dz], axis=1)
        u = along / half[of]
        inner = np.clip(u, -1, 1)
        # Ends stay ends, what is between moves: monotonic for |bend| and |pull| below a quarter.
        warped = inner + (1 - inner**2) * (bend[of] + pull[of] * inner)
        warped[:, 2] = inner[:, 2]
        # Ends and sides reach their box only in the middle and at one height.
        across, high = warped[:, 1::-1] ** 2, (inner[:, 2:] - widest[of]) ** 2
        warped[:, :2] *= 1 - rounding[of, :2] * across - rounding[of, 2:] * high
        x, y, z = ((warped * factor[of] + u - inner) * half[of]).T
        return np.stack([x * c[of] - y * s[of], x * s[of] + y * c[of], z], axis=1) + base[of]

    xyz[:] = moved(xyz.astype(np.float64), pair)
    truth[:, 3:6] *= factor
    truth[:, 2] = base[:, 2] + truth[:, 5] / 2
    dx, dy, dz = (center - base).T
    x, y, z = (np.stack([dx * c + dy * s, dy * c - dx * s, dz], axis=1) * factor).T
    return np.stack([x * c - y * s, x * s + y * c, z], axis=1) + base


def targets_of(boxes: LevelBoxes, truth: Array) -> Array:
    """Return what makes boxes the true ones (B, 7): shift in their axes, m, logarithms of factors of the size, sine and cosine of twice the turn,
    1 where front and back are right and 0 where not.
    """
    x, y, up = (truth[:, :3] - boxes.center_m).T
    c, s, turn = np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad), truth[:, 6] - boxes.yaw_rad
    log_size = np.log(truth[:, 3:6] / boxes.size_m)
    forward = np.cos(turn) > 0
    return np.column_stack([x * c + y * s, y * c - x * s, up, log_size, np.sin(2 * turn), np.cos(2 * turn), forward])


class RefinementNetwork(nn.Module):
    """Layers for each point, the maximum over the points of a box, and layers for the box (Qi et al., CVPR 2017)."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = WIDTHS
        self.first, self.of_box = nn.Linear(POINT_VALUES, a, bias=False), nn.Linear(BOX_VALUES, a, bias=False)
        self.points = nn.Sequential(
            nn.BatchNorm1d(a), nn.ReLU(), nn.Linear(a, b, bias=False), nn.BatchNorm1d(b), nn.ReLU(),
            nn.Linear(b, c, bias=False), nn.BatchNorm1d(c), nn.ReLU(),
        )  # fmt: skip
        self.boxes = nn.Sequential(
            nn.Linear(c + BOX_VALUES, d, bias=False), nn.BatchNorm1d(d), nn.ReLU(),
            nn.Linear(d, d, bias=False), nn.BatchNorm1d(d), nn.ReLU(), nn.Linear(d, len(NAMES) + OUTPUTS),
        )  # fmt: skip

    def forward(self, points: Tensor, box: Tensor) -> Tensor:
        """Map points (B, n, 7) and values of boxes (B, 15) to logits of categories and corrections (B, 6 + 10)."""
        x = self.first(points) + self.of_box(box)[:, None]
        x = self.points(x.flatten(0, 1)).unflatten(0, points.shape[:2]).amax(dim=1)
        return self.boxes(torch.cat([x, box], dim=1))


def loss_of(
    out: Tensor, target: Tensor, size: Tensor, category: Tensor, weight: Tensor
) -> tuple[Tensor, dict[str, float]]:
    """Return the loss of logits and corrections (B, 16) and its parts."""
    logits, out = out[:, : len(NAMES)], out[:, len(NAMES) :]
    right = (category > 0) * weight

    def mean(loss: Tensor, over: Tensor = right) -> Tensor:
        return (loss * over).sum() / over.sum().clamp(min=1)

    off = (out[:, :8] - target[:, :8]).abs()
    with torch.no_grad():
        overlap = overlap_of(out, target, size)
    entropy = F.binary_cross_entropy_with_logits
    parts = {
        "object": 2 * mean(F.cross_entropy(F.pad(logits, (1, 0)), category.long(), reduction="none"), weight),
        "place": mean(off[:, :2].sum(1) / size[:, 1].clamp(min=0.3)),
        "height": mean(off[:, 2]),
        "size": mean(off[:, 3:6].sum(1)),
        "axis": 0.5 * mean(off[:, 6:8].sum(1)),
        "direction": 0.3 * mean(entropy(out[:, 8], target[:, 8], reduction="none")),
        "quality": 0.5 * mean(entropy(out[:, 9], overlap, reduction="none")),
    }
    return torch.stack(list(parts.values())).sum(), {name: float(value.detach()) for name, value in parts.items()}


def overlap_of(out: Tensor, target: Tensor, size: Tensor) -> Tensor:
    """Return the IoU (B,) of the corrected and the true rectangle, as if both had the true heading, times how well that is met."""
    shared, area = torch.ones_like(out[:, 0]), torch.ones_like(out[:, 0])
    for axis in range(2):
        true, away = size[:, axis], (out[:, axis] - target[:, axis]).abs()
        own = true * (out[:, 3 + axis] - target[:, 3 + axis]).clamp(-2, 2).exp()
        low, high = torch.maximum(-true / 2, away - own / 2), torch.minimum(true / 2, away + own / 2)
        shared = shared * (high - low).clamp(min=0)
        area = area * own
    aligned = (out[:, 6:8] * target[:, 6:8]).sum(1) / out[:, 6:8].norm(dim=1).clamp(min=1e-3)
    return shared / (area + size.prod(1) - shared).clamp(min=1e-3) * aligned.clamp(0, 1)


def train(
    mount: str, out: Path, scenes: int, plan: FitPlan, generator: Popen[bytes] | None, start: Path | None
) -> dict[str, Tensor]:
    """Fit the network to the shards, of which each step may use as many as its number allows; waits for those that are being made.

    It goes on from the means of the checkpoint `start`, if one is given.
    """
    torch.manual_seed(plan.seed)
    network = RefinementNetwork()
    if start is not None:
        network.load_state_dict(torch.load(start, weights_only=True)["mean"])
    shards: list[dict[str, NDArray[Any]]] = []

    def step_loss(network: nn.Module, rng: np.random.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        while len(shards) < min(math.ceil(scenes / PER_SHARD), 4 + step // STEPS_PER_SHARD):
            with np.load(wait_for(shard_path(out, mount, plan.seed, len(shards)), generator)) as data:
                shards.append({name: data[name] for name in data.files})
        shard = shards[rng.integers(len(shards))]
        # Objects twice as often as what is none.
        chance = np.where(shard["matched"], 2.0, 1.0)
        rows = rng.choice(len(chance), min(BATCH, len(chance)), replace=False, p=chance / chance.sum())
        points, box, *targets = drawn(shard, rows, rng)
        return loss_of(network(points, box), *targets)

    return fit(network, step_loss, plan)


def finish(
    mount: Mount, first: Path, out: Path, weights: dict[str, Tensor], card: dict[str, Any], examples: int
) -> None:
    """Export next to the first stage, calibrate and report."""
    network = RefinementNetwork()
    network.load_state_dict(weights)
    own, generator = out / f"{mount}.onnx", torch.Generator().manual_seed(0)
    if first.resolve() != own.resolve():
        shutil.copyfile(first, own)
    path = own.with_suffix(SUFFIX)
    checked = {
        "points": torch.rand((3, POINTS, POINT_VALUES), generator=generator),
        "box": torch.rand((3, BOX_VALUES), generator=generator),
    }
    axes = {name: {0: "boxes"} for name in (*checked, "corrections")}
    export_checked(network.eval(), path, checked, ("corrections",), axes, bits=16)
    info = {
        "version": VERSION,
        "groups": list(CATEGORIES),
        "calibration": dict.fromkeys(CATEGORIES, RAW_CALIBRATION),
        "card": card,
    }
    describe(path, info, METADATA_KEY)
    calibrated = [draw_example(mount, (card["seed"], 1_000_000, k), REPORTED_KINDS) for k in range(examples)]
    info["calibration"] = calibrate(own, calibrated)
    describe(path, info, METADATA_KEY)
    detector = open_network(own, LidarConfig(), name=mount)
    tested = [draw_example(mount, (card["seed"], 2_000_000, k)) for k in range(examples)]
    card = card | {"simulated": report(detector, tested, range_m=detector.range_m)}
    path.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")
    print(f"{path.stat().st_size / 1e6:.2f} MB", json.dumps(card), flush=True)


def main(
    mount: Mount, out: Path, scenes: int = 8000, steps: int = 20_000, seed: int = 47, first: Path | None = None,
    start: Path | None = None, examples: int = 150, only_generate: bool = False,
) -> None:  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    # Without the second stage that may be there already.
    bare = out / "first.onnx"
    if not bare.exists():
        shutil.copyfile(first or WEIGHTS / f"{mount}.onnx", bare)
    if only_generate:
        generate(mount, bare, out, scenes, seed)
        return
    generator = Popen([sys.executable, *sys.argv, "--only-generate"])
    try:
        plan = FitPlan(steps, seed, RATE if start is None else START_RATE, out / "refinement.pt", 100)
        weights = train(mount, out, scenes, plan, generator, start)
    finally:
        generator.terminate()
    card = {
        "mount": mount,
        "seed": seed,
        "scenes": scenes,
        "steps": steps,
        "rate": plan.peak_rate,
        "batch": BATCH,
        "widths": WIDTHS,
        "torch": torch.__version__,
    }
    if start is not None:
        before = json.loads((start.parent / f"{mount}.boxes.json").read_text())
        card["start"] = {key: value for key, value in before.items() if key != "simulated"}
    finish(mount, bare, out, weights, card, examples)
