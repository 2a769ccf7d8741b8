"""Quantization-aware training: a network that computes in integers, its weights of 7 bits, what layers hand on of 8.

Quantization after training loses vehicles of which a LiDAR of few lines shows little. Trained on with quantized weights and activations,
by straight-through gradients, for the step sizes as well (LSQ, Esser et al., ICLR 2020), toward what the network computes in floats
(distillation, Hinton et al., 2015), the network loses next to nothing. Products of 8 and 7 bits add up in 16 without saturation on
processors that have no instruction for more.
"""

from __future__ import annotations

import copy
import math
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from training.network import AXIS, BOX, CATEGORY, DIRECTION, HEAT, QUALITY, SEGMENT, VOTE, BevNetwork

WEIGHT_BITS = 7
WEIGHT_LEVELS, LEVELS = 2 ** (WEIGHT_BITS - 1) - 1, 255  # largest values
# Of the grid: heights of -0.5 to 4.5 m, halved, and logarithms of counts, see `rasterize`.
INPUT_STEP, INPUT_ZERO = 1 / 64, 32
# Of all values, the part that the first steps reach, of as many as are looked at, and the least that they reach.
LARGEST_SHARE, MAX_VALUES, LEAST_LARGEST = 0.9999, 1_000_000, 1e-3
# Of the heat in the distillation loss, so that it counts as much as boxes: as divergence it is small where scores are nearly the same. 10 to 160 do alike.
HEAT_WEIGHT = 40


def quantized(value: Tensor, step: Tensor | float, low: int, high: int) -> Tensor:
    """Round to multiples of a step from `low` to `high` of them; gradients pass as if it were only limited."""
    whole = value / step
    return (whole + (whole.round() - whole).detach()).clamp(low, high) * step


def weight_step(kernel: Tensor) -> Tensor:
    """Return the step sizes (outputs,) of the weights of a kernel (outputs, inputs, k, k), by the largest of each output."""
    return kernel.detach().abs().amax((1, 2, 3)).clamp(min=1e-12) / WEIGHT_LEVELS


