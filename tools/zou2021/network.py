"""The network of Zou, Guo, Chen and Yuan (2021) for a 16-line LiDAR at the roadside, and its losses.

The paper leaves some things open or prints what cannot be meant. What is done here:

- Eight channels a cell: greatest and mean height, direction and distance of the cell's middle, greatest and mean intensity,
  number of points, and whether there are any. They are made of the 12 channels of `log2sim`'s grid. Samples hold no
  intensity, so those two are zero. Direction and distance are those from the middle of the grid; the paper's shifts of the
  points in training have the same effect.
- The layers are those of its table. Batch normalization is not mentioned; it is added, is merged into the convolutions by
  the export, and makes training in minutes possible.
- Outputs: the text says 8 channels, the table 14. The quantities it names need 11: offset x, y; logits of background, ground,
  large vehicle, small vehicle, two-wheeler and pedestrian; height; heading x, y.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from lidar_training.clouds import CATEGORIES, Sample, Shard, augmented, grid_of, window_of
from lidar_training.export import MAX_EXPORT_ERROR, describe, description
from lidar_training.network import IN_CHANNELS, MIN_POINTS, OUT_CHANNELS, loss_of, targets_of
from numpy.typing import NDArray
from torch import Tensor, nn

from log2sim.perception.detect3d.network import load_network

PAPER_CHANNELS, PAPER_OUTPUTS = 8, 11
OFFSET, CLASSES, HEIGHT, HEADING = slice(0, 2), slice(2, 8), slice(8, 9), slice(9, 11)
BACKGROUND, GROUND, LARGE, SMALL, TWO_WHEELER, PEDESTRIAN = range(6)
CELL_M = 0.1875
DISTANCE_UNIT_M = 30.0
# Mean length, width and height of the classes from `LARGE` on, m: those of the simulated road users.
CLASS_SIZES_M = ((9.0, 2.5, 3.1), (4.5, 1.85, 1.6), (1.8, 0.7, 1.65), (0.6, 0.65, 1.72))
HEIGHT_LIMITS_M = (0.3, 5.0)
FOCUS = 2.0
CLASS_WEIGHTS = (0.1, 0.75, 0.9, 0.9, 0.9, 0.9)
# Printed as 10; Fast R-CNN's Smooth L1 has its square, so that the loss is linear beyond 0.01.
SMOOTH_L1_BETA = 10.0
PARTS = 4
NO_CENTER_LOGIT = -9.0


class PaperGrid(nn.Module):
    """The paper's 8 channels from the 12 of `log2sim.perception.detect3d.network`."""

    def forward(self, grid: Tensor, middle_m: Tensor | None = None) -> Tensor:
        """Map grids (B, 12, H, W) to (B, 8, H, W).

        Parameters
        ----------
        middle_m : (B, 2), optional
            From the middle of each grid to that of the window which it is a part of; by default it is the whole window.
        """
        x = (torch.arange(grid.shape[2], dtype=grid.dtype) + 0.5 - grid.shape[2] / 2) * CELL_M
        y = (torch.arange(grid.shape[3], dtype=grid.dtype) + 0.5 - grid.shape[3] / 2) * CELL_M
        zero = torch.zeros_like(grid[:, :1])
        x, y = x.view(1, 1, -1, 1) + zero, y.view(1, 1, 1, -1) + zero
        if middle_m is not None:
            x, y = x - middle_m[:, 0].view(-1, 1, 1, 1), y - middle_m[:, 1].view(-1, 1, 1, 1)
        direction, distance = torch.atan2(y, x) / torch.pi, torch.sqrt(x * x + y * y) / DISTANCE_UNIT_M
        count = grid[:, 3:4]
        filled = (count > 0).to(grid.dtype)
        return torch.cat([2 * grid[:, 0:2], direction, distance, zero, zero, count, filled], dim=1)


def _layers(*convolutions: nn.Module) -> nn.Sequential:
    parts: list[nn.Module] = []
    for layer in convolutions:
        parts += [layer, nn.BatchNorm2d(layer.out_channels), nn.ReLU(inplace=True)]
    return nn.Sequential(*parts)


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)


def _up(inputs: int, outputs: int) -> nn.ConvTranspose2d:
    return nn.ConvTranspose2d(inputs, outputs, 4, 2, 1, bias=False)


