"""How much noise there is and how fast an object maneuvers, read off its own track."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from log2sim.agents.smooth.motion_prior import Chain
from log2sim.agents.smooth.quadratic import Quadratic, minimize, total
from log2sim.geometry import Array


@dataclass(frozen=True)
class Belief:
    """What is believed about a jerk density before the data are seen: median in m2/s5 and spread of its logarithm."""

    median: float
    log_spread: float

    def __call__(self, log_density: float) -> float:
        return ((log_density - float(np.log(self.median))) / self.log_spread) ** 2


# So weak that some seconds of data outweigh it; and a firm one for errors that repeat from tick to tick, which look like
# maneuvers.
OPEN, FIRM = Belief(1.5, 2.5), Belief(3.0, 0.7)
# Information that ties two knots beyond this leaves no digits for the data.
MAX_INFORMATION = 1e13
LIMITS = (1e-4, 1e4)
# Reach of the search in the logarithm, round by round.
WIDTHS = (2.0, 0.8)


def shared_density(
    chain: Chain, state: Array, fixed: Quadratic, weight: float, *, scaled: bool, belief: Belief = OPEN, rounds: int = 2
) -> tuple[float, float]:
    """Jerk density in m2/s5 of both axes and the factor on the noise's variance, by marginal likelihood.

    Parameters
    ----------
    fixed : Quadratic
        What the observations say, over 3 unknowns a knot and 2 columns, about `state`.
    weight : float
        Sum of the observations' weights.
    scaled : bool
        True where the variance of the noise is known up to a factor only.
    rounds : int
        How often to search, each time closer; 1 where a finer search follows.
    """
    jerk = chain.jerk(state)
    steps = len(chain) - 1
    # Six unknowns are as good as free: the initial state.
    freedom = max(2.0 * weight - 6.0, 1.0)

    def misfit(log_density: Array) -> float:
        u = float(log_density[0])
        least = minimize(total([(1.0, fixed), (np.exp(-u), jerk)]))
        noise = freedom * np.log(least.value) if scaled else least.value
        return float(noise + 2.0 * least.log_determinant + 6.0 * steps * u + belief(u))

    lowest = floor(chain)
    start = np.array([np.log(max(belief.median, lowest))])
    u = _descend(misfit, start, WIDTHS[:rounds], lowest)
    ratio = float(np.exp(u[0]))
    if not scaled:
        return ratio, 1.0
    factor = minimize(total([(1.0, fixed), (1 / ratio, jerk)])).value / freedom
    return ratio * factor, factor


def separate_densities(
    chain: Chain, parts: tuple[Quadratic, Quadratic], fixed: Quadratic, start: float, belief: Belief = OPEN
) -> tuple[float, float]:
    """Jerk densities along and across the way, by marginal likelihood.

    Drivers brake and steer at different times: the straight run of a braking car, the constant speed of one that changes
    lanes are smoothed as hard as they deserve.
    """
    steps = len(chain) - 1

    def misfit(logs: Array) -> float:
        least = minimize(total([(1.0, fixed), (np.exp(-logs[0]), parts[0]), (np.exp(-logs[1]), parts[1])]))
        return float(least.value + least.log_determinant + 3.0 * steps * logs.sum() + belief(logs[0]) + belief(logs[1]))

    logs = _descend(misfit, np.full(2, np.log(start)), WIDTHS, floor(chain))
    return float(np.exp(logs[0])), float(np.exp(logs[1]))


def floor(chain: Chain) -> float:
    """Least density in m2/s5 with which the knots' equations can be solved."""
    stiffest = float(chain.inverse[:, 0, 0].max()) if len(chain) > 1 else 0.0
    return max(stiffest / MAX_INFORMATION, LIMITS[0])


def _descend(misfit: Callable[[Array], float], start: Array, widths: tuple[float, ...], lowest: float) -> Array:
    """Coordinate-wise parabolas through three points each, all from the same center, once for every width."""
    at, low, high = start.copy(), np.log(lowest), np.log(LIMITS[1])
    for width in widths:
        here, move = misfit(at), np.zeros_like(at)
        for axis in range(len(at)):
            side = np.zeros_like(at)
            side[axis] = width
            above, below = misfit(at + side), misfit(at - side)
            slope, bend = (above - below) / (2 * width), (above + below - 2 * here) / width**2
            reach = 2 * width
            move[axis] = -np.sign(slope) * reach if bend * reach <= abs(slope) else -slope / bend
        at = np.clip(at + move, low, high)
    return at
