"""Which vehicles stand, from what little of them shows."""

from __future__ import annotations

import numpy as np
from test_size import measured

from log2sim.agents.hypotheses import explain_track
from log2sim.agents.static import robust_line

TRUCK = (18.0, 2.55, 3.8)


def test_a_robust_line_is_least_squares_without_outliers_and_hardly_moves_with_them():
    rng = np.random.default_rng(2)
    t = np.sort(rng.uniform(0, 4, 60))
    xy = np.outer(t, [1.5, -0.5]) + rng.normal(0, 0.1, (60, 2))
    _, velocity, sigma = robust_line(t, xy, np.full(60, 0.01))
    np.testing.assert_allclose(velocity, np.polyfit(t, xy, 1)[0], atol=0.02)
    assert np.abs(velocity - [1.5, -0.5]).max() < 4 * sigma
    xy[rng.choice(60, 10, replace=False)] += 8.0
    np.testing.assert_allclose(robust_line(t, xy, np.full(60, 0.01))[1], [1.5, -0.5], atol=0.1)
    assert robust_line(np.ones(5), xy[:5], np.ones(5))[2] == np.inf


def passing(speed_mps: float):
    """A long truck seen from a sensor that drives past it at 6 m/s and sees 40 degrees to either side of its left."""
    states, sensors = [], []
    for k in range(30):
        states.append((20.0 + 0.1 * k * speed_mps, 8.0, 0.0))
        sensors.append((0.6 * k, 0.0, 1.9))
    return measured(states, TRUCK, "truck", sensors=sensors)


def test_a_long_truck_of_which_ever_more_shows_stands_and_a_slow_one_does_not():
    standing, creeping = passing(0.0), passing(1.0)
    # The center that a typical length gives moves as more of the truck is seen.
    grown = standing.measurements.center_m.copy()
    grown[:, 0] = np.linspace(24.0, 20.0, 30)
    assert explain_track(standing)[0].static
    object.__setattr__(standing.measurements, "center_m", grown)
    assert explain_track(standing)[0].static
    assert not explain_track(creeping)[0].static
