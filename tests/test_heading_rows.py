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


@pytest.mark.matrix
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


def test_cars_whose_fronts_are_seen_tell_the_side_of_traffic_for_the_others():
    """Six cars at both curbs of a street of known traffic; each alone is unsure, the two without points know nothing."""
    poses = [(20.0 * k, y, 0.0) for k in range(3) for y in (-4.0, 4.0)]
    street = np.array([[2.0, -2.0] * 3, [-2.0, 2.0] * 3])
    own = np.array([-2.0, 2.0, -2.0, 2.0, 0.0, 0.0])
    chance = headings_of(rows_of(poses), own, street, 0.9)
    assert chance[4] < 0.3
    assert chance[5] > 0.7
    np.testing.assert_allclose(headings_of(rows_of(poses), -own, -street, 0.9), 1 - chance)
