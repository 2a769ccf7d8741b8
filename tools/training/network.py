"""The network: stem of stride 2, four scales, nearest up-sampling with 1x1 laterals, one head at stride 2."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from log2sim.datatypes import GROUP_OF
from training.clouds import CATEGORIES, Sample

IN_CHANNELS, OUT_CHANNELS = 12, 25
HEAT, CATEGORY, BOX, AXIS = slice(0, 3), slice(3, 8), slice(8, 14), slice(14, 16)
DIRECTION, QUALITY, SEGMENT, VOTE = slice(16, 18), slice(18, 19), slice(19, 23), slice(23, 25)
# Probability of an object in a cell before training; keeps the first steps of focal loss stable (Lin et al., ICCV 2017).
HEAT_PRIOR_LOGIT = -3.5


def conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """Make a convolution with batch normalization and ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, dilation * (kernel - 1) // 2, dilation, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


Widths = tuple[int, int, int, int]  # channels at strides of 2, 4, 8 and 16


def widths_of(kernels: Mapping[str, Tensor]) -> Widths:
    """Return the widths of a network by the kernels (outputs, inputs, k, k) of its layers, by name."""
    a, b, c, d = (len(kernels[f"{name}.0"]) for name in ("stem", "down4", "down8", "down16"))
    return a, b, c, d


class BevNetwork(nn.Module):
    """Anchor-free detector on bird's-eye-view grids, after CenterPoint (Yin et al., CVPR 2021) and PIXOR (Yang et al., CVPR 2018)."""

    def __init__(self, widths: Widths) -> None:
        super().__init__()
        a, b, c, d = widths
        self.stem = nn.Sequential(conv(IN_CHANNELS, a, kernel=6, stride=2), conv(a, a))
        self.down4 = nn.Sequential(conv(a, b, stride=2), conv(b, b))
        self.down8 = nn.Sequential(conv(b, c, stride=2), conv(c, c), conv(c, c))
        self.down16 = nn.Sequential(conv(c, d, stride=2), conv(d, d), conv(d, d))
        self.lateral8, self.lateral4, self.lateral2 = conv(d, c, 1), conv(c, b, 1), conv(b, a, 1)
        self.merge8, self.merge4, self.merge2 = conv(c, c), conv(b, b), conv(a, 32)
        self.head = nn.Conv2d(32, OUT_CHANNELS, 1)
        self.up = nn.Upsample(scale_factor=2, mode="nearest")
        # Where the quantized network quantizes, besides behind layers.
        self.entrance, self.sum8, self.sum4, self.sum2 = (nn.Identity() for _ in range(4))
        with torch.no_grad():
            self.head.bias[HEAT] = HEAT_PRIOR_LOGIT

    def forward(self, grid: Tensor) -> Tensor:
        """Map grids (B, 12, H, W) to maps (B, 25, H/2, W/2)."""
        s2 = self.stem(self.entrance(grid))
        s4 = self.down4(s2)
        s8 = self.down8(s4)
        s16 = self.down16(s8)
        s8 = self.merge8(self.sum8(s8 + self.up(self.lateral8(s16))))
        s4 = self.merge4(self.sum4(s4 + self.up(self.lateral4(s8))))
        return self.head(self.merge2(self.sum2(s2 + self.up(self.lateral2(s4)))))


VEHICLE_CATEGORIES, TWO_WHEELER_CATEGORIES = 3, 2


def loss_of(maps: Tensor, targets: Targets, grid: Tensor) -> tuple[Tensor, dict[str, float]]:
    """Return the loss of maps (B, 25, h, w) and its parts."""
    where = targets.regressed
    count = where.sum().clamp(min=1)
    parts = {"heat": _heat_loss(maps[:, HEAT], targets)}
    parts["box"] = ((maps[:, BOX] - targets.box[:, :6]).abs() * where).sum() / count
    parts["axis"] = ((maps[:, AXIS] - targets.box[:, 6:8]).abs() * where).sum() / count
    # Least squares, so that the answer is the mean where front and back cannot be told apart.
    parts["direction"] = (((maps[:, DIRECTION] - targets.box[:, 8:10]) ** 2) * where).sum() / count
    parts["quality"] = _quality_loss(maps, targets) / count
    parts["category"] = 0.3 * _category_loss(maps[:, CATEGORY], targets)
    occupied = F.max_pool2d(grid[:, 3:4], 2)[:, 0].gt(0).float()
    entropy = F.cross_entropy(maps[:, SEGMENT], targets.segment, reduction="none")
    sure = torch.exp(-entropy)
    focal = (1 - sure) ** 2 * entropy * occupied * torch.where(targets.segment > 0, 3.0, 1.0)
    parts["segment"] = focal.sum() / occupied.sum().clamp(min=1)
    object_cells = (targets.segment > 0).float() * occupied
    off = (maps[:, VOTE] - targets.vote).abs().sum(1) * object_cells
    parts["vote"] = 0.3 * off.sum() / object_cells.sum().clamp(min=1)
    total = torch.stack(list(parts.values())).sum()
    return total, {name: float(value.detach()) for name, value in parts.items()}


