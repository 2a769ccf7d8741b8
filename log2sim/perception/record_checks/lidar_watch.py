"""Which sweeps of a LiDAR repeat an earlier one, and which have next to no points."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from log2sim.datatypes import Log
from log2sim.geometry import inverse
from log2sim.perception.record_checks.sweep_sketches import CELL_M, SweepSketch, common_share

# A sweep that has this share of its obstacle points in common with another is a copy of it: rounded to millimeters one has
# nine in ten on each axis, and noise of a LiDAR leaves one in ten where nothing moves.
MIN_COPIED_SHARE = 0.6
# Where nothing tells how much sweeps of this LiDAR usually have in common, only exact copies count.
MIN_IDENTICAL_SHARE = 0.95
# Motion of the LiDAR by ten cells, or by the angle that moves points at 30 m as far, moves all points of structures.
MIN_MOTION_M = 10 * CELL_M
MIN_TURN_RAD = MIN_MOTION_M / 30.0
# So many pairs of sweeps tell how much they usually have in common.
MIN_PAIRS = 5
MAX_USUAL_SHARE = 0.3
# Fewer obstacle points do not tell copies from chance.
MIN_OBSTACLES = 20


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
    _shares: dict[bool, list[float]] = field(default_factory=lambda: {False: [], True: []})

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
            moved, still = self._motion(last.since_ns, t_ns)
            copy = (moved and share >= MIN_IDENTICAL_SHARE) or (same and self._usually_differ(still))
            if not copy:
                self._shares[still].append(share)
        self._last = _Sweep(last.since_ns if same and last is not None else t_ns, sketch)
        self.repeated[t_ns] = copy
        return copy

    def _usually_differ(self, still: bool) -> bool:
        """Return whether sweeps are known to have few points in common, from one place or while the LiDAR moves."""
        shares = self._shares[still]
        return len(shares) >= MIN_PAIRS and float(np.median(shares)) < MAX_USUAL_SHARE

    def _motion(self, before_ns: int, after_ns: int) -> tuple[bool, bool]:
        """Return whether the LiDAR moved between two stamps enough to change all points, and whether it stood."""
        if self.log.lidars[self.name].mount == "map":
            return False, True
        poses, known = self.log.map_T_sensor(self.name, [before_ns, after_ns])
        if not known.all():
            return False, False
        step = inverse(poses[0]) @ poses[1]
        moved_m = float(np.linalg.norm(step[:3, 3]))
        turned_rad = float(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1.0, 1.0)))
        return moved_m > MIN_MOTION_M or turned_rad > MIN_TURN_RAD, moved_m < CELL_M and turned_rad < MIN_TURN_RAD / 10
