"""Limits that poses of a log have to keep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# Quaternions are stored with three decimals or more.
QUATERNION_TOLERANCE = 1e-3

# Farther than any place on Earth is from the origin of a map.
MAX_POSITION_M = 1e9


def find_not_unit(q: Array) -> NDArray[np.intp]:
    """Find the rows of quaternions (N, 4) whose norm is not 1 within `QUATERNION_TOLERANCE`, or not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.flatnonzero(~(np.abs(np.linalg.norm(q, axis=1) - 1) <= QUATERNION_TOLERANCE))
