"""Training of the LiDAR detector: samples, targets, loss, and a toy from scenes to a file that detects."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx", reason="needs the extra 'train'")

TOOLS = Path(__file__).parents[1] / "tools"
sys.path.insert(0, str(TOOLS))

import torch  # noqa: E402
import train_lidar  # noqa: E402
from lidar_training.export import description, export_onnx, import_onnx  # noqa: E402
from lidar_training.network import BevNetwork  # noqa: E402


@pytest.mark.slow
def test_a_toy_learns_to_find_vehicles(tmp_path) -> None:
    """A minute from nothing: what it finds on fresh scenes is mostly right."""
    train_lidar.generate("roadside", tmp_path / "data", 100, 5)
    train_lidar.fit("roadside", tmp_path / "data", tmp_path, [train_lidar.Round(5, 100, 420)])
    train_lidar.finish("roadside", tmp_path, [train_lidar.Round(5, 100, 420)], examples=12)
    card = json.loads((tmp_path / "roadside.json").read_text())
    assert card["simulated"]["vehicle"]["average_precision"] > 0.15
    assert (tmp_path / "roadside.onnx").stat().st_size < 1_000_000


def test_training_goes_on_from_the_network_in_a_file(tmp_path) -> None:
    """A network that is read back computes what it did, on other grids than those that its layers' moments were taken from."""
    torch.manual_seed(0)
    network = BevNetwork()
    for layer in network.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            for values in (layer.weight.data, layer.running_var):
                values.uniform_(0.5, 2.0)
            for values in (layer.bias.data, layer.running_mean):
                values.uniform_(-0.5, 0.5)
    torch.save({"mean": network.state_dict()}, tmp_path / "x.pt")
    export_onnx(tmp_path / "x.pt", tmp_path / "x.onnx", description("vehicle", 0.25, 40.0))
    grids = torch.rand(6, 12, 64, 64)
    again = import_onnx(tmp_path / "x.onnx", grids[:4])
    with torch.no_grad():
        expected = network.eval()(grids[4:])
        error = 2e-3 * float(expected.abs().max())  # weights are stored in half floats
        np.testing.assert_allclose(again(grids[4:]), expected, rtol=0, atol=error)
        # In training a layer is normalized by the batch, whose moments are those that were put in.
        np.testing.assert_allclose(again.train()(grids[:4]), network.eval()(grids[:4]), rtol=0, atol=error)
    assert (tmp_path / "x.onnx").stat().st_size < 0.55 * (tmp_path / "x.pt").stat().st_size
