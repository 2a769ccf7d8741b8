"""Logistic regression for the fits and benchmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from log2sim.datatypes.log_odds import probability_of
from log2sim.geometry import Array

ITERATIONS = 50


def logistic_regression(x: Array, right: ArrayLike, precision: ArrayLike, prior: ArrayLike = 0.0) -> Array:
    """Most likely weights (K,) of columns `x` (N, K) for the log-odds of what is right (N,), by Newton's method.

    Beforehand they are about `prior` (K,) with a `precision` (K,), which keeps them finite where little was seen.
    """
    wanted, least = np.broadcast_to(prior, x.shape[1]), np.broadcast_to(precision, x.shape[1])
    w = wanted.astype(np.float64)

    def loss(w: Array) -> float:
        logits = x @ w
        return float(np.sum(np.logaddexp(0.0, logits) - right * logits) + least @ (w - wanted) ** 2 / 2)

    for _ in range(ITERATIONS):
        p = probability_of(x @ w)
        hessian = (x * (p * (1 - p))[:, None]).T @ x + np.diag(least)
        step = np.linalg.solve(hessian, x.T @ (right - p) - least * (w - wanted))
        # Whole steps from far away may lead farther away.
        while np.abs(step).max() > 1e-9 and loss(w + step) > loss(w):
            step /= 2
        w = w + step
        if np.abs(step).max() < 1e-9:
            break
    return w
