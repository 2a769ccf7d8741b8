"""Batches of samples from several sources, such as simulated shards and frames of a real log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from lidar_training.losses import loss_of
from lidar_training.samples import Sample, Shard, augmented, grid_of, window_of
from lidar_training.targets import targets_of
from numpy.typing import NDArray
from torch import Tensor, nn

from zou2021.network import CELL_M, loss_of_cells
from zou2021.targets import cell_targets

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
