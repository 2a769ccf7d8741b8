"""The most probable path through noisy samples, with its standard deviation: it interpolates gaps as the motion around suggests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# A step between two parts of a path may have any size up to some of these.
STEP_PRIOR = 100.0
# Samples are never taken for more exact, which keeps the equations solvable.
MIN_SIGMA = 1e-3


@dataclass(frozen=True)
class PathPrior:
    """What is known of a path before it is measured, in units u: m of a position, rad of an angle.

    Attributes
    ----------
    density : float, u2/s5
        Spectral density of the third derivative, white noise.
    place, rate, change : float, u, u/s, u/s2
        Standard deviations of the first value about the first sample, and of its first and second derivative.
    """

    density: float
    place: float
    rate: float
    change: float


# Accelerations in traffic of 1.5 m/s2 that last for some 1.5 s (Singer, IEEE Trans. AES 6, 1970): 2 * 1.5**2 / 1.5.
POSITION_PRIOR = PathPrior(density=3.0, place=100.0, rate=50.0, change=2.0)
# Yaw accelerations of 0.3 rad/s2 that last as long.
YAW_PRIOR = PathPrior(density=0.12, place=4.0, rate=1.0, change=0.5)


@dataclass(frozen=True, eq=False)
class FittedPath:
    """A path at the times that were asked for.

    Attributes
    ----------
    value : (T, D) float64
    sigma : (T,) float64
        Standard deviation of each coordinate.
    step : (D,) float64
        How far the samples after the step are off those before it; 0 without a step.
    step_sigma : float
    """

    value: Array
    sigma: Array
    step: Array
    step_sigma: float


def fit_path(
    t_s: Array,
    samples: Array,
    sigma: float,
    asked_s: Array,
    prior: PathPrior,
    *,
    after: NDArray[np.bool_] | None = None,
) -> FittedPath:
    """Fit a path to samples and evaluate it, in units u of the samples.

    Parameters
    ----------
    t_s : (n,) float64, s
    samples : (n, D) float64, u
    sigma : float, u
        Standard deviation of each sample.
    asked_s : (T,) float64, s
    prior : PathPrior
    after : (n,) bool, optional
        Samples that are off all others by one unknown step.

    Notes
    -----
    Gaussian process regression with the kernel of a twice integrated acceleration whose derivative is white noise; it equals
    the fixed-interval smoother of the constant-acceleration model and a smoothing spline of fifth degree (Wahba, J. Royal Stat.
    Soc. B 40, 1978). Cost O(n^3): for some hundred samples around a gap.
    """
    start = min(float(t_s.min()), float(asked_s.min()))
    t, asked = t_s - start, asked_s - start
    base = samples[0]
    shifted = np.zeros(len(t)) if after is None else after.astype(np.float64)
    noise = max(sigma, MIN_SIGMA) ** 2
    # Value, rate and change at the start and the step are estimated apart from the rest, which keeps the digits of both.
    terms, asked_terms = np.column_stack([_powers(t), shifted]), np.column_stack([_powers(asked), np.zeros(len(asked))])
    scale = np.array([prior.place, prior.rate, prior.change, STEP_PRIOR])
    factor = np.linalg.cholesky(prior.density * _wandering(t, t) + noise * np.eye(len(t)))
    design = np.linalg.solve(factor, terms * scale)
    measured = np.linalg.solve(factor, samples - base)
    cross = np.linalg.solve(factor, prior.density * _wandering(t, asked))
    covariance = np.linalg.inv(design.T @ design + np.eye(len(scale)))
    found = covariance @ design.T @ measured
    reach = asked_terms * scale - cross.T @ design
    variance = prior.density * asked**5 / 20 - np.sum(cross**2, axis=0) + np.sum((reach @ covariance) * reach, axis=1)
    return FittedPath(
        base + reach @ found + cross.T @ measured,
        np.sqrt(np.maximum(variance, 0.0)),
        STEP_PRIOR * found[3],
        STEP_PRIOR * float(np.sqrt(covariance[3, 3])) if shifted.any() else 0.0,
    )


def _powers(t_s: Array) -> Array:
    """Return what value, rate and change at the start contribute at times (n,) after it: (n, 3)."""
    return np.stack([np.ones(len(t_s)), t_s, t_s**2 / 2], axis=1)


def _wandering(first_s: Array, second_s: Array) -> Array:
    """Compute the covariances (n, m) of white noise that is integrated three times, of unit density, at times (n,) and (m,)."""
    a, b = first_s[:, None], second_s[None, :]
    early, apart = np.minimum(a, b), np.abs(a - b)
    return np.asarray(early**5 / 20 + apart * early**4 / 8 + apart**2 * early**3 / 12)
