"""The clock of a replay."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

STORE_S = 0.05  # spacing of stored states, about 20 Hz
MARGIN = 1e-6  # in steps, for rounding: a waypoint at 0.3 s is on step 30 of 10 ms


@dataclass(frozen=True)
class StepClock:
    """Steps at `begin_s + n * dt_s` for n in [0, `steps`).

    Attributes
    ----------
    begin_s : float, s
    dt_s : float, s
        Length of a step.
    steps : int
    """

    begin_s: float
    dt_s: float
    steps: int

    @classmethod
    def spanning(cls, begin_s: float, end_s: float, dt_s: float) -> StepClock:
        """Create the clock whose steps cover `begin_s` to `end_s`."""
        return cls(begin_s, dt_s, math.floor((end_s - begin_s) / dt_s + MARGIN) + 1)

    @property
    def store_every(self) -> int:
        """States are stored at every so many steps."""
        return max(1, round(STORE_S / self.dt_s))

    def time(self, step: int) -> float:
        """Return the time of a step in s."""
        return self.begin_s + step * self.dt_s

    def first_step(self, t_s: Array) -> NDArray[np.intp]:
        """Return the first steps at or after times (N,)."""
        return np.ceil((t_s - self.begin_s) / self.dt_s - MARGIN).astype(np.intp)

    def last_step(self, t_s: Array) -> NDArray[np.intp]:
        """Return the last steps at or before times (N,)."""
        return np.floor((t_s - self.begin_s) / self.dt_s + MARGIN).astype(np.intp)