class Zou2021Network(nn.Module):
    """Fully convolutional network of the paper's table: five times down, five times up, skips by concatenation.

    Parameters
    ----------
    share : float
        Share of the paper's channels, for tests.
    """

    def __init__(self, share: float = 1.0) -> None:
        super().__init__()
        c24, c48, c64, c96, c128, c192 = (max(2, round(n * share)) for n in (24, 48, 64, 96, 128, 192))
        self.grid = PaperGrid()
        self.c1 = _layers(_conv(PAPER_CHANNELS, c24, 1), _conv(c24, c24), _conv(c24, c48, stride=2), _conv(c48, c48))
        self.c2 = _layers(_conv(c48, c64, stride=2), _conv(c64, c64), _conv(c64, c64))
        self.c3 = _layers(_conv(c64, c96, stride=2), _conv(c96, c96), _conv(c96, c96))
        self.c4 = _layers(_conv(c96, c128, stride=2), _conv(c128, c128), _conv(c128, c128))
        self.c5 = _layers(_conv(c128, c192, stride=2), _conv(c192, c192))
        self.d1 = _layers(_conv(c192, c192), _up(c192, c128))
        self.d2 = _layers(_conv(2 * c128, c128), _up(c128, c96))
        self.d3 = _layers(_conv(2 * c96, c96), _up(c96, c64))
        self.d4 = _layers(_conv(2 * c64, c64), _up(c64, c48))
        self.d5 = nn.Sequential(*_layers(_conv(2 * c48, c48)), nn.ConvTranspose2d(c48, PAPER_OUTPUTS, 4, 2, 1))

    def forward(self, grid: Tensor, middle_m: Tensor | None = None) -> Tensor:
        """Map grids (B, 12, H, W), H and W even, to the paper's outputs (B, 11, H, W); `middle_m` as in `PaperGrid`."""
        s2 = self.c1(self.grid(grid, middle_m))
        s4 = self.c2(s2)
        s8 = self.c3(s4)
        s16 = self.c4(s8)
        x = self.d1(self.c5(s16))
        for up, skip in ((self.d2, s16), (self.d3, s8), (self.d4, s4), (self.d5, s2)):
            # A side that is no multiple of 32 cells is one too long after going down and up.
            x = up(torch.cat([x[:, :, : skip.shape[2], : skip.shape[3]], skip], dim=1))
        return x


class LaidOut(nn.Module):
    """The network with its outputs in the layout that `log2sim` decodes by votes.

    Each cell says that the object's center is where its offset points, that the box stands on the ground, that its height is
    the one regressed, and length and width are the means of its most probable class. Nothing is said of centers, so that
    decoding by centers finds nothing.
    """

    def __init__(self, network: Zou2021Network) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("log_sizes", torch.log(torch.tensor(CLASS_SIZES_M)))

    def forward(self, grid: Tensor) -> Tensor:
        """Map grids (B, 12, H, W) to maps (B, 25, H, W)."""
        out = self.network(grid)
        logits, height = out[:, CLASSES], out[:, HEIGHT].clamp(*HEIGHT_LIMITS_M)
        users = logits[:, LARGE:]
        best = (users >= users.max(dim=1, keepdim=True).values).to(out.dtype)
        sizes = torch.einsum("bkhw,kc->bchw", best / best.sum(dim=1, keepdim=True), self.log_sizes)
        # Decoding takes the angle of the axis alone, so that its length need not be 1.
        cos, sin = out[:, 9:10], out[:, 10:11]
        zero = torch.zeros_like(height)
        parts = [  # in the order of the channels in `lidar_training.network`
            # Centers of three groups.
            zero.expand(-1, 3, -1, -1) + NO_CENTER_LOGIT,
            # car, truck, bus; motorcycle, cyclist: the paper's classes do not tell the last of each from the others.
            logits[:, SMALL : SMALL + 1], logits[:, LARGE : LARGE + 1], zero - 30, zero, zero + 1,
            # Box, axis, direction, quality.
            out[:, OFFSET], height / 2, sizes[:, :2], torch.log(height),
            2 * sin * cos, cos * cos - sin * sin,
            sin, cos,
            zero,
            # Segments of the ground and the background, vehicles, two-wheelers, people.
            torch.logsumexp(logits[:, BACKGROUND : GROUND + 1], dim=1, keepdim=True),
            torch.logsumexp(logits[:, LARGE : SMALL + 1], dim=1, keepdim=True),
            logits[:, TWO_WHEELER:],
            out[:, OFFSET],
        ]  # fmt: skip
        maps = torch.cat(parts, dim=1)
        if maps.shape[1] != OUT_CHANNELS:
            raise ValueError(f"{maps.shape[1]} channels, expected {OUT_CHANNELS}")
        return maps


def smooth_l1(difference: Tensor) -> Tensor:
    """Fast R-CNN's Smooth L1 (Girshick, ICCV 2015) with the paper's beta."""
    square = SMOOTH_L1_BETA**2
    size = difference.abs()
    return torch.where(size < 1 / square, 0.5 * square * size * size, size - 0.5 / square)


