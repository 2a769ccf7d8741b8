"""The loss: penalty-reduced focal loss for the peaks, L1 for boxes, cross entropies, and the expected overlap."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from lidar_training.network import AXIS, BOX, CATEGORY, DIRECTION, HEAT, QUALITY, SEGMENT, VOTE
from lidar_training.targets import Targets

# Meters of x, y, z and logarithms of length, width, height.
BOX_WEIGHTS = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
VEHICLE_CATEGORIES, TWO_WHEELER_CATEGORIES = 3, 2


def loss_of(maps: Tensor, targets: Targets, grid: Tensor) -> tuple[Tensor, dict[str, float]]:
    """Return the loss of maps (B, 25, h, w) and its parts."""
    where = targets.regressed
    count = where.sum().clamp(min=1)
    parts = {"heat": _heat_loss(maps[:, HEAT], targets)}
    weights = torch.tensor(BOX_WEIGHTS).view(1, 6, 1, 1)
    parts["box"] = ((maps[:, BOX] - targets.box[:, :6]).abs() * where * weights).sum() / count
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
        box, truth = maps[:, BOX].float(), targets.box
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
        aligned = (maps[:, AXIS].float() * truth[:, 6:8]).sum(1) / maps[:, AXIS].float().norm(dim=1).clamp(min=1e-3)
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
