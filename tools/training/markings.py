"""Train the network that finds markings and borders in maps of the ground: draw pictures, fit, report, in one command that resumes.

pip install 'log2sim[train]'
python tools/fit.py line_maps MAPS --maps 270 --plain 60               # roads as maps show them; 20 minutes on two cores
python tools/fit.py line_maps HELD --maps 50 --plain 20 --first 270    # others, to calibrate and report on
python tools/train.py markings MAPS HELD DIR                           # everything; the card tells the rounds of what ships
python tools/train.py markings MAPS HELD DIR --pictures 20 --steps 50  # a toy
"""

from __future__ import annotations

import json
import multiprocessing
import pickle
import time
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import torch
import torch.nn.functional as F
from fits.line_maps import RoadMap
from fits.logistic import logistic_regression
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry
from torch import Tensor, nn

from log2sim.datatypes.scenario import BORDER_KINDS
from log2sim.errors import Log2SimError
from log2sim.road.borders import find_edges
from log2sim.road.markings import AREA_M2, find_paint
from log2sim.road.paint_network import (
    CHANNELS,
    KINDS,
    LANE_LINES,
    METADATA_KEY,
    OUTPUTS,
    find_paint_maps,
    open_markings_network,
)
from training import fitting
from training.export import describe, export_checked
from training.fitting import FitPlan
from training.map_crops import Crop, iterate_crops, picture_map
from training.network import conv

PICTURES, STEPS, BATCH, RATE = 640, 40_000, 4, 2e-3
# Crops that wait to be taken, those among which each step chooses, and how many of these are new.
WAITING, POOL, NEW_CROPS = 32, 128, 3
REPORT_CROPS = 400
# Mean log-odds of the cells of lane lines are calibrated as they are; of borders and of what has few cells they are not.
OBJECTS = ("stop_line", "crosswalk", "other", "border")
# Right is what overlaps with a true one as `log2sim evaluate` asks, and of lines and borders what is for more than half within 0.3 m of true
# ones; they count once for each 5 m. A weak prior keeps the log-odds of cells as they are.
MIN_OVERLAP = {"crosswalk": 0.5, "other": 0.2}
MIN_SHARED, REACH_M, PART_M, PRECISION = 0.5, 0.3, 5.0, 1.0
# Markings are a hundredth of all cells.
KIND_WEIGHT, BORDER_WEIGHT, AXIS_WEIGHT, WIDTH_WEIGHT = 5.0, 2.0, 0.2, 1.0
# Cells of stop lines and symbols are a ten thousandth of all, and count more; what ships is of their true share again.
RARE_WEIGHTS = {"stop_line": 5.0, "other": 5.0}


class PaintNetwork(nn.Module):
    """Logits of no marking and of each kind, of borders, direction and width of lines (B, 10, H, W) from maps (B, 12, H, W)."""

    def __init__(self, a: int = 16, b: int = 24, c: int = 32, d: int = 48) -> None:
        super().__init__()
        self.down1 = nn.Sequential(conv(CHANNELS, a), conv(a, a))
        self.down2 = nn.Sequential(conv(a, b, stride=2), conv(b, b))
        self.down4 = nn.Sequential(conv(b, c, stride=2), conv(c, c))
        # Gaps of dashed lines and the course of a road are tens of meters long (dilated convolutions: Yu & Koltun, ICLR 2016).
        self.down8 = nn.Sequential(conv(c, d, stride=2), *(conv(d, d, dilation=k) for k in (1, 2, 4, 8, 2, 1)))
        self.lateral4, self.merge4 = nn.Conv2d(d, c, 1), conv(c, c)
        self.lateral2, self.merge2 = nn.Conv2d(c, b, 1), conv(b, b)
        self.lateral1, self.merge1 = nn.Conv2d(b, a, 1), conv(a, a)
        self.head = nn.Conv2d(a, OUTPUTS, 1)
        self.up = nn.Upsample(scale_factor=2, mode="nearest")

    def forward(self, values: Tensor) -> Tensor:
        s1 = self.down1(values)
        s2 = self.down2(s1)
        s4 = self.down4(s2)
        s4 = self.merge4(s4 + self.up(self.lateral4(self.down8(s4))))
        s2 = self.merge2(s2 + self.up(self.lateral2(s4)))
        return self.head(self.merge1(s1 + self.up(self.lateral1(s2))))


def kind_weights() -> Tensor:
    """Weights (6,) of no marking and of each kind."""
    return torch.tensor([1.0, *(RARE_WEIGHTS.get(kind, 1.0) for kind in KINDS)])