def loss_of_cells(out: Tensor, targets: CellTargets) -> tuple[Tensor, dict[str, float]]:
    """Return the loss of outputs (B, 11, H, W) and its four parts.

    Notes
    -----
    The class of every cell that is not empty by focal loss; height and heading by Smooth L1, the offset by the logarithm of
    1 + |error| (printed relative to the true offset, which breaks where that is 0), on the cells of road users. The total is
    1/2 sum (l^2 L + log(l^2 + 1)) with l = 1/4, so that all weights are constant.
    """
    filled = (targets.label != IGNORED).float()
    user = (targets.label >= LARGE).float()
    users = user.sum().clamp(min=1)
    log_p = F.log_softmax(out[:, CLASSES].float(), dim=1)
    label = targets.label.clamp(min=0)
    own = log_p.gather(1, label[:, None])[:, 0]
    weight = torch.tensor(CLASS_WEIGHTS)[label]
    focal = -weight * (1 - own.exp()) ** FOCUS * own
    heading = smooth_l1(out[:, HEADING] - targets.heading).sum(dim=1)
    offset = torch.log1p((out[:, OFFSET] - targets.offset).abs()).sum(dim=1)
    parts = {
        "class": (focal * filled).sum() / filled.sum().clamp(min=1),
        "height": (smooth_l1(out[:, HEIGHT] - targets.height)[:, 0] * user).sum() / users,
        "heading": (heading * user).sum() / users,
        "offset": (offset * user).sum() / users,
    }
    square = (1 / PARTS) ** 2
    total = torch.stack([square * part + torch.log(torch.tensor(square + 1.0)) for part in parts.values()]).sum() / 2
    return total, {name: float(value.detach()) for name, value in parts.items()}


IGNORED = -1
CLASS_OF = {"truck": 2, "bus": 2, "car": 3, "motorcycle": 4, "cyclist": 4, "pedestrian": 5}
# Cells with lower tops are the ground, under road users too.
GROUND_TOP_M = 0.2
# Half the diagonal of a cell: the middle of a cell with points of a road user can be that far outside.
MARGIN_M = 0.14


@dataclass(eq=False)
class CellTargets:
    """Maps of a batch.

    Attributes
    ----------
    label : (B, H, W) int64
        The class, 0 background, 1 ground; `IGNORED` in empty cells and on road users with too few points.
    offset : (B, 2, H, W) float32
        To the center of the cell's road user, m.
    height : (B, 1, H, W) float32
        Of the road user, m.
    heading : (B, 2, H, W) float32
        Cosine and sine.
    """

    label: Tensor
    offset: Tensor
    height: Tensor
    heading: Tensor


def cell_targets(
    samples: list[Sample], lows: list[NDArray[np.float64]], grids: NDArray[np.float32], cell_m: float
) -> CellTargets:
    """Draw the targets of samples on their grids (B, 12, H, W)."""
    count, _, h, w = grids.shape
    label = np.where(grids[:, 3] > 0, np.where(2 * grids[:, 0] < GROUND_TOP_M, 1, 0), IGNORED).astype(np.int64)
    offset, heading = np.zeros((count, 2, h, w), np.float32), np.zeros((count, 2, h, w), np.float32)
    height = np.zeros((count, 1, h, w), np.float32)
    for k, (sample, low) in enumerate(zip(samples, lows, strict=True)):
        for row, code, points in zip(sample.boxes, sample.category, sample.points, strict=True):
            name = CATEGORIES[code]
            if name == "other":
                continue
            x, y, _, length, width, tall, yaw = (float(v) for v in row)
            reach = np.hypot(length, width) / 2 + MARGIN_M
            i0, i1 = (int(np.clip(v, 0, h)) for v in ((x - low[0] - reach) / cell_m, (x - low[0] + reach) / cell_m + 1))
            j0, j1 = (int(np.clip(v, 0, w)) for v in ((y - low[1] - reach) / cell_m, (y - low[1] + reach) / cell_m + 1))
            if i0 >= i1 or j0 >= j1:
                continue
            dx = (x - low[0] - (np.arange(i0, i1) + 0.5) * cell_m)[:, None] + np.zeros((1, j1 - j0))
            dy = (y - low[1] - (np.arange(j0, j1) + 0.5) * cell_m)[None, :] + np.zeros((i1 - i0, 1))
            c, s = np.cos(yaw), np.sin(yaw)
            inside = np.abs(dx * c + dy * s) < length / 2 + MARGIN_M
            inside &= np.abs(dy * c - dx * s) < width / 2 + MARGIN_M
            area = (slice(i0, i1), slice(j0, j1))
            inside &= (label[(k, *area)] != IGNORED) & (2 * grids[(k, 0, *area)] >= GROUND_TOP_M)
            known = points >= MIN_POINTS and name in CLASS_OF
            label[(k, *area)][inside] = CLASS_OF[name] if known else IGNORED
            offset[(k, 0, *area)][inside], offset[(k, 1, *area)][inside] = dx[inside], dy[inside]
            height[(k, 0, *area)][inside] = tall
            heading[(k, 0, *area)][inside], heading[(k, 1, *area)][inside] = c, s
    return CellTargets(*(torch.from_numpy(a) for a in (label, offset, height, heading)))


