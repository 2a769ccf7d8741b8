"""What flows between the stages: sensors, streams, logs, detections.

Everything is a frozen record of columns. Arrays are never changed once a record holds them. Letters in shapes: N points,
M boxes, L labels, A agents, T ticks, F frames of a stream.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class Detections:
    """2D boxes of one camera frame: `box_px` (M, 4) u0, v0, u1, v1, `score` (M,) in [0, 1], `category` (M,) str."""

    box_px: Array
    score: Array
    category: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.box_px)

    @classmethod
    def empty(cls) -> Detections:
        return cls(np.zeros((0, 4)), np.zeros(0), np.zeros(0, dtype="<U16"))

    def take(self, index: Any) -> Detections:
        """The rows at `index` (integers or a mask)."""
        return Detections(self.box_px[index], self.score[index], self.category[index])


@dataclass(frozen=True, eq=False)
class Measurements:
    """What the sensors say about the objects of one tick, one row an object, all in the map frame.

    `t_ns` (M,) int64 when the object was seen (the mean time of its points, else the frame's stamp); `category` (M,) str;
    `score` (M,) of the detector; `camera` (M,) str; `box_px` (M, 4); `truncated` (M,) bool: cut by the image border;
    `ends_visible` (M, 2) bool: whether the cluster's right and left end, as the sensor sees it, are ends of the object;
    `center_m` (M, 3) box center; `size_m` (M, 3) length, width, height; `yaw_rad` (M,) up to quarter turns where only
    LiDAR speaks; `covariance` (M, 2, 2) of the center's x, y in m2; `points` (M,) LiDAR points on the object; `source`
    (M,) "lidar", "topdown" or "" where there is no position yet; `cluster` M arrays (n, 3) of points;
    `sensor_m` (M, 3) where they were seen from; `height_px_m` (M,) height in m that the image box spans at that depth.
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
        return len(self.t_ns)

    def take(self, index: Any) -> Measurements:
        """The rows at `index` (integers or a mask)."""
        rows = np.arange(len(self))[index]
        columns = {k: v[rows] for k, v in vars(self).items() if k != "cluster"}
        return Measurements(**columns, cluster=tuple(self.cluster[i] for i in rows))

    @classmethod
    def join(cls, parts: Sequence[Measurements]) -> Measurements:
        """Rows of several sets, one after the other; an empty sequence gives an empty set."""
        if not parts:
            return cls.empty()
        columns = {k: np.concatenate([getattr(p, k) for p in parts]) for k in vars(parts[0]) if k != "cluster"}
        return cls(**columns, cluster=tuple(c for p in parts for c in p.cluster))

    @classmethod
    def empty(cls) -> Measurements:
        text, none = np.zeros(0, dtype="<U16"), np.zeros(0)
        return cls(
            np.zeros(0, dtype=np.int64), text, none, text, np.zeros((0, 4)), np.zeros(0, dtype=bool),
            np.zeros((0, 2), dtype=bool), np.zeros((0, 3)), np.zeros((0, 3)), none, np.zeros((0, 2, 2)), np.zeros(0, dtype=np.int64), text, (), np.zeros((0, 3)), none,
        )  # fmt: skip
