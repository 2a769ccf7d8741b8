"""Boxes of several scenes as one table, found or true."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class SceneBoxes:
    """Boxes of several scenes, one row a box: those that a detector found, or the true ones.

    Attributes
    ----------
    scene : (M,) int64
        Number of the scene (one sweep, one sample) that each box belongs to; only boxes of one scene match.
    box : (M, 7) float64, m and rad
        Center x, y, z, length, width, height, yaw; found and true boxes in the same frame.
    category : (M,) str
    score : (M,) float64
        Of found boxes; 1 for true ones.
    points : (M,) int64 or None
        Number of LiDAR points in each box; None when it was not counted.
    range_m : (M,) float64
        Horizontal distance from the sensor.
    ignored : (M,) bool
        Boxes that are neither right nor wrong: true ones that nobody has to find, found ones that truth cannot judge.
    """

    scene: NDArray[np.int64]
    box: Array
    category: NDArray[np.str_]
    score: Array
    points: NDArray[np.int64] | None
    range_m: Array
    ignored: NDArray[np.bool_]

    def __post_init__(self) -> None:
        """Check that the columns fit each other and that scores are numbers."""
        rows = len(self.scene)
        if self.box.shape != (rows, 7):
            raise ValueError(f"box has the shape {self.box.shape}, expected ({rows}, 7)")
        for name in ("category", "score", "points", "range_m", "ignored"):
            column = getattr(self, name)
            if column is not None and column.shape != (rows,):
                raise ValueError(f"{name} has the shape {column.shape}, expected ({rows},)")
        if not np.isfinite(self.score).all():
            raise ValueError("a score is not finite")

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.scene)

    @classmethod
    def of(
        cls,
        box: ArrayLike,
        category: ArrayLike = "",
        score: ArrayLike = 1.0,
        *,
        scene: ArrayLike = 0,
        points: ArrayLike | None = None,
        range_m: ArrayLike | None = None,
        ignored: ArrayLike = False,
    ) -> Self:
        """Make a table from arrays; a single value holds for all rows.

        Parameters
        ----------
        box : (M, 7), m and rad
            x, y, z, length, width, height, yaw.
        category, score, scene, points, ignored : (M,) or a single value
        range_m : (M,) or a single value, optional
            By default the distance from the origin of the boxes' frame.
        """
        rows = np.asarray(box, dtype=np.float64).reshape(-1, 7)
        away = np.hypot(rows[:, 0], rows[:, 1]) if range_m is None else range_m

        def column(values: ArrayLike, kind: Any = None) -> NDArray[Any]:
            return np.array(np.broadcast_to(np.asarray(values, dtype=kind), len(rows)))

        return cls(
            column(scene, np.int64),
            rows,
            column(category, np.str_),
            column(score, np.float64),
            None if points is None else column(points, np.int64),
            column(away, np.float64),
            column(ignored, np.bool_),
        )

    @classmethod
    def join(cls, scenes: Sequence[SceneBoxes]) -> SceneBoxes:
        """Join one table for each scene; scenes are numbered by their place in the sequence.

        The number of points is kept when all tables that are not empty have it.
        """
        if not scenes:
            return cls.of(np.zeros((0, 7)))
        counted = all(s.points is not None for s in scenes if len(s))
        return cls(
            np.repeat(np.arange(len(scenes), dtype=np.int64), [len(s) for s in scenes]),
            np.concatenate([s.box for s in scenes]),
            np.concatenate([s.category for s in scenes]),
            np.concatenate([s.score for s in scenes]),
            np.concatenate([s.points for s in scenes if s.points is not None] or [np.zeros(0, np.int64)])
            if counted
            else None,
            np.concatenate([s.range_m for s in scenes]),
            np.concatenate([s.ignored for s in scenes]),
        )

    def take(self, index: Any) -> Self:
        """Take the rows at `index`, integers or a mask."""
        columns: dict[str, Any] = {k: None if v is None else v[index] for k, v in vars(self).items()}
        return type(self)(**columns)

    def ignoring(self, rows: NDArray[np.bool_]) -> Self:
        """Return the table with the boxes of a mask (M,) ignored, too."""
        return replace(self, ignored=self.ignored | rows)
