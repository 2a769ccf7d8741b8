"""Which sweeps of a LiDAR repeat an earlier one, and how many points they have."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from log2sim.datatypes import Log
from log2sim.perception.record_checks.motion import Motion, motion_of
from log2sim.perception.record_checks.sweep_sketches import CELL_M, SweepSketch, common_share

# A sweep that has this share of its obstacle points in common with another is a copy of it: rounded to millimeters one has
# nine in ten on each axis, and noise of a LiDAR leaves one in ten where nothing moves.
MIN_COPIED_SHARE = 0.6
# Where nothing tells how much sweeps of this LiDAR usually have in common, only exact copies count.
MIN_IDENTICAL_SHARE = 0.95
# Motion of the LiDAR by ten cells moves all points of structures to other cells.
MIN_MOTION_M = 10 * CELL_M
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
    points : dict of int to int
        Number of points, by stamp.
    """

    log: Log
    name: str
    repeated: dict[int, bool] = field(default_factory=dict)
    points: dict[int, int] = field(default_factory=dict)
    _last: _Sweep | None = None
    _shares: dict[Motion, list[float]] = field(default_factory=lambda: {"stands": [], "drives": [], "unclear": []})

    def is_repeated(self, t_ns: int, sketch: SweepSketch) -> bool:
        """Return whether a sweep repeats the one before it, and remember it.

        Notes
        -----
        A LiDAR that stands in a synthetic world without noise gives the same points again and again, and rightly so. Hence a
        sweep is a copy where the LiDAR moved meanwhile, or where its sweeps are known to differ even from one place.
        """
        self.points[t_ns] = sketch.points
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
        """Return whether sweeps are known to have few points in common: even from one place, or while the LiDAR drives as now."""
        kinds: tuple[Motion, ...] = ("stands", "drives") if motion == "drives" else ("stands",)
        known = [self._shares[kind] for kind in kinds if len(self._shares[kind]) >= MIN_PAIRS]
        return any(float(np.median(shares)) < MAX_USUAL_SHARE for shares in known)

    def _motion(self, before_ns: int, after_ns: int) -> Motion:
        """Return how the LiDAR moved between two stamps; it drives where all points of structures are in other cells."""
        motion = motion_of(self.log, self.name, before_ns, after_ns)
        if motion != "drives":
            return motion
        poses, _ = self.log.map_T_sensor(self.name, np.array([before_ns, after_ns]))
        return "drives" if np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3]) > MIN_MOTION_M else "unclear"
