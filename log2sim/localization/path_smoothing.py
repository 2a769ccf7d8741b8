"""Noise taken out of a path: the most probable motion through its samples, block by block."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.localization.path_fit import PathPrior, fit_path

# Each block is smoothed with the samples this long before and after it; those farther away change nothing.
BLOCK_S, MARGIN_S = 1.0, 1.0
# More samples of a block and its margins are averaged in groups, within which a vehicle moves steadily.
MAX_SAMPLES = 150


def smooth_path(
    t_s: Array, values: Array, measured: NDArray[np.bool_], noise: float, prior: PathPrior
) -> tuple[Array, Array]:
    """Smooth the measured samples of a path, in units u; the others stay as they are.

    Parameters
    ----------
    t_s : (P,) float64, s
    values : (P, D) float64, u
    measured : (P,) bool
    noise : float, u
        Standard deviation of the samples, independent of each other.
    prior : PathPrior

    Returns
    -------
    values : (P, D) float64, u
    sigma : (P,) float64, u
        Standard deviations of the smoothed samples, 0 of the others.
    """
    out, sigma = values.copy(), np.zeros(len(t_s))
    rows = np.flatnonzero(measured)
    t = t_s[rows]
    done = 0
    while done < len(rows):
        stop = int(np.searchsorted(t, t[done] + BLOCK_S))
        first, last = np.searchsorted(t, [t[done] - MARGIN_S, t[stop - 1] + MARGIN_S])
        near = rows[first:last]
        size = -(-len(near) // MAX_SAMPLES)
        groups = np.arange(0, len(near), size)
        counts = np.diff(np.append(groups, len(near)))
        mean_t = np.add.reduceat(t_s[near], groups) / counts
        mean = np.add.reduceat(values[near], groups, axis=0) / counts[:, None]
        block = rows[done:stop]
        fitted = fit_path(mean_t, mean, noise / np.sqrt(size), t_s[block], prior)
        out[block], sigma[block] = fitted.value, fitted.sigma
        done = stop
    return out, sigma
