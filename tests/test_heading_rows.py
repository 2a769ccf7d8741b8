"""Rows of parked vehicles: who belongs to one, and the exact probabilities of headings that are decided together."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from log2sim.agents.heading import ALIKE_ACROSS, ALIKE_ALONG, find_rows, headings_of
from log2sim.datatypes.log_odds import probability_of


def rows_of(poses, lengths_m=None, stands=None):
    poses = np.array(poses, dtype=float)
    lengths = np.full(len(poses), 4.5) if lengths_m is None else np.array(lengths_m)
    return find_rows(poses, lengths, np.arange(len(poses)) if stands is None else np.array(stands))


CURB = [(6.0 * k, 0.0, np.pi * (k % 2)) for k in range(4)]
LOT = [(0.1 * k, 2.7 * k, 0.0) for k in range(5)]


def test_cars_along_a_curb_are_one_row_and_so_are_those_side_by_side():
    (curb,), (lot,) = rows_of(CURB), rows_of(LOT)
    assert curb.members.tolist() == [0, 1, 2, 3]
    assert curb.toward.tolist() == [1, -1, 1, -1]
    assert (curb.alike, lot.alike) == (ALIKE_ALONG, ALIKE_ACROSS)
    assert len(lot.members) == 5


def test_other_lines_other_axes_and_what_moves_are_rows_of_their_own():
    opposite = [(x, 9.0, yaw) for x, y, yaw in CURB]
    assert sorted(len(row.members) for row in rows_of(CURB + opposite)) == [4, 4]
    assert sorted(len(row.members) for row in rows_of([*CURB, (24.0, 0.0, 0.5)])) == [1, 4]
    assert sorted(len(row.members) for row in rows_of([*CURB[:2], (40.0, 0.0, 0.0)])) == [1, 2]
    assert sorted(len(row.members) for row in rows_of(CURB, stands=[0, 1, 3])) == [1, 1, 2]
    assert sorted(len(row.members) for row in rows_of(CURB, lengths_m=[4.5, 4.5, 12.0, 4.5])) == [4]


def test_rows_of_a_car_park_that_face_each_other_are_two_and_a_queue_beside_a_curb_is_no_car_park():
    opposite = [(5.0 + x, y, np.pi) for x, y, _ in LOT]
    assert [(row.members.tolist(), row.alike) for row in rows_of(LOT + opposite)] == [
        ([0, 1, 2, 3, 4], ALIKE_ACROSS), ([5, 6, 7, 8, 9], ALIKE_ACROSS),
    ]  # fmt: skip
    queue = [(7.0 * k, 3.2, 0.0) for k in range(3)]
    assert [row.alike for row in rows_of(CURB + queue)] == [ALIKE_ALONG] * 2


@pytest.mark.parametrize("seed", range(4))
def test_probabilities_are_those_of_all_cases_enumerated(seed):
    rng = np.random.default_rng(seed)
    rows = rows_of(CURB + [(50.0, 2.7 * k, 0.0) for k in range(2)])
    n = 6
    own, street, right = rng.normal(0, 2, n), rng.normal(0, 1.5, (2, n)), rng.normal()
    total, along = 0.0, np.zeros(n)
    for side, ways, turned in product(range(2), product([1, -1], repeat=len(rows)), product([1, -1], repeat=n)):
        weight = probability_of(right if side == 0 else -right)
        for row, way in zip(rows, ways):
            weight *= probability_of(way * np.mean(row.toward * street[side, row.members]))
            for k, toward in zip(row.members, row.toward):
                agrees = turned[k] * toward == way
                weight *= (row.alike if agrees else 1 - row.alike) * probability_of(turned[k] * own[k])
        total += weight
        along += weight * (np.array(turned) == 1)
    np.testing.assert_allclose(headings_of(rows, own, street, right), along / total, atol=1e-12)


def test_sure_neighbors_turn_an_unsure_one_along_the_curb_but_hardly_in_a_lot():
    street = np.zeros((2, 5))
    own = np.array([5.0, 5.0, -0.5, 5.0, 5.0])
    curb = headings_of(rows_of([(6.0 * k, 0.0, 0.0) for k in range(5)]), own, street, 0.0)
    lot = headings_of(rows_of(LOT), own, street, 0.0)
    assert curb[2] > 0.85
    assert 0.5 < lot[2] < 0.75


def test_one_that_surely_parks_the_wrong_way_does():
    own = np.array([3.0, 3.0, -6.0, 3.0])
    chance = headings_of(rows_of([(6.0 * k, 0.0, 0.0) for k in range(4)]), own, np.zeros((2, 4)), 0.0)
    assert chance[2] < 0.1
    assert (chance[[0, 1, 3]] > 0.9).all()


def test_cars_whose_fronts_are_seen_tell_the_side_of_traffic_for_the_others():
    """Six cars at both curbs of a street of known traffic; each alone is unsure, the two without points know nothing."""
    poses = [(20.0 * k, y, 0.0) for k in range(3) for y in (-4.0, 4.0)]
    street = np.array([[2.0, -2.0] * 3, [-2.0, 2.0] * 3])
    own = np.array([-2.0, 2.0, -2.0, 2.0, 0.0, 0.0])
    chance = headings_of(rows_of(poses), own, street, 0.9)
    assert chance[4] < 0.3
    assert chance[5] > 0.7
    np.testing.assert_allclose(headings_of(rows_of(poses), -own, -street, 0.9), 1 - chance)


def test_log_odds_of_any_size_are_no_overflow():
    with np.errstate(all="raise", under="ignore"):
        chance = headings_of(rows_of(CURB), np.array([40.0, -40.0, 40.0, 40.0]), np.zeros((2, 4)), 0.0)
    assert np.isfinite(chance).all()
