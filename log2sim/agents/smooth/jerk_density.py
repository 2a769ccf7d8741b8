"""Estimates of the noise's scale and of the jerk's power spectral density by maximum marginal likelihood."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from log2sim.agents.smooth.motion_prior import MotionPrior
from log2sim.agents.smooth.quadratic import Quadratic, minimize, weighted_sum
from log2sim.geometry import Array


@dataclass(frozen=True)
class LogNormalPrior:
    """Prior of a jerk density: median in m2/s5 and standard deviation of its logarithm."""

    median: float
    log_sigma: float

    def penalty(self, log_density: float) -> float:
        """Twice the negative log density, up to a constant."""
        return ((log_density - float(np.log(self.median))) / self.log_sigma) ** 2


# The weak prior is outweighed by some seconds of data. The strong one is for errors that repeat from tick to tick, which
# look like maneuvers.
WEAK_PRIOR, STRONG_PRIOR = LogNormalPrior(1.5, 2.5), LogNormalPrior(3.0, 0.7)
# Information that ties two knots beyond this leaves no digits of float64 for the data.
MAX_INFORMATION = 1e13
MIN_DENSITY, MAX_DENSITY = 1e-4, 1e4  # m2/s5
# Half widths of the search in the logarithm, round by round.
SEARCH_WIDTHS = (2.0, 0.8)


@dataclass(frozen=True)
class DensityEstimator:
    """Maximizes the marginal likelihood of jerk densities.

    Attributes
    ----------
    prior : LogNormalPrior
    unknown_scale : bool
        Whether the variance of the noise is known up to a factor only.
    rounds : int
        Rounds of the search for one density, each narrower; 1 where a finer search follows.
    """

    prior: LogNormalPrior = WEAK_PRIOR
    unknown_scale: bool = False
    rounds: int = 2

    def isotropic(
        self, motion: MotionPrior, state: Array, likelihood: Quadratic, weight_sum: float
    ) -> tuple[float, float]:
        """Estimate one jerk density in m2/s5 for both axes and the factor on the noise's variance.

        Parameters
        ----------
        motion : MotionPrior
        state : (K, 3, 2) float64
            Reference state of the forms.
        likelihood : Quadratic
            Squared residuals over 3 unknowns a knot and 2 columns, about `state`.
        weight_sum : float
            Sum of the observations' weights.
        """
        jerk = motion.jerk(state)
        steps = len(motion) - 1
        # The six unknowns of the initial state are as good as free.
        freedom = max(2.0 * weight_sum - 6.0, 1.0)

        def objective(log_density: Array) -> float:
            u = float(log_density[0])
            least = minimize(weighted_sum([(1.0, likelihood), (np.exp(-u), jerk)]))
            noise = freedom * np.log(least.value) if self.unknown_scale else least.value
            return float(noise + 2.0 * least.log_determinant + 6.0 * steps * u + self.prior.penalty(u))

        lowest = min_density(motion)
        start = np.array([np.log(max(self.prior.median, lowest))])
        u = _coordinate_descent(objective, start, SEARCH_WIDTHS[: self.rounds], lowest)
        ratio = float(np.exp(u[0]))
        if not self.unknown_scale:
            return ratio, 1.0
        factor = minimize(weighted_sum([(1.0, likelihood), (1 / ratio, jerk)])).value / freedom
        return ratio * factor, factor

    def by_direction(
        self, motion: MotionPrior, jerk: tuple[Quadratic, Quadratic], likelihood: Quadratic, start: float
    ) -> tuple[float, float]:
        """Estimate jerk densities in m2/s5 along and across the path.

        Drivers brake and steer at different times: the straight path of a braking car and the constant speed of one that
        changes lanes are each smoothed as strongly as the data allow.
        """
        steps = len(motion) - 1

        def objective(logs: Array) -> float:
            least = minimize(
                weighted_sum([(1.0, likelihood), (np.exp(-logs[0]), jerk[0]), (np.exp(-logs[1]), jerk[1])])
            )
            misfit = least.value + least.log_determinant + 3.0 * steps * logs.sum()
            return float(misfit + self.prior.penalty(logs[0]) + self.prior.penalty(logs[1]))

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
