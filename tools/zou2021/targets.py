"""What the network of Zou et al. (2021) is to answer in each cell of a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from lidar_training.samples import CATEGORIES, Sample
from lidar_training.targets import MIN_POINTS
from numpy.typing import NDArray
from torch import Tensor

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
