"""Logs of other kinds than the sample: slow and fast sensors, a minibus at the curb."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from plain_settings import AGENTS_ALONE
from worlds import tiny_log

from log2sim.config import Config
from log2sim.datatypes import Log, Scenario, Stream
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.pipeline import reconstruct

pytestmark = pytest.mark.slow
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


@pytest.mark.parametrize("rate_hz", [20, 2])
def test_everybody_is_found_at_any_rate(world_at_20_hz: tuple[Log, Scenario], rate_hz: int) -> None:
    log, truth = world_at_20_hz
    found = evaluate(reconstruct(every(log, 20 // rate_hz), LABELS).scenario, truth)
    assert found["recall"] >= 0.95
    assert found["precision"] >= 0.9
    assert found["position_median_m"] < 0.3
    assert found["id_switches"] == 0


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
