"""Plug-ins of other packages: the examples of the cookbook run as installed, and a wrong one is one line that names its package."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from plugin_packages import PAGE, install, install_examples

from log2sim import Config, Scenario, open_log, reconstruct, replay
from log2sim.datatypes import Log
from log2sim.errors import LogError, PluginError
from log2sim.export.exporters import export
from log2sim.files import plugins
from log2sim.perception.detect3d.detectors import create_lidar_detector
from log2sim.perception.first_pass import cloud_origin
from log2sim.perception.lidar.cloud import Cloud, assemble_cloud
from log2sim.simulation import load_policy

PACKAGE = r"package 'broken 2\.1'"


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the search path, whose modules are forgotten after the test."""
    folder = tmp_path / "site"
    folder.mkdir()
    known = set(sys.modules)
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name in set(sys.modules) - known:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(folder)):
            del sys.modules[name]


@pytest.fixture
def examples(packages: Path) -> Path:
    install_examples(packages)
    return packages


def broken(packages: Path, kind: str, code: str, place: str = "THING") -> None:
    """Install the package `broken` with one plug-in of the name "mine"."""
    install(packages, "broken", code, {f"log2sim.{kind}": {"mine": f"broken:{place}"}}, "2.1")


def cloud_of(log: Log) -> Cloud:
    origin, ground_z = cloud_origin(log, int(log.streams["top"].t_ns[0]))
    sweeps = {"top": log.streams["top"].read(0)}
    cloud = assemble_cloud(log, sweeps, origin=origin, ground_z=ground_z, max_range_m=60.0)
    assert cloud is not None
    return cloud


# The examples of the cookbook


def test_there_is_an_example_of_every_kind(examples: Path) -> None:
    groups = set(re.findall(r"`log2sim\.(\w+)`", PAGE))
    assert groups == set(plugins.BUILT_IN)
    for kind in groups:
        (name,) = set(plugins.names(kind)) - set(plugins.BUILT_IN[kind])
        assert plugins.load(kind, name) is not None
        assert "package 'my-plugins 1.0'" in plugins.plugin_label(kind, name)


def test_the_log_reader_opens_a_folder(examples: Path, tmp_path: Path) -> None:
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{10**18 + k * 10**8}.png"), np.full((480, 640, 3), k, np.uint8))
    log = open_log(tmp_path)
    assert log.format == "frame-folder"
    assert log.streams["road"].t_ns.tolist() == [10**18, 10**18 + 10**8, 10**18 + 2 * 10**8]
    assert log.streams["road"].read(2).mean() == 2.0


def test_the_detector_runs(examples: Path, tiny_folder: Path) -> None:
    result = reconstruct(
        open_log(tiny_folder), Config(detect="center", stop_s=0.4, map={"lanes": False}, appearance={"colors": False})
    )
    assert result.scenario.provenance["detector"] == "center"
    assert result.report["detections"]["front"] == result.report["ticks"]


def test_the_lidar_detector_runs(examples: Path, tiny_folder: Path) -> None:
    log = open_log(tiny_folder)
    cloud = cloud_of(log)
    found = create_lidar_detector("lidar:highest", log, Config().lidar).detect(cloud)
    assert found.center_m[0, 2] + 0.75 == pytest.approx(cloud.xyz[cloud.height.argmax(), 2] + cloud.origin[2])


@pytest.mark.parametrize(
    ("wrong", "told"), [({"category": np.array(["bycicle"])}, "cyclist|bicycle"), ({"score": np.array([1.2])}, "1.2")]
)
def test_boxes_in_clouds_that_cannot_be_are_told(
    examples: Path, tiny_folder: Path, monkeypatch: pytest.MonkeyPatch, wrong: dict, told: str
) -> None:
    log = open_log(tiny_folder)
    detector, cloud = create_lidar_detector("lidar:highest", log, Config().lidar), cloud_of(log)
    boxes = replace(detector.detect(cloud).take(np.arange(1)), **wrong)
    monkeypatch.setattr(type(detector.inner), "detect", lambda *_: boxes)
    with pytest.raises(PluginError, match=f"row 0: .*({told})"):
        detector.detect(cloud)


def test_the_exporter_writes(examples: Path, tiny_folder: Path, tmp_path: Path) -> None:
    export(Scenario.load(tiny_folder / "truth.json"), "agent-list", tmp_path / "out")
    assert (tmp_path / "out" / "agents.txt").read_text().startswith("ego car\n")


