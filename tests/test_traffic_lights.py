"""Traffic lights: from boxes with noise around true housings, in pictures of a synthetic junction, to signals with states."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from worlds import cloud_at

from log2sim.datatypes import Log, Scenario
from log2sim.geometry import box_corners, inverse, project
from log2sim.perception.frames import LightBox, add_ranges, crop_lights
from log2sim.perception.lidar.projection import view_of
from log2sim.road.signals import STATES, find_signals, lamp_evidence, place_lights
from log2sim.synth.scene import scene_from_table
from log2sim.synth.synthesis import synthesize

HOUSING_M = np.array([0.25, 0.34, 0.96])
LAMPS = {"red": (40, 40, 255), "yellow": (30, 190, 255), "green": (150, 235, 40)}


def drawn(state: str, height: int = 36, glare: bool = False) -> np.ndarray[Any, Any]:
    """A housing with three lamps, BGR."""
    image = np.full((height, height // 3 + 2, 3), (36, 36, 34), np.uint8)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    for k, (name, color) in enumerate(LAMPS.items()):
        r = np.hypot(v - height * (0.2 + 0.3 * k), u - image.shape[1] / 2) / (height * 0.11)
        image[r < 1] = color if name in state.split("_") else np.array(color) // 8
        if glare and name in state.split("_"):
            image[r < 0.5] = 255
    return image


@lru_cache(maxsize=2)
def junction(moving: bool = True) -> tuple[Log, Scenario]:
    program = [["red", 1.5], ["red_yellow", 1.0], ["green", 4.0], ["yellow", 3.0]]
    lights = [
        {"id": "right", "position": [14.0, -4.6, 3.2], "yaw_deg": 180, "program": program},
        {"id": "left", "position": [16.0, 4.8, 3.6], "yaw_deg": 180, "program": [["green", 1.0], ["yellow", 2.0], ["red", 9.0]]},
    ]  # fmt: skip
    camera = {"name": "front", "position_m": [1.6, 0, 1.5], "fov_deg": 70, "size_px": [640, 400], "rate_hz": 5}
    table = {
        "name": "junction", "duration_s": 4.0, "traffic_light": lights, "camera": [camera],
        "road": [{"line": [[-60, 0], [60, 0]], "width_m": 8.0}],
        "ego": {"waypoints": [[-14, -1.8, 5.0 if moving else 0.0], [60, -1.8, 5.0]], "wait_s": [] if moving else [[0, 20.0]]},
    }  # fmt: skip
    return synthesize(scene_from_table(table), observe=False)


@lru_cache(maxsize=2)
def boxes_of(moving: bool = True) -> list[LightBox]:
    """Boxes around the true housings with errors of a pixel, and the pictures in them."""
    (log, truth), rng, out = junction(moving), np.random.default_rng(0), []
    for index, t_ns in enumerate(log.streams["front"].t_ns.tolist()):
        image = log.streams["front"].read(index)
        cam_T_map = inverse(log.map_T_sensor("front", t_ns)[0][0])
        rows = []
        for signal in truth.signals:
            corners = box_corners(signal.position_m, HOUSING_M, signal.heading_rad or 0.0)[0]
            uv, seen = project(log.cameras["front"], corners @ cam_T_map[:3, :3].T + cam_T_map[:3, 3])
            if seen.all():
                rows.append([*(uv.min(axis=0) + rng.normal(size=2)), *(uv.max(axis=0) + rng.normal(size=2)), 0.6])
        out += crop_lights("front", t_ns, image, np.array(rows).reshape(-1, 5))
    return out


def test_signals_of_a_junction_are_placed_and_change_when_they_do() -> None:
    log, truth = junction()
    signals, seen = find_signals(log, truth, boxes_of())
    assert seen == "2 traffic lights"
    for true in truth.signals:
        found = min(signals, key=lambda s: float(np.linalg.norm(s.position_m - true.position_m)))
        assert np.linalg.norm(found.position_m - true.position_m) < 3 * found.sigma_m + 0.3 < 4.0
        assert true.heading_rad is not None
        assert found.heading_rad is not None
        assert np.cos(found.heading_rad - true.heading_rad) > 0.85
        t_s = np.arange(found.t_s[0], found.t_s[-1], 0.05)
        assert np.mean(found.at(t_s) == true.at(t_s)) > 0.9
        assert found.confidence > 0.8


def test_a_range_by_lidar_points_makes_the_distance_sure() -> None:
    log, truth = junction(moving=False)
    boxes = boxes_of(moving=False)
    eye = log.map_T_sensor("front", boxes[0].t_ns)[0][0][:3, 3]
    near = [
        min((s.position_m for s in truth.signals), key=lambda p: abs(np.arctan2(*(p - eye)[[1, 0]]) - _azimuth(log, b)))
        for b in boxes
    ]
    ranged = [
        LightBox(b.camera, b.t_ns, b.box_px, b.score, b.crop, float(np.linalg.norm(p - eye)))
        for b, p in zip(boxes, near)
    ]
    for housing in place_lights(log, ranged):
        off = min(float(np.linalg.norm(housing.position - s.position_m)) for s in truth.signals)
        assert off < 0.5
        assert housing.sigma_m < 0.5


def _azimuth(log: Log, box: LightBox) -> float:
    camera = log.cameras["front"]
    return float(-np.arctan(((box.box_px[0] + box.box_px[2]) / 2 - camera.K[0, 2]) / camera.K[0, 0]))


def test_boxes_that_do_not_repeat_or_never_shine_are_no_signals() -> None:
    log, truth = junction()
    boxes = boxes_of()
    assert find_signals(log, truth, boxes[:2])[0] == ()
    dark = [LightBox(b.camera, b.t_ns, b.box_px, b.score, drawn("off")) for b in boxes]
    signals, seen = find_signals(log, truth, dark)
    assert signals == ()
    assert "no lamp lit" in seen
    assert find_signals(log, truth, [])[1] == "no traffic light seen"


@pytest.mark.parametrize("glare", [False, True])
@pytest.mark.parametrize("state", ["red", "yellow", "green", "off", "red_yellow"])
@pytest.mark.parametrize("height", [18, 36])
def test_the_lamp_that_shines_is_told(state: str, glare: bool, height: int) -> None:
    assert STATES[int(np.argmax(lamp_evidence(drawn(state, height, glare))))] == state


def test_points_in_the_middle_of_a_box_give_its_range() -> None:
    log, truth = junction(moving=False)
    box = boxes_of(moving=False)[0]
    signal = min(
        truth.signals, key=lambda s: abs(_azimuth(log, box) - np.arctan2(s.position_m[1] + 1.8, s.position_m[0] + 12.4))
    )
    offsets = np.array([[0, 0, 0], [0, 0.03, 0.1], [0, -0.03, -0.1], [3.0, 0, 0], [0, 0, -2.5]])
    cloud = cloud_at(signal.position_m + offsets, sensor=(0.0, 0.0, 0.0))
    view = view_of(log, "front", box.t_ns)
    assert view is not None
    expected = np.linalg.norm(signal.position_m - view.map_T_cam[:3, 3])
    aside = LightBox("front", box.t_ns, box.box_px + 150, 0.5, box.crop)
    near, none = add_ranges([box, aside], view, cloud)
    assert near.range_m == pytest.approx(expected, abs=0.05)
    assert np.isnan(none.range_m)
