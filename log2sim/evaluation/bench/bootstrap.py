"""Errors as sums over objects, so that chance can be told from difference: what if other objects had come by?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

Parts = Mapping[str, tuple[float, float]]
"""By object: squares that it adds, m2, and how often it counts. The error is the root of one sum over the other."""

RESAMPLES = 1000
LEAST_OBJECTS = 5


def error_of(parts: Parts) -> float | None:
    """Root mean square error of all objects, m; None where nothing counts."""
    squares, count = (sum(column) for column in zip(*parts.values())) if parts else (0.0, 0.0)
    return float(np.sqrt(squares / count)) if count > 0 else None


def share_not_worse(parts: Parts, other: Parts, allowance: float) -> float:
    """Share of resamples in which an error is no more than another's times `1 + allowance`.

    Notes
    -----
    Paired bootstrap (Efron, 1979) over objects: the ticks of one object are wrong together, so they are drawn together. What
    only one side has, such as a false object, counts nothing on the other. Too few objects are sure of nothing.
    """
    names = sorted({*parts, *other})
    if len(names) < LEAST_OBJECTS:
        return 0.0
    mine, theirs = (np.array([side.get(n, (0.0, 0.0)) for n in names]).reshape(-1, 2) for side in (parts, other))
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=RESAMPLES)
    a, b = drawn @ mine, drawn @ theirs
    usable = (a[:, 1] > 0) & (b[:, 1] > 0)
    if not usable.any():
        return 0.0
    a, b = a[usable], b[usable]
    return float(np.mean(a[:, 0] * b[:, 1] <= b[:, 0] * a[:, 1] * (1 + allowance) ** 2))
