"""Noise of the samples of a path, in units u: m or rad."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# Derivatives are taken over these times: the first finds jumps and sudden stops, the second jumps that take a while. Shorter ones
# would find the vibration of the vehicle and the last digits of stored poses.
SPANS_S = (0.1, 0.3)
# Third differences need some rows for a median.
MIN_ROWS_FOR_NOISE, MIN_SIGMA = 8, 1e-3
# Errors are independent where over this many times the time they grow by less than this: halfway from 1 to the root of 3.
WHITENESS_SPAN, MAX_GROWTH = 3.0, 1.3


def noise_of(t_s: Array, values: Array, usual_sigma: float) -> float:
    """Estimate the standard deviation, u, of the noise of samples (P, D); the usual one for few samples.

    Notes
    -----
    From third differences over the shortest of `SPANS_S`. The median absolute value, 0.6745 standard deviations of a Gaussian, is
    insensitive to jumps (Rousseeuw and Croux, J. Am. Stat. Assoc. 88, 1993). Slow errors, such as those of a GNSS that drifts, do
    not show; where samples are sparse the third derivative of the motion itself counts as noise.
    """
    rows, differences = _third_differences(t_s, values, SPANS_S[0])
    if len(rows) < MIN_ROWS_FOR_NOISE:
        return usual_sigma
    spread = np.median(np.abs(differences), axis=0) / 0.6745
    return max(float(np.sqrt(np.mean(spread**2))), MIN_SIGMA)


def independent_noise(t_s: Array, xy_m: Array) -> float:
    """Estimate the standard deviation, m, of the errors of positions (P, 2) across the path that change from sample to sample.

    Notes
    -----
    Across the path stamps that are off change nothing. 0 where errors last, as those of a GNSS that drifts: over three times the
    time such errors grow by its root, while independent ones stay.
    """
    period = float(np.median(np.diff(t_s))) if len(t_s) > MIN_ROWS_FOR_NOISE else 0.0
    if period <= 0:
        return 0.0
    near, far = (_noise_across(t_s, xy_m, span) for span in (period, WHITENESS_SPAN * period))
    return near if far < MAX_GROWTH * near else 0.0


def _noise_across(t_s: Array, xy_m: Array, span_s: float) -> float:
    """Estimate the noise, m, of positions (P, 2) across the path from third differences over a time; 0 for few."""
    rows, differences = _third_differences(t_s, xy_m, span_s)
    along = xy_m[rows[:, -1]] - xy_m[rows[:, 0]]
    length = np.linalg.norm(along, axis=1)
    moving = length > 0
    if moving.sum() < MIN_ROWS_FOR_NOISE:
        return 0.0
    across = (differences[:, 1] * along[:, 0] - differences[:, 0] * along[:, 1])[moving] / length[moving]
    return float(np.median(np.abs(across))) / 0.6745


def _third_differences(t_s: Array, values: Array, span_s: float) -> tuple[NDArray[np.intp], Array]:
    """Compute third differences (n, D) of samples some time apart, with the standard deviation of the samples; their rows (n, 4)."""
    steps = [np.arange(len(t_s))]
    for _ in range(3):
        after = np.searchsorted(t_s, t_s[np.minimum(steps[-1], len(t_s) - 1)] + span_s * 0.99)
        steps.append(np.where(steps[-1] < len(t_s), after, len(t_s)))
    rows = np.stack(steps, axis=1)
    rows = rows[rows[:, -1] < len(t_s)]
    # Weights of the divided difference: the inverse products of each time's distances to the other three.
    t = t_s[rows] / span_s
    weights = 1.0 / (t[:, :, None] - t[:, None, :] + np.eye(4)).prod(axis=2)
    return rows, np.einsum("nj,njk->nk", weights, values[rows]) / np.linalg.norm(weights, axis=1, keepdims=True)
