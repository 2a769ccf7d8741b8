"""What flows between the stages: sensors, streams, logs, detections.

Everything is a frozen record of columns. Arrays are never changed once a record holds them. Letters in shapes: N points,
M boxes, L labels, A agents, T ticks, F frames of a stream.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes.measurements import Measurements


@dataclass(frozen=True, eq=False)
class Track:
    """One object over time: `tick` (n,) strictly increasing indices and the measurement (n rows) it got at each."""

    category: str
    tick: NDArray[np.int64]
    measurements: Measurements

    def __len__(self) -> int:
        return len(self.tick)
