"""Doubts about motion: speeds beyond a category's, and reversing as nobody does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from log2sim.agents.moving import motion_doubts, sideways_doubts
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
