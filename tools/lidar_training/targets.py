"""What the network is to answer for a sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidar_training.samples import CATEGORIES, Sample
from log2sim.datatypes import GROUP_OF

# In the order of the channels of heat.
GROUPS = ("vehicle", "two_wheeler", "pedestrian")
# An object with fewer points is neither asked for nor punished.
MIN_POINTS = 4
STRIDE = 2
# Width of the peak as a share of length and width, and at least of a cell.
PEAK_LENGTH, PEAK_WIDTH, MIN_PEAK_CELLS = 0.16, 0.18, 0.55
# Cells whose peak is higher than this regress the box.
MIN_REGRESSED_PEAK = 0.45


@dataclass(eq=False)
class Targets:
    """Maps (B, ...) at the network's stride.

    Attributes
    ----------
    heat : (B, 3, h, w)
        One at an object's middle, falling around it.
    box : (B, 10, h, w)
        dx, dy, z, log sizes, sin and cos of twice the yaw, sin and cos of the yaw.
    regressed, considered : (B, 1, h, w)
        Where the box is regressed; where the heat is judged.
    category : (B, h, w) int64
        Index of the category, -1 where none is regressed.
    segment : (B, h, w) int64
        0 background, else 1 + group.
    vote : (B, 2, h, w)
    """

    heat: Tensor
    box: Tensor
    regressed: Tensor
    considered: Tensor
    category: Tensor
    segment: Tensor
    vote: Tensor


def targets_of(samples: list[Sample], lows: list[np.ndarray], cells: int, cell_m: float) -> Targets:
    """Draw the targets of samples in their windows."""
    n, b, cell = cells // STRIDE, len(samples), cell_m * STRIDE
    heat = np.zeros((b, 3, n, n), np.float32)
    box = np.zeros((b, 10, n, n), np.float32)
    regressed, considered = np.zeros((b, 1, n, n), np.float32), np.ones((b, 1, n, n), np.float32)
    category, segment = np.full((b, n, n), -1, np.int64), np.zeros((b, n, n), np.int64)
    vote = np.zeros((b, 2, n, n), np.float32)
    for k, (sample, low) in enumerate(zip(samples, lows, strict=True)):
        for row, code, points in zip(sample.boxes, sample.category, sample.points, strict=True):
            name = CATEGORIES[code]
            if name == "other":
                continue
            x, y, z, length, width, height, yaw = (float(v) for v in row)
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
            inside = (np.abs(along) < length / 2 + 0.1) & (np.abs(across) < width / 2 + 0.1)
            if points < MIN_POINTS or name == "bicycle" or not (0 <= u < n and 0 <= v < n):
                considered[(k, 0, *area)][inside] = 0
                continue
            group = GROUPS.index(GROUP_OF[name])
            peak = np.exp(
                -0.5
                * (
                    (along / max(length * PEAK_LENGTH, cell * MIN_PEAK_CELLS)) ** 2
                    + (across / max(width * PEAK_WIDTH, cell * MIN_PEAK_CELLS)) ** 2
                )
            )
            peak[int(u) - i0, int(v) - j0] = 1
            stronger = peak > heat[(k, group, *area)]
            heat[(k, group, *area)][stronger] = peak[stronger]
            near = (peak > MIN_REGRESSED_PEAK) & stronger
            values = (
                dx + 0 * dy,
                dy + 0 * dx,
                z,
                np.log(length),
                np.log(width),
                np.log(height),
                np.sin(2 * yaw),
                np.cos(2 * yaw),
                s,
                c,
            )
            for q, value in enumerate(values):
                box[(k, q, *area)][near] = value[near] if isinstance(value, np.ndarray) else value
            regressed[(k, 0, *area)][near] = 1
            category[(k, *area)][near] = code
            segment[(k, *area)][inside] = 1 + group
            vote[(k, 0, *area)][inside] = np.broadcast_to(dx, inside.shape)[inside]
            vote[(k, 1, *area)][inside] = np.broadcast_to(dy, inside.shape)[inside]
    return Targets(*(torch.from_numpy(t) for t in (heat, box, regressed, considered, category, segment, vote)))
