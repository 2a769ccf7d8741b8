"""3D boxes of road users at one moment, as a detector finds them in a cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.numerals import short_repr


@dataclass(frozen=True, eq=False)
class Boxes3D:
    """Boxes of M road users, map frame.

    Attributes
    ----------
    t_ns : (M,) int64
        Time of the points in each box, absolute.
    center_m : (M, 3) float64
        Box centers, m.
    size_m : (M, 3) float64
        Length, width, height, m.
    yaw_rad : (M,) float64
        Heading, counter-clockwise from the map's x axis.
    heading_score : (M,) float64
        Probability in [0.5, 1] that front and back are not swapped.
    category : (M,) str
    score : (M,) float64
        Calibrated probability in [0, 1] that the box is right.
    points : (M,) int64
        Number of points in the box.
    seen_by : (M, 2) bool, optional
        Which of the `ENDS` found it; None where their clouds were searched as one.
    """

    __repr__ = short_repr

    t_ns: NDArray[np.int64]
    center_m: Array
    size_m: Array
    yaw_rad: Array
    heading_score: Array
    category: NDArray[np.str_]
    score: Array
    points: NDArray[np.int64]
    seen_by: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.t_ns)

    def take(self, index: Any) -> Self:
        """Take the boxes at `index`, integers or a mask."""
        columns: dict[str, Any] = {k: None if v is None else v[index] for k, v in vars(self).items()}
        return type(self)(**columns)

    @classmethod
    def empty(cls) -> Self:
        """Return no boxes."""
        text = np.zeros(0, dtype="<U16")
        flat = np.zeros(0)
        return cls(
            np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), flat, flat, text, flat, np.zeros(0, np.int64)
        )

    @classmethod
    def join(cls, parts: Sequence[Boxes3D]) -> Boxes3D:
        """Concatenate several sets; an empty sequence gives no boxes. Who found them is known if it is of all."""
        if not parts:
            return cls.empty()
        columns: dict[str, Any] = {}
        for name in vars(parts[0]):
            values = [getattr(p, name) for p in parts]
            columns[name] = None if any(v is None for v in values) else np.concatenate(values)
        return cls(**columns)
