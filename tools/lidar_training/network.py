"""The network: space-to-depth stem, four scales, nearest up-sampling with 1x1 laterals, one head at stride 2."""

from __future__ import annotations

import torch
from torch import Tensor, nn

IN_CHANNELS, OUT_CHANNELS = 12, 25
HEAT, CATEGORY, BOX, AXIS = slice(0, 3), slice(3, 8), slice(8, 14), slice(14, 16)
DIRECTION, QUALITY, SEGMENT, VOTE = slice(16, 18), slice(18, 19), slice(19, 23), slice(23, 25)
# Probability of an object in a cell before training; keeps the first steps of focal loss stable (Lin et al., ICCV 2017).
HEAT_PRIOR_LOGIT = -3.5


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class BevNetwork(nn.Module):
    """Anchor-free detector on bird's-eye-view grids, after CenterPoint (Yin et al., CVPR 2021) and PIXOR (Yang et al., CVPR 2018)."""

    def __init__(
        self, widths: tuple[int, int, int, int] = (16, 32, 48, 64), depths: tuple[int, int, int] = (1, 2, 2)
    ) -> None:
        super().__init__()
        a, b, c, d = widths
        self.stem = nn.Sequential(nn.PixelUnshuffle(2), _conv(IN_CHANNELS * 4, a), _conv(a, a))
        self.down4 = nn.Sequential(_conv(a, b, stride=2), *[_conv(b, b) for _ in range(depths[0])])
        self.down8 = nn.Sequential(_conv(b, c, stride=2), *[_conv(c, c) for _ in range(depths[1])])
        self.down16 = nn.Sequential(_conv(c, d, stride=2), *[_conv(d, d) for _ in range(depths[2])])
        self.lateral8, self.lateral4, self.lateral2 = _conv(d, c, 1), _conv(c, b, 1), _conv(b, a, 1)
        self.merge8, self.merge4, self.merge2 = _conv(c, c), _conv(b, b), _conv(a, 32)
        self.head = nn.Conv2d(32, OUT_CHANNELS, 1)
        self.up = nn.Upsample(scale_factor=2, mode="nearest")
        with torch.no_grad():
            self.head.bias[HEAT] = HEAT_PRIOR_LOGIT

    def forward(self, grid: Tensor) -> Tensor:
        """Map grids (B, 12, H, W) to maps (B, 25, H/2, W/2)."""
        s2 = self.stem(grid)
        s4 = self.down4(s2)
        s8 = self.down8(s4)
        s16 = self.down16(s8)
        s8 = self.merge8(s8 + self.up(self.lateral8(s16)))
        s4 = self.merge4(s4 + self.up(self.lateral4(s8)))
        return self.head(self.merge2(s2 + self.up(self.lateral2(s4))))
