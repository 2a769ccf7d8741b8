"""Intensities of LiDAR returns: paint returns more than asphalt where the ground is painted, until it is wet."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from worlds import tiny_log

from log2sim.datatypes import Log, Scenario, Sweep
from log2sim.geometry import Array, apply
from log2sim.synth.ground import Ground, GroundPlan
from log2sim.synth.paint import REFLECTANCE, GroundReflectance
from log2sim.synth.scene import Road

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


def ground_returns(log: Log, truth: Scenario) -> tuple[Array, np.ndarray, Any]:
    """Points (N, 2) on the map, their intensities (N,), and the area of true markings."""
    sweep: Sweep = log.streams["top"].read(3)
    assert sweep.t_ns is not None
    assert sweep.intensity is not None
    poses, _ = log.map_T_sensor("top", sweep.t_ns)
    xyz = np.einsum("nij,nj->ni", poses[:, :3, :3], sweep.xyz_m) + poses[:, :3, 3]
    assert truth.map_features is not None
    lines = [shapely.LineString(m.points_m[:, :2]) for m in truth.map_features.markings]
    return xyz[:, :2], sweep.intensity, shapely.union_all(lines)


def contrast(log: Log, truth: Scenario, road_half_m: float = 4.6) -> float:
    xy, intensity, lines = ground_returns(log, truth)
    near = np.hypot(*(xy - [1.5, 0.0]).T) < 9.0  # where the spot of a beam is narrower than a line
    away = shapely.distance(lines, shapely.points(xy))
    on, off = near & (away < 0.03), near & (away > 0.4) & (np.abs(xy[:, 1]) < road_half_m)
    assert on.sum() > 20
    return float(np.median(intensity[on]) / np.median(intensity[off]))


@pytest.mark.slow
def test_paint_returns_two_to_four_times_as_much_as_asphalt_and_little_more_when_wet() -> None:
    assert 2.0 < contrast(*street()) < 4.0
    assert contrast(*street(environment={"weather": "rain", "rain_mm_h": 5.0})) < 1.5


@pytest.mark.slow
def test_returns_of_worn_paint_are_those_of_asphalt_where_it_is_missing() -> None:
    fresh, worn = contrast(*street()), contrast(*street(road={"worn": 0.9}))
    assert worn < 0.6 * fresh


def test_intensities_move_no_point_and_come_again_with_the_seed() -> None:
    first, again = (street()[0].streams["top"].read(4) for _ in range(2))
    assert np.array_equal(first.intensity, again.intensity)
    assert first.intensity.min() >= 1
    assert first.intensity.max() <= 255
    painted, bare = (street(road={"marking": kind})[0].streams["top"].read(4) for kind in ("solid", "none"))
    assert np.array_equal(painted.xyz_m, bare.xyz_m)
    assert not np.array_equal(painted.intensity, bare.intensity)


def test_a_wide_spot_sees_the_mean_of_what_it_covers() -> None:
    road = Road(line=((-50.0, 2.0), (50.0, 2.0)), width_m=10.0, marking="solid", side_marking="none", sidewalk_m=0.0)
    ground = GroundReflectance(Ground(GroundPlan([road]), 0))
    y = np.linspace(1, 3, 401)
    xy = np.column_stack([np.full(len(y), 7.3), y])
    for spot in (0.04, 0.16, 0.32):
        found = ground.at(xy, np.full(len(y), spot))
        # However wide the spot, the line of 14 cm adds as much.
        added = (found - REFLECTANCE["asphalt"]).sum() * 0.005 / (REFLECTANCE["paint"] - REFLECTANCE["asphalt"])
        assert added == pytest.approx(0.14, abs=0.05)
        assert found.max() <= REFLECTANCE["paint"] + 0.01
    assert ground.at(np.zeros((0, 2)), np.zeros(0)).shape == (0,)


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
