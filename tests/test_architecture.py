"""log2sim/README.md tells what is true: rooms in their order, names that exist, examples that run when registered."""

from __future__ import annotations

import importlib
import re
import sys
import tomllib
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from lidar_networks import write_network
from test_layers import RANKED, ROOT

from log2sim import Config, Scenario, open_log, reconstruct, registry, replay
from log2sim.datatypes import Log
from log2sim.export.exporters import export
from log2sim.perception.detect3d.detectors import create_lidar_detector
from log2sim.perception.first_pass import cloud_origin
from log2sim.perception.lidar.viewpoints import assemble_cloud
from log2sim.simulation import runner, simulators

TEXT = (ROOT / "log2sim" / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def example(defines: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import the example that defines a name as the module `my_package`."""
    (code,) = [code for code in EXAMPLES if re.search(rf"^(class|def) {defines}\b", code, re.MULTILINE)]
    module = ModuleType("my_package")
    monkeypatch.setitem(sys.modules, "my_package", module)
    exec(compile(code, "log2sim/README.md", "exec"), vars(module))
    return module


def register(kind: str, name: str, attribute: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.BUILT_IN[kind], name, f"my_package:{attribute}")


def test_the_picture_shows_every_room_in_the_order_of_its_rank() -> None:
    picture = re.search(r"```text\n(.*?)```", TEXT, re.DOTALL)
    assert picture is not None
    shown = [word for line in picture[1].splitlines() for word in line[17:53].split()]
    assert sorted(shown) == sorted(RANKED)
    rank = {room: k for k, room in enumerate(RANKED)}
    lines = [[rank[word] for word in line[17:53].split()] for line in picture[1].splitlines()]
    for above, below in pairwise(lines):
        assert min(above) > max(below)


@pytest.mark.parametrize(("path", "name"), sorted(set(re.findall(r"`([\w/]+\.py)` `(\w+)`", TEXT))))
def test_the_names_exist(path: str, name: str) -> None:
    module = importlib.import_module(f"log2sim.{path.removesuffix('.py').replace('/', '.')}")
    assert name in vars(module)


def test_the_pipeline_calls_the_functions_of_the_table_in_their_order() -> None:
    source = (ROOT / "log2sim" / "pipeline.py").read_text(encoding="utf-8")
    rows = re.findall(r"^\| [\w ]+ \| `[\w/.]+` `(\w+)`", TEXT, re.MULTILINE)
    called = {name: source.rfind(f" {name}(") for name in rows if f" {name}(" in source}
    second_pass = [name for name in rows[rows.index("fit_homographies") :] if name in called]
    assert len(second_pass) >= 6
    assert second_pass == sorted(second_pass, key=called.__getitem__)


def test_there_is_an_example_for_each_kind_of_plug_in() -> None:
    assert len(EXAMPLES) == 6
    for kind in registry.BUILT_IN:
        assert f"kind `{kind}`" in TEXT
    entry = tomllib.loads(re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)[0])
    assert entry["project"]["entry-points"] == {"log2sim.log": {"frame-folder": "my_package.reader:READER"}}


def test_the_log_reader_opens_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    example("FrameFolder", monkeypatch)
    register("log", "frame-folder", "READER", monkeypatch)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{10**18 + k * 10**8}.png"), np.full((480, 640, 3), k, np.uint8))
    log = open_log(tmp_path)
    assert log.format == "frame-folder"
    assert log.streams["road"].t_ns.tolist() == [10**18, 10**18 + 10**8, 10**18 + 2 * 10**8]
    assert log.streams["road"].read(2).mean() == 2.0


def test_the_detector_runs(tiny_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    example("CenterDetector", monkeypatch)
    register("detector", "center", "create", monkeypatch)
    log: Log = open_log(tiny_folder)
    result = reconstruct(log, Config.load(detect={"name": "center"}))
    assert result.scenario.provenance["detector"] == "center"
    assert result.report["detections"]["front"] == result.report["ticks"]


def test_the_lidar_detector_runs(tiny_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    example("HighestPoint", monkeypatch)
    register("lidar_detector", "highest", "create_highest", monkeypatch)
    log: Log = open_log(tiny_folder)
    detector = create_lidar_detector("lidar:highest", log, Config().lidar)
    origin, ground_z = cloud_origin(log, int(log.streams["top"].t_ns[0]))
    cloud = assemble_cloud(log, {"top": log.streams["top"].read(0)}, origin=origin, ground_z=ground_z, max_range_m=60.0)
    assert cloud is not None
    found = detector.detect(cloud)
    assert found.center_m[0, 2] + 0.75 == pytest.approx(cloud.xyz[cloud.height.argmax(), 2] + origin[2])


def test_the_network_describes_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = example("describe", monkeypatch)
    bare = write_network(tmp_path / "bare.onnx")
    module.describe(str(bare), str(tmp_path / "mine.onnx"))
    log = Log("made", "log2sim", {}, {}, {})
    detector: Any = create_lidar_detector(f"lidar:{tmp_path / 'mine.onnx'}", log, Config().lidar)
    assert detector.network.info.name == "mine"


def test_the_exporter_writes(tiny_scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    example("AgentList", monkeypatch)
    register("export", "list", "EXPORTER", monkeypatch)
    export(Scenario.load(tiny_scenario), "list", tmp_path / "out")
    assert (tmp_path / "out" / "agents.txt").read_text().startswith("ego car\n")


def test_the_vehicle_model_drives(tiny_scenario: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = example("step_in_halves", monkeypatch)
    monkeypatch.setitem(simulators.STEPS, "halves", module.step_in_halves)
    monkeypatch.setattr(runner, "MODELS", (*runner.MODELS, "halves"))
    scenario = Scenario.load(tiny_scenario)
    ours, kinematic = (replay(scenario, model=model) for model in ("halves", "kinematic"))
    assert {a.model for a in ours.agents} >= {"halves"}
    assert ours.metrics["cross_track_max_m"] == pytest.approx(kinematic.metrics["cross_track_max_m"], abs=0.01)
