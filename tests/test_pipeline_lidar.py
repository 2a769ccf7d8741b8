"""Detection in LiDAR sweeps from the sensors to the scenario: without cameras, and joined with image boxes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from worlds import CAR, PARKED, WALKER, tiny_log, tiny_table

from log2sim.config import Config
from log2sim.datatypes import Agent, Log, Scenario
from log2sim.errors import ConfigError, LogError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.pipeline import Result, reconstruct

ALL_AROUND = [{**tiny_table()["lidar"][0], "azimuth_deg": [-180.0, 180.0], "azimuth_step_deg": 1.0, "channels": 20}]
BEHIND = PARKED | {"id": "behind", "pose": [-9.0, 4.0, 200.0]}


@pytest.fixture(scope="module")
def world() -> tuple[Log, Scenario]:
    return tiny_log([CAR, PARKED, WALKER, BEHIND], lidar=ALL_AROUND)


def run(log: Log, detector: str, *settings: str) -> Result:
    return reconstruct(log, Config.load(settings=[f"detect.name={detector}", *settings]))


def nearest(result: Result, xy: Any) -> Agent | None:
    """The agent that is within 1 m of a place at some time."""
    for agent in result.scenario.others:
        if np.hypot(agent.waypoints.x_m - xy[0], agent.waypoints.y_m - xy[1]).min() < 1.0:
            return agent
    return None


def test_a_log_without_cameras_is_reconstructed(world: tuple[Log, Scenario]) -> None:
    log, truth = world
    blind = replace(log, cameras={}, streams={"top": log.streams["top"]}, reference_camera=None)
    result = run(blind, "lidar:labels")
    assert len(result.scenario.others) == 4
    table = evaluate(result.scenario, truth)
    assert table["recall"] == table["precision"] == 1.0
    assert result.report["sync"]["reference"] == "top"
    # The last sweep ends after the last label.
    assert result.report["detections"] == {"lidar:labels": 4 * (result.report["ticks"] - 1)}
    assert result.report["measurements"]["with_lidar"] == result.report["measurements"]["total"]
    assert result.scenario.provenance["detector"] == "lidar:labels"


def test_a_detector_in_sweeps_leaves_the_cameras_of_a_log_alone(world: tuple[Log, Scenario]) -> None:
    log, _ = world

    def broken(_: int) -> Any:
        raise AssertionError("an image was read")

    unread = replace(log, streams=dict(log.streams) | {"front": replace(log.streams["front"], read=broken)})
    result = run(unread, "lidar:labels")
    plan = {entry["stage"]: entry for entry in result.report["plan"]}
    for stage in ("image decoding", "detection in every frame", "homography", "fusion of cameras"):
        assert not plan[stage]["kept"]
        assert "no camera is used" in plan[stage]["reason"]
    assert plan["detection in LiDAR sweeps"]["reason"] == "detector 'lidar:labels'"
    assert [c["used"] for c in result.scenario.cameras] == [False]


def test_an_object_outside_all_cameras_is_found_by_the_lidar_alone(world: tuple[Log, Scenario]) -> None:
    log, _ = world
    assert nearest(run(log, "labels"), BEHIND["pose"]) is None
    for detector in ("lidar:labels", "labels+lidar:labels"):
        found = nearest(run(log, detector), BEHIND["pose"])
        assert found is not None
        assert found.category == "car"


def test_both_detectors_together_see_every_object_once(world: tuple[Log, Scenario]) -> None:
    log, truth = world
    result = run(log, "labels+lidar:labels")
    assert len(result.scenario.others) == 4
    assert evaluate(result.scenario, truth)["precision"] == 1.0
    assert result.scenario.provenance["detector"] == "labels+lidar:labels"
    assert set(result.report["detections"]) == {"front", "lidar:labels"}


def test_sensors_that_a_detector_needs_are_asked_for(world: tuple[Log, Scenario]) -> None:
    log, _ = world
    with pytest.raises(ConfigError, match=r"--cameras: detector 'lidar:labels' uses no camera"):
        run(log, "lidar:labels", "cameras=front")
    with pytest.raises(LogError, match="the log has no LiDAR; detector 'lidar:labels' needs one"):
        run(replace(log, lidars={}), "labels+lidar:labels")
    with pytest.raises(LogError, match=r"no camera, which detector 'labels' needs; .* --detector lidar:vehicle"):
        run(replace(log, cameras={}), "labels+lidar:labels")
    with pytest.raises(ConfigError, match=r"sync\.reference: LiDAR 'front' is not used; used: top"):
        run(log, "lidar:labels", "sync.reference=front")