def test_the_policy_drives(examples: Path, tiny_folder: Path) -> None:
    scenario = Scenario.load(tiny_folder / "truth.json")
    driven = replay(scenario, ego=load_policy("calm")).agent("ego")
    # At 3 m/s it never brakes, so it rolls on without throttle.
    assert driven.driver == "policy"
    assert driven.speed_mps == pytest.approx(np.full(len(driven), 3.0), abs=0.01)


def test_the_vehicle_model_drives(examples: Path, tiny_folder: Path) -> None:
    scenario = Scenario.load(tiny_folder / "truth.json")
    ours, kinematic = (replay(scenario, model=model) for model in ("halves", "kinematic"))
    assert "halves" in {a.model for a in ours.agents}
    assert ours.metrics["cross_track_max_m"] == pytest.approx(kinematic.metrics["cross_track_max_m"], abs=0.01)


# Wrong plug-ins


@pytest.mark.parametrize(
    ("kind", "code", "message"),
    [
        (
            "export",
            "import no_such_module",
            r"raised ModuleNotFoundError: No module named 'no_such_module' \(line 1 of broken\.py\)",
        ),
        ("export", "OTHER = 1", r"raised AttributeError: module 'broken' has no attribute 'THING'"),
        (
            "export",
            "class THING: pass",
            r"is the class THING, expected an object of it: name an instance, such as THING\(\)",
        ),
        ("export", "THING = 3", r"has no 'options', 'loses', 'write'; expected an object with options, loses, write"),
        (
            "export",
            "class E:\n    options, loses = (), ''\n    def write(self, scenario): pass\nTHING = E()",
            r"write\(scenario\) cannot be called as write\(scenario, folder, options\): too many positional arguments",
        ),
        ("detector", "THING = 3", r"is a int, expected create\(log, \*, min_score, max_overlap, tiles\)"),
        (
            "detector",
            "def THING(log): pass",
            r"THING\(log\) cannot be called as create\(.*\): got an unexpected keyword argument",
        ),
        (
            "log",
            "class R:\n    name = ''\nTHING = R()",
            r"has no 'looks_for', 'suffixes', 'matches', 'sequences', 'open'",
        ),
    ],
)
def test_what_is_no_plug_in_is_one_line_that_names_the_package(
    packages: Path, kind: str, code: str, message: str
) -> None:
    broken(packages, kind, code)
    with pytest.raises(PluginError, match=rf"'mine' of {PACKAGE} \(broken:THING\): {message}") as raised:
        plugins.load(kind, "mine")
    assert "\n" not in str(raised.value)


READER = """
class Reader:
    name, looks_for, suffixes = "mine", "nothing", ()
    def matches(self, path): return {matches}
    def sequences(self, path): return {sequences}
    def open(self, path, sequence): return {log}
THING = Reader()
"""


GOOD = {"matches": "True", "sequences": "['a']", "log": "None"}


@pytest.mark.parametrize("code", ["import no_such_module", READER.format(**{**GOOD, "matches": "path.nothing"})])
def test_a_broken_reader_keeps_no_other_log_from_being_opened(
    packages: Path, tiny_folder: Path, tmp_path: Path, code: str
) -> None:
    broken(packages, "log", code)
    log = open_log(tiny_folder)
    assert log.format == "log2sim"
    told = [note for note in log.notes if "'broken 2.1'" in note]
    assert len(told) == code.startswith("import")
    with pytest.raises((LogError, PluginError), match=PACKAGE):
        open_log(tmp_path)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("def THING(seen): return 1", r"policy at 0 s: answered int, expected log2sim\.simulation\.policy\.Controls"),
        (
            "class THING:\n    def __init__(self, x): pass",
            r"cannot be made: TypeError: .*missing 1 required positional argument: 'x'",
        ),
        ("THING = 3", r"is a int, expected a callable policy\(observation\) -> Controls"),
        ("def THING(seen): return seen.nothing", r"policy at 0 s: raised AttributeError"),
    ],
)
def test_a_policy_that_fails_is_one_line(packages: Path, tiny_folder: Path, code: str, message: str) -> None:
    broken(packages, "policy", code)
    with pytest.raises(PluginError, match=rf"^policy 'mine' of {PACKAGE} \(broken:THING\): {message}"):
        replay(Scenario.load(tiny_folder / "truth.json"), ego=load_policy("mine"))
