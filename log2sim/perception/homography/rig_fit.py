"""The homographies of all cameras of a rig, solved together.

One RANSAC finds the ground under the rig from the correspondences of all cameras and ticks. The ego's pitch and roll against
it are those of all cameras, and are kept at each tick if they lower held-out errors. Then one bundle over the feet of boxes
in all cameras finds where boxes end, and how each camera is turned.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, apply_homography
from log2sim.perception.homography.camera_fit import (
    FOOT_SIGMA_M,
    FOOT_SIGMA_PX,
    GROUND_SIGMA_M,
    GROUND_SIGMA_PX,
    MIN_TESTED_FEET,
)
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.fit import HomographyFit, PitchRoll, refused_fit
from log2sim.perception.homography.rig import Rig, RigState, foot_homography, foot_sigma_m, road_homography
from log2sim.perception.homography.rig_feet import FeetFit, fit_feet
from log2sim.perception.homography.rig_plane import SAMPLES, HeightRows, find_plane, tilt_of_ticks
from log2sim.perception.homography.rig_rows import RigRows, heights_of
from log2sim.perception.homography.stabilization import MIN_SIGNIFICANCE_SIGMA, HeldOutErrors
from log2sim.perception.homography.validation import MIN_INLIER_SHARE, MIN_INLIERS

# Crossfall of 2.5 % over the width of a lane, and the depth of ruts: the road is this far from a plane.
ROAD_SIGMA_M = 0.05
# Fewer correspondences of all cameras together do not tell the ground from what else they may be on.
MIN_ROWS = 30


@dataclass(frozen=True, eq=False)
class RigFit:
    """The homographies of the cameras of a rig, fitted together.

    Attributes
    ----------
    reason : str
        Why nothing was fitted, "" otherwise.
    rig : Rig
    fits : mapping of str to HomographyFit
        From the feet of boxes to the ground, by camera; refused ones state why.
    state : RigState or None
    ticks : (T,) int64
        Ticks with a plane of their own, ascending.
    planes : (T, 3) float64
    """

    reason: str
    rig: Rig
    fits: Mapping[str, HomographyFit] = field(default_factory=dict)
    state: RigState | None = None
    ticks: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    planes: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def road_at_tick(self, camera: str, tick: int) -> Array | None:
        """Return the homography (3, 3) of the road itself for a camera at a tick; None where nothing was fitted."""
        plane = self._plane_at_tick(tick)
        return None if self.state is None or plane is None else road_homography(self.rig, self.state, camera, plane)

    def road_z_m(self, xy: Array, tick: int) -> float | None:
        """Return the height of the road at a ground position (2,), m; None where nothing was fitted."""
        plane = self._plane_at_tick(tick)
        return None if plane is None else float(plane @ [*(xy - self.rig.origin_m[:2]), 1.0] + self.rig.origin_m[2])

    def _plane_at_tick(self, tick: int) -> Array | None:
        if self.state is None:
            return None
        k = int(np.searchsorted(self.ticks, tick))
        return np.asarray(self.planes[k] if k < len(self.ticks) and self.ticks[k] == tick else self.state.plane)


def fit_rig(
    rig: Rig,
    feet: Mapping[str, Correspondences],
    ground: Mapping[str, Correspondences],
    *,
    rng: np.random.Generator,
    samples: int = SAMPLES,
) -> RigFit:
    """Fit the homographies of all cameras of a rig.

    Parameters
    ----------
    rig : Rig
    feet, ground : mapping of str to Correspondences
        Of obstacles and of LiDAR ground points, by camera.
    rng : numpy.random.Generator
    samples : int
        Planes that RANSAC draws for the whole rig.
    """
    foot_rows = RigRows.of(rig, feet, FOOT_SIGMA_PX, FOOT_SIGMA_M)
    ground_rows = RigRows.of(rig, ground, GROUND_SIGMA_PX, GROUND_SIGMA_M)
    heights = _heights(rig, RigRows.join([foot_rows, ground_rows]))
    plane = find_plane(heights, rng, samples) if len(heights.tick) >= MIN_ROWS else None
    if plane is None:
        reason = f"{len(heights.tick)} correspondences of all cameras do not determine the ground"
        return RigFit(reason, rig)
    share = heights.inlier_share(plane)
    if share < MIN_INLIER_SHARE:
        return RigFit(f"only {share:.0%} of the correspondences of all cameras agree on a ground", rig)
    fit = fit_feet(rig, foot_rows, RigState.calibrated(rig, plane))
    ticks, planes, decision = np.zeros(0, dtype=np.int64), np.zeros((0, 3)), None
    if len(ground_rows) and len(foot_rows) >= MIN_TESTED_FEET:
        ticks, planes = _planes_of_ticks(_heights(rig, ground_rows), plane)
        own = _of_rows(ticks, planes, plane, foot_rows.tick)
        moving = fit_feet(rig, foot_rows, fit.state, own, is_start=False)
        decision = _decide(foot_rows, fit, moving, planes - plane)
        if decision.per_tick:
            fit = moving
        else:
            ticks, planes = ticks[:0], planes[:0]
    result = _RigResult(rig, fit, foot_rows, ticks, planes, decision)
    fits = {name: result.of_camera(name, feet.get(name) or Correspondences.join([])) for name in rig.cameras}
    return RigFit("", rig, fits, fit.state, ticks, planes)


def _heights(rig: Rig, rows: RigRows) -> HeightRows:
    height, sigma = heights_of(rig, rows)
    kept = np.isfinite(sigma)
    xy1 = np.column_stack([rows.xy, np.ones(len(rows))])
    return HeightRows(xy1[kept], height[kept], np.hypot(sigma, ROAD_SIGMA_M)[kept], rows.tick[kept])


def _planes_of_ticks(heights: HeightRows, plane: Array) -> tuple[NDArray[np.int64], Array]:
    ticks, tilt = tilt_of_ticks(heights, plane)
    return ticks, plane + np.column_stack([tilt, np.zeros(len(ticks))])


def _of_rows(ticks: NDArray[np.int64], planes: Array, plane: Array, tick: NDArray[np.int64]) -> Array:
    """Look up the planes (N, 3) of ticks (N,); that of all ticks where there is none."""
    index = np.clip(np.searchsorted(ticks, tick), 0, len(ticks) - 1)
    return np.where((ticks[index] == tick)[:, None], planes[index], plane)


def _decide(rows: RigRows, fixed: FeetFit, moving: FeetFit, tilt: Array) -> PitchRoll:
    """Accept or refuse the tilt of each tick, which ground points gave, by the errors of the feet."""
    squared = np.stack([fixed.errors.squared, moving.errors.squared])
    errors = HeldOutErrors(rows.tick, squared, np.stack([fixed.errors.pixels, moving.errors.pixels]))
    significance = errors.significance() if np.abs(tilt).max() > 0 else 0.0
    before, after = np.median(errors.distance_px, axis=1).tolist()
    pitch, roll = np.degrees(tilt[:, :2].std(axis=0)).tolist()
    return PitchRoll(significance > MIN_SIGNIFICANCE_SIGMA, "ground points", pitch, roll, (before, after), significance)


@dataclass(frozen=True, eq=False)
class _RigResult:
    """The fit of a rig, from which the results of its cameras are made."""

    rig: Rig
    fit: FeetFit
    rows: RigRows
    ticks: NDArray[np.int64]
    planes: Array
    decision: PitchRoll | None

    def of_camera(self, name: str, data: Correspondences) -> HomographyFit:
        """Make the result of one camera, refused where its feet contradict the rig."""
        number = list(self.rig.cameras).index(name)
        own = self.rows.camera == number
        count, agree = int(own.sum()), int((own & self.fit.inliers).sum())
        needed = max(MIN_INLIERS, int(np.ceil(MIN_INLIER_SHARE * count)))
        if count >= MIN_INLIERS and agree < needed:
            reason = f"{agree} of {count} feet of its obstacles agree with the rig, at least {needed} are needed"
            return refused_fit(reason, len(data))
        h = foot_homography(self.rig, self.fit.state, name)
        inliers = self._inliers(own, data)
        distance = np.hypot(*(apply_homography(h, data.uv[inliers])[0] - data.xy_ego[inliers]).T)
        known = distance[np.isfinite(distance)]
        s = np.linalg.svd(h, compute_uv=False)
        per_tick = foot_homography(self.rig, self.fit.state, name, self.planes) if len(self.ticks) else None
        return HomographyFit(
            True,
            "",
            h,
            inliers,
            float(np.median(known)) if len(known) else float("nan"),
            float(s[0] / s[-1]),
            self.ticks,
            per_tick,
            foot_sigma_m(self.rig, self.fit.state, name, self.fit.covariance_of(number)),
            self.decision,
        )

    def _inliers(self, own: NDArray[np.bool_], data: Correspondences) -> NDArray[np.bool_]:
        """Mark the correspondences (N,) of a camera that agree; the rows of the rig are sorted by tick, and finite."""
        out = np.zeros(len(data), dtype=bool)
        usable = np.flatnonzero(np.isfinite(np.column_stack([data.uv, data.xy_ego])).all(axis=1))
        out[usable[np.argsort(data.tick[usable], kind="stable")]] = self.fit.inliers[own]
        return out
