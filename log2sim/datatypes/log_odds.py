"""Probabilities and their log-odds, in which independent evidence adds up."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Nearer to 0 or 1 no probability is believed: no evidence shows every reason, and networks are surer than right.
MIN_PROBABILITY, MAX_PROBABILITY = 0.01, 0.99


def log_odds_of(probability: ArrayLike) -> NDArray[np.float64]:
    """Return the log-odds (...) in nats of probabilities (...) between 0 and 1, these two excluded."""
    p = np.asarray(probability, dtype=np.float64)
    return np.asarray(np.log(p / (1.0 - p)))


def probability_of(log_odds: ArrayLike) -> NDArray[np.float64]:
    """Return the probabilities (...) of log-odds (...) in nats, however large these are."""
    return np.asarray(np.exp(-np.logaddexp(0.0, -np.asarray(log_odds, dtype=np.float64))))
