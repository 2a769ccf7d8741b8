"""Train the network of Zou, Guo, Chen and Yuan (2021) for a 16-line LiDAR at the roadside on shards of tools/train.py lidar, and export it.

    pip install 'log2sim[train]'
    python tools/train.py lidar roadside DIR --only generate
    python tools/train.py zou2021 DIR/data OUT --steps 1500
    log2sim reconstruct LOG --detector lidar:OUT/zou2021.onnx --set lidar.decode=votes

The paper leaves some things open or prints what cannot be meant. What is done here:

- Eight channels a cell: greatest and mean height, direction and distance of the cell's middle, greatest and mean intensity,
  number of points, and whether there are any. They are made of the 12 channels of `log2sim`'s grid. Samples hold no
  intensity, so those two are zero. Direction and distance are those from the middle of the grid; the paper's shifts of the
  points in training have the same effect.
- The layers are those of its table. Batch normalization is not mentioned; it is added, is merged into the convolutions by
  the export, and makes training in minutes possible.
- Outputs: the text says 8 channels, the table 14. The quantities it names need 11: offset x, y; logits of background, ground,
  large vehicle, small vehicle, two-wheeler and pedestrian; height; heading x, y.
- Boxes have the mean sizes of their class.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from training.clouds import CATEGORIES, Sample, Shard, augmented, grid_of, window_of
from training.export import describe, description, export_checked
from training.fitting import FitPlan, fit
from training.network import IN_CHANNELS, MIN_POINTS, conv

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
        """Map grids (B, 12, H, W) to (B, 8, H, W); `middle_m` (B, 2) leads from the middle of each to that of the window it is a part of."""
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


def _up(inputs: int, outputs: int) -> nn.Sequential:
    layer = nn.ConvTranspose2d(inputs, outputs, 4, 2, 1, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class Zou2021Network(nn.Module):
    """Fully convolutional network of the paper's table: five times down, five times up, skips by concatenation.

    `share` is that of the paper's channels which it has.
    """

    def __init__(self, share: float = 1.0) -> None:
        super().__init__()
        c24, c48, c64, c96, c128, c192 = (max(2, round(n * share)) for n in (24, 48, 64, 96, 128, 192))
        self.grid = PaperGrid()
        self.c1 = nn.Sequential(conv(PAPER_CHANNELS, c24, 1), conv(c24, c24), conv(c24, c48, stride=2), conv(c48, c48))
        self.c2 = nn.Sequential(conv(c48, c64, stride=2), conv(c64, c64), conv(c64, c64))
        self.c3 = nn.Sequential(conv(c64, c96, stride=2), conv(c96, c96), conv(c96, c96))
        self.c4 = nn.Sequential(conv(c96, c128, stride=2), conv(c128, c128), conv(c128, c128))
        self.c5 = nn.Sequential(conv(c128, c192, stride=2), conv(c192, c192))
        self.d1 = nn.Sequential(conv(c192, c192), _up(c192, c128))
        self.d2 = nn.Sequential(conv(2 * c128, c128), _up(c128, c96))
        self.d3 = nn.Sequential(conv(2 * c96, c96), _up(c96, c64))
        self.d4 = nn.Sequential(conv(2 * c64, c64), _up(c64, c48))
        self.d5 = nn.Sequential(conv(2 * c48, c48), nn.ConvTranspose2d(c48, PAPER_OUTPUTS, 4, 2, 1))

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
        parts = [  # in the order of the channels in `training.network`
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
        return torch.cat(parts, dim=1)


def smooth_l1(difference: Tensor) -> Tensor:
    """Fast R-CNN's Smooth L1 (Girshick, ICCV 2015) with the paper's beta."""
    square = SMOOTH_L1_BETA**2
    size = difference.abs()
    return torch.where(size < 1 / square, 0.5 * square * size * size, size - 0.5 / square)


def loss_of_cells(out: Tensor, targets: CellTargets) -> tuple[Tensor, dict[str, float]]:
    """Return the loss of outputs (B, 11, H, W) and its four parts.

    The class of every cell that is not empty by focal loss; height and heading by Smooth L1, the offset by the logarithm of
    1 + |error| (printed relative to the true offset, which breaks where that is 0), on the cells of road users. The total is
    1/2 sum (l^2 L + log(l^2 + 1)) with l = 1/4, so that all weights are constant.
    """
    filled = (targets.label != IGNORED).float()
    user = (targets.label >= LARGE).float()
    users = user.sum().clamp(min=1)
    log_p = F.log_softmax(out[:, CLASSES], dim=1)
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
    """Maps of a batch."""

    label: Tensor  # (B, H, W) int64: the class, 0 background, 1 ground; `IGNORED` in empty cells and on road users with too few points
    offset: Tensor  # (B, 2, H, W), m: to the center of the cell's road user
    height: Tensor  # (B, 1, H, W), m: of the road user
    heading: Tensor  # (B, 2, H, W): cosine and sine


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
PEAK_RATE = 2e-3
BATCH = 4
# The network works at full resolution: parts of a window save most of its time.
PART_CELLS = (128, 160)
PART_M = 12.0  # largest distance along an axis between the middles of such a part and of its window


def export_zou2021(network: Zou2021Network, path: Path, card: dict[str, object]) -> None:
    """Write the network as ONNX, laid out for decoding by votes, and check that both compute the same."""
    laid_out, axes = LaidOut(network).eval(), {0: "batch", 2: "x", 3: "y"}
    # Sides of 16 cells but not of 32, unequal ones: as far as any of its grids can be.
    checked = torch.rand((1, IN_CHANNELS, 208, 176), generator=torch.Generator().manual_seed(0))
    export_checked(laid_out, path, {"grid": checked}, ("maps",), {"grid": axes, "maps": axes})
    describe(path, description("zou2021", CELL_M, RANGE_M) | {"stride": 1, "card": card})


def main(data: list[Path], out: Path, steps: int = 1500, seed: int = 1, share: float = 1.0) -> Path:
    """Train on folders of shards, or go on from the checkpoint in `out`, and export the averaged weights; returns the ONNX file.

    `share` of the paper's channels.
    """
    shards = [Shard(path) for folder in data for path in sorted(folder.glob("*.npz"))]
    if not shards:
        raise FileNotFoundError(
            f"{', '.join(map(str, data))}: no shards; make them by tools/train.py lidar --only generate"
        )
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(seed)
    network = Zou2021Network(share).to(memory_format=torch.channels_last)

    def step(network: nn.Module, rng: np.random.Generator, _: int) -> tuple[Tensor, dict[str, float]]:
        drawn = [shards[int(rng.integers(len(shards)))] for _ in range(BATCH)]
        samples = [augmented(shard[int(rng.integers(len(shard)))], rng) for shard in drawn]
        cells = int(rng.choice(PART_CELLS))
        lows = [window_of(rng, cells, CELL_M) for _ in samples]
        grids = np.stack([grid_of(s, low, cells, CELL_M) for s, low in zip(samples, lows, strict=True)])
        middle = torch.from_numpy(rng.uniform(-PART_M, PART_M, (len(samples), 2)).astype(np.float32))
        maps = network(torch.from_numpy(grids).to(memory_format=torch.channels_last), middle)
        return loss_of_cells(maps, cell_targets(samples, lows, grids, CELL_M))

    network.load_state_dict(fit(network, step, FitPlan(steps, seed, PEAK_RATE, out / "checkpoint.pt")))
    path = out / "zou2021.onnx"
    export_zou2021(network, path, {"steps": steps, "seed": seed, "share": share, "samples": sum(map(len, shards))})
    return path
