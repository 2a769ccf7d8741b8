"""Doubts about motion: speeds beyond a category's, and reversing as nobody does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from log2sim.agents.moving import jump_doubts, motion_doubts, sideways_doubts
from log2sim.agents.size import TrackGeometry
from log2sim.agents.static import yaw_sigma
from log2sim.datatypes import CATEGORIES, MAX_SPEED_MPS, Detections, Measurements, Waypoints


def moving(speed_mps: np.ndarray, sigma_mps: float | None = None, rate_hz: float = 10.0) -> Waypoints:
    n = len(speed_mps)
    t, zero = np.arange(n) / rate_hz, np.zeros(n)
    x = np.concatenate([[0.0], np.cumsum((speed_mps[1:] + speed_mps[:-1]) / 2 / rate_hz)])
    sigma = None if sigma_mps is None else zero + sigma_mps
    return Waypoints(t, x, zero, zero, zero, speed_mps, zero == 0, zero + 0.1, sigma_speed_mps=sigma)


@pytest.mark.parametrize("category", CATEGORIES)
def test_what_is_faster_than_its_category_is_doubted_while_it_is(category):
    limit = MAX_SPEED_MPS[category]
    assert motion_doubts(category, moving(np.full(20, 0.9 * limit))) == ()
    w = moving(np.where(np.arange(20) < 5, 1.2, 0.9) * limit)
    (doubt,) = motion_doubts(category, w)
    assert doubt.flag == "speed"
    assert doubt.holds(w.t_s).sum() == 5
    assert doubt.reason == f"moves at {1.2 * limit:.0f} m/s from 0.0 to 0.4 s"
    assert motion_doubts(category, moving(w.speed_mps, sigma_mps=0.2 * limit)) == ()


@pytest.mark.parametrize("rate_hz", [2.0, 10.0, 20.0])
def test_reversing_out_of_a_driveway_is_driving_and_reversing_fast_or_far_is_not(rate_hz):
    def after(seconds: float, speed: float) -> Waypoints:
        t = np.arange(0, 30, 1 / rate_hz)
        return moving(np.where(t < seconds, -speed, 0.0), 0.1, rate_hz)

    assert motion_doubts("car", after(8.0, 2.0)) == ()
    (fast,) = motion_doubts("car", after(3.0, 7.4))
    assert (fast.flag, fast.start_s) == ("reversing", 0.0)
    assert fast.reason.startswith("reverses at up to 7.4 m/s from 0.0 to ")
    assert fast.end_s == pytest.approx(3.0, abs=1.01 / rate_hz)
    (far,) = motion_doubts("cyclist", after(25.0, 2.0))
    assert far.flag == "reversing"
    assert motion_doubts("pedestrian", after(3.0, 4.0)) == ()


def test_measurements_beside_the_way_are_doubted_unless_they_are_few():
    t = np.arange(40) / 10
    residual, sigma = np.full(40, 0.2), np.full(40, 0.3)
    assert jump_doubts(t, residual, sigma) == ()
    residual[[5, 6]] = 2.0
    assert jump_doubts(t, residual, sigma) == ()
    residual[20:25] = [1.5, 2.5, np.nan, 3.0, 1.5]
    first, second, third = jump_doubts(t, residual, sigma)
    assert (first.flag, first.start_s, first.end_s) == ("jump", 0.5, 0.6)
    assert second.reason == "measured up to 2.5 m off its path from 2.0 to 2.1 s"
    assert (third.start_s, third.end_s) == (2.3, 2.4)


@pytest.mark.parametrize("length_m", [2.0, 6.0])
@pytest.mark.parametrize("turned_deg", [0.0, 20.0, 90.0, 160.0, 180.0])
def test_a_long_side_across_the_way_slides(length_m, turned_deg):
    """A side that may be the width of a vehicle says nothing."""
    t = np.arange(10) / 10
    found = Detections(np.zeros((10, 4)), np.ones(10), np.full(10, "truck"))
    m = replace(
        Measurements.unplaced(found, t_ns=0, camera="", sensor_m=np.zeros(3)),
        yaw_rad=np.full(10, 0.4 + np.deg2rad(turned_deg)),
        low_m=np.zeros((10, 2)),
        high_m=np.tile([length_m, 1.5], (10, 1)),
    )
    doubts = sideways_doubts(m, t, np.full(10, 0.4), np.full(10, 3.6))
    assert [doubt.flag for doubt in doubts] == (["sideways"] if length_m == 6.0 and turned_deg == 90.0 else [])
    assert sideways_doubts(m, t, np.full(10, 0.4), np.full(10, 0.5)) == ()


@pytest.mark.parametrize("sigma_m", [0.02, 0.1])
def test_sigma_of_a_standing_yaw_is_that_of_its_sides_or_boxes(sigma_m):
    """The sides of a car of 4 m, and boxes that scatter about it."""
    rng = np.random.default_rng(1)
    side = np.column_stack([rng.uniform(-2, 2, 400), np.full(400, -0.9), np.zeros(400)])
    side[:, 1] += np.abs(rng.normal(0, sigma_m, 400))
    geometry = TrackGeometry(
        np.array([4.0, 1.8, 1.5]), np.zeros((5, 2)), np.tile(np.eye(2), (5, 1, 1)), np.zeros(5), 0.0
    )
    found = Detections(np.zeros((5, 4)), np.ones(5), np.full(5, "car"))
    m = replace(Measurements.unplaced(found, t_ns=0, camera="", sensor_m=np.zeros(3)), cluster=(side,) * 5)
    by_points = yaw_sigma(m, geometry)
    assert 0.3 * sigma_m / 4 < by_points < max(2 * sigma_m / 4, 0.0051)
    assert yaw_sigma(m, replace(geometry, yaw_rad=None)) > 0.9
    boxes = replace(m, box_yaw_rad=sigma_m * np.array([1.0, -1.0, np.nan, 1.0 + np.pi / sigma_m, -1.0]))
    assert sigma_m / np.sqrt(2) <= yaw_sigma(boxes, geometry) <= max(sigma_m, 0.05)
