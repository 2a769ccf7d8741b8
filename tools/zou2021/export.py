"""The network of Zou et al. (2021) as an ONNX file for `lidar:FILE.onnx --set lidar.decode=votes`."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lidar_training.export import MAX_EXPORT_ERROR, describe, description
from lidar_training.network import IN_CHANNELS

from log2sim.perception.detect3d.network import load_network
from zou2021.network import CELL_M, LaidOut, Zou2021Network

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
