"""Which sweeps of a LiDAR repeat an earlier one, and which have next to no points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from log2sim.datatypes import Log
from log2sim.geometry import inverse
from log2sim.perception.record_checks.driving import sensor_drives
from log2sim.perception.record_checks.sweep_sketches import CELL_M, SweepSketch, common_share

# A sweep that has this share of its obstacle points in common with another is a copy of it: rounded to millimeters one has
# nine in ten on each axis, and noise of a LiDAR leaves one in ten where nothing moves.
MIN_COPIED_SHARE = 0.6
# Where nothing tells how much sweeps of this LiDAR usually have in common, only exact copies count.
MIN_IDENTICAL_SHARE = 0.95
# Motion of the LiDAR by ten cells moves all points of structures to other cells; one that moves points by less than a cell at
# this distance is none.
MIN_MOTION_M = 10 * CELL_M
FAR_M = 30.0
# So many pairs of sweeps tell how much they usually have in common.
MIN_PAIRS = 5
MAX_USUAL_SHARE = 0.3
# Fewer obstacle points do not tell copies from chance.
MIN_OBSTACLES = 20


Motion = Literal["stands", "drives", "unclear"]


@dataclass(frozen=True, eq=False)
class _Sweep:
    """A sweep, and the stamp of the first in a row that have their points in common with it."""

    since_ns: int
    sketch: SweepSketch


@dataclass(eq=False)
class LidarWatch:
    """Judge the sweeps of one LiDAR in the order of their stamps.

    Attributes
    ----------
    log : Log
        Its poses tell how the LiDAR moves.
    name : str
        Of the LiDAR.
    repeated : dict of int to bool
        Whether a sweep repeats an earlier one, by stamp, ns.
    points, obstacles : dict of int to int
        Number of points, and of those that are above the ground, by stamp.
    """

    log: Log
    name: str
    repeated: dict[int, bool] = field(default_factory=dict)
    points: dict[int, int] = field(default_factory=dict)
    obstacles: dict[int, int] = field(default_factory=dict)
    _last: _Sweep | None = None
    _shares: dict[Motion, list[float]] = field(default_factory=lambda: {"stands": [], "drives": [], "unclear": []})

    def is_repeated(self, t_ns: int, sketch: SweepSketch) -> bool:
        """Return whether a sweep repeats the one before it, and remember it.

        Notes
        -----
        A LiDAR that stands in a synthetic world without noise gives the same points again and again, and rightly so. Hence a
        sweep is a copy where the LiDAR moved meanwhile, or where its sweeps are known to differ even from one place.
        """
        self.points[t_ns], self.obstacles[t_ns] = sketch.points, sketch.obstacles
        last, same, copy = self._last, False, False
        if last is not None and min(sketch.obstacles, last.sketch.obstacles) >= MIN_OBSTACLES:
            share = common_share(last.sketch, sketch)
            same = share >= MIN_COPIED_SHARE
            motion = self._motion(last.since_ns, t_ns)
            copy = (motion == "drives" and share >= MIN_IDENTICAL_SHARE) or (same and self._usually_differ(motion))
            if not copy:
                self._shares[motion].append(share)
        self._last = _Sweep(last.since_ns if same and last is not None else t_ns, sketch)
        self.repeated[t_ns] = copy
        return copy

    def _usually_differ(self, motion: Motion) -> bool:
        """Return whether sweeps are known to have few points in common where the LiDAR moves like this."""
        shares = self._shares[motion]
        return motion != "unclear" and len(shares) >= MIN_PAIRS and float(np.median(shares)) < MAX_USUAL_SHARE

    def _motion(self, before_ns: int, after_ns: int) -> Motion:
        """Return how the LiDAR moved between two stamps."""
        if self.log.lidars[self.name].mount == "map":
            return "stands"
        poses, known = self.log.map_T_sensor(self.name, np.array([before_ns, after_ns]))
        if not known.all():
            return "unclear"
        step = inverse(poses[0]) @ poses[1]
        moved_m = float(np.linalg.norm(step[:3, 3]))
        turned_rad = float(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1.0, 1.0)))
        if moved_m > MIN_MOTION_M and sensor_drives(self.log, self.name, before_ns, after_ns):
            return "drives"
        return "stands" if max(moved_m, turned_rad * FAR_M) < CELL_M else "unclear"
