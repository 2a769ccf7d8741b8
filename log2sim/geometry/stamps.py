"""Stamps: nanoseconds and the record nearest in time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

NS_PER_S = 1_000_000_000


def period_of(t_ns: NDArray[np.int64]) -> float:
    """Return the median period of stamps (T,), s; 0 for a single one."""
    return float(np.median(np.diff(t_ns))) / NS_PER_S if len(t_ns) > 1 else 0.0


def nearest_index(stamps: NDArray[Any], t: ArrayLike) -> NDArray[np.int64]:
    """Find the nearest stamp to each time.

    Parameters
    ----------
    stamps : (F,) int64 ns or float64 s
        In ascending order, at least one.
    t : scalar or (T,)
        In the unit of `stamps`.

    Returns
    -------
    (T,) int64
        Index into `stamps`; of two equally near ones the earlier.
    """
    t = np.atleast_1d(np.asarray(t))
    after = np.minimum(np.searchsorted(stamps, t), len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(stamps[before] - t) <= np.abs(stamps[after] - t)
    return np.where(earlier, before, after).astype(np.int64, copy=False)
