"""Logs with LiDARs alone, at the roadside, without poses, of other rates and vehicles: commands work or say in a line why not."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import names, run
from plain_settings import AGENTS_ALONE, AGENTS_ONLY
from worlds import tiny_log, tiny_table

from log2sim.config import Config
from log2sim.datatypes import Log, Scenario, Stream
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.files import plugins
from log2sim.logs.native.writer import write_log
from log2sim.pipeline import reconstruct

TOP, FRONT = tiny_table()["lidar"][0], tiny_table()["camera"][0]
POLE = {
    **TOP, "name": "pole", "mount": "map", "position_m": [0.0, -6.0, 5.0], "yaw_deg": 20.0, "elevation_deg": [-40.0, -2.0],
    "channels": 40,
}  # fmt: skip
EYE = {**FRONT, "name": "eye", "mount": "map", "position_m": [0.0, -6.0, 5.0], "yaw_deg": 20.0, "pitch_deg": -12.0}
# What each log lacks or adds against one camera and one LiDAR on an ego, and the detector of its labels.
SETUPS: dict[str, tuple[dict[str, Any], str]] = {
    "lidar": ({"camera": []}, "lidar:labels"),
    "roadside-lidar": ({"camera": [], "lidar": [POLE], "ego": None}, "lidar:labels"),
    "roadside": ({"camera": [EYE], "lidar": [POLE], "ego": None}, "labels"),
    "roadside-camera": ({"camera": [EYE], "lidar": [], "ego": None}, "labels"),
    "car-and-roadside": ({"camera": [EYE], "lidar": [POLE, TOP]}, "labels"),
}
# The others hold nothing that these do not; they take as long again.
EACH = [name if name in ("lidar", "roadside") else pytest.param(name, marks=pytest.mark.slow) for name in SETUPS]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, Path]]:
    """The log of a setup and the scenario of its labels, each made once."""
    root, known = tmp_path_factory.mktemp("setups"), {}

    def make(name: str) -> tuple[Path, Path]:
        if name not in known:
            changes, detector = SETUPS[name]
            log, truth = tiny_log(name=name, **changes)
            write_log(log, root / name)
            truth.save(root / name / "truth.json")
            scenario, quick = root / f"{name}.json", AGENTS_ONLY if detector == "labels" else ()
            ran = run("reconstruct", root / name, "--out", scenario, "--detector", detector, "--quiet", *quick)
            assert ran.code == 0, ran.err
            known[name] = root / name, scenario
        return known[name]

    return make


@pytest.mark.matrix
@pytest.mark.parametrize("name", EACH)
def test_the_scenario_is_that_of_the_world(made: Callable[[str], tuple[Path, Path]], name: str, tmp_path: Path) -> None:
    log, scenario = made(name)
    loaded = Scenario.load(scenario)
    assert (loaded.ego is None) == name.startswith("roadside")
    for k, truth in enumerate((log, log / "truth.json")):
        assert run("evaluate", scenario, "--truth", truth, "--out", tmp_path / f"{k}.json", "--quiet").code == 0
        figures = json.loads((tmp_path / f"{k}.json").read_text())
        assert figures["recall"] == 1.0
        assert figures["precision"] == 1.0
        assert figures["position_rmse_m"] < 0.4


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH)
def test_the_scenario_is_drawn_replayed_changed_and_exported(
    made: Callable[[str], tuple[Path, Path]], name: str, tmp_path: Path
) -> None:
    log, scenario = made(name)
    first = Scenario.load(scenario).others[0].id
    commands = [
        ("replay", scenario, "--out", tmp_path / "r.json"),
        ("replay", scenario, "--out", tmp_path / "reactive.json", "--agents", "reactive"),
        ("plot", scenario, "--out", tmp_path / "p.png", "--replay", tmp_path / "r.json", "--truth", log),
        ("view", scenario, "--out", tmp_path / "v.html", "--replay", tmp_path / "r.json", "--truth", log),
        ("edit", scenario, "--out", tmp_path / "e.json", "--remove", first),
    ]
    for command in commands:
        ran = run(*command, "--quiet") if command[0] != "plot" else run(*command)
        assert ran.code == 0, (command, ran.err)
    ego = ("--ego", first) if name.startswith("roadside") else ()
    for format in plugins.names("export"):
        if format == "rerun":
            continue  # needs its package
        ran = run("export", scenario, "--to", format, "--out", tmp_path / format, *ego, "--quiet")
        assert ran.code == 0, (format, ran.err)
        assert names(tmp_path / format)


def test_sensors_at_the_road_stand_in_the_scenario_with_where_they_look(
    made: Callable[[str], tuple[Path, Path]],
) -> None:
    scenario = Scenario.load(made("roadside")[1])
    eye, pole = scenario.sensors
    assert [(s["name"], s["kind"]) for s in (eye, pole)] == [("eye", "camera"), ("pole", "lidar")]
    for sensor in (eye, pole):
        assert (sensor["x_m"], sensor["y_m"], sensor["z_m"]) == pytest.approx((0.0, -6.0, 5.0), abs=1e-6)
        assert sensor["yaw_rad"] == pytest.approx(math.radians(20.0), abs=0.01)
    # A camera of 70 degrees that looks down shows a wider part of the ground.
    tilt = math.cos(math.radians(12.0))
    assert eye["fov_rad"] == pytest.approx(2 * math.atan(math.tan(math.radians(35.0)) / tilt), abs=0.02)
    assert pole["fov_rad"] == pytest.approx(math.radians(120.0), abs=0.02)
    moved = scenario.aligned_to(replace(scenario, map=replace(scenario.map, offset_m=(100.0, 0.0, 0.0))))
    assert abs(moved.sensors[0]["x_m"]) == pytest.approx(100.0)


LABELS = Config.load(None, ["detect.name=labels"], **AGENTS_ALONE)
AROUND = {"azimuth_deg": [-130.0, 130.0], "channels": 20, "elevation_deg": [-18.0, 3.0]}


def sensors(rate_hz: float = 10.0, step_deg: float = 0.8) -> dict[str, Any]:
    """Three small cameras and a coarse LiDAR that see all but what is behind."""
    cameras = [
        {"name": name, "position_m": [1.5, 0.0, 1.6], "yaw_deg": yaw, "fov_deg": 90.0, "size_px": [400, 240],
         "offset_s": 0.03, "rate_hz": rate_hz}
        for name, yaw in (("front", 0.0), ("left", 85.0), ("right", -85.0))
    ]  # fmt: skip
    lidar = {
        "name": "top",
        "position_m": [1.2, 0.0, 1.9],
        "rate_hz": rate_hz,
        "range_m": 60.0,
        "azimuth_step_deg": step_deg,
    }
    return {"camera": cameras, "lidar": [lidar | AROUND]}


def every(log: Log, step: int) -> Log:
    """The log with every so-many-th record."""

    def thin(s: Stream) -> Stream:
        return replace(s, t_ns=s.t_ns[::step], read=lambda i: s.read(i * step))

    return replace(log, streams={name: thin(s) for name, s in log.streams.items()})


@pytest.fixture(scope="module")
def world_at_20_hz() -> tuple[Log, Scenario]:
    agents = [
        {"id": "ahead", "category": "car", "waypoints": [[14.0, 0.0, 7.0], [80.0, 0.0, 9.0]]},
        {"id": "oncoming", "category": "car", "waypoints": [[55.0, 3.5, 8.0], [-60.0, 3.5, 8.0]]},
        {"id": "parked", "category": "car", "pose": [22.0, -4.0, 0.0]},
        {"id": "walker", "category": "pedestrian", "waypoints": [[16.0, -6.5, 1.4], [8.0, -6.5, 1.4]]},
    ]
    ego = {"waypoints": [[0.0, 0.0, 6.0], [40.0, 0.0, 7.0]], "poses": "poses"}
    return tiny_log(agents, duration_s=4.5, ego=ego, **sensors(20.0))


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [20, 2])
def test_everybody_is_found_at_any_rate(world_at_20_hz: tuple[Log, Scenario], rate_hz: int) -> None:
    log, truth = world_at_20_hz
    found = evaluate(reconstruct(every(log, 20 // rate_hz), LABELS).scenario, truth)
    assert found["recall"] >= 0.95
    assert found["precision"] >= 0.9
    assert found["position_median_m"] < 0.3
    assert found["id_switches"] == 0


@pytest.mark.slow
def test_a_minibus_at_the_curb_neither_slides_nor_turns_nor_grows() -> None:
    size = (7.5, 2.3, 2.9)
    parked = {"id": "minibus", "category": "bus", "size_m": list(size), "pose": [11.75, -3.55, 0.0]}
    ego = {"waypoints": [[0.0, 0.0, 8.0], [60.0, 0.0, 8.0]], "poses": "poses"}
    log, _ = tiny_log([parked], duration_s=2.6, ego=ego, **sensors())
    (found,) = reconstruct(log, LABELS).scenario.others
    assert found.static
    assert found.size_m[:2] == pytest.approx(size[:2], abs=0.5)
    w = found.waypoints
    assert np.hypot(w.x_m - 11.75, w.y_m + 3.55).max() < 0.3
    assert np.degrees(np.abs(np.sin(w.yaw_rad))).max() < 3.0
