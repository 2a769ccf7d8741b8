"""Poses by LiDAR odometry for times in which given poses are wrong or missing and the motion around tells too little."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.geometry import (
    NS_PER_S,
    Array,
    PoseTrack,
    quaternion_from_rotation,
    rotation_from_quaternion,
    slerp,
    transform,
)
from log2sim.localization.alignment import fit_to_given
from log2sim.localization.checked_poses import CheckedPoses, Stretch
from log2sim.localization.ego_sweeps import densest_lidar
from log2sim.localization.given_poses import MAX_SIGMA_M, USUAL_SIGMA_M, USUAL_SIGMA_RAD
from log2sim.localization.odometry import Odometry, run_odometry
from log2sim.localization.registration import is_installed
from log2sim.localization.verdict import MAX_UNSURE_SHARE, unsure_share

# Odometry begins this long before and ends this long after, which fits it to the poses there.
MARGIN_S = 2.0
# Odometry that differs from the poses before or after by more, RMS, is not sure of the motion; nor does it meet both.
MAX_MISFIT_M = 0.1
# Fewer poses do not tell whether odometry fits to them.
MIN_FITTED, MIN_FITTED_M = 5, 1.0
# Sweeps farther apart leave too much to the motion between them.
MAX_STEP_S = 0.6
# Odometry drifts by up to this share of its path and by this much per m of it: centimeters over twenty meters.
DRIFT_SHARE, DRIFT_RAD_PER_M = 0.005, 2e-4

Progress = Callable[[int, int], None]


def bridge_by_lidar(log: Log, checked: CheckedPoses, progress: Progress) -> CheckedPoses:
    """Take poses from LiDAR odometry where given ones are not known, as far as sweeps and its library are there.

    Parameters
    ----------
    log : Log
        With the poses that were given, by which its sweeps may be placed.
    checked : CheckedPoses
    progress : callable
        Called with (sweeps done, all sweeps).
    """
    if not any(s.unknown_s for s in checked.stretches) or not is_installed():
        return checked
    lidar = densest_lidar(log)
    if lidar is None:
        return checked
    track, stretches = checked.track, []
    for stretch in checked.stretches:
        found = _bridge(log, lidar, track, stretch, progress) if stretch.unknown_s else None
        stretches.append(stretch if found is None else found[1])
        track = track if found is None else found[0]
    return replace(checked, track=track, stretches=tuple(stretches))


def _bridge(
    log: Log, lidar: str, track: PoseTrack, stretch: Stretch, progress: Progress
) -> tuple[PoseTrack, Stretch] | None:
    """Replace the poses of a stretch by those of odometry; None where it is not sure of them."""
    margin_ns = round(MARGIN_S * NS_PER_S)
    window = stretch.first_ns - margin_ns, stretch.last_ns + margin_ns
    t_ns = log.streams[lidar].t_ns
    if np.sum((t_ns >= window[0]) & (t_ns <= window[1])) < 2:
        return None
    try:
        found = run_odometry(log, lidar, during_ns=window, progress=progress)
    except LogError:
        return None
    placed = _placed(found, track, stretch)
    if placed is None or unsure_share(found) > MAX_UNSURE_SHARE:
        return None
    rows = (track.t_ns < placed.t_ns[0]) | (track.t_ns > placed.t_ns[-1])
    rows &= (track.t_ns < stretch.first_ns) | (track.t_ns > stretch.last_ns)
    joined = _joined(track, np.flatnonzero(rows), placed)
    assert placed.sigma_m is not None
    bridged = replace(stretch, unknown_s=0.0, sigma_m=float(placed.sigma_m.max()), by="LiDAR odometry")
    return joined, bridged


@dataclass(frozen=True, eq=False)
class _Side:
    """Odometry laid on the poses before or after a stretch.

    Attributes
    ----------
    poses : (n, 4, 4) float64
        Of the stretch.
    away_m : (n,) float64, m
        Way from the nearest of the poses before or after.
    misfit_m : float, m
        RMS distance from these.
    fitted_m : float, m
        Length of the path along these.
    """

    poses: Array
    away_m: Array
    misfit_m: float
    fitted_m: float

    @property
    def sigma_m(self) -> Array:
        """Standard deviations (n,) of the poses: a misfit may be of the speed, so that it grows beyond the poses it is fitted to."""
        growth = 1 + 2 * self.away_m / max(self.fitted_m, MIN_FITTED_M)
        return np.asarray(np.hypot(self.misfit_m * growth, DRIFT_SHARE * self.away_m))


def _placed(found: Odometry, track: PoseTrack, stretch: Stretch) -> PoseTrack | None:
    """Lay odometry on the poses before and after a stretch: its poses in between; None where it covers or fits too little."""
    t_ns = found.t_ns
    known = track.at(t_ns)[1]
    inside = np.flatnonzero((t_ns >= stretch.first_ns) & (t_ns <= stretch.last_ns))
    before = np.flatnonzero((t_ns < stretch.first_ns) & known)
    after = np.flatnonzero((t_ns > stretch.last_ns) & known)
    edges = np.concatenate([t_ns[before[-1:]], t_ns[inside], t_ns[after[:1]]])
    if not len(inside) or np.diff(edges).max(initial=0) > MAX_STEP_S * NS_PER_S:
        return None
    sides = [_side(found, track, rows, inside) for rows in (before, after) if len(rows) >= MIN_FITTED]
    if not sides or max(side.misfit_m for side in sides) > MAX_MISFIT_M:
        return None
    share = np.zeros(len(inside))
    if len(sides) == 2:
        share = sides[0].away_m / np.maximum(sides[0].away_m + sides[1].away_m, 1e-6)
    first, last = sides[0], sides[-1]
    apart_m = np.linalg.norm(first.poses[:, :3, 3] - last.poses[:, :3, 3], axis=1)
    away_m = np.minimum(first.away_m, last.away_m)
    odometry_m = np.minimum(first.sigma_m, last.sigma_m)
    sigma_m = np.sqrt(USUAL_SIGMA_M**2 + odometry_m**2 + (apart_m / 2) ** 2)
    sigma_rad = np.hypot(USUAL_SIGMA_RAD, DRIFT_RAD_PER_M * away_m)
    if sigma_m.max() > MAX_SIGMA_M:
        return None
    poses = _between(first.poses, last.poses, share)
    return PoseTrack(t_ns[inside], poses, sigma_m=sigma_m, sigma_yaw_rad=sigma_rad)


def _side(found: Odometry, track: PoseTrack, rows: NDArray[np.intp], inside: NDArray[np.intp]) -> _Side:
    """Fit odometry to the poses of a track at some of its rows, all before or all after the rows `inside`."""
    map_T_odom = fit_to_given(PoseTrack(found.t_ns[rows], found.odom_T_ego[rows]), track)
    assert map_T_odom is not None
    off = (map_T_odom @ found.odom_T_ego[rows])[:, :3, 3] - track.at(found.t_ns[rows])[0][:, :3, 3]
    path_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(found.odom_T_ego[:, :3, 3], axis=0), axis=1)))
    nearest = rows[-1] if rows[0] < inside[0] else rows[0]
    return _Side(
        map_T_odom @ found.odom_T_ego[inside],
        np.abs(path_m[inside] - path_m[nearest]),
        float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1)))),
        float(np.ptp(path_m[rows])),
    )


def _between(first: Array, last: Array, share: Array) -> Array:
    """Go over from poses (n, 4, 4) to others by shares (n,)."""
    rotation = slerp(quaternion_from_rotation(first[:, :3, :3]), quaternion_from_rotation(last[:, :3, :3]), share)
    place = (1 - share)[:, None] * first[:, :3, 3] + share[:, None] * last[:, :3, 3]
    return transform(rotation_from_quaternion(rotation), place)


def _joined(track: PoseTrack, rows: NDArray[np.intp], other: PoseTrack) -> PoseTrack:
    """Return some poses of a track together with those of another one."""
    usual = USUAL_SIGMA_M, USUAL_SIGMA_RAD
    t_ns = np.concatenate([track.t_ns[rows], other.t_ns])
    order = np.argsort(t_ns, kind="stable")
    sigmas = np.concatenate([track.sigmas_at(track.t_ns[rows], usual), other.sigmas_at(other.t_ns, usual)])[order]
    return replace(
        track,
        t_ns=t_ns[order],
        map_T_ego=np.concatenate([track.map_T_ego[rows], other.map_T_ego])[order],
        max_gap_s=max(track.max_gap_s, MAX_STEP_S),
        sigma_m=sigmas[:, 0],
        sigma_yaw_rad=sigmas[:, 1],
    )
