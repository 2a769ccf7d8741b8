"""Every parser on damaged files and any text: what it raises is our error that says where, and nothing else passes."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest
from damaged_bytes import damaged, quick, result_or_refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from log_encoders import argoverse, kitti, kitti_object, native, nuscenes, pandaset, ros, waymo, waymo_parquet
from log_encoders.world import make_world
from worlds import tiny_toml

from log2sim.config import Config
from log2sim.datatypes import Log, Scenario
from log2sim.errors import ConfigError, Log2SimError, LogError, RecordError, ScenarioError
from log2sim.evaluation.detection.boxes import DetectedBoxes
from log2sim.export.exporters import Options, export
from log2sim.export.openscenario.read import load
from log2sim.export.roads.opendrive import require_roads
from log2sim.export.xml_text import read
from log2sim.files.documents import read_json
from log2sim.logs.opening import open_log
from log2sim.logs.ros.messages import read_settings
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay
from log2sim.synth.scene import load_scene

few = settings(quick, max_examples=25)
fewer = settings(quick, max_examples=8)


@cache
def short_world() -> Log:
    return make_world(duration_s=0.25)


@pytest.fixture(scope="module")
def sound(tiny_scenario: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """A sound file of each kind of document."""
    folder = tmp_path_factory.mktemp("sound")
    scenario = Scenario.load(tiny_scenario)
    export(scenario, "openscenario", folder / "x", Options())
    replay(scenario, mode="exact", dt_s=0.1).save(folder / "replay.json")
    return {
        "scenario": tiny_scenario.read_bytes(),
        "replay": (folder / "replay.json").read_bytes(),
        "xosc": next((folder / "x").glob("*.xosc")).read_bytes(),
        "xodr": next((folder / "x").glob("*.xodr")).read_bytes(),
        "settings": Config().to_toml().encode(),
        "scene": tiny_toml().encode(),
        "topics": b'reference_camera = "a"\n[cameras.a]\nimages = "/a/image"\n[poses]\nsource = "tf"\n',
        "json": json.dumps({"a": [1.5, None, {"b": "\u00e9"}]}).encode(),
    }


DOCUMENTS: dict[str, tuple[Callable[[Path], Any], type[Exception]]] = {
    "scenario": (Scenario.load, ScenarioError),
    "replay": (Replay.load, ScenarioError),
    "xosc": (load, ScenarioError),
    "xodr": (lambda path: require_roads(read(path), str(path)), LogError),
    "settings": (Config.load, ConfigError),
    "scene": (load_scene, ConfigError),
    "topics": (lambda path: read_settings([path]), ConfigError),
    "json": (lambda path: read_json(path), LogError),
}


@pytest.mark.parametrize("kind", DOCUMENTS)
@few
@given(data=st.data())
def test_a_damaged_document_is_an_error_or_a_value(
    tmp_path: Path, sound: dict[str, bytes], kind: str, data: st.DataObject
) -> None:
    parse, error = DOCUMENTS[kind]
    path = tmp_path / "file"
    path.write_bytes(data.draw(damaged(sound[kind])))
    result_or_refusal(lambda: parse(path), error, str(path))


json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**40), 10**40) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.parametrize("parse", [Scenario.from_dict, Replay.from_dict, DetectedBoxes.from_dict])
@few
@given(data=st.data())
def test_any_value_in_a_document_is_an_error_or_a_value(
    sound: dict[str, bytes], parse: Callable[[Any], Any], data: st.DataObject
) -> None:
    boxes = {"format": "log2sim-boxes", "boxes_version": 1, "frames": []}
    document = {
        Scenario.from_dict: json.loads(sound["scenario"]),
        Replay.from_dict: json.loads(sound["replay"]),
        DetectedBoxes.from_dict: boxes,
    }[parse]
    holder, key = {"": document}, ""
    while isinstance(holder[key], (dict, list)) and holder[key] and data.draw(st.integers(0, 3)):
        holder = holder[key]
        key = data.draw(st.sampled_from(sorted(holder) if isinstance(holder, dict) else range(len(holder))))
    holder[key] = data.draw(json_values)
    with contextlib.suppress(Log2SimError):
        parse(document)


def _bag(container: str) -> Callable[[Log, Path], Path]:
    return lambda log, folder: ros.encode_as(log, folder, ros.Style(container=container))


CONTAINERS: dict[str, tuple[Callable[[Log, Path], Path], str]] = {
    "bag": (_bag("bag"), "*.bag"),
    "db3": (_bag("db3"), "*/*"),
    "mcap": (_bag("mcap"), "*.mcap"),
    "waymo v1": (waymo.encode, "*.tfrecord"),
    "waymo v2": (waymo_parquet.encode, "*/*.parquet"),
    "argoverse 2": (argoverse.encode, "*/*.feather"),
    "nuscenes": (nuscenes.encode_world, "*/*.json"),
    "pandaset": (pandaset.encode, "*/**/*.*"),
    "kitti raw": (kitti.encode_raw, "**/*.txt"),
    "kitti tracking": (kitti.encode_tracking, "**/*.txt"),
    "kitti object": (kitti_object.encode, "**/*.*"),
    "log2sim": (native.encode, "**/*.*"),
}


@pytest.fixture(scope="module", params=CONTAINERS)
def container(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """What is opened, the folder that it is in, and which of its files are damaged."""
    encode, pattern = CONTAINERS[request.param]
    folder = tmp_path_factory.mktemp("container")
    return encode(short_world(), folder), folder, pattern


def read_all(path: Path) -> None:
    """Open a log and read all that a run may read; records may be refused one by one, each in one line."""
    log = open_log(path)
    assert log.streams
    for stream in log.streams.values():
        for i in range(len(stream.t_ns)):
            result_or_refusal(partial(stream.read, i), RecordError, "")
    assert all("\n" not in note for note in log.notes)
    _ = log.labels


@pytest.mark.matrix
@fewer
@given(data=st.data())
def test_a_log_with_a_damaged_file_is_an_error_or_a_log(
    container: tuple[Path, Path, str], tmp_path: Path, data: st.DataObject
) -> None:
    path, folder, pattern = container
    copy = tmp_path / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    file = data.draw(st.sampled_from(sorted(copy.glob(pattern))))
    file.write_bytes(data.draw(damaged(file.read_bytes())))
    result_or_refusal(lambda: read_all(copy / path.relative_to(folder)), Log2SimError, str(tmp_path))