class Quantizer(nn.Module):
    """Quantizes to 8 bits, in steps that are learned where none is given; the first values, not negative, that it meets set them."""

    def __init__(self, step: float = math.nan, zero: int = 0) -> None:
        super().__init__()
        self.log_step = nn.Parameter(torch.tensor(step).log(), requires_grad=math.isnan(step))
        self.zero = zero

    def forward(self, x: Tensor) -> Tensor:
        """Quantize values of any shape."""
        if not self.training:
            return torch.fake_quantize_per_tensor_affine(x, float(self.log_step.exp()), self.zero, 0, LEVELS)
        if self.log_step.isnan():
            largest = x.detach().flatten()[:: max(x.numel() // MAX_VALUES, 1)].quantile(LARGEST_SHARE)
            self.log_step.data = (largest.clamp(min=LEAST_LARGEST) / LEVELS).log()
        step, share = self.log_step.exp(), 1 / math.sqrt(x.numel() * LEVELS)  # of the gradient, as LSQ has it
        return quantized(x, step * share + (step * (1 - share)).detach(), -self.zero, LEVELS - self.zero)


class QuantizedConv(nn.Module):
    """Convolution with a quantized kernel, ReLU or not, and quantization of the output or none.

    Where the output is quantized, so is the bias, to multiples of a step of the input times one of the kernel: what is empty is the same everywhere, and
    one step more of it everywhere would be too much.
    """

    def __init__(self, conv: nn.Conv2d, relu: nn.Module, before: Quantizer | None, out: nn.Module) -> None:
        super().__init__()
        self.conv, self.relu, self.out = conv, relu, out
        self._before = (before,)  # the quantizer of the input, which is no part of this module

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H', W')."""
        conv = self.conv
        kernel, bias = self.quantized() if self.training else (conv.weight, conv.bias)
        return self.out(self.relu(F.conv2d(x, kernel, bias, conv.stride, conv.padding)))

    @property
    def bias_step(self) -> Tensor | None:
        """Step sizes of the bias (outputs,), or None."""
        (before,) = self._before
        return None if before is None else weight_step(self.conv.weight) * before.log_step.detach().exp()

    def quantized(self) -> tuple[Tensor, Tensor]:
        """Quantize the kernel and the bias."""
        kernel, bias, step = self.conv.weight, self.conv.bias, self.bias_step
        if step is not None:
            bias = quantized(bias, step, -(2**31), 2**31)
        return quantized(kernel, weight_step(kernel)[:, None, None, None], -WEIGHT_LEVELS, WEIGHT_LEVELS), bias


def quantized_network(network: BevNetwork) -> BevNetwork:
    """Make a quantized network of the same weights; normalization is folded into its kernels.

    What is enlarged and added stays exact until the sum is quantized, and so do the maps.
    """

    def quantize(layers: Any, before: Quantizer) -> tuple[list[QuantizedConv], Quantizer]:
        steps = [before, *(Quantizer() for _ in layers)]
        convs = [
            QuantizedConv(fuse_conv_bn_eval(layer[0], layer[1]), nn.ReLU(), *pair)
            for layer, pair in zip(layers, pairwise(steps))
        ]
        return convs, steps[-1]

    network = copy.deepcopy(network).eval()
    before = network.entrance = Quantizer(INPUT_STEP, INPUT_ZERO)
    for name in ("stem", "down4", "down8", "down16"):
        convs, before = quantize(getattr(network, name), before)
        setattr(network, name, nn.Sequential(*convs))
    for k in (8, 4, 2):
        lateral = getattr(network, f"lateral{k}")
        exact = QuantizedConv(fuse_conv_bn_eval(lateral[0], lateral[1]), nn.ReLU(), None, nn.Identity())
        before = Quantizer()
        (merge,), _ = quantize([getattr(network, f"merge{k}")], before)
        for name, part in ((f"lateral{k}", exact), (f"sum{k}", before), (f"merge{k}", merge)):
            setattr(network, name, part)
    network.head = QuantizedConv(network.head, nn.Identity(), None, nn.Identity())
    return network.eval()


def quantize_kernels(network: nn.Module) -> dict[str, NDArray[np.float32]]:
    """Quantize kernels and biases for good, which training does at each step; return the steps (outputs,) of the biases by name."""
    steps = {}
    with torch.no_grad():
        for name, part in network.named_modules():
            if isinstance(part, QuantizedConv):
                if part.bias_step is not None:
                    steps[f"{name}.conv.bias"] = part.bias_step.numpy()
                for value, new in zip((part.conv.weight, part.conv.bias), part.quantized()):
                    value.copy_(new)
    return steps


def distillation_loss(maps: Tensor, wanted: Tensor, grid: Tensor) -> tuple[Tensor, dict[str, float]]:
    """Return how far maps (B, 25, h, w) are from those of the network in floats, where objects are to it, and the parts of that."""
    p = torch.sigmoid(wanted[:, HEAT])
    there = p.amax(1, keepdim=True)
    entropy = F.binary_cross_entropy_with_logits(maps[:, HEAT], p, reduction="none")
    least = F.binary_cross_entropy_with_logits(wanted[:, HEAT], p, reduction="none")
    parts = {"heat": HEAT_WEIGHT * (entropy - least).sum() / p.sum()}
    of_box = torch.cat([maps[:, part] - wanted[:, part] for part in (BOX, AXIS, DIRECTION)], 1).abs()
    parts["box"] = (of_box * there).sum() / there.sum()
    of_kind = torch.cat([maps[:, part] - wanted[:, part] for part in (CATEGORY, QUALITY)], 1).abs()
    parts["kind"] = 0.1 * (of_kind * there).sum() / there.sum()
    occupied = F.max_pool2d(grid[:, 3:4], 2)[:, 0].gt(0)
    segment = F.log_softmax(wanted[:, SEGMENT], 1)
    divergence = (segment.exp() * (segment - F.log_softmax(maps[:, SEGMENT], 1))).sum(1)
    parts["segment"] = divergence[occupied].mean()
    object_cells = (1 - segment[:, 0].exp()) * occupied
    off = (maps[:, VOTE] - wanted[:, VOTE]).abs().sum(1) * object_cells
    parts["vote"] = 0.3 * off.sum() / object_cells.sum().clamp(min=1)
    return torch.stack(list(parts.values())).sum(), {name: float(value.detach()) for name, value in parts.items()}
