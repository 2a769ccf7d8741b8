"""How well an object that stands, or one that moves, explains positions: marginal likelihoods of Gaussian processes.

All unknowns (place, velocity, accelerations, errors that repeat) are Gaussian and integrated out, so that hypotheses with more
of them are compared fairly (MacKay, Information Theory, Inference, and Learning Algorithms, 2003, chapter 28). Positions that
fit no such motion are outliers at a fixed cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# A place is known before to some car lengths: the gates of the tracker reach as far.
PLACE_SIGMA_M = 5.0
# Errors of a center repeat while the view stays the same, for some half a second of passing traffic; the rest of the variance
# changes from tick to tick.
VIEW_S, REPEATED_SHARE = 0.5, 0.9
# One position in twenty shows something else, anywhere within a gate of 3 m.
OUTLIER_LOG = float(np.log(0.05 / (np.pi * 3.0**2)))
# Outliers are removed in so many rounds at most, each those that are worse than as many on either side: since errors repeat, an
# outlier makes its neighbors unlikely too.
MAX_ROUNDS, NEIGHBORS = 12, 3


@dataclass(frozen=True, eq=False)
class Positions:
    """Positions of a track.

    Attributes
    ----------
    t_s : (n,) float64, s
        In rising order.
    xy_m : (n, 2) float64, m
    variance : (n,) float64, m2
        Of a position in each direction, changing views included.
    """

    t_s: Array
    xy_m: Array
    variance: Array

    def __len__(self) -> int:
        """Return the number of positions."""
        return len(self.t_s)

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Positions:
        """Return some of the rows."""
        return Positions(self.t_s[rows], self.xy_m[rows], self.variance[rows])


@dataclass(frozen=True)
class MotionPriorSigmas:
    """How far an object is expected to move.

    Attributes
    ----------
    speed_mps : float
        Standard deviation of each component of the velocity; 0 for one that stands.
    acceleration_mps2 : float
        Standard deviation of its change in 1 s.
    """

    speed_mps: float = 0.0
    acceleration_mps2: float = 0.0


STANDING = MotionPriorSigmas()


@dataclass(frozen=True, eq=False)
class MarginalLikelihood:
    """How well a hypothesis explains positions.

    Attributes
    ----------
    log : float
        Logarithm of the marginal likelihood, outliers included.
    inlier : (n,) bool
    """

    log: float
    inlier: NDArray[np.bool_]


def marginal_likelihood(positions: Positions, motion: MotionPriorSigmas) -> MarginalLikelihood:
    """Compute the marginal likelihood of one object that moves as expected, or stands.

    Notes
    -----
    The velocity is a Wiener process about the middle of the track. O(n^3).
    """
    inlier = np.ones(len(positions), dtype=bool)
    best = MarginalLikelihood(-np.inf, inlier)
    for _ in range(MAX_ROUNDS):
        log, each = _likelihoods(positions.take(inlier), motion)
        log += OUTLIER_LOG * int((~inlier).sum())
        if log > best.log:
            best = MarginalLikelihood(log, inlier)
        padded = np.full(len(each) + 2 * NEIGHBORS, np.inf)
        padded[NEIGHBORS : NEIGHBORS + len(each)] = each
        lowest = reduce(np.minimum, [padded[k : k + len(each)] for k in range(2 * NEIGHBORS + 1)])
        worst = np.flatnonzero((each < OUTLIER_LOG) & (each == lowest))
        if len(worst) == 0 or inlier.sum() <= 2:
            break
        inlier = inlier.copy()
        inlier[np.flatnonzero(inlier)[worst]] = False
    return best


def _likelihoods(p: Positions, motion: MotionPriorSigmas) -> tuple[float, Array]:
    """Return the log-likelihood of all positions, and that of each given all others (n,)."""
    s = p.t_s - (p.t_s[0] + p.t_s[-1]) / 2
    middle = np.median(p.xy_m, axis=0) if motion.speed_mps == 0 else p.xy_m[np.argmin(np.abs(s))]
    z = p.xy_m - middle
    k = noise_of(p) + PLACE_SIGMA_M**2 + motion.speed_mps**2 * np.outer(s, s)
    if motion.acceleration_mps2:
        near = np.minimum(np.abs(s)[:, None], np.abs(s)[None, :]) * (np.sign(s)[:, None] == np.sign(s)[None, :])
        far = np.maximum(np.abs(s)[:, None], np.abs(s)[None, :])
        k += motion.acceleration_mps2**2 * near**2 * (far / 2 - near / 6)
    inverse = np.linalg.inv(k)
    weighted, variance = inverse @ z, 1.0 / np.diag(inverse)
    log = -0.5 * float(np.vdot(z, weighted)) - float(np.linalg.slogdet(k)[1]) - len(p) * float(np.log(2 * np.pi))
    each = -np.log(2 * np.pi * variance) - 0.5 * variance * (weighted**2).sum(axis=1)
    return log, each


def noise_of(p: Positions) -> Array:
    """Return the covariance (n, n), m2, of the errors: a part that repeats while the view stays the same, and one that does not."""
    sigma = np.sqrt(p.variance)
    repeated = np.exp(-np.abs(p.t_s[:, None] - p.t_s[None, :]) / VIEW_S)
    return np.outer(sigma, sigma) * (REPEATED_SHARE * repeated + (1 - REPEATED_SHARE) * np.eye(len(p)))
