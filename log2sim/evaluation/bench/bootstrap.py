"""Bootstrap over objects: how uncertain an error is, and whether it is smaller than another by more than chance."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

ErrorSums = Mapping[str, tuple[float, float]]
"""By object: sum of its squared errors, m^2, and their number. The error is the root of the ratio of both sums."""

RESAMPLES = 1000
MIN_OBJECTS = 5
INTERVAL = (0.05, 0.95)


def error_of(sums: ErrorSums) -> float | None:
    """Compute the root mean square error, m, of all objects; None without any."""
    squares, count = (sum(column) for column in zip(*sums.values())) if sums else (0.0, 0.0)
    return float(np.sqrt(squares / count)) if count > 0 else None


def error_interval(sums: ErrorSums) -> tuple[float, float] | None:
    """Compute the quantiles `INTERVAL` of an error, m, over resamples of its objects; None with fewer than `MIN_OBJECTS`."""
    if len(sums) < MIN_OBJECTS:
        return None
    drawn = _drawn(len(sums)) @ np.array([sums[name] for name in sorted(sums)])
    drawn = drawn[drawn[:, 1] > 0]
    low, high = np.sqrt(np.quantile(drawn[:, 0] / drawn[:, 1], INTERVAL))
    return float(low), float(high)


def _drawn(count: int) -> NDArray[np.int64]:
    """Draw how often each of some objects is in each resample (`RESAMPLES`, count)."""
    return np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=RESAMPLES)


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
    drawn = _drawn(len(names))
    a, b = drawn @ mine, drawn @ theirs
    usable = (a[:, 1] > 0) & (b[:, 1] > 0)
    if not usable.any():
        return 0.0
    a, b = a[usable], b[usable]
    return float(np.mean(a[:, 0] * b[:, 1] <= b[:, 0] * a[:, 1] * (1 + allowance) ** 2))