class Probabilities(nn.Module):
    """What ships: probabilities in place of logits."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, values: Tensor) -> Tensor:
        logits, kinds = self.network(values), 1 + len(KINDS)
        calibrated = logits[:, :kinds] - torch.log(kind_weights())[:, None, None]
        parts = (
            torch.softmax(calibrated, dim=1),
            torch.sigmoid(logits[:, kinds : kinds + 1]),
            logits[:, kinds + 1 :],
        )
        return torch.cat(parts, dim=1)


def loss_of(
    logits: Tensor, values: Tensor, kind: Tensor, border: Tensor, line: Tensor
) -> tuple[Tensor, dict[str, float]]:
    """Return the loss in the cells that a sensor saw, and its parts."""
    kinds, seen = 1 + len(KINDS), ((values[:, 5] > 0) | (values[:, 9] > 0)).float()
    on_line = seen * ((kind > 0) & (kind <= 1 + KINDS.index("stop_line"))).float()
    count, on_lines = seen.sum() + 1, on_line.sum() + 1
    axis, width = (
        ((logits[:, kinds + 1 : kinds + 3] - line[:, :2]) ** 2).sum(dim=1),
        (logits[:, kinds + 3] - line[:, 2]).abs(),
    )
    parts = {
        "kind": KIND_WEIGHT
        * (F.cross_entropy(logits[:, :kinds], kind, kind_weights(), reduction="none") * seen).sum()
        / count,
        "border": BORDER_WEIGHT
        * (F.binary_cross_entropy_with_logits(logits[:, kinds], border, reduction="none") * seen).sum()
        / count,
        "axis": AXIS_WEIGHT * (axis * on_line).sum() / on_lines,
        "width": WIDTH_WEIGHT * (width * on_line).sum() / on_lines,
    }
    return torch.stack(list(parts.values())).sum(), {name: float(value.detach()) for name, value in parts.items()}


def tensors_of(crops: list[Crop]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Stack crops to inputs and answers."""
    values, kind, border, line = (
        torch.from_numpy(np.stack([getattr(c, name) for c in crops])) for name in ("values", "kind", "border", "line")
    )
    return values.float(), kind.long(), border.float(), line.float()


def feed(queue: Queue[Crop], paths: list[Path], seed: int) -> None:
    """Draw crops without end, in a process of its own."""
    for crop in iterate_crops(paths, seed):
        queue.put(crop)


