"""The sample of a cloud's rays: one for each direction and sensor, from where the sensor was."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.perception.lidar.cloud import CELL_RAD, Cloud, CloudSensor, sample_rays


def cloud_of(xyz, *, height=None, sensors=(), t_s=None):
    n = len(xyz)
    height = xyz[:, 2] if height is None else height
    t_s = np.zeros(n) if t_s is None else t_s
    return Cloud(
        10**18, np.array([1e5, 2e6, 3.0]), xyz.astype(np.float32), t_s.astype(np.float32),
        np.array([0, 0, 2.0], np.float32), np.abs(height) < 0.1, height.astype(np.float32), tuple(sensors),
    )  # fmt: skip


def directions(rays):
    to = rays.end - rays.start
    return np.arctan2(to[:, 1], to[:, 0]), to[:, 2] / np.hypot(to[:, 0], to[:, 1])


def test_near_and_far_points_keep_their_share() -> None:
    # A wall at 5 m on one half and one at 40 m on the other, both with a ray every 0.1 degrees.
    azimuth, slope = (
        a.ravel() for a in np.meshgrid(np.deg2rad(np.arange(-80, 80, 0.1)), np.deg2rad(np.arange(-2, 2, 0.1)))
    )
    reach = np.where(azimuth < 0, 5.0, 40.0)
    rays = sample_rays(cloud_of(np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), 2 + reach * slope])))
    near = np.hypot(rays.end[:, 0], rays.end[:, 1]) < 6
    assert near.sum() == pytest.approx((~near).sum(), rel=0.02)
    assert len(rays) == pytest.approx(160 / 0.5 * 4 / 0.5, rel=0.15)
    found_azimuth, found_slope = directions(rays)
    assert np.ptp(found_azimuth) == pytest.approx(np.deg2rad(160), abs=2 * CELL_RAD)
    assert np.ptp(found_slope) == pytest.approx(np.deg2rad(4), abs=2 * CELL_RAD)


def test_each_ray_starts_where_its_sensor_was() -> None:
    sensors = [
        CloudSensor(2, np.array([1.0, 0, 2]), np.array([10.0, 0, 0])),
        CloudSensor(1, np.array([-1.0, 3, 1]), np.zeros(3)),
    ]
    xyz = np.array([[20.0, 0, 1], [0, 20, 1], [-20, 0, 1]])
    rays = sample_rays(cloud_of(xyz, sensors=sensors, t_s=np.array([0.0, -0.1, 0.05])))
    start_of = {tuple(e): s for e, s in zip(rays.end.round(3).tolist(), rays.start.round(3).tolist())}
    assert start_of == {(20, 0, 1): [1, 0, 2], (0, 20, 1): [0, 0, 2], (-20, 0, 1): [-1, 3, 1]}