def _heat_loss(logits: Tensor, targets: Targets) -> Tensor:
    """CornerNet's focal loss (Law & Deng, ECCV 2018) as CenterNet and CenterPoint use it."""
    p = torch.sigmoid(logits).clamp(1e-4, 1 - 1e-4)
    middle = (targets.heat >= 0.999).float()
    right = middle * (1 - p) ** 2 * p.log()
    wrong = (1 - middle) * targets.considered * (1 - targets.heat) ** 4 * p**2 * (1 - p).log()
    return -(right + wrong).sum() / middle.sum().clamp(min=1)


def _quality_loss(maps: Tensor, targets: Targets) -> Tensor:
    """Cross entropy to the overlap of the regressed and the true rectangle, as if both had the true heading."""
    with torch.no_grad():
        box, truth = maps[:, BOX], targets.box
        c, s = truth[:, 9], truth[:, 8]
        dx, dy = box[:, 0] - truth[:, 0], box[:, 1] - truth[:, 1]
        overlap = torch.ones_like(dx)
        areas = torch.zeros_like(dx)
        for offset, channel in ((dx * c + dy * s, 3), (dy * c - dx * s, 4)):
            a, b = box[:, channel].clamp(-2, 4).exp() / 2, truth[:, channel].exp() / 2
            overlap = overlap * (torch.minimum(a, b + offset.abs()) + torch.minimum(b - offset.abs(), a)).clamp(min=0)
        for source in (box, truth):
            areas = areas + (source[:, 3].clamp(-2, 4) + source[:, 4].clamp(-2, 4)).exp()
        # A heading that is off turns the rectangle out of the other.
        aligned = (maps[:, AXIS] * truth[:, 6:8]).sum(1) / maps[:, AXIS].norm(dim=1).clamp(min=1e-3)
        iou = overlap / (areas - overlap).clamp(min=1e-3) * aligned.clamp(0, 1)
    entropy = F.binary_cross_entropy_with_logits(maps[:, QUALITY][:, 0], iou.clamp(0, 1), reduction="none")
    return (entropy * targets.regressed[:, 0]).sum()


def _category_loss(logits: Tensor, targets: Targets) -> Tensor:
    total = logits.new_zeros(())
    spans = ((0, VEHICLE_CATEGORIES), (VEHICLE_CATEGORIES, TWO_WHEELER_CATEGORIES))
    for first, count in spans:
        mask = (targets.category >= first) & (targets.category < first + count)
        if mask.any():
            rows = logits[:, first : first + count].permute(0, 2, 3, 1)[mask]
            total = total + F.cross_entropy(rows, targets.category[mask] - first)
    return total


# In the order of the channels of heat.
GROUPS = ("vehicle", "two_wheeler", "pedestrian")
# An object with fewer points is neither asked for nor punished.
MIN_POINTS = 4
MIN_TOWED_M = 1.5
STRIDE = 2
# Width of the peak as a share of length and width, and at least of a cell.
PEAK_LENGTH, PEAK_WIDTH, MIN_PEAK_CELLS = 0.16, 0.18, 0.55
# Of a long vehicle that is seen end-on nothing shows where its middle is, and a peak that may be anywhere is nowhere: its peak is as far behind the
# end that shows as the middle of a car is, m. Where the sensor is so far beside its flank, m, its length shows, and the peak is in the middle. Cells
# regress the middle in either case.
HALF_CAR_M, FLANK_SHOWS_M = 2.2, 2.0
# Cells whose peak is higher than this regress the box.
MIN_REGRESSED_PEAK = 0.45


@dataclass(eq=False)
class Targets:
    """Maps (B, ...) at the network's stride."""

    heat: Tensor  # (B, 3, h, w): one at an object's peak, falling around it
    box: Tensor  # (B, 10, h, w): dx, dy, z, log sizes, sin and cos of twice the yaw, sin and cos of the yaw
    regressed: Tensor  # (B, 1, h, w): where the box is regressed
    considered: Tensor  # (B, 3, h, w): where the heat is judged
    category: Tensor  # (B, h, w): index of the category, -1 where none is regressed
    segment: Tensor  # (B, h, w): 0 background, else 1 + group
    vote: Tensor  # (B, 2, h, w)


