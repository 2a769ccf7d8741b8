"""Detection in LiDAR sweeps from the sensors to the scenario: without cameras, and joined with image boxes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from plain_settings import AGENTS_ALONE
from worlds import CAR, PARKED, WALKER, tiny_log, tiny_table

from log2sim.config import Config, LidarConfig
from log2sim.datatypes import Agent, Boxes3D, Detections, Frame, Log, Scenario
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.geometry import inverse, project_boxes, wrap_angle
from log2sim.perception.detect.detectors import create_detector
from log2sim.perception.detect3d.detectors import create_lidar_detector
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.run_detectors import Detectors
from log2sim.pipeline import infer_scenario, observe_log, reconstruct, start
from log2sim.report import Result

ALL_AROUND = [{**tiny_table()["lidar"][0], "azimuth_deg": [-180.0, 180.0], "azimuth_step_deg": 1.0, "channels": 20}]
BEHIND = PARKED | {"id": "behind", "pose": [-9.0, 4.0, 200.0]}


@pytest.fixture(scope="module")
def world() -> tuple[Log, Scenario]:
    return tiny_log([CAR, PARKED, WALKER, BEHIND], lidar=ALL_AROUND)


def nearest(result: Result, xy: Any) -> Agent | None:
    """The agent that is within 1 m of a place at some time."""
    for agent in result.scenario.others:
        if np.hypot(agent.waypoints.x_m - xy[0], agent.waypoints.y_m - xy[1]).min() < 1.0:
            return agent
    return None


def test_a_log_without_cameras_is_reconstructed(world: tuple[Log, Scenario]) -> None:
    log, truth = world
    blind = replace(log, cameras={}, streams={"top": log.streams["top"]}, reference_camera=None)
    result = reconstruct(blind, Config.load(settings=["detect.name=lidar:labels"], **AGENTS_ALONE))
    assert len(result.scenario.others) == 4
    table = evaluate(result.scenario, truth)
    assert table["recall"] == table["precision"] == 1.0
    assert result.report["sync"]["reference"] == "top"
    # The last sweep ends after the last label.
    assert result.report["detections"] == {"lidar:labels": 4 * (result.report["ticks"] - 1)}
    assert result.report["measurements"]["with_lidar"] == result.report["measurements"]["total"]
    assert result.scenario.provenance["detector"] == "lidar:labels"


@dataclass(frozen=True)
class Images:
    """Image boxes of the labels, some of them changed."""

    log: Log
    change: Callable[[Frame, Detections], Detections]
    name: str = "changed"
    default_min_score: float = 0.0

    def detect(self, frame: Frame) -> Detections:
        return self.change(frame, create_detector("labels", self.log).detect(frame))


@dataclass(frozen=True)
class Sweeps:
    """Boxes of the labels, some of them changed."""

    log: Log
    change: Callable[[Boxes3D], Boxes3D]
    name: str = "lidar:changed"

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        return self.change(create_lidar_detector("lidar:labels", self.log, LidarConfig()).detect(cloud))


def run_with(log: Log, images: Images | None, sweeps: Sweeps | None) -> Result:
    name = "+".join(["labels"] * (images is not None) + ["lidar:labels"] * (sweeps is not None))
    started = start(log, Config.load(settings=[f"detect.name={name}"]))
    started = replace(started, detectors=Detectors(images, sweeps))
    return infer_scenario(replace(started, plan=started.plan.only_agents()), observe_log(started))


def test_a_false_image_box_is_doubted_where_the_lidar_sees_something_else() -> None:
    container = {"center": [14.0, 6.0], "size_m": [4.4, 1.8, 1.6], "color": [190, 180, 170]}
    log, _ = tiny_log([CAR], lidar=ALL_AROUND, building=[container])

    def more(frame: Frame, found: Detections) -> Detections:
        cam_T_map = inverse(log.map_T_sensor("front", frame.t_ns)[0][0])
        center, size = np.array([[14.0, 6.0, 0.8]]), np.array([[4.4, 1.8, 1.6]])
        px = project_boxes(center, size, np.zeros(1), frame.camera, cam_T_map).box_px
        false = Detections(px, np.array([0.55]), np.array(["car"]))
        return Detections(*(np.concatenate([getattr(d, k) for d in (found, false)]) for k in vars(found)))

    alone, both = (run_with(log, Images(log, more), s) for s in (None, Sweeps(log, lambda boxes: boxes)))
    assert nearest(alone, (14.0, 6.0)) is not None
    assert nearest(both, (14.0, 6.0)) is None
    assert len(both.scenario.others) == 1


def test_a_moving_car_points_where_it_goes_though_boxes_say_the_opposite(world: tuple[Log, Scenario]) -> None:
    log, _ = world
    backward = Sweeps(log, lambda b: replace(b, yaw_rad=b.yaw_rad + np.pi, heading_score=np.full(len(b), 0.9)))
    car = next(a for a in run_with(log, None, backward).scenario.others if not a.static and a.category == "car")
    assert abs(wrap_angle(car.waypoints.yaw_rad)).max() < np.deg2rad(10)
    assert (car.waypoints.speed_mps > 2).all()
