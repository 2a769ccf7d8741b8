"""The two-stream network of Lin, Tian, Duan and Zhou (2021): crops of a map from above and of a picture, fused by their mean.

Each stream is AVOD's encoder and decoder with a quarter of its channels: four blocks after VGG with pooling between them, and
transposed convolutions joined with the encoder's levels back to full resolution. For every anchor both maps are cropped to
3 x 3 by bilinear sampling, averaged, and one layer answers with a score for the anchor's class and a box. The paper describes
no second stage, and none is built. Batch normalization is as in AVOD's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from two_stream.inputs import CLASSES, NEGATIVE, POSITIVE, Inputs

BLOCKS = ((8, 2), (16, 2), (32, 3), (64, 3))
CROP = 3
HIDDEN = 128
BEV_CHANNELS, IMAGE_CHANNELS, BOX_CODE = 6, 3, 7
ALPHA, GAMMA = 0.25, 2.0
# Probability of an object before training (Lin et al., ICCV 2017).
PRIOR_LOGIT = -4.6
MAX_ANCHORS = 6000


def _conv(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class Stream(nn.Module):
    """Encoder and decoder of one input, to its own resolution."""

    def __init__(self, channels: int, blocks: tuple[tuple[int, int], ...]) -> None:
        super().__init__()
        down, width = [], channels
        for outputs, count in blocks:
            down.append(nn.Sequential(*[_conv(width if k == 0 else outputs, outputs) for k in range(count)]))
            width = outputs
        self.down = nn.ModuleList(down)
        ups, merges = [], []
        for lower, upper in zip(blocks[::-1], blocks[-2::-1], strict=False):
            ups.append(nn.ConvTranspose2d(lower[0], upper[0], 2, 2))
            merges.append(_conv(2 * upper[0], upper[0]))
        self.ups, self.merges = nn.ModuleList(ups), nn.ModuleList(merges)
        # The paper's 1 x 1 convolution before the crops.
        self.squeeze = nn.Conv2d(blocks[0][0], blocks[0][0], 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (1, C, H, W) to features (1, D, H, W)."""
        levels = []
        for k, block in enumerate(self.down):
            x = block(x if k == 0 else F.max_pool2d(x, 2))
            levels.append(x)
        for up, merge, level in zip(self.ups, self.merges, levels[-2::-1], strict=True):
            x = up(x)
            # Odd sides lose a row on the way down.
            x = F.pad(x, (0, level.shape[3] - x.shape[3], 0, level.shape[2] - x.shape[2]))
            x = merge(torch.cat([x, level], dim=1))
        return self.squeeze(x)


class TwoStream(nn.Module):
    """Both streams and the layer on the fused crops."""

    def __init__(self, blocks: tuple[tuple[int, int], ...] = BLOCKS) -> None:
        super().__init__()
        self.bev, self.image = Stream(BEV_CHANNELS, blocks), Stream(IMAGE_CHANNELS, blocks)
        self.fuse = nn.Sequential(nn.Linear(blocks[0][0] * CROP * CROP, HIDDEN), nn.ReLU(inplace=True))
        self.score = nn.Linear(HIDDEN, len(CLASSES))
        self.box = nn.Linear(HIDDEN, BOX_CODE * len(CLASSES))
        with torch.no_grad():
            self.score.bias.fill_(PRIOR_LOGIT)

    def forward(self, bev: Tensor, image: Tensor, bev_boxes: Tensor, image_boxes: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (N, K) and box codes (N, K, 7) of anchors, K classes.

        Parameters
        ----------
        bev, image : (1, 6, H, W), (1, 3, h, w)
        bev_boxes, image_boxes : (N, 4)
            Places of the anchors, see `Inputs`.
        """
        fused = (crops(self.bev(bev), bev_boxes) + crops(self.image(image), image_boxes)) / 2
        hidden = self.fuse(fused)
        return self.score(hidden), self.box(hidden).view(-1, len(CLASSES), BOX_CODE)


def crops(features: Tensor, boxes: Tensor) -> Tensor:
    """Sample features (1, D, H, W) bilinearly at 3 x 3 places of each box (N, 4): (N, D * 9)."""
    share = (torch.arange(CROP, dtype=boxes.dtype) + 0.5) / CROP
    rows = boxes[:, 0:1] + (boxes[:, 2:3] - boxes[:, 0:1]) * share
    columns = boxes[:, 1:2] + (boxes[:, 3:4] - boxes[:, 1:2]) * share
    rows, columns = rows[:, :, None] + 0 * columns[:, None, :], columns[:, None, :] + 0 * rows[:, :, None]
    grid = torch.stack([columns, rows], dim=-1).reshape(1, -1, CROP * CROP, 2)
    sampled = F.grid_sample(features, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return sampled[0].permute(1, 0, 2).flatten(1)


@dataclass(frozen=True, eq=False)
class Batch:
    """Inputs of one pair as tensors, with as many anchors as a step takes."""

    bev: Tensor
    image: Tensor
    bev_boxes: Tensor
    image_boxes: Tensor
    kind: Tensor
    label: Tensor
    goal: Tensor

    @classmethod
    def of(cls, inputs: Inputs, rng: np.random.Generator | None = None) -> Batch:
        """Take all anchors, or all positive and some others."""
        rows = np.arange(len(inputs.kind))
        if rng is not None and len(rows) > MAX_ANCHORS:
            positive = np.flatnonzero(inputs.label == POSITIVE)
            others = np.flatnonzero(inputs.label == NEGATIVE)
            count = min(len(others), max(MAX_ANCHORS - len(positive), 0))
            rows = np.concatenate([positive, rng.choice(others, count, replace=False)])
        columns = (inputs.bev_boxes, inputs.image_boxes, inputs.kind, inputs.label, inputs.goal)
        return cls(
            torch.from_numpy(inputs.bev[None]), torch.from_numpy(inputs.image[None]),
            *(torch.from_numpy(c[rows]) for c in columns),
        )  # fmt: skip

    def run(self, network: nn.Module) -> tuple[Tensor, Tensor]:
        """Return logits (N,) and box codes (N, 7) for the class of each anchor."""
        logits, codes = network(self.bev, self.image, self.bev_boxes, self.image_boxes)
        rows = torch.arange(len(self.kind))
        return logits[rows, self.kind], codes[rows, self.kind]


def loss_of_anchors(logits: Tensor, codes: Tensor, batch: Batch) -> tuple[Tensor, dict[str, float]]:
    """Focal loss of the scores and Smooth L1 of the boxes, not weighted against each other.

    Notes
    -----
    The paper divides the focal loss by the number of boxes, which makes it vanish beside the other where nearly all anchors
    are empty; both are divided by the number of positive ones, as RetinaNet does (Lin et al., ICCV 2017). Its alpha counts
    for objects, 1 - alpha for the rest, as there.
    """
    positive = (batch.label == POSITIVE).float()
    judged = (batch.label >= NEGATIVE).float()
    count = positive.sum().clamp(min=1)
    own = torch.where(batch.label == POSITIVE, logits, -logits)
    weight = torch.where(batch.label == POSITIVE, ALPHA, 1 - ALPHA)
    focal = -weight * torch.sigmoid(-own) ** GAMMA * F.logsigmoid(own)
    parts = {
        "class": (focal * judged).sum() / count,
        "box": (F.smooth_l1_loss(codes, batch.goal, reduction="none").sum(dim=1) * positive).sum() / count,
    }
    return parts["class"] + parts["box"], {name: float(value.detach()) for name, value in parts.items()}
