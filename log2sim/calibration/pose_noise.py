"""Errors of the ego's poses: how large they are, how long they last, and what can be known of a sensor in spite of them.

Each coordinate errs as a first-order Gauss-Markov process, as poses of GNSS and IMU do. Sizes and the time constant are
estimated by restricted maximum likelihood (Patterson, Thompson, Biometrika 1971), so that standard deviations hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from log2sim.calibration.twists import MOTION_SPAN_NS
from log2sim.geometry import NS_PER_S, Array

# Errors of position across, of height, of yaw and of roll and pitch: components of a twist, usual sizes in m and rad, and how
# far sizes are from these in powers of e.
COMPONENTS = ((0, 1), (2,), (5,), (3, 4))
USUAL_NOISE = np.array([0.03, 0.03, np.deg2rad(0.1), np.deg2rad(0.1)])
LOG_NOISE_SIGMA = 1.0
TIMES_S = (0.5, 2.0, 8.0)
LOG_STEPS = (0.8, 0.4, 0.2)
# An offset of the clock counts as shown by the ego's motion if errors of the poses alone would show no more than this share.
MAX_NOISE_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Linearized:
    """Residuals of motions between sweeps, and their derivatives.

    Attributes
    ----------
    t_ns : (K,) int64
        Stamps of the sweeps.
    residual : (6 P,) float64
        Of P pairs, m and rad.
    by_values : (6 P, V) float64
        Derivatives by what is estimated; the first is a time offset.
    by_poses : (6 P, 6 K) float64
        By errors of the poses.
    information : sequence of (6, 6)
        Of each pair's registration.
    prior : (V,) float64
        Information about what is estimated, before.
    pull : (V,) float64
        `prior` times how far the values are below what is expected.
    """

    t_ns: NDArray[np.int64]
    residual: Array
    by_values: Array
    by_poses: Array
    information: Sequence[Array]
    prior: Array
    pull: Array


@dataclass(frozen=True, eq=False)
class Solution:
    """Step of the values (V,), their covariance (V, V), and the share of the offset's information that is noise."""

    step: Array
    covariance: Array
    noise_share: float


