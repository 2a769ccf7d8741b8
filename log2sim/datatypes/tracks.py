"""Tracks: the measurements of one object over time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes.measurements import Measurements
from log2sim.numerals import short_repr


@dataclass(frozen=True, eq=False)
class Track:
    """One object over time.

    Attributes
    ----------
    category : str
    tick : (n,) int64
        Strictly increasing indices of ticks.
    measurements : Measurements
        n rows, one at each of these ticks.
    unrecorded : (U,) int64
        Increasing indices of ticks at which no sensor that measured it recorded anything: that it was not measured there says
        nothing.
    searched : float
        Share of its ticks, above 0, at which pictures of a camera that measured it were searched; 1 for a track of sweeps alone.
    """

    __repr__ = short_repr

    category: str
    tick: NDArray[np.int64]
    measurements: Measurements
    unrecorded: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    searched: float = 1.0

    def __len__(self) -> int:
        """Return the number of measurements."""
        return len(self.tick)
