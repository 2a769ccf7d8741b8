"""Positions that change by white jerk: knots in time, and what the motion model and the observations say about them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.smooth.quadratic import Quadratic

# Knots stand no nearer to each other than this; in between the acceleration is taken as constant, which at 100 m/s3 of
# jerk costs 0.02 mm. The information that ties two knots grows like the fifth power of the inverse step: 1 ms apart they
# would leave no digits for the data.
KNOT_STEP_S = 0.02
# Vague beliefs that make a single observation, or a pair of them, have an answer.
VELOCITY_PRIOR_MPS = 40.0
ACCELERATION_PRIOR_MPS2 = 4.0

# Covariance of position, velocity, acceleration after unit time of white jerk of unit density, and its inverse.
_UNIT_Q = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
_UNIT_INFORMATION = np.linalg.inv(_UNIT_Q)


@dataclass(frozen=True, eq=False)
class Observations:
    """Positions `xy` (n, 2) with covariances `r` (n, 2, 2) at times `t_s` (n,)."""

    t_s: Array
    xy: Array
    r: Array


@dataclass(frozen=True, eq=False)
class Chain:
    """Knots (K,) and the motion between them: `step` (K-1, 3, 3) carries position, velocity and acceleration on,
    `inverse` (K-1, 3, 3) is the information about what is left, at a jerk density of 1, `inverse_before` the same seen from
    the earlier knot. `diagonal` (K, 3, 3) and `cross` (K-1, 3, 3) are the blocks of the squared jerk.
    """

    knots_s: Array
    step: Array
    inverse: Array
    inverse_before: Array
    cross: Array
    diagonal: Array

    @classmethod
    def over(cls, t_s: Array, step_s: float = KNOT_STEP_S) -> Chain:
        """Chain with knots out of the times (n,), no nearer to each other than a step."""
        knots = place_knots(t_s, step_s)
        dt = np.diff(knots)
        # Inverted in units of the step: steps from milliseconds to seconds are equally well conditioned.
        scale = np.stack([dt**-2.5, dt**-1.5, dt**-0.5], axis=-1)
        step = np.zeros((len(dt), 3, 3))
        step[:, [0, 1, 2], [0, 1, 2]] = 1.0
        step[:, 0, 1], step[:, 1, 2], step[:, 0, 2] = dt, dt, dt**2 / 2
        inverse = _UNIT_INFORMATION * scale[:, :, None] * scale[:, None, :]
        cross = -np.swapaxes(step, 1, 2) @ inverse
        diagonal = np.zeros((len(knots), 3, 3))
        before = -cross @ step
        diagonal[:-1] = before
        diagonal[1:] += inverse
        return cls(knots, step, inverse, before, cross, diagonal)

    def __len__(self) -> int:
        return len(self.knots_s)

    def jerk(self, state: Array) -> Quadratic:
        """Squared jerk of every column of a reference state (K, 3, 2), over a density of 1."""
        left = state[1:] - self.step @ state[:-1]
        return Quadratic.of(self.diagonal, self.cross, self._pull(left), float(np.vdot(left, self.inverse @ left)))

    def jerk_by_direction(self, state: Array, direction: Array) -> tuple[Quadratic, Quadratic]:
        """The squared jerk along and across a direction (K-1, 2) at every step, over all six unknowns of a knot."""
        outer = direction[:, :, None] * direction[:, None, :]
        left = state[1:] - self.step @ state[:-1]
        diagonal = np.zeros((len(self), 6, 6))
        # Each step has a direction of its own, so a knot's block takes two of them.
        diagonal[:-1] = _spread(self.inverse_before, outer)
        diagonal[1:] += _spread(self.inverse, outer)
        cross = _spread(self.cross, outer)
        both = np.broadcast_to(np.eye(2), (len(self), 2, 2))
        forms = []
        for part, d, c in (
            (left @ outer, diagonal, cross),
            (left - left @ outer, _spread(self.diagonal, both) - diagonal, _spread(self.cross, both[1:]) - cross),
        ):
            value = float(np.vdot(part, self.inverse @ part))
            forms.append(Quadratic.of(d, c, self._pull(part).reshape(-1, 6, 1), value))
        return forms[0], forms[1]

    def _pull(self, left: Array) -> Array:
        """How what is left (K-1, 3, 2) of every step pulls at the knots."""
        pull = np.zeros((len(self), *left.shape[1:]))
        pull[:-1] = -self.cross @ left
        pull[1:] -= self.inverse @ left
        return pull


def _spread(blocks: Array, outer: Array) -> Array:
    """Blocks (n, 3, 3) of one axis, over both along a direction whose outer square is (n, 2, 2): (n, 6, 6)."""
    return np.asarray(blocks[:, :, None, :, None] * outer[:, None, :, None, :]).reshape(-1, 6, 6)


def place_knots(t_s: Array, step_s: float = KNOT_STEP_S) -> Array:
    """Times (K,) out of those given (n,), from the first on, none nearer to the one before than `step_s`."""
    times = np.unique(t_s)
    if np.all(np.diff(times) >= step_s):
        return times
    knots: list[float] = []
    for t in times.tolist():
        if not knots or t - knots[-1] >= step_s:
            knots.append(t)
    return np.array(knots)


def nearest_index(knots: Array, t: Array) -> NDArray[np.intp]:
    """Index of the knot nearest to every time."""
    if len(knots) == 1:
        return np.zeros(len(t), dtype=np.intp)
    i = np.clip(np.searchsorted(knots, t), 1, len(knots) - 1)
    return np.where(np.abs(knots[i - 1] - t) <= np.abs(knots[i] - t), i - 1, i)


def add_at(target: Array, place: NDArray[np.intp], values: Array) -> None:
    """`target[place] += values` where places may repeat, in order."""
    first = np.flatnonzero(np.diff(place, prepend=-1))
    target[place[first]] += values if len(first) == len(place) else np.add.reduceat(values, first, axis=0)
