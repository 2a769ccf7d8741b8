"""Clouds of coming ticks and the boxes found in them, made in the background."""

from __future__ import annotations

import threading
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Boxes3D, Log, Obstacles, Sweep
from log2sim.fusion_level import FusionLevel
from log2sim.perception.cooperative.alignment import align_parts
from log2sim.perception.detect3d.detectors import LidarDetector
from log2sim.perception.frames import RecordReader
from log2sim.perception.lidar.cloud import Cloud, cloud_origin, compensation_of
from log2sim.perception.lidar.rays import sample_rays
from log2sim.perception.lidar.viewpoints import assemble_views
from log2sim.perception.record_checks.sweep_sketches import sketch_sweep
from log2sim.perception.sync import Schedule
from log2sim.plan import Plan, Stage

OBSTACLE_REACH_M = 70.0
OBSTACLE_VOXEL_M = 0.12
RANK_BITS = 25  # more than the points of any sweep
# Ticks that are prepared ahead of the one that is measured, so that two threads have work.
TICKS_AHEAD = 2

Key = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class CloudOptions:
    """How clouds are made and searched.

    Attributes
    ----------
    max_range_m : float
        Points farther from the origin along an axis are left out.
    detector : LidarDetector, optional
        Searches the clouds of the reference sensor.
    sweeps : int
        Successive clouds that the detector sees as one.
    """

    max_range_m: float
    detector: LidarDetector | None = None
    sweeps: int = 1


class CloudPrefetcher:
    """Make the clouds of coming ticks in the background; ticks share the clouds of the same sweeps, each read once.

    Attributes
    ----------
    compensated : Counter of str
        Number of sweeps by how they were compensated, see `compensation_of`.
    """

    def __init__(
        self,
        log: Log,
        schedule: Schedule,
        plan: Plan,
        records: RecordReader,
        pool: ThreadPoolExecutor,
        options: CloudOptions,
    ) -> None:
        self._log, self._schedule, self._plan, self._records = log, schedule, plan, records
        self._pool, self._options = pool, options
        self._counting = threading.Lock()
        self.compensated: Counter[str] = Counter()
        self._sweeps: dict[tuple[str, int], Future[Sweep | None]] = {}
        self._latest: dict[str, Future[Sweep | None]] = {}
        self._clouds: dict[Key, Future[Cloud | None]] = {}
        self._boxes: dict[Key, Future[Boxes3D]] = {}
        self._earlier: list[Key] = []
        # Boxes of the two clouds before, by whose motion the points of both ends are put to one time.
        self._before: list[Future[Boxes3D]] = []

    def prefetch(self, tick: int) -> None:
        """Start making what a tick and the ones after it need, and forget what only earlier ticks needed."""
        ticks = range(max(tick - 1, 0), min(tick + TICKS_AHEAD, len(self._schedule)))
        keys = {key: None for k in ticks for row in range(self._schedule.rows) for key in [self._key(k, row)]}
        sweeps = {(name, i): None for key in keys for name, i in zip(self._schedule.sweeps, key) if i >= 0}
        kept = {*keys, *self._earlier}
        self._clouds = {k: v for k, v in self._clouds.items() if k in kept}
        self._boxes = {k: v for k, v in self._boxes.items() if k in keys}
        self._sweeps = {k: v for k, v in self._sweeps.items() if k in sweeps}
        # What waits for something else goes after it: it must never keep that from being made.
        for name, i in sorted(sweeps):
            if (name, i) not in self._sweeps:
                reading = self._pool.submit(self._read, name, i, self._latest.get(name))
                self._sweeps[name, i] = self._latest[name] = reading
        for key in keys:
            if key not in self._clouds:
                read = {n: self._sweeps[n, i] for n, i in zip(self._schedule.sweeps, key) if i >= 0}
                self._clouds[key] = self._pool.submit(self._make, read)
        if self._options.detector is not None:
            self._search([self._key(k, self._schedule.reference_row) for k in ticks], self._options.detector)

    def cloud(self, tick: int, row: int) -> Cloud | None:
        """Return the cloud for a row of the schedule; waits until it is made."""
        return self._clouds[self._key(tick, row)].result()

    def boxes(self, tick: int) -> Boxes3D:
        """Return what the detector found in the cloud of the reference sensor; waits until it is found."""
        return self._boxes[self._key(tick, self._schedule.reference_row)].result()

    def _key(self, tick: int, row: int) -> Key:
        """Return the sweep of every LiDAR, -1 for none, that a row of a tick uses."""
        return tuple(int(index[row, tick]) for index in self._schedule.sweeps.values())

    def _search(self, keys: list[Key], detector: LidarDetector) -> None:
        """Start searching the clouds at successive keys that are not searched yet."""
        for key in keys:
            if key not in self._boxes:
                earlier = [self._clouds[k] for k in self._earlier]
                self._boxes[key] = self._pool.submit(_boxes_in, detector, self._clouds[key], earlier, self._before)
                if self._plan.fusion is FusionLevel.POINTS:
                    self._before = [*self._before, self._boxes[key]][-2:]
                self._earlier = [*self._earlier, key][max(len(self._earlier) + 2 - self._options.sweeps, 0) :]

    def _read(self, name: str, index: int, before: Future[Sweep | None] | None) -> Sweep | None:
        """Read a sweep; None where it cannot be read or repeats another, which is known once those before it are read."""
        sweep: Sweep | None = self._records.get(name, index)
        sketch = None if sweep is None else sketch_sweep(self._log, name, sweep)
        if before is not None:
            before.exception()
        if sweep is None or sketch is None:
            return None
        if self._records.watch.lidars[name].is_repeated(int(self._log.streams[name].t_ns[index]), sketch):
            return None
        kind = compensation_of(self._log, name, sweep) if self._plan.keeps(Stage.MOTION_COMPENSATION) else "left out"
        with self._counting:
            self.compensated[kind] += 1
        return sweep

    def _make(self, reading: dict[str, Future[Sweep | None]]) -> Cloud | None:
        sweeps = {name: sweep for name, future in reading.items() if (sweep := future.result()) is not None}
        if not sweeps:
            return None
        origin, ground_z = cloud_origin(self._log, next(iter(sweeps.values())).stamp_ns)
        cloud = assemble_views(
            self._log, sweeps, origin=origin, ground_z=ground_z, max_range_m=self._options.max_range_m,
            compensate=self._plan.keeps(Stage.MOTION_COMPENSATION),
        )  # fmt: skip
        if cloud is not None:
            cloud.prepare(ground=self._plan.keeps(Stage.HOMOGRAPHY))
        return cloud


