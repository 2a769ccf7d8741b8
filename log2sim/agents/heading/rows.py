"""Rows of parked vehicles: neighbors that park alike, most of them in the direction of the street."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.log_odds import probability_of
from log2sim.perception.box_fitting import rotate

# Neighbors of one row: axes are parallel within three standard deviations of a parked car's yaw; bumper to bumper with room for one
# more car at most and in one line, or side by side in places 2.3 to 3 m wide; lanes are wider.
MAX_TURNED_RAD = 0.2
MAX_GAP_M, MAX_OUT_OF_LINE_M = 7.0, 1.3
MAX_BESIDE_M, MAX_AHEAD_M = 3.0, 3.0
# Share of a row that points alike. Along a street the law of most countries asks for it. In places across, 76 % of drivers pull
# forward into them (AAA, 2015).
ALIKE_ALONG, ALIKE_ACROSS = 0.93, 0.76


@dataclass(frozen=True, eq=False)
class Row:
    """Vehicles that stand in one row.

    Attributes
    ----------
    members : (R,) int64
    toward : (R,) float64
        1 for those whose yaw is that of the first member within a right angle, -1 for the others.
    alike : float
        Probability that a member points in the direction of the row.
    """

    members: NDArray[np.int64]
    toward: Array
    alike: float

    def joint(self, own: Array, street: Array) -> tuple[float, Array]:
        """Combine what is known of each of M vehicles with what is known of the street.

        Parameters
        ----------
        own, street : (M,) float64
            Log-odds that a vehicle points along its yaw, and that the street goes that way.

        Returns
        -------
        log_likelihood : float
            Of all that is known of the members, given what is known of the street.
        chance : (R,) float64
            Probability that each member points along its yaw, given all.
        """
        # Everything below is in the direction of the first member: first column for it, second against it.
        known = probability_of(np.outer(self.toward * own[self.members], [1.0, -1.0]))
        way = probability_of(np.mean(self.toward * street[self.members]) * np.array([1.0, -1.0]))
        # Likelihood of each member, by the direction of the row.
        each = self.alike * known + (1 - self.alike) * known[:, ::-1]
        # Directions that all members together exclude would underflow.
        logs = np.log(way) + np.log(each).sum(axis=0)
        total = float(np.logaddexp(*logs))
        row = np.exp(logs - total)
        along = self.alike * known[:, 0] / each[:, 0] * row[0] + (1 - self.alike) * known[:, 0] / each[:, 1] * row[1]
        return total, np.where(self.toward > 0, along, 1 - along)


def find_rows(poses: Array, lengths_m: Array, stands: NDArray[np.int64]) -> list[Row]:
    """Group those of M vehicles that stand into rows; one without neighbors, or that moves, is a row of its own.

    Parameters
    ----------
    poses : (M, 3) float64
        x, y in m and yaw in rad up to half turns.
    lengths_m : (M,) float64
    stands : (S,) int64
        Which of them stand.
    """
    in_line, beside = np.zeros((2, len(poses), len(poses)), dtype=bool)
    standing = np.zeros(len(poses), dtype=bool)
    standing[stands] = True
    for i in stands:
        to = rotate(poses[:, :2] - poses[i, :2], -poses[i, 2])
        parallel = standing & (np.abs(np.sin(poses[:, 2] - poses[i, 2])) < np.sin(MAX_TURNED_RAD))
        gap = np.abs(to[:, 0]) - (lengths_m + lengths_m[i]) / 2
        in_line[i] = parallel & (gap < MAX_GAP_M) & (np.abs(to[:, 1]) < MAX_OUT_OF_LINE_M)
        beside[i] = parallel & (np.abs(to[:, 0]) < MAX_AHEAD_M) & (np.abs(to[:, 1]) < MAX_BESIDE_M) & ~in_line[i]
    lot: NDArray[np.bool_] = np.any(beside | beside.T, axis=1)
    # On a car park the next one in line is of the row opposite, nose to nose.
    linked, label = beside | (in_line & ~lot & ~lot[:, None]), np.arange(len(poses))
    for i, j in zip(*np.nonzero(linked)):
        label[label == label[j]] = label[i]
    return [_row(np.flatnonzero(label == k), poses, lot) for k in np.unique(label)]


def _row(members: NDArray[np.int64], poses: Array, lot: NDArray[np.bool_]) -> Row:
    toward = np.where(np.cos(poses[members, 2] - poses[members[0], 2]) > 0, 1.0, -1.0)
    return Row(members, toward, ALIKE_ACROSS if lot[members].any() else ALIKE_ALONG)


def headings_of(rows: Sequence[Row], own: Array, street: Array, right: float) -> Array:
    """Return the probability (M,) that each vehicle points along its yaw.

    Parameters
    ----------
    own : (M,) float64
        Log-odds by what is known of each alone.
    street : (2, M) float64
        Log-odds that the street goes that way, if traffic keeps right, and if it keeps left.
    right : float
        Log-odds that traffic keeps right, by other evidence.

    Notes
    -----
    Exact: rows are independent given the side of traffic, and members of a row given its direction.
    """
    total, chance = np.array([right, -right]) / 2, np.zeros((2, len(own)))
    for side in range(2):
        for row in rows:
            log_likelihood, chance[side, row.members] = row.joint(own, street[side])
            total[side] += log_likelihood
    return np.asarray(probability_of(total[0] - total[1]) * chance[0] + probability_of(total[1] - total[0]) * chance[1])
