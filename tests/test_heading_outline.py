"""The outline of a vehicle from the side tells its front: random vehicles under simulated LiDARs."""

from __future__ import annotations

from dataclasses import replace

import fit_outline
import numpy as np
import pytest
from test_size import bare

from log2sim.agents import heading
from log2sim.datatypes import Waypoints
from log2sim.perception.boxes import rotate


@pytest.fixture(scope="module")
def vehicles():
    """Vehicles that the weights were not fitted to."""
    found = [fit_outline.draw(np.random.default_rng([2, seed])) for seed in range(30)]
    return [v for v in found if v is not None]


def odds_of(seen, turn=0.0, shift=(0.0, 0.0), yaw=0.0, ground_m=0.0):
    """Log-odds of a vehicle at `shift` that is turned in the map, with a box that points along `yaw` from its axis."""
    track = bare([shift] * 3)
    parts = [np.column_stack([rotate(p[:, :2], turn) + shift, p[:, 2] + ground_m]) for p in np.array_split(seen.xyz, 3)]
    m = replace(
        track.measurements, cluster=tuple(parts), bottom_m=np.full(3, ground_m),
        sensor_m=np.tile(np.append(rotate(seen.view_m, turn) + shift, ground_m + 2.0), (3, 1)),
    )  # fmt: skip
    t = np.array([0.0, 0.2])
    w = Waypoints(
        t_s=t, x_m=np.full(2, shift[0]), y_m=np.full(2, shift[1]), z_m=np.zeros(2), yaw_rad=np.full(2, turn + yaw),
        speed_mps=np.zeros(2), observed=np.ones(2, dtype=bool), sigma_xy_m=np.full(2, 0.1),
    )  # fmt: skip
    return heading.outline_log_odds(replace(track, measurements=m), w, np.array([0.0, 0.1, 0.2]), tuple(seen.size_m))


def test_most_fronts_are_found_and_sure_ones_are_right(vehicles):
    odds = np.array([odds_of(seen) for seen in vehicles])
    assert np.mean(odds > 0) >= 0.8
    assert np.mean(odds[np.abs(odds) > 3] > 0) >= 0.95


def test_a_vehicle_turned_round_has_the_opposite_log_odds_anywhere(vehicles):
    for seen in vehicles[:8]:
        here = odds_of(seen)
        assert odds_of(seen, turn=2.0, shift=(700.0, -300.0), ground_m=40.0) == pytest.approx(here, abs=0.4)
        assert odds_of(seen, yaw=np.pi) == pytest.approx(-here, abs=0.4)


def test_a_box_that_ends_too_early_is_as_long_as_its_points(vehicles):
    seen = max(
        (v for v in vehicles if v.size_m[0] < 5.5),
        key=lambda v: len(v.xyz) * (np.ptp(v.xyz[:, 0]) > 0.95 * v.size_m[0]),
    )
    size = seen.size_m * [0.85, 1.0, 1.0]
    short = heading.outline_of(seen.xyz, size, seen.view_m)
    exact = heading.outline_of(seen.xyz, seen.size_m, seen.view_m)
    assert np.mean(short.cells != exact.cells) < 0.08


def test_neighbors_behind_a_gap_and_the_ground_are_no_part_of_it():
    rng = np.random.default_rng(5)
    side = np.column_stack([rng.uniform(-2.2, 2.2, 400), np.full(400, 0.9), rng.uniform(0.3, 1.4, 400)])
    others = np.vstack(
        [side[:50] * 0.1 + [2.9, 0.0, 1.0], side[:50] * [1, 1, 0], side[:50] + np.array([0.0, 1.0, 0.0])]
    )
    alone, among = (
        heading.outline_of(p, np.array([4.4, 1.8, 1.5]), np.array([0.0, 9.0]))
        for p in (side, np.vstack([side, others]))
    )
    np.testing.assert_array_equal(alone.cells, among.cells)