class PoseNoise:
    """Linearized residuals with errors of the poses and of the registrations.

    Errors of the poses are eliminated, which takes factors of the size of the sweeps instead of that of the pairs.
    """

    def __init__(self, problem: Linearized) -> None:
        both = np.column_stack([problem.by_values, problem.residual])
        blocks = problem.by_poses.reshape(len(problem.information), 6, -1)
        weighted = np.einsum("pij,pjk->pik", np.array(problem.information), blocks).reshape(problem.by_poses.shape)
        weighted_both = np.einsum(
            "pij,pjk->pik", np.array(problem.information), both.reshape(len(blocks), 6, -1)
        ).reshape(both.shape)
        # Components first, so that each is a block.
        order = np.arange(problem.by_poses.shape[1]).reshape(-1, 6).T.ravel()
        self._of_poses = (problem.by_poses.T @ weighted)[np.ix_(order, order)]
        self._mixed, self._of_both = (weighted.T @ both)[order], both.T @ weighted_both
        self._prior, self._pull = np.diag(problem.prior), problem.pull
        apart_s = (problem.t_ns[:, None] - problem.t_ns) / NS_PER_S
        self._shapes = {tau: _Shape.of(apart_s, tau) for tau in TIMES_S}

    def estimate(self) -> list[tuple[float, Array, float]]:
        """Find the sizes (4,) of errors for each time constant, s: tuples of its probability, the sizes, and itself."""
        found = [(*self._descend(tau), tau) for tau in TIMES_S]
        least = min(cost for cost, _, _ in found)
        weights = np.exp([least - cost for cost, _, _ in found])
        return [(float(w), noise, tau) for w, (_, noise, tau) in zip(weights / weights.sum(), found)]

    def solve(self, noise: Array, tau: float) -> Solution:
        """Solve for the values under errors of given sizes (4,) and time constant, s.

        Notes
        -----
        The velocities by which a time offset shows have the errors of the poses in them: what these seem to tell about the
        offset is taken off its information, as in regression with errors in the variables (Fuller, 1987, section 1.2).
        """
        both, _ = self._eliminate(noise, tau)
        information, right = both[:-1, :-1] + self._prior, both[:-1, -1] + self._pull
        own = 1 / np.linalg.inv(information)[0, 0] - self._prior[0, 0]
        false = self._information_of_noise(noise, tau)
        reduced = information.copy()
        reduced[0, 0] -= min(false, MAX_NOISE_SHARE * own)
        covariance = np.linalg.inv(reduced)
        share = false / own if own > 0 else 1.0
        return Solution(covariance @ right, covariance @ information @ covariance, share)

    def _eliminate(self, noise: Array, tau: float) -> tuple[Array, float]:
        """Return the information (V + 1, V + 1) about values and residual, and the logarithm of the determinant of their covariance."""
        matrix, log_det = self._with_noise(noise, tau)
        lower = np.linalg.cholesky(matrix)
        white = solve_triangular(lower, self._mixed, lower=True, check_finite=False)
        return self._of_both - white.T @ white, log_det + 2 * float(np.log(np.diag(lower)).sum())

    def _with_noise(self, noise: Array, tau: float) -> tuple[Array, float]:
        """Return the information (6 K, 6 K) about errors of poses, and the logarithm of the determinant of their prior covariance."""
        shape, matrix, log_det = self._shapes[tau], self._of_poses.copy(), 0.0
        k = len(shape.inverse)
        for sigma, components in zip(noise, COMPONENTS):
            for c in components:
                matrix[c * k : c * k + k, c * k : c * k + k] += shape.inverse / sigma**2
                log_det += 2 * k * float(np.log(sigma)) + shape.log_det
        return matrix, log_det

    def _cost(self, noise: Array, tau: float) -> float:
        """Compute the negative logarithm of the restricted likelihood, with the prior of the sizes."""
        both, log_det = self._eliminate(noise, tau)
        information, right = both[:-1, :-1] + self._prior, both[:-1, -1] + self._pull
        fitted = both[-1, -1] - right @ np.linalg.solve(information, right)
        prior = np.sum((np.log(noise / USUAL_NOISE) / LOG_NOISE_SIGMA) ** 2)
        return float(0.5 * (log_det + np.linalg.slogdet(information)[1] + fitted + prior))

    def _descend(self, tau: float) -> tuple[float, Array]:
        """Find the sizes of least cost, one after the other with smaller steps."""
        noise = USUAL_NOISE.copy()
        best = self._cost(noise, tau)
        for step in LOG_STEPS:
            for k in range(len(noise)):
                for factor in (np.exp(-step), np.exp(step)):
                    other = noise.copy()
                    other[k] *= factor
                    while (cost := self._cost(other, tau)) < best:
                        noise, best = other.copy(), cost
                        other[k] *= factor
        return best, noise

    def _information_of_noise(self, noise: Array, tau: float) -> float:
        """Compute what the errors of the velocities alone would tell about a time offset, 1/s2."""
        matrix, _ = self._with_noise(noise, tau)
        left = self._of_poses - self._of_poses @ np.linalg.solve(matrix, self._of_poses)
        velocity = self._shapes[tau].velocity
        k = len(velocity)
        blocks = ((sigma, slice(c * k, c * k + k)) for sigma, cs in zip(noise, COMPONENTS) for c in cs)
        return float(sum(sigma**2 * np.sum(left[rows, rows] * velocity) for sigma, rows in blocks))


@dataclass(frozen=True, eq=False)
class _Shape:
    """Inverse (K, K) and logarithm of the determinant of the correlation of errors, and the covariance of velocities, 1/s2."""

    inverse: Array
    log_det: float
    velocity: Array

    @classmethod
    def of(cls, apart_s: Array, tau: float) -> _Shape:
        """Compute them for stamps `apart_s` (K, K), s, from each other."""
        span = 2 * MOTION_SPAN_NS / NS_PER_S
        alike, before, after = (np.exp(-np.abs(apart_s + d) / tau) for d in (0.0, -span, span))
        return cls(np.linalg.inv(alike), float(np.linalg.slogdet(alike)[1]), (2 * alike - before - after) / span**2)