def _boxes_in(
    detector: LidarDetector,
    making: Future[Cloud | None],
    earlier: list[Future[Cloud | None]],
    found: list[Future[Boxes3D]],
) -> Boxes3D:
    cloud = making.result()
    if cloud is None:
        return Boxes3D.empty()
    cloud = align_parts(cloud, [boxes.result() for boxes in found])
    return detector.detect(cloud, [before for future in earlier if (before := future.result()) is not None])


def obstacles_of(cloud: Cloud) -> Obstacles:
    """Take the points above the ground, one a voxel, and a sample of the rays, so that a long log fits in memory."""
    index, xyz = cloud.obstacles, cloud.obstacle_columns.T
    near = np.flatnonzero(np.hypot(xyz[:, 0], xyz[:, 1]) < OBSTACLE_REACH_M)
    index = index[near[_voxel_sample(xyz[near], OBSTACLE_VOXEL_M)]]
    kept = cloud.stamp_ns, cloud.origin, cloud.xyz[index], cloud.t_s[index], cloud.sensor, sample_rays(cloud)
    if not cloud.parts:
        return Obstacles(*kept)
    first = np.cumsum([len(part.xyz) for part in cloud.parts])
    seen_from = np.searchsorted(first, index, side="right").astype(np.uint8)
    return Obstacles(*kept, np.array([part.sensor for part in cloud.parts]), seen_from)


def _voxel_sample(xyz: NDArray[np.float32], voxel_m: float) -> NDArray[np.intp]:
    """Return the indices of the first point of every voxel among points (N, 3), in the order of the points."""
    i, j, k = np.floor(xyz / voxel_m).astype(np.int64).T
    # Voxel and rank in one number: numbers are sorted several times as fast as their places are.
    ordered = np.sort((((i * 4096 + j) * 4096 + k) << RANK_BITS) + np.arange(len(xyz)))
    voxel = ordered >> RANK_BITS
    first = np.flatnonzero(np.diff(voxel, prepend=voxel[:1] - 1))
    return np.sort(ordered[first] & ((1 << RANK_BITS) - 1))
