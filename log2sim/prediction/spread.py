"""How far predictions are off: standard deviations that grow with the lead."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, STANDSTILL_MPS
from log2sim.geometry import Array
from log2sim.prediction.motion_table import Complex, MotionTable


class Restlessness(NamedTuple):
    """What agents do that does not follow from their past.

    Attributes
    ----------
    along_mps2, across_mps2 : float, m/s2
        Standard deviations of the acceleration along and across the course.
    """

    along_mps2: float
    across_mps2: float


ACCELERATION_S = 2.0
"""For how long an acceleration lasts: drivers and pedestrians change what they do after one to three seconds."""

MOVING: Mapping[str, Restlessness] = {
    "vehicle": Restlessness(0.8, 0.6),
    "two_wheeler": Restlessness(0.7, 0.6),
    "pedestrian": Restlessness(0.35, 0.35),
    "other": Restlessness(0.8, 0.6),
}
WAITING: Mapping[str, Restlessness] = {
    "vehicle": Restlessness(0.5, 0.1),
    "two_wheeler": Restlessness(0.4, 0.1),
    "pedestrian": Restlessness(0.25, 0.15),
    "other": Restlessness(0.5, 0.1),
}
"""Of agents that stand: most stay, some start."""

WAITING_S = 10.0
"""Who has stood for as long is half as likely to start at once: the longer agents stand, the longer they go on to stand."""

USUAL_ERRORS = 5.0
"""How many errors of an agent's own past the values above count as."""

MIN_SCALE = 0.1
"""Of an agent's own variances to the usual ones: what was regular so far can still brake."""


def drift_variance(lead_s: Array, lasts_s: float = ACCELERATION_S) -> Array:
    """Compute the variance, m2, of the way after leads that an acceleration of 1 m/s2 makes, which lasts exponentially long.

    Notes
    -----
    Twice integrated Ornstein-Uhlenbeck noise (Singer, "Estimating optimal tracking filter performance for manned maneuvering
    targets", 1970): it grows as lead^4 / 4 within `lasts_s` and as lead^3 beyond.
    """
    r = np.asarray(lead_s, dtype=np.float64) / lasts_s
    series = r**4 / 4 - r**5 / 15 + r**6 / 72  # cancels below in the closed form
    closed = 2 * r**3 / 3 - r**2 + 2 - 2 * (1 + r) * np.exp(-r)
    return np.asarray(lasts_s**4 * np.where(r < 0.05, series, closed))


def usual_sigma(table: MotionTable, lead_s: Array) -> Array:
    """Compute usual standard deviations (A, T, H, 2), m, along and across the course, for agents of each kind."""
    speed = np.abs(table.velocity_mps)
    groups = [GROUP_OF[a.category] for a in table.agents]
    moving, waiting = (
        np.array([kind[g] for g in groups], dtype=np.float64).reshape(-1, 1, 2) for kind in (MOVING, WAITING)
    )
    stands = speed < STANDSTILL_MPS
    patience = np.sqrt(WAITING_S / (WAITING_S + _lasting(stands, table) * table.tick_s))
    acceleration = np.where(stands[..., None], waiting * patience[..., None], moving)
    variance = drift_variance(lead_s)[:, None] * acceleration[:, :, None] ** 2
    return np.asarray(np.sqrt(table.sigma_m[..., None, None] ** 2 + variance))


def _lasting(state: NDArray[np.bool_], table: MotionTable) -> NDArray[np.intp]:
    """For how many ticks (A, T) a state has lasted; 0 where it is not so."""
    ticks = np.arange(state.shape[1])
    since = np.maximum.accumulate(np.where(~state | table.begins, ticks, 0), axis=1)
    return np.where(state, ticks - since, 0)


def own_scale(table: MotionTable, error_m: Complex, course: Complex, sigma_m: Array, ticks: int) -> Array:
    """Compute by how much each agent's motion was more regular than usual so far: factors (A, T) on its standard deviations.

    Times at which it stood do not count, nor does their factor differ from 1: they say nothing about how it drives.

    Parameters
    ----------
    error_m : (A, T) complex128, m
        Error of the prediction at each tick for `ticks` later; NaN where unknown.
    course : (A, T) complex128
        Unit vectors of the predicted courses.
    sigma_m : (A, T, 2) float64, m
        Usual standard deviations then.
    ticks : int
        After which the error is known; errors closer to each other count as one.
    """
    off = error_m * course.conj()
    squared = (off.real / sigma_m[..., 0]) ** 2 + (off.imag / sigma_m[..., 1]) ** 2
    moves = np.abs(np.where(table.present, table.velocity_mps, 0.0)) >= STANDSTILL_MPS
    known = np.isfinite(squared) & moves
    sums = [_known_sums(np.where(known, v, 0.0), table, ticks) / ticks for v in (squared, 2.0)]
    usual = 2.0 * USUAL_ERRORS
    scale = np.sqrt(np.maximum((usual + sums[0]) / (usual + sums[1]), MIN_SCALE))
    return np.where(moves, scale, 1.0)


def _known_sums(value: Array, table: MotionTable, ticks: int) -> Array:
    """Sum values (A, T) within each piece, up to the tick after which each is known."""
    total = np.zeros_like(value)
    total[:, ticks:] = np.cumsum(value, axis=1)[:, : value.shape[1] - ticks] if ticks < value.shape[1] else 0.0
    start = np.maximum.accumulate(np.where(table.begins, np.arange(value.shape[1]), 0), axis=1)
    return np.asarray(total - np.take_along_axis(total, start, axis=1))
