"""Intensities of LiDAR returns: paint returns more than asphalt where the ground is painted, until it is wet."""

from __future__ import annotations

from typing import Any

import numpy as np
from worlds import tiny_log

from log2sim.datatypes import Log, Scenario
from log2sim.geometry import apply

DENSE: dict[str, Any] = {
    "name": "top",
    "position_m": [1.2, 0.0, 1.9],
    "channels": 64,
    "elevation_deg": [-25.0, -4.0],
    "azimuth_step_deg": 0.25,
    "range_m": 60.0,
    "noise_m": 0.0,
}


def street(**changes: Any) -> tuple[Log, Scenario]:
    road = {"line": [[-60.0, 0.0], [60.0, 0.0]], "width_m": 10.0, "sidewalk_m": 0.0, "marking": "solid"}
    return tiny_log([], observe=False, camera=[], lidar=[DENSE], road=[{**road, **changes.pop("road", {})}], **changes)


def test_intensities_move_no_point_and_come_again_with_the_seed() -> None:
    first, again = (street()[0].streams["top"].read(4) for _ in range(2))
    assert np.array_equal(first.intensity, again.intensity)
    assert first.intensity.min() >= 1
    assert first.intensity.max() <= 255
    painted, bare = (street(road={"marking": kind})[0].streams["top"].read(4) for kind in ("solid", "none"))
    assert np.array_equal(painted.xyz_m, bare.xyz_m)
    assert not np.array_equal(painted.intensity, bare.intensity)


def test_dark_cars_return_less_than_white_ones() -> None:
    means = []
    for color in ([20, 20, 20], [235, 235, 235]):
        car = {"id": "car", "category": "car", "color": color, "pose": [12.0, 0.0, 0.0]}
        log, truth = tiny_log([car], observe=False, camera=[])
        sweep = log.streams["top"].read(3)
        pose = log.map_T_sensor("top", np.array([sweep.stamp_ns]))[0][0]
        high = apply(pose, sweep.xyz_m.astype(float))[:, 2] > 0.3
        means.append(sweep.intensity[high].mean())
        assert truth.others[0].id == "car"
    assert means[1] > 4 * means[0]
