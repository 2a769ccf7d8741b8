"""The motion prior and the measurements of a chain of states as quadratic forms, their minimum, and densities by likelihood.

It is the continuous Wiener process acceleration model of Bar-Shalom, Li and Kirubarajan, Estimation with Applications to
Tracking and Navigation (2001), section 6.2.3, for uneven steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, nearest_index

# A chain of at most as many states is inverted as a dense matrix.
MAX_DENSE_STATES = 8


@dataclass(frozen=True, eq=False)
class Quadratic:
    """`value - 2 gradient.d + d.A.d` of a step d away from a reference state, A block-tridiagonal."""

    band: Array  # (K p, 2p): columns of A from the diagonal down
    gradient: Array  # (K, p, m): negative half gradient at the reference, of m columns of unknowns that share A
    value: float  # at the reference


@dataclass(frozen=True, eq=False)
class Minimum:
    """Minimum of a quadratic form."""

    step: Array  # (K, p, m): from the reference to the minimum
    value: float  # at the minimum
    log_determinant: float  # log(det A)
    form: Quadratic

    @cached_property
    def covariance(self) -> Array:
        """Diagonal blocks (K, p, p) of the inverse of A."""
        return selected_inverse(*from_band(self.form.band, self.step.shape[1]))[0]


def weighted_sum(terms: Iterable[tuple[float, Quadratic]]) -> Quadratic:
    """Sum weighted forms about the same reference."""
    (weight, first), *others = terms
    band, gradient, value = first.band * weight, first.gradient * weight, first.value * weight
    for weight, term in others:
        band += weight * term.band
        gradient += weight * term.gradient
        value += weight * term.value
    return Quadratic(band, gradient, value)


def minimize(form: Quadratic) -> Minimum:
    """Find the minimum by a banded Cholesky factorization, O(K p^3).

    Raises `np.linalg.LinAlgError`: When A is not positive definite.
    """
    from scipy.linalg.lapack import dpbtrf, dpbtrs

    factor, failed = dpbtrf(form.band.T, lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"the normal equations lose rank at unknown {failed} of {len(form.band)}")
    step, _ = dpbtrs(factor, form.gradient.reshape(-1, form.gradient.shape[2]), lower=1)
    step = step.reshape(form.gradient.shape)
    return Minimum(step, form.value - float(np.vdot(form.gradient, step)), 2.0 * float(np.log(factor[0]).sum()), form)


def to_band(diagonal: Array, off: Array | None) -> Array:
    """Store the blocks on (K, p, p) and above (K-1, p, p) the diagonal, None if zero, as LAPACK's lower band storage, transposed.

    Every block column holds the diagonal block and the one below it; reading it with a stride that goes one further with
    every column skews it into the band.
    """
    count, size, _ = diagonal.shape
    slab = np.zeros((count, size, 3 * size - 1))
    slab[:, :, :size] = diagonal
    if off is not None:
        slab[:-1, :, size : 2 * size] = off
    return _band_view(slab).reshape(count * size, 2 * size)


def from_band(band: Array, size: int) -> tuple[Array, Array]:
    """Extract the blocks on (K, p, p) and above (K-1, p, p) the diagonal of a matrix in band storage."""
    count = len(band) // size
    slab = np.zeros((count, size, 3 * size - 1))
    _band_view(slab)[:] = band.reshape(count, size, 2 * size)
    half = slab[:, :, :size]
    diagonal = half + np.swapaxes(half, 1, 2)
    diagonal[:, range(size), range(size)] /= 2
    return diagonal, slab[:-1, :, size : 2 * size]


def _band_view(slab: Array) -> Array:
    """View (K, p, 2p) of a slab (K, p, 3p-1) that starts one item further in every next column."""
    count, size, _ = slab.shape
    block, column, item = slab.strides
    shape = (count, size, 2 * size)
    # As np.lib.stride_tricks.as_strided does, in a sixth of its time.
    return np.ndarray(shape, np.float64, slab.data, strides=(block, column + item, item))


def selected_inverse(diagonal: Array, off: Array) -> tuple[Array, Array]:
    """Blocks on (K, p, p) and above (K-1, p, p) the diagonal of the inverse of a block-tridiagonal matrix.

    Cyclic reduction (Buzbee, Golub and Nielson, SIAM J. Numer. Anal. 7, 1970): every other state is eliminated at once, which leaves a chain of half the length. Its O(log K) rounds
    are each a few stacked products, where elimination along the chain would take K.
    """
    count, size, _ = diagonal.shape
    if count <= MAX_DENSE_STATES:
        dense, k = np.zeros((count, size, count, size)), np.arange(count)
        dense[k, :, k] = diagonal
        dense[k[:-1], :, k[1:]] = off
        dense[k[1:], :, k[:-1]] = np.swapaxes(off, 1, 2)
        whole = np.linalg.inv(dense.reshape(count * size, -1)).reshape(dense.shape).astype(np.float64, copy=False)
        return whole[k, :, k], whole[k[:-1], :, k[1:]]
    even, odd = diagonal[::2], np.linalg.inv(diagonal[1::2])
    left, right = off[::2], off[1::2]  # even to odd, odd to even
    n, m = len(left), len(right)
    from_left, from_right = odd @ np.swapaxes(left, 1, 2), odd[:m] @ right
    reduced = even.copy()
    reduced[:n] -= left @ from_left
    reduced[1 : 1 + m] -= np.swapaxes(right, 1, 2) @ from_right
    inverse, neighbor = selected_inverse(reduced, -left[:m] @ from_right)
    to_left = -from_left @ inverse[:n]
    to_left[:m] -= from_right @ np.swapaxes(neighbor[:m], 1, 2)
    to_right = -from_left[:m] @ neighbor[:m] - from_right @ inverse[1 : 1 + m]
    odd -= to_left @ np.swapaxes(from_left, 1, 2)
    odd[:m] -= to_right @ np.swapaxes(from_right, 1, 2)
    on, above = np.empty_like(diagonal), np.empty_like(off)
    on[::2], on[1::2] = inverse, odd
    above[::2], above[1::2] = np.swapaxes(to_left, 1, 2), to_right
    return on, above


# Minimum distance of two knots; in between the acceleration is taken as constant, which at 100 m/s3 of jerk costs 0.02 mm.
# The information that ties two knots grows with the fifth power of the inverse step: 1 ms apart they would leave no digits
# for the data.
KNOT_STEP_S = 0.02
# Standard deviations of the vague prior of the first state.
VELOCITY_PRIOR_MPS = 40.0
ACCELERATION_PRIOR_MPS2 = 4.0

# Covariance of position, velocity, acceleration after unit time of white jerk of unit density, and its inverse.
_UNIT_Q = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
_UNIT_INFORMATION = np.linalg.inv(_UNIT_Q)


@dataclass(frozen=True, eq=False)
class NoisyPositions:
    """Measured positions with their noise."""

    t_s: Array  # (n,), s
    xy: Array  # (n, 2), m
    r: Array  # (n, 2, 2), m2: covariance of each position
    # Whether errors repeat from tick to tick and have heavier tails than Gaussian ones, as those of measured boxes
    correlated: bool = False


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """Knots and the motion between them, at a jerk density of 1 m2/s5."""

    knots_s: Array  # (K,), s
    step: Array  # (K-1, 3, 3): transition of position, velocity and acceleration to the next knot
    inverse: Array  # (K-1, 3, 3): information about the process noise of each step
    inverse_before: Array  # (K-1, 3, 3): the same, propagated to the earlier knot
    cross: Array  # (K-1, 3, 3): blocks above the diagonal of the squared jerk
    diagonal: Array  # (K, 3, 3): blocks on the diagonal of the squared jerk

    @classmethod
    def over(cls, t_s: Array, step_s: float = KNOT_STEP_S) -> MotionPrior:
        """Build the prior with knots out of the times (n,), none nearer to another than `step_s`."""
        knots = np.unique(t_s)
        if np.any(np.diff(knots) < step_s):
            kept = [float(knots[0])]
            for t in knots[1:].tolist():
                if t - kept[-1] >= step_s:
                    kept.append(t)
            knots = np.array(kept)
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
        """Return the number of knots."""
        return len(self.knots_s)

    def jerk(self, state: Array) -> Quadratic:
        """Squared jerk over the three unknowns that both axes share, about a state (K, 3, 2)."""
        band = to_band(self.diagonal, self.cross)
        return Quadratic(band, *self._gradient(state[1:] - self.step @ state[:-1]))

    def jerk_by_direction(self, state: Array, direction: Array) -> tuple[Quadratic, Quadratic]:
        """Squared jerk along and across unit directions (K-1, 2) of the steps, over all six unknowns of a knot."""
        outer = direction[:, :, None] * direction[:, None, :]
        noise = state[1:] - self.step @ state[:-1]
        along = noise @ outer
        # Each step has a direction of its own, so a knot's block takes two of them.
        diagonal = np.zeros((len(self), 6, 6))
        diagonal[:-1] = kronecker(self.inverse_before, outer)
        diagonal[1:] += kronecker(self.inverse, outer)
        cross = kronecker(self.cross, outer)
        longitudinal = self._form(along, diagonal, cross)
        np.negative(diagonal, out=diagonal)
        np.negative(cross, out=cross)
        for axis in range(2):  # across is all that is not along
            diagonal[:, axis::2, axis::2] += self.diagonal
            cross[:, axis::2, axis::2] += self.cross
        return longitudinal, self._form(noise - along, diagonal, cross)

    def _form(self, noise: Array, diagonal: Array, cross: Array) -> Quadratic:
        gradient, value = self._gradient(noise)
        return Quadratic(to_band(diagonal, cross), gradient.reshape(-1, 6, 1), value)

    def _gradient(self, noise: Array) -> tuple[Array, float]:
        """Negative half gradient (K, 3, 2) of the squared jerk for process noise (K-1, 3, 2), and its value."""
        weighted = self.inverse @ noise
        gradient = np.zeros((len(self), 3, 2))
        gradient[:-1] = np.swapaxes(self.step, 1, 2) @ weighted
        gradient[1:] -= weighted
        return gradient, float(np.vdot(noise, weighted))


def kronecker(blocks: Array, weights: Array) -> Array:
    """Kronecker products (n, 6, 6) of blocks (n, 3, 3) of one axis and weights (n, 2, 2) of each pair of axes."""
    product = np.empty((len(blocks), 6, 6))
    for first in range(2):
        for second in range(2):
            np.multiply(blocks, weights[:, first, second, None, None], out=product[:, first::2, second::2])
    return product


# Information about position, velocity and acceleration of the first knot.
INITIAL_INFORMATION = np.array([0.0, VELOCITY_PRIOR_MPS**-2, ACCELERATION_PRIOR_MPS2**-2])
# Prior share of outliers and the ratio of their standard deviation to that of inliers.
OUTLIER_SHARE, OUTLIER_WIDTH = 0.02, 10.0
# Scale of the Geman-McClure weights: an observation at this many sigmas counts a quarter.
GEMAN_MCCLURE_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class MeasurementModel:
    """Which state each observation measures, and how.

    All forms contain the vague prior of the first knot, with which a single observation, or two of them, have a solution.
    """

    observed: NoisyPositions
    knot: NDArray[np.intp]  # (n,): index of the knot that each observation measures
    design: Array  # (n, 3): row that takes the knot's position, velocity and acceleration to the observed position
    group_start: NDArray[np.intp]  # (G,): rows at which the observations of another knot begin

    @classmethod
    def of(cls, observed: NoisyPositions, prior: MotionPrior) -> MeasurementModel:
        """Tie each observation to the nearest knot of a motion prior."""
        knot = nearest_index(prior.knots_s, observed.t_s)
        start = np.concatenate([[0], np.flatnonzero(knot[1:] > knot[:-1]) + 1])
        return cls(observed, knot, position_row(observed.t_s - prior.knots_s[knot]), start)

    def residual(self, state: Array) -> Array:
        """Observed minus predicted positions (n, 2) for a state (K, 3, 2)."""
        return np.asarray(self.observed.xy - np.einsum("ni,nia->na", self.design, state[self.knot]))

    def independent_axes(self, state: Array, information: Array) -> Quadratic:
        """Squared residuals with scalar information (n,), over the three unknowns that both axes share."""
        residual = self.residual(state)
        rows = self.design * information[:, None]
        diagonal = self._sum_by_knot(rows[:, :, None] * self.design[:, None, :], len(state))
        gradient = self._sum_by_knot(rows[:, :, None] * residual[:, None, :], len(state))
        diagonal[0] += np.diag(INITIAL_INFORMATION)
        gradient[0] -= INITIAL_INFORMATION[:, None] * state[0]
        value = float(information @ (residual**2).sum(axis=1) + INITIAL_INFORMATION @ (state[0] ** 2).sum(axis=1))
        return Quadratic(to_band(diagonal, None), gradient, value)

    def coupled_axes(self, state: Array, information: Array) -> Quadratic:
        """Squared residuals with information (n, 2, 2), over all six unknowns of a knot."""
        residual = self.residual(state)
        weighted = np.einsum("nab,nb->na", information, residual)
        h = self.design
        diagonal = self._sum_by_knot(kronecker(h[:, :, None] * h[:, None, :], information), len(state))
        gradient = self._sum_by_knot((h[:, :, None] * weighted[:, None, :]).reshape(-1, 6, 1), len(state))
        initial = np.repeat(INITIAL_INFORMATION, 2)
        diagonal[0] += np.diag(initial)
        gradient[0, :, 0] -= initial * state[0].ravel()
        value = float(np.vdot(weighted, residual) + initial @ state[0].ravel() ** 2)
        return Quadratic(to_band(diagonal, None), gradient, value)

    def _sum_by_knot(self, values: Array, count: int) -> Array:
        """Sum values (n, ...) of the observations of each knot to (K, ...)."""
        sums = np.zeros((count, *values.shape[1:]))
        unique = len(self.group_start) == len(self.knot)
        sums[self.knot[self.group_start]] = values if unique else np.add.reduceat(values, self.group_start, axis=0)
        return sums


def position_row(offset_s: Array) -> Array:
    """Rows (n, 3) that take position, velocity and acceleration to the position after an offset (n,)."""
    return np.stack([np.ones_like(offset_s), offset_s, offset_s**2 / 2], axis=-1)


def transition(offset_s: Array) -> Array:
    """Transition matrices (n, 3, 3) over offsets (n,) at constant acceleration."""
    step = np.zeros((len(offset_s), 3, 3))
    step[:, 0] = position_row(offset_s)
    step[:, 1, 1:] = step[:, 0, :2]
    step[:, 2, 2] = 1.0
    return step


def propagate(prior: MotionPrior, state: Array, t_s: Array) -> Array:
    """Propagate the state (K, 3, 2) from the nearest knot to each time (T,): (T, 3, 2)."""
    knot = nearest_index(prior.knots_s, t_s)
    return transition(t_s - prior.knots_s[knot]) @ state[knot]


def zero_motion(state: Array, velocity_information: Array, acceleration_information: Array) -> Quadratic:
    """Pseudo-measurements of zero velocity and zero acceleration, with information (K, 2, 2) about each."""
    count = len(state)
    diagonal, gradient = np.zeros((count, 6, 6)), np.zeros((count, 6, 1))
    diagonal[:, 2:4, 2:4], diagonal[:, 4:, 4:] = velocity_information, acceleration_information
    v = np.einsum("kab,kb->ka", velocity_information, state[:, 1])
    a = np.einsum("kab,kb->ka", acceleration_information, state[:, 2])
    gradient[:, 2:4, 0], gradient[:, 4:, 0] = -v, -a
    value = float(np.vdot(v, state[:, 1]) + np.vdot(a, state[:, 2]))
    return Quadratic(to_band(diagonal, None), gradient, value)


def geman_mcclure_weights(squared: Array) -> Array:
    """Robust weights (n,) of squared residuals in sigmas, while the outliers are not yet known.

    Geman and McClure, Statistical methods for tomographic image reconstruction (1987).
    """
    return np.asarray(1.0 / (1.0 + squared / GEMAN_MCCLURE_SIGMAS**2) ** 2)


def inlier_probability(squared: Array) -> Array:
    """Probability (n,) of being an inlier, from squared residuals in sigmas, relative to that of a residual of zero.

    Mixture of two Gaussians, that of the outliers `OUTLIER_WIDTH` times as wide (expectation step of Dempster, Laird and
    Rubin, 1977, section 4.3). Inliers keep nearly all their weight, unlike with `geman_mcclure_weights`.
    """
    odds = OUTLIER_SHARE / (1.0 - OUTLIER_SHARE) / OUTLIER_WIDTH**2
    exponent = np.minimum(squared, 200.0) / 2.0 * (1.0 - OUTLIER_WIDTH**-2)
    return np.asarray((1.0 + odds) / (1.0 + odds * np.exp(exponent)))


# Lognormal priors of a jerk density: median in m2/s5 and standard deviation of its logarithm. The weak one is outweighed by some
# seconds of data. The strong one is for errors that repeat from tick to tick, which look like maneuvers.
WEAK_PRIOR, STRONG_PRIOR = (1.5, 2.5), (3.0, 0.7)
# Information that ties two knots beyond this leaves no digits of float64 for the data.
MAX_INFORMATION = 1e13
MIN_DENSITY, MAX_DENSITY = 1e-4, 1e4  # m2/s5
# Half widths of the search in the logarithm, round by round.
SEARCH_WIDTHS = (2.0, 0.8)


@dataclass(frozen=True)
class DensityEstimator:
    """Maximizes the marginal likelihood of jerk densities."""

    prior: tuple[float, float] = WEAK_PRIOR
    rounds: int = 2  # rounds of the search for one density, each narrower; 1 where a finer search follows

    def _penalty(self, log_density: float) -> float:
        """Twice the negative log density of the prior, up to a constant."""
        return ((log_density - float(np.log(self.prior[0]))) / self.prior[1]) ** 2

    def isotropic(self, motion: MotionPrior, state: Array, likelihood: Quadratic) -> float:
        """Estimate one jerk density in m2/s5 for both axes.

        `state`: (K, 3, 2): reference state of the forms. `likelihood`: squared residuals over 3 unknowns a knot and 2 columns,
        about `state`.
        """
        jerk = motion.jerk(state)
        steps = len(motion) - 1

        def objective(log_density: Array) -> float:
            u = float(log_density[0])
            least = minimize(weighted_sum([(1.0, likelihood), (np.exp(-u), jerk)]))
            return float(least.value + 2.0 * least.log_determinant + 6.0 * steps * u + self._penalty(u))

        lowest = min_density(motion)
        start = np.array([np.log(max(self.prior[0], lowest))])
        return float(np.exp(_coordinate_descent(objective, start, SEARCH_WIDTHS[: self.rounds], lowest)[0]))

    def by_direction(
        self, motion: MotionPrior, jerk: tuple[Quadratic, Quadratic], likelihood: Quadratic, start: float
    ) -> tuple[float, float]:
        """Estimate jerk densities in m2/s5 along and across the path.

        Drivers brake and steer at different times: the straight path of a braking car and the constant speed of one that
        changes lanes are each smoothed as strongly as the data allow.
        """
        steps = len(motion) - 1

        def objective(logs: Array) -> float:
            along, across = (np.exp(-logs[0]), jerk[0]), (np.exp(-logs[1]), jerk[1])
            least = minimize(weighted_sum([(1.0, likelihood), along, across]))
            misfit = least.value + least.log_determinant + 3.0 * steps * logs.sum()
            return float(misfit + self._penalty(logs[0]) + self._penalty(logs[1]))

        logs = _coordinate_descent(objective, np.full(2, np.log(start)), SEARCH_WIDTHS, min_density(motion))
        return float(np.exp(logs[0])), float(np.exp(logs[1]))


def min_density(motion: MotionPrior) -> float:
    """Smallest density in m2/s5 with which the normal equations are solvable in float64."""
    stiffest = float(motion.inverse[:, 0, 0].max()) if len(motion) > 1 else 0.0
    return max(stiffest / MAX_INFORMATION, MIN_DENSITY)


def _coordinate_descent(
    objective: Callable[[Array], float], start: Array, widths: tuple[float, ...], lowest: float
) -> Array:
    """Step to the vertex of a parabola through three points on each axis, all from one center, once for every width."""
    at, low, high = start.copy(), np.log(lowest), np.log(MAX_DENSITY)
    for width in widths:
        here, move = objective(at), np.zeros_like(at)
        for axis in range(len(at)):
            side = np.zeros_like(at)
            side[axis] = width
            above, below = objective(at + side), objective(at - side)
            slope, curvature = (above - below) / (2 * width), (above + below - 2 * here) / width**2
            reach = 2 * width
            move[axis] = -np.sign(slope) * reach if curvature * reach <= abs(slope) else -slope / curvature
        at = np.clip(at + move, low, high)
    return at