def targets_of(samples: list[Sample], lows: list[np.ndarray], cells: int, cell_m: float) -> Targets:
    """Draw the targets of samples in their windows."""
    n, b, cell = cells // STRIDE, len(samples), cell_m * STRIDE
    heat = np.zeros((b, 3, n, n), np.float32)
    box = np.zeros((b, 10, n, n), np.float32)
    regressed, considered = np.zeros((b, 1, n, n), np.float32), np.ones((b, 3, n, n), np.float32)
    category, segment = np.full((b, n, n), -1, np.int64), np.zeros((b, n, n), np.int64)
    vote = np.zeros((b, 2, n, n), np.float32)
    for k, (sample, low) in enumerate(zip(samples, lows, strict=True)):
        for row, code, points in zip(sample.boxes, sample.category, sample.points, strict=True):
            name = CATEGORIES[code]
            x, y, z, length, width, height, yaw = (float(v) for v in row)
            # Animals and strollers are none of the groups; what is towed may as well pass for a vehicle.
            if name == "other" and length < MIN_TOWED_M:
                continue
            u, v = (x - low[0]) / cell, (y - low[1]) / cell
            reach = int((max(length, width) / 2 + 0.6) / cell) + 3
            i0, i1 = max(0, int(u) - reach), min(n, int(u) + reach + 1)
            j0, j1 = max(0, int(v) - reach), min(n, int(v) + reach + 1)
            if i0 >= i1 or j0 >= j1:
                continue
            area = (slice(i0, i1), slice(j0, j1))
            dx = ((u - np.arange(i0, i1) - 0.5) * cell)[:, None].astype(np.float32)
            dy = ((v - np.arange(j0, j1) - 0.5) * cell)[None, :].astype(np.float32)
            c, s = np.cos(yaw), np.sin(yaw)
            along, across = dx * c + dy * s, dy * c - dx * s
            # From the middle to the peak along the axis; the sensor is at the origin.
            beside_m = abs(x * s - y * c) - width / 2
            play_m = max(length / 2 - HALF_CAR_M, 0.0) * float(np.clip(1 - beside_m / FLANK_SHOWS_M, 0, 1))
            shift_m = float(np.clip(-(x * c + y * s), -play_m, play_m))
            pu, pv = u + shift_m * c / cell, v + shift_m * s / cell
            inside = (np.abs(along) < length / 2 + 0.1) & (np.abs(across) < width / 2 + 0.1)
            # A bicycle without rider may pass for a two-wheeler, but not for a person.
            group = GROUPS.index("vehicle" if name == "other" else GROUP_OF[name])
            if points < MIN_POINTS or name in ("bicycle", "other") or not (0 <= pu < n and 0 <= pv < n):
                considered[(k, group, *area)][inside] = 0
                continue
            spread_m = [
                max(min(length, 2 * HALF_CAR_M) * PEAK_LENGTH, cell * MIN_PEAK_CELLS),
                max(width * PEAK_WIDTH, cell * MIN_PEAK_CELLS),
            ]
            peak = np.exp(-0.5 * (((along + shift_m) / spread_m[0]) ** 2 + (across / spread_m[1]) ** 2))
            peak[int(pu) - i0, int(pv) - j0] = 1
            stronger = peak > heat[(k, group, *area)]
            heat[(k, group, *area)][stronger] = peak[stronger]
            near = (peak > MIN_REGRESSED_PEAK) & stronger
            shape = *np.log([length, width, height]), np.sin(2 * yaw), np.cos(2 * yaw)
            values = (dx + 0 * dy, dy + 0 * dx, z, *shape, s, c)
            for q, value in enumerate(values):
                box[(k, q, *area)][near] = value[near] if isinstance(value, np.ndarray) else value
            regressed[(k, 0, *area)][near] = 1
            category[(k, *area)][near] = code
            segment[(k, *area)][inside] = 1 + group
            vote[(k, 0, *area)][inside] = np.broadcast_to(dx, inside.shape)[inside]
            vote[(k, 1, *area)][inside] = np.broadcast_to(dy, inside.shape)[inside]
    return Targets(*(torch.from_numpy(t) for t in (heat, box, regressed, considered, category, segment, vote)))
