"""Paired bootstrap over objects: whether one error is smaller than another by more than chance."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

ErrorSums = Mapping[str, tuple[float, float]]
"""By object: sum of its squared errors, m^2, and their number. The error is the root of the ratio of both sums."""

RESAMPLES = 1000
MIN_OBJECTS = 5


def error_of(sums: ErrorSums) -> float | None:
    """Compute the root mean square error, m, of all objects; None without any."""
    squares, count = (sum(column) for column in zip(*sums.values())) if sums else (0.0, 0.0)
    return float(np.sqrt(squares / count)) if count > 0 else None


def confidence_not_worse(sums: ErrorSums, other: ErrorSums, allowance: float) -> float:
    """Compute the fraction of resamples in which an error is at most another one times `1 + allowance`.

    It is 0 with fewer than `MIN_OBJECTS` objects.

    Notes
    -----
    Paired bootstrap (Efron, 1979) over objects, because errors of one object at successive ticks are correlated. An object of
    one side only, such as a false one, adds nothing to the other.
    """
    names = sorted({*sums, *other})
    if len(names) < MIN_OBJECTS:
        return 0.0
    mine, theirs = (np.array([side.get(n, (0.0, 0.0)) for n in names]).reshape(-1, 2) for side in (sums, other))
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=RESAMPLES)
    a, b = drawn @ mine, drawn @ theirs
    usable = (a[:, 1] > 0) & (b[:, 1] > 0)
    if not usable.any():
        return 0.0
    a, b = a[usable], b[usable]
    return float(np.mean(a[:, 0] * b[:, 1] <= b[:, 0] * a[:, 1] * (1 + allowance) ** 2))
