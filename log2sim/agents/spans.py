"""Spans of time in which something holds without a break."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def spans_of(mask: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the rows of each run of True in a mask (T,), in their order."""
    rows = np.flatnonzero(mask)
    return np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []
