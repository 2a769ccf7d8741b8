"""What is observed at one tick: boxes, measurements, obstacles, rays, and tracks of them over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes.log import Deferred, seen_from
from log2sim.files.arrays import ArrayFile, ArrayList, Columns, array_lengths, join_arrays, take_arrays
from log2sim.files.documents import short_repr
from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class Boxes3D(Columns):
    """Boxes of M road users, map frame."""

    __repr__ = short_repr

    t_ns: NDArray[np.int64]  # (M,): time of the points in each box, absolute
    center_m: Array  # (M, 3): box centers, m
    size_m: Array  # (M, 3): length, width, height, m
    yaw_rad: Array  # (M,): heading, counter-clockwise from the map's x axis
    heading_score: Array  # (M,): probability in [0.5, 1] that front and back are not swapped
    category: NDArray[np.str_]  # (M,)
    score: Array  # (M,): calibrated probability in [0, 1] that the box is right
    points: NDArray[np.int64]  # (M,): number of points in the box
    # (M, 2): which of the `ENDS` found it; None where their clouds were searched as one
    seen_by: NDArray[np.bool_] | None = None

    @classmethod
    def empty(cls) -> Self:
        """Return no boxes."""
        n, flat = np.zeros(0, np.int64), np.zeros(0)
        return cls(n, np.zeros((0, 3)), np.zeros((0, 3)), flat, flat, np.zeros(0, dtype="<U16"), flat, n)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Concatenate several sets; an empty sequence gives no boxes. Who found them is known if it is of all."""
        return super().join(parts) if parts else cls.empty()


TUPLES = ("cluster", "others")
"""Columns of measurements that are no arrays."""


@dataclass(frozen=True, eq=False)
class Detections:
    """2D boxes of one camera frame."""

    __repr__ = short_repr

    box_px: Array  # (M, 4): u0, v0, u1, v1
    score: Array  # (M,): in [0, 1]
    category: NDArray[np.str_]  # (M,)
    # (K, 5): boxes u0, v0, u1, v1 and scores of traffic lights in the frame, which are no road users
    traffic_lights: Array = field(default_factory=lambda: np.zeros((0, 5)))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.box_px)

    @classmethod
    def empty(cls) -> Detections:
        """Return detections without rows."""
        return cls(np.zeros((0, 4)), np.zeros(0), np.zeros(0, dtype="<U16"))

    def take(self, index: Any) -> Detections:
        """Take the rows at `index`, integers or a mask; of traffic lights none."""
        return Detections(self.box_px[index], self.score[index], self.category[index])


@dataclass(frozen=True, eq=False)
class OtherView:
    """What a second LiDAR, far from the first, shows of an object at the same tick."""

    sensor_m: Array  # (3,): viewpoint, m, map frame
    # (2,): whether the right and the left end of the points, as seen from there, are ends of the object
    ends_visible: NDArray[np.bool_]
    # (n, 4): these points, subsampled: x, y, z in m, and the time after `t_ns` of the row in s
    cluster: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BoxEvidence:
    """What cameras and LiDARs observed of each object, map frame; nothing unobserved is completed but by a 3D detector."""

    __repr__ = short_repr

    t_ns: NDArray[np.int64]  # (M,): mean time of the object's LiDAR points, else the stamp of the camera frame
    category: NDArray[np.str_]  # (M,)
    score: Array  # (M,): of the detector, in [0, 1]
    camera: NDArray[np.str_]  # (M,): "" for an object that no camera detected
    box_px: Array  # (M, 4): u0, v0, u1, v1; NaN without camera
    truncated: NDArray[np.bool_]  # (M,): whether the image border cuts the box
    # (M,), m: height that the image box spans at the object's depth, or where a homography places its foot; NaN where unknown
    height_px_m: Array
    points: NDArray[np.int64]  # (M,): number of LiDAR points on the object
    # M arrays (n, 4) or (n, 3): these points, subsampled: x, y, z in m, and where it is known the time after `t_ns` in s
    cluster: Sequence[NDArray[np.float64]]
    sensor_m: Array  # (M, 3): viewpoint
    yaw_rad: Array  # (M,): direction of the object's length up to half turns, for short sides up to quarter turns; NaN without points
    low_m: Array  # (M, 2): ends of the points along the length and the width axis, relative to the viewpoint; NaN without points
    high_m: Array
    # (M, 2): whether the right and the left end of the points, as seen from the viewpoint, are ends of the object
    ends_visible: NDArray[np.bool_]
    # (M,): heights of the ground under the object and, `top_m`, of its highest points; NaN where unknown
    bottom_m: Array
    top_m: Array
    box_center_m: Array  # (M, 3): center of the box that a detector found in the LiDAR's sweep, m; NaN without one, as in the next three
    box_size_m: Array  # (M, 3): its length, width, height, m
    box_yaw_rad: Array  # (M,): its heading
    heading_score: Array  # (M,): probability in [0.5, 1] that its front and back are not swapped
    seen_by: NDArray[np.bool_]  # (M, 2): which of the `ENDS` measured it
    # M: what a second viewpoint shows, None for rows without; empty where no row has one
    others: tuple[OtherView | None, ...] = field(default=(), kw_only=True)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.t_ns)

    @property
    def kept_points(self) -> NDArray[np.int64]:
        """How many points of each row are kept (M,); none is read for it."""
        return np.array(array_lengths(self.cluster), dtype=np.int64)

    def views_of(self, rows: NDArray[np.signedinteger[Any]]) -> list[tuple[int, OtherView]]:
        """List the viewpoints of rows (n,), first their own in their order, then the others: the row, and what is seen from there."""
        own = [(int(k), OtherView(self.sensor_m[k], self.ends_visible[k], self.cluster[k])) for k in rows]
        return own + [(int(k), view) for k in rows if self.others and (view := self.others[k]) is not None]

    def points_of(self, k: int) -> NDArray[np.float64]:
        """Return the places (n, 3) of the points of a row from all viewpoints."""
        view = self.others[k] if self.others else None
        own = self.cluster[k][:, :3]
        return own if view is None else np.concatenate([own, view.cluster[:, :3]])

    def take(self, index: Any) -> Self:
        """Take the rows at `index`: integers, a mask, or a slice, which copies nothing."""
        columns = {k: v[index] for k, v in vars(self).items() if k not in TUPLES}
        if isinstance(index, slice):
            return type(self)(**columns, cluster=self.cluster[index], others=self.others[index])
        rows = np.arange(len(self))[index]
        others = tuple(self.others[i] for i in rows) if self.others else ()
        return type(self)(**columns, cluster=take_arrays(self.cluster, rows.tolist()), others=others)

    def stored(self, file: ArrayFile) -> Self:
        """Return the same rows with their points in the keeping of a file."""
        return replace(self, cluster=ArrayList(file.keep(points) for points in self.cluster))


@dataclass(frozen=True, eq=False)
class Measurements(BoxEvidence):
    """Evidence for the objects of one tick with a provisional position of each, for gating and tracking."""

    __repr__ = short_repr

    # (M, 3): box center, m, NaN without a position. It assumes the typical size of the category where no end was observed; the final
    # size and positions are estimated from the evidence of a whole track.
    center_m: Array
    covariance: Array  # (M, 2, 2): of the center's x, y, m2
    source: NDArray[np.str_]  # (M,): "lidar", "topdown", or "" without a position

    @classmethod
    def join(cls, parts: Sequence[Measurements]) -> Measurements:
        """Concatenate several sets; an empty sequence gives an empty set."""
        if not parts:
            return cls.empty()
        columns = {k: np.concatenate([getattr(p, k) for p in parts]) for k in vars(parts[0]) if k not in TUPLES}
        others = tuple(v for p in parts for v in p.others or (None,) * len(p)) if any(p.others for p in parts) else ()
        return cls(**columns, cluster=join_arrays(p.cluster for p in parts), others=others)

    @classmethod
    def empty(cls) -> Measurements:
        """Return measurements without rows."""
        return cls.unplaced(Detections.empty(), t_ns=0, camera="", sensor_m=np.zeros(3))

    @classmethod
    def from_boxes(cls, boxes: Boxes3D, sensor_m: Array) -> Measurements:
        """Return a row for each box (M,) of a 3D detector, seen from a sensor (3,), without LiDAR points and position."""
        found = Detections(np.full((len(boxes), 4), np.nan), boxes.score, boxes.category)
        return replace(
            cls.unplaced(found, t_ns=0, camera="", sensor_m=sensor_m), t_ns=boxes.t_ns, box_center_m=boxes.center_m,
            box_size_m=boxes.size_m, box_yaw_rad=boxes.yaw_rad, heading_score=boxes.heading_score,
        )  # fmt: skip

    @classmethod
    def unplaced(cls, detections: Detections, *, t_ns: int, camera: str, sensor_m: Array) -> Measurements:
        """Return a row a detection (M,) of a frame of a camera, without LiDAR points and without a position."""
        m = len(detections)
        return cls(
            t_ns=np.full(m, t_ns, dtype=np.int64),
            category=detections.category,
            score=detections.score,
            camera=np.full(m, camera),
            box_px=detections.box_px,
            truncated=np.zeros(m, dtype=bool),
            height_px_m=np.full(m, np.nan),
            points=np.zeros(m, dtype=np.int64),
            cluster=tuple(np.zeros((0, 3)) for _ in range(m)),
            sensor_m=np.tile(sensor_m, (m, 1)),
            yaw_rad=np.full(m, np.nan),
            low_m=np.full((m, 2), np.nan),
            high_m=np.full((m, 2), np.nan),
            ends_visible=np.zeros((m, 2), dtype=bool),
            bottom_m=np.full(m, np.nan),
            top_m=np.full(m, np.nan),
            box_center_m=np.full((m, 3), np.nan),
            box_size_m=np.full((m, 3), np.nan),
            box_yaw_rad=np.full(m, np.nan),
            heading_score=np.full(m, np.nan),
            seen_by=seen_from("", m),
            center_m=np.full((m, 3), np.nan),
            covariance=np.full((m, 2, 2), np.nan),
            source=np.full(m, "", dtype="<U16"),
        )


@dataclass(frozen=True, eq=False)
class Rays:
    """A sample of the rays of one tick that ended on the ground or on an obstacle, evenly spread over directions.

    Positions are in m, map axes, relative to the origin of the cloud.
    """

    end: NDArray[np.float32]  # (K, 3): the points that they hit
    t_s: NDArray[np.float32]  # (K,): times relative to the stamp of the cloud
    sensor: NDArray[np.uint8]  # (K,): number of the LiDAR
    position: NDArray[np.float32]  # (S, 3): of the LiDARs at the stamp of the cloud
    velocity_mps: NDArray[np.float32]  # (S, 3): of the LiDARs

    def __len__(self) -> int:
        """Return the number of rays."""
        return len(self.end)

    @property
    def start(self) -> NDArray[np.float32]:
        """Where their LiDARs were (K, 3) when they sent them."""
        return np.asarray(self.of_lidar(self.position) + self.of_lidar(self.velocity_mps) * self.t_s[:, None])

    @cached_property
    def level(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """From where their LiDARs were at the stamp of the cloud to their ends (K,): x, y and horizontal distance."""
        x, y = (self.end[:, axis] - self.of_lidar(self.position[:, axis]) for axis in range(2))
        return x, y, np.hypot(x, y)

    def of_lidar(self, values: NDArray[np.float32]) -> Any:
        """Return the value (..., D) or number of each ray's LiDAR among those of all (S, ...); of a single LiDAR just its own."""
        return values[0] if len(values) == 1 else values[self.sensor]


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Points above the ground at one tick, one a voxel; points and rays may be given as functions that read them."""

    stamp_ns: int
    origin: Array  # (3,): m, map frame
    xyz: Deferred[NDArray[np.float32]] = Deferred()  # (N, 3): m, map axes, relative to `origin`
    t_s: Deferred[NDArray[np.float32]] = Deferred()  # (N,): times relative to `stamp_ns`
    # (3,): position of the sensor relative to `origin`, mean over several; of viewpoints far from each other the first
    sensor: NDArray[np.float32]  # type: ignore[misc]  # those before it are descriptors, they have no default
    # A sample of all rays, those that end on the ground too: where they passed is nothing
    free: Deferred[Rays | None] = Deferred(None)
    # (V, 3): positions of LiDARs far from each other relative to `origin`; None where all points are seen from `sensor`
    viewpoints: NDArray[np.float32] | None = None
    seen_from: Deferred[NDArray[np.uint8] | None] = Deferred(None)  # (N,): the viewpoint of each point

    def sensor_of(self, index: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return the position (3,) of the sensor that sees most of the points at `index`."""
        if self.viewpoints is None or self.seen_from is None or not len(index):
            return self.sensor
        return np.asarray(self.viewpoints[np.bincount(self.seen_from[index]).argmax()])

    @cached_property
    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Azimuth (N,) rad in the map frame, horizontal distance (N,) m and slope (N,) of every point from the sensor."""
        x, y, z = (self.xyz - self.sensor).T
        reach = np.hypot(x, y)
        return np.arctan2(y, x), reach, z / np.maximum(reach, np.float32(1e-3))

    def near(self, xy: Array, reach_m: float) -> NDArray[np.intp]:
        """Return the indices (n,), rising, of the points in the square of `reach_m` to all four sides of a place (2,), map frame."""
        x, y = (xy - self.origin[:2]).astype(np.float32)
        near = np.flatnonzero(np.abs(self._x - x) <= reach_m)
        return np.asarray(near[np.abs(self.xyz[near, 1] - y) <= reach_m], dtype=np.intp)

    @cached_property
    def _x(self) -> NDArray[np.float32]:
        """The x of all points (N,) side by side, which many places are compared with."""
        return np.ascontiguousarray(self.xyz[:, 0])


@dataclass(frozen=True, eq=False)
class Track:
    """One object over time."""

    __repr__ = short_repr

    category: str
    tick: NDArray[np.int64]  # (n,): strictly increasing indices of ticks
    measurements: Measurements  # n rows, one at each of these ticks
    # (U,): increasing indices of ticks at which no sensor that measured it recorded, so that its absence there says nothing
    unrecorded: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    # Share of its ticks, above 0, at which pictures of a camera that measured it were searched; 1 for a track of sweeps alone
    searched: float = 1.0
    ticks_per_search: int = 1  # within which a picture is searched in all its tiles

    def __len__(self) -> int:
        """Return the number of measurements."""
        return len(self.tick)