RANGE_M = 30.0
# As far as any of its grids can be: sides of 16 cells but not of 32, unequal ones.
CHECKED_CELLS = (208, 176)


def export_zou2021(network: Zou2021Network, path: Path, card: dict[str, Any]) -> None:
    """Write the network as ONNX and check that both compute the same.

    Raises
    ------
    RuntimeError
        When they differ by more than `MAX_EXPORT_ERROR`.
    """
    laid_out = LaidOut(network).eval()
    axes = {0: "batch", 2: "x", 3: "y"}
    with warnings.catch_warnings():
        # The exporter that needs no further package announces its end.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            laid_out, (torch.zeros(1, IN_CHANNELS, 128, 96),), str(path), input_names=["grid"], output_names=["maps"],
            opset_version=17, dynamo=False, dynamic_axes={"grid": axes, "maps": axes},
        )  # fmt: skip
    describe(path, description("zou2021", CELL_M, RANGE_M) | {"stride": 1, "card": card})
    grid = np.random.default_rng(0).random((IN_CHANNELS, *CHECKED_CELLS), dtype=np.float32)
    with torch.no_grad():
        expected = laid_out(torch.from_numpy(grid[None]))[0].numpy()
    difference = load_network(path).run(grid) - expected
    error = float((np.abs(difference) / np.maximum(np.abs(expected), 1)).max())
    if not error < MAX_EXPORT_ERROR:
        raise RuntimeError(f"{path}: ONNX and torch differ by {error:.2g}, more than {MAX_EXPORT_ERROR:g}")


BATCH = 4
CELLS = 256
# The paper's network works at full resolution: parts of a window save most of its time.
ZOU2021_CELLS = (128, 160)
PART_M = 12.0
"""Largest distance along an axis between the middles of such a part and of its window."""


class Samples(Protocol):
    """Samples by number: a shard, or a list of samples."""

    def __len__(self) -> int: ...

    def __getitem__(self, k: int) -> Sample: ...


def shards_in(folders: Sequence[Path]) -> list[Shard]:
    """Open the shards of folders, in the order of their names."""
    paths = [path for folder in folders for path in sorted(folder.glob("*.npz"))]
    if not paths:
        raise FileNotFoundError(
            f"{', '.join(map(str, folders))}: no shards; make them by tools/train_lidar.py --only generate"
        )
    return [Shard(path) for path in paths]


@dataclass(frozen=True, eq=False)
class Mixture:
    """Simulated samples, half of whose places in a batch another source may take.

    Attributes
    ----------
    simulated : sequence of Samples
    other : Samples
        Empty for none.
    """

    simulated: Sequence[Samples]
    other: Samples = field(default_factory=list)

    def draw(self, rng: np.random.Generator) -> list[Sample]:
        """Draw a batch of augmented samples."""
        out = []
        for k in range(BATCH):
            source = self.simulated[int(rng.integers(len(self.simulated)))]
            if k % 2 and len(self.other):
                source = self.other
            out.append(augmented(source[int(rng.integers(len(source)))], rng))
        return out


def windows(
    samples: list[Sample], cells: int, cell_m: float, rng: np.random.Generator
) -> tuple[NDArray[np.float32], list[NDArray[np.float64]]]:
    """Rasterize samples in random windows: grids (B, 12, H, W) and lower corners."""
    lows = [window_of(rng, cells, cell_m) for _ in samples]
    return np.stack([grid_of(s, low, cells, cell_m) for s, low in zip(samples, lows, strict=True)]), lows


def zou2021_loss(
    network: nn.Module, samples: list[Sample], rng: np.random.Generator
) -> tuple[Tensor, dict[str, float]]:
    """Return the loss of the paper's network on samples."""
    grids, lows = windows(samples, int(rng.choice(ZOU2021_CELLS)), CELL_M, rng)
    middle = torch.from_numpy(rng.uniform(-PART_M, PART_M, (len(samples), 2)).astype(np.float32))
    out = network(torch.from_numpy(grids).to(memory_format=torch.channels_last), middle)
    return loss_of_cells(out, cell_targets(samples, lows, grids, CELL_M))


def centers_loss(cell_m: float):
    """Return the loss on samples of a network of `lidar_training.network` with cells of a size."""

    def loss(network: nn.Module, samples: list[Sample], rng: np.random.Generator) -> tuple[Tensor, dict[str, float]]:
        grids, lows = windows(samples, CELLS, cell_m, rng)
        grid = torch.from_numpy(grids).to(memory_format=torch.channels_last)
        return loss_of(network(grid), targets_of(samples, lows, CELLS, cell_m), grid)

    return loss
