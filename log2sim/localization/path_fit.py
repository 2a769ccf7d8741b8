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
    covariance = _covariance(t, t, prior) + STEP_PRIOR**2 * np.outer(shifted, shifted) + noise * np.eye(len(t))
    factor = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(factor, samples - base)
    cross = np.linalg.solve(factor, _covariance(t, asked, prior))
    of_step = np.linalg.solve(factor, STEP_PRIOR**2 * shifted)
    variance = _variance(asked, prior) - np.sum(cross**2, axis=0)
    step_variance = STEP_PRIOR**2 * float(shifted.any()) - float(of_step @ of_step)
    return FittedPath(
        base + cross.T @ whitened,
        np.sqrt(np.maximum(variance, 0.0)),
        of_step @ whitened,
        float(np.sqrt(max(step_variance, 0.0))),
    )


def _covariance(first_s: Array, second_s: Array, prior: PathPrior) -> Array:
    """Compute the covariances (n, m) of the path before it is measured between times (n,) and (m,) after its start."""
    a, b = first_s[:, None], second_s[None, :]
    early, apart = np.minimum(a, b), np.abs(a - b)
    wandering = early**5 / 20 + apart * early**4 / 8 + apart**2 * early**3 / 12
    line = prior.place**2 + prior.rate**2 * a * b + prior.change**2 * (a * b) ** 2 / 4
    return np.asarray(line + prior.density * wandering)


def _variance(t_s: Array, prior: PathPrior) -> Array:
    """Compute the diagonal (n,) of `_covariance`."""
    line = prior.place**2 + (prior.rate * t_s) ** 2 + (prior.change * t_s**2) ** 2 / 4
    return np.asarray(line + prior.density * t_s**5 / 20)
