"""Detections of a camera frame and measurements of a tick, as columns with M rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class Detections:
    """2D boxes of one camera frame.

    Attributes
    ----------
    box_px : (M, 4) float64
        u0, v0, u1, v1.
    score : (M,) float64
        In [0, 1].
    category : (M,) str
    """

    box_px: Array
    score: Array
    category: NDArray[np.str_]

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.box_px)

    @classmethod
    def empty(cls) -> Detections:
        """Return detections without rows."""
        return cls(np.zeros((0, 4)), np.zeros(0), np.zeros(0, dtype="<U16"))

    def take(self, index: Any) -> Detections:
        """Take the rows at `index`, integers or a mask."""
        return Detections(self.box_px[index], self.score[index], self.category[index])


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measured objects of one tick, one row an object, in the map frame.

    Attributes
    ----------
    t_ns : (M,) int64
        Mean time of the object's LiDAR points, else the stamp of the camera frame.
    category : (M,) str
    score : (M,) float64
        Of the detector, in [0, 1].
    camera : (M,) str
    box_px : (M, 4) float64
        u0, v0, u1, v1.
    truncated : (M,) bool
        Whether the image border cuts the box.
    ends_visible : (M, 2) bool
        Whether the right and the left end of the cluster, as seen from the sensor, are ends of the object.
    center_m : (M, 3) float64
        Box center.
    size_m : (M, 3) float64
        Length, width, height.
    yaw_rad : (M,) float64
        Up to quarter turns where it comes from LiDAR alone; NaN where unknown.
    covariance : (M, 2, 2) float64
        Of the center's x, y, m2.
    points : (M,) int64
        Number of LiDAR points on the object.
    source : (M,) str
        "lidar", "topdown", or "" without a position.
    cluster : M arrays (n, 3) float64
        LiDAR points, subsampled, m.
    sensor_m : (M, 3) float64
        Viewpoint of the points.
    height_px_m : (M,) float64
        Height in m that the image box spans at the object's depth.
    """

    t_ns: NDArray[np.int64]
    category: NDArray[np.str_]
    score: Array
    camera: NDArray[np.str_]
    box_px: Array
    truncated: NDArray[np.bool_]
    ends_visible: NDArray[np.bool_]
    center_m: Array
    size_m: Array
    yaw_rad: Array
    covariance: Array
    points: NDArray[np.int64]
    source: NDArray[np.str_]
    cluster: tuple[NDArray[np.float64], ...]
    sensor_m: Array
    height_px_m: Array

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.t_ns)

    def take(self, index: Any) -> Measurements:
        """Take the rows at `index`, integers or a mask."""
        rows = np.arange(len(self))[index]
        columns = {k: v[rows] for k, v in vars(self).items() if k != "cluster"}
        return Measurements(**columns, cluster=tuple(self.cluster[i] for i in rows))

    @classmethod
    def join(cls, parts: Sequence[Measurements]) -> Measurements:
        """Concatenate several sets; an empty sequence gives an empty set."""
        if not parts:
            return cls.empty()
        columns = {k: np.concatenate([getattr(p, k) for p in parts]) for k in vars(parts[0]) if k != "cluster"}
        return cls(**columns, cluster=tuple(c for p in parts for c in p.cluster))

    @classmethod
    def empty(cls) -> Measurements:
        """Return measurements without rows."""
        text, none = np.zeros(0, dtype="<U16"), np.zeros(0)
        return cls(
            np.zeros(0, dtype=np.int64), text, none, text, np.zeros((0, 4)), np.zeros(0, dtype=bool),
            np.zeros((0, 2), dtype=bool), np.zeros((0, 3)), np.zeros((0, 3)), none, np.zeros((0, 2, 2)), np.zeros(0, dtype=np.int64), text, (), np.zeros((0, 3)), none,
        )  # fmt: skip
