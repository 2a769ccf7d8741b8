"""Obstacles of all ticks of a log, whose points and rays wait in a temporary file until they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.array_file import ArrayFile, ArrayList
from log2sim.datatypes import Obstacles, Rays
from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class _Tick:
    """What is kept of obstacles: `points` holds xyz, t_s and perhaps seen_from, `rays` end, t_s and sensor."""

    stamp_ns: int
    origin: Array
    sensor: NDArray[np.float32]
    viewpoints: NDArray[np.float32] | None
    points: ArrayList
    rays: ArrayList
    lidars: tuple[NDArray[np.float32], NDArray[np.float32]] | None

    def obstacles(self) -> Obstacles:
        return Obstacles(
            self.stamp_ns,
            self.origin,
            partial(self.points.__getitem__, 0),
            partial(self.points.__getitem__, 1),
            self.sensor,
            None if self.lidars is None else self._rays,
            self.viewpoints,
            partial(self.points.__getitem__, 2) if len(self.points) > 2 else None,
        )

    def _rays(self) -> Rays:
        assert self.lidars is not None
        end, t_s, sensor = self.rays
        return Rays(end, t_s, sensor, *self.lidars)


class ObstacleList(Sequence["Obstacles | None"]):
    """Obstacles by tick, None at ticks without LiDAR.

    What is asked for is new each time: its stamp, its origin and the place of its sensor are at hand, and its points and rays are
    read when they are looked at.

    Parameters
    ----------
    file : ArrayFile
        What keeps points and rays.
    """

    def __init__(self, file: ArrayFile) -> None:
        self._file = file
        self._ticks: list[_Tick | None] = []

    def append(self, obstacles: Obstacles | None) -> None:
        """Add those of the next tick."""
        self._ticks.append(None if obstacles is None else self._kept(obstacles))

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self._ticks)

    def __getitem__(self, tick: Any) -> Any:
        """Return the obstacles of a tick, a list of them for a slice."""
        if isinstance(tick, slice):
            return [self[k] for k in range(len(self))[tick]]
        kept = self._ticks[tick]
        return None if kept is None else kept.obstacles()

    def _kept(self, of: Obstacles) -> _Tick:
        points = self._keep_all([of.xyz, of.t_s] + ([] if of.seen_from is None else [of.seen_from]))
        rays = self._keep_all([] if of.free is None else [of.free.end, of.free.t_s, of.free.sensor])
        lidars = None if of.free is None else (of.free.position, of.free.velocity_mps)
        return _Tick(of.stamp_ns, of.origin, of.sensor, of.viewpoints, points, rays, lidars)

    def _keep_all(self, columns: Sequence[NDArray[Any]]) -> ArrayList:
        return ArrayList([self._file.keep(column) for column in columns])