def fit(paths: list[Path], out: Path, steps: int, seed: int, start: Path | None) -> nn.Module:
    """Fit the network, or go on from its checkpoint; crops are drawn beside."""
    queue: Queue[Crop] = multiprocessing.get_context("fork").Queue(WAITING)
    feeder = multiprocessing.get_context("fork").Process(target=feed, args=(queue, paths, seed), daemon=True)
    feeder.start()
    pool = list[Crop]()

    def step_loss(network: nn.Module, rng: np.random.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        while len(pool) < POOL:
            pool.append(queue.get())
        for k in rng.integers(0, POOL, NEW_CROPS):
            pool[k] = queue.get()
        values, *answers = tensors_of([pool[k] for k in rng.choice(POOL, BATCH, replace=False)])
        with torch.autocast("cpu", torch.bfloat16):  # 0.6 of the time where the processor has it
            logits = network(values)
        return loss_of(logits.float(), values, *answers)

    torch.manual_seed(seed)
    network = PaintNetwork()
    if start is not None:
        network.load_state_dict(torch.load(start, weights_only=True)["mean"])
    plan = FitPlan(steps, seed, RATE, out / "markings.pt", 200)
    network.load_state_dict(fitting.fit(network.to(memory_format=torch.channels_last), step_loss, plan))
    feeder.terminate()
    return network.eval()


def report(network: nn.Module, paths: list[Path], seed: int) -> dict[str, Any]:
    """Measure cells at a probability of a half on disturbed crops: precision and recall of each kind, and how far probabilities err."""
    names = ("none", *KINDS, "border")
    found, true, right, expected = (np.zeros(len(names)) for _ in range(4))
    for _, crop in zip(range(REPORT_CROPS), iterate_crops(paths, seed)):
        values, kind, border, _ = tensors_of([crop])
        seen = ((values[:, 5] > 0) | (values[:, 9] > 0))[0]
        with torch.no_grad():
            probability = Probabilities(network)(values)[0, : len(names), seen].numpy()
        answer = np.stack([kind[0][seen].numpy() == k for k in range(len(names) - 1)] + [border[0][seen].numpy() > 0])
        found, true = found + (probability > 0.5).sum(axis=1), true + answer.sum(axis=1)
        right += ((probability > 0.5) & answer).sum(axis=1)
        expected += probability.sum(axis=1)
    return {
        name: {
            "precision": _share(right[k], found[k]),
            "recall": _share(right[k], true[k]),
            "expected_over_true": _share(expected[k], true[k]),
        }
        for k, name in enumerate(names)
    }


def _share(part: float, whole: float) -> float:
    return round(float(part / max(whole, 1e-9)), 4)


def calibrate(path: Path, held: list[Path]) -> dict[str, tuple[float, float]]:
    """Fit offsets and slopes of mean log-odds by which whole markings and borders are there to what is found in maps."""
    network, rows = open_markings_network(path), {name: list[tuple[float, bool]]() for name in OBJECTS}
    for file in held:
        road: RoadMap = pickle.loads(file.read_bytes())
        maps, true = find_paint_maps(road.ground, network), {name: list[BaseGeometry]() for name in OBJECTS}
        for there in (*road.true.markings, *road.true.borders):
            true.setdefault(_object(there.kind), []).append(_shape(there.kind, there.points_m[:, :2]))
        for one in find_paint(road.ground, maps) + find_edges(road.ground, maps):
            name, shape = _object(one.kind), _shape(one.kind, one.xy)
            if name not in OBJECTS:
                continue
            if one.kind in AREA_M2:
                overlaps = [shape.intersection(there).area / shape.union(there).area for there in true[name]]
                rows[name].append((one.log_odds, max(overlaps, default=0.0) >= MIN_OVERLAP[one.kind]))
            else:
                within = shape.intersection(shapely.union_all(true[name])).area / shape.area
                rows[name] += [(one.log_odds, within > MIN_SHARED)] * (1 + round(one.length_m / PART_M))
    table = {}
    for name, pairs in rows.items():
        odds, right = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
        weights = logistic_regression(np.column_stack([np.ones(len(odds)), odds]), right, PRECISION, (0.0, 1.0))
        table[name] = (round(float(weights[0]), 2), round(float(weights[1]), 2))
    return table


def _object(kind: str) -> str:
    return "lane_line" if kind in LANE_LINES else "border" if kind in BORDER_KINDS else kind


def _shape(kind: str, xy: NDArray[np.float64]) -> BaseGeometry:
    """Return the ground that a marking covers, or that is near a line or border."""
    if kind in AREA_M2:
        return shapely.buffer(shapely.Polygon(xy), 0)  # an outline that crosses itself is none of its loops twice
    return shapely.LineString(xy).buffer(REACH_M)


def draw_pictures(out: Path, count: int, seed: int) -> list[Path]:
    """Draw pictures of roads, which are kept."""
    paths = []
    for index in range(count):
        path = out / f"{seed}-picture-{index:04d}.pkl"
        try:
            if not path.exists():
                part = path.with_suffix(".part")
                part.write_bytes(pickle.dumps(picture_map(10_000 * seed + index), protocol=5))
                part.replace(path)
        except Log2SimError as error:  # a road that the scene file's limits rule out
            print(f"{path.name} left out: {error}", flush=True)
            continue
        paths.append(path)
    return paths


def main(
    maps: Path,
    held: Path,
    out: Path,
    pictures: int = PICTURES,
    steps: int = STEPS,
    seed: int = 0,
    start: Path | None = None,
) -> None:
    """Run the steps in a folder of pictures, checkpoint and results; `start`: a checkpoint of an earlier run."""
    out.mkdir(parents=True, exist_ok=True)
    paths = sorted(maps.glob("*.pkl")) + draw_pictures(out, pictures, seed)
    begun = time.process_time()
    network, path = fit(paths, out, steps, seed, start), out / "markings.onnx"
    inputs = {"map": tensors_of([next(iterate_crops(paths, seed))])[0]}
    axes = {name: {2: "rows", 3: "columns"} for name in ("map", "paint")}
    export_checked(Probabilities(network).eval(), path, inputs, ("paint",), axes, bits=8)
    info = {"version": 1, "kinds": KINDS, "objects": {}}
    describe(path, info, METADATA_KEY)
    others = sorted(held.glob("*.pkl"))
    info["objects"] = calibrate(path, others)
    describe(path, info, METADATA_KEY)
    card = {
        "seed": seed, "maps": len(list(maps.glob("*.pkl"))), "pictures": pictures, "steps": steps, "batch": BATCH, "rate": RATE,
        "start": start and start.name, "torch": torch.__version__, "cpu_s": round(time.process_time() - begun),
        "objects": info["objects"], "simulated": report(network, others, seed),
    }  # fmt: skip
    (out / "markings.json").write_text(json.dumps(card, indent=1) + "\n")
    print(f"{path.stat().st_size / 1e3:.0f} kB", json.dumps(card), flush=True)
