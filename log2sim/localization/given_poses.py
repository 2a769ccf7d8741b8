"""Poses of a log checked against what a vehicle can do, and repaired."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Finding, Log
from log2sim.geometry import NS_PER_S, Array, PoseTrack, rotation_from_rpy, runs_of, yaw_of
from log2sim.geometry.transforms import USUAL_SIGMA_M, USUAL_SIGMA_RAD
from log2sim.localization.path import (
    MAX_DENSE_S,
    POSITION_PRIOR,
    YAW_PRIOR,
    FittedPath,
    Limits,
    RepairedPath,
    bridge,
    independent_noise,
    repair_path,
    smooth_path,
)


@dataclass(frozen=True)
class Stretch:
    """A time in which poses were repaired or are not known."""

    # {"pose_jump", "frozen_poses", "gap", "skip", "copies"}: a skip is a step that stays: the position may have jumped,
    # or stamps may miss some time
    kind: str
    first_ns: int  # `first_ns`, `last_ns`: stamps of the first and the last pose in question; of a gap those around it
    last_ns: int
    shift_m: float = 0.0  # `shift_m`, `turn_rad`: by how much poses were moved at most
    turn_rad: float = 0.0
    sigma_m: float = 0.0  # largest standard deviation of a repaired position that is used
    unknown_s: float = 0.0  # for how long no pose is known well enough
    poses: int = 0  # number of poses in question
    by: str = "the motion around"  # what bridges it

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return (self.last_ns - self.first_ns) / NS_PER_S


@dataclass(frozen=True, eq=False)
class CheckedPoses:
    """Poses after the check, in the order of time what was found, and whether given poses are not where they were.

    The track is the very one that was given where nothing is wrong with it. What was measured moves with poses that moved.
    """

    track: PoseTrack
    stretches: tuple[Stretch, ...]
    moved: bool = False


# From rest a vehicle gets no farther than by this acceleration until the next pose; what is less is the last digit of a position.
MIN_COPY_STEP_M = 0.1
# One run or two may be poses that froze.
MIN_RUNS = 3


def leave_out_copies(track: PoseTrack) -> tuple[PoseTrack, list[Stretch]]:
    """Leave out poses that are the same as the one before although the next one is far away, if that happens again and again."""
    poses = track.map_T_ego
    copy = np.append(False, (poses[1:] == poses[:-1]).all(axis=(1, 2)))
    held, steps_m = [], []
    for first, stop in runs_of(copy):
        if stop == len(poses):
            continue
        dt_s = (track.t_ns[stop] - track.t_ns[stop - 1]) / NS_PER_S
        step_m = float(np.linalg.norm(poses[stop, :3, 3] - poses[first, :3, 3]))
        if step_m > max(MIN_COPY_STEP_M, MAX_ACCELERATION_MPS2 * dt_s**2):
            held.append((first, stop))
            steps_m.append(step_m)
    if len(held) < MIN_RUNS:
        return track, []
    rows = np.concatenate([np.arange(*run) for run in held])
    last = len(poses) - int(np.argmin(copy[::-1]))
    if last < len(poses) and len(poses) - last <= 2 * np.median([stop - first for first, stop in held]):
        rows = np.append(rows, np.arange(last, len(poses)))
    kept = np.setdiff1d(np.arange(len(poses)), rows)
    first_ns, last_ns = int(track.t_ns[rows[0]]), int(track.t_ns[rows[-1]])
    thinned = replace(track, t_ns=track.t_ns[kept], map_T_ego=poses[kept])
    return thinned, [Stretch("copies", first_ns, last_ns, max(steps_m), poses=len(rows))]


# Vehicles on roads brake, speed up and turn with up to 10 m/s2; the rest is how their bodies pitch and bounce. They change their
# yaw rate by less than 3 rad/s2 at the limit of their tires.
MAX_ACCELERATION_MPS2, MAX_YAW_ACCELERATION_RADPS2 = 12.0, 5.0
# Smaller faults are left as they are: stamps that are off by some 10 ms at 30 m/s, GNSS without corrections, and the fits that
# would repair them err by as much.
MIN_STEP_M, MIN_STEP_RAD = 0.4, np.deg2rad(2.0)
MIN_LASTING_STEP_M, MIN_LASTING_STEP_RAD = 2.0, np.deg2rad(5.0)
POSITION = Limits(MAX_ACCELERATION_MPS2, POSITION_PRIOR, MIN_STEP_M, MIN_LASTING_STEP_M, USUAL_SIGMA_M)
YAW = Limits(MAX_YAW_ACCELERATION_RADPS2, YAW_PRIOR, MIN_STEP_RAD, MIN_LASTING_STEP_RAD, USUAL_SIGMA_RAD)
# Poses with more noise across the path are smoothed; less changes agents by no more than GNSS/INS errs.
MIN_SMOOTHED_M = 0.04
# Poses are not used where their standard deviation is beyond these, by which what is 20 m away is off by less than a meter.
MAX_SIGMA_M, MAX_SIGMA_RAD = 0.5, 0.035
# Over longer gaps a line between two poses is off by more than 2 cm at 3 m/s2, so that poses are added by the motion around.
MAX_LINEAR_S, ADDED_STEP_S = 0.25, 0.05
# No gap as long is bridged within `MAX_SIGMA_M`.
MAX_BRIDGED_S = 8.0


def check_poses(given: PoseTrack) -> CheckedPoses:
    """Check given poses and repair them where a vehicle cannot have moved so, or where they are far apart.

    Stretches that are off by a constant are moved back, which keeps what they measured; what cannot be right, and gaps, are
    bridged by the most probable motion between the poses around. Of two parts of a path the one that lasts longer is taken for
    right. Roll and pitch stay as they are. Linear in the number of poses.
    """
    if len(given.t_ns) < 2:
        return CheckedPoses(given, ())
    track, stretches = leave_out_copies(given)
    t_s, xyz = (track.t_ns - track.t_ns[0]) / NS_PER_S, track.map_T_ego[:, :3, 3]
    yaw_rad = np.unwrap(yaw_of(track.map_T_ego))
    level = repair_path(t_s, xyz[:, :2], POSITION)
    height = repair_path(t_s, xyz[:, 2:], POSITION, level.at_rest)
    yaw = repair_path(t_s, yaw_rad[:, None], YAW, level.at_rest)
    bridged = level.bridged | height.bridged | yaw.bridged
    changed = level.moved | height.moved | yaw.moved | bridged
    new_xyz, turn_rad = np.hstack([level.values, height.values]), yaw.values[:, 0] - yaw_rad
    sigmas = _sigmas(level, yaw)
    known = np.asarray((sigmas <= [MAX_SIGMA_M, MAX_SIGMA_RAD]).all(axis=1))
    for first, stop in runs_of(changed):
        k = slice(first, stop)
        stretches.append(
            Stretch(
                "frozen_poses" if level.at_rest[k].mean() > 0.5 else "pose_jump",
                int(track.t_ns[first]),
                int(track.t_ns[stop - 1]),
                float(np.linalg.norm(new_xyz[k] - xyz[k], axis=1).max()),
                float(np.abs(turn_rad[k]).max()),
                float(sigmas[k][known[k], 0].max(initial=0.0)),
                float(np.sum(~known[k])) * float(np.median(np.diff(t_s))),
                stop - first,
            )
        )
    stretches += [
        Stretch("skip", int(track.t_ns[s.first]), int(track.t_ns[s.last]), shift_m=s.size)
        for s in (*level.skips, *height.skips)
        if s.size >= MIN_STEP_M
    ]
    kept, measured = ~changed | known, ~bridged
    dense = measured.sum() > 1 and float(np.median(np.diff(t_s[measured]))) < MAX_DENSE_S
    # The noise of sparse positions does not show.
    if dense and independent_noise(t_s[measured], new_xyz[measured, :2]) > MIN_SMOOTHED_M and not level.skips:
        level, height, yaw = (_smoothed(t_s, path, measured) for path in (level, height, yaw))
        new_xyz, turn_rad = np.hstack([level.values, height.values]), yaw.values[:, 0] - yaw_rad
        changed, sigmas = np.ones_like(changed), _sigmas(level, yaw)
    if changed.any():
        poses = track.map_T_ego.copy()
        poses[changed] = _placed(poses[changed], new_xyz[changed], turn_rad[changed])
        track = replace(track, map_T_ego=poses, sigma_m=sigmas[:, 0], sigma_yaw_rad=sigmas[:, 1])

    def bridge_gap(at_s: Array) -> tuple[FittedPath, FittedPath] | None:
        position = bridge(t_s, new_xyz, measured, at_s, noise=level.noise, prior=POSITION_PRIOR)
        turned = bridge(t_s, yaw.values, measured, at_s, noise=yaw.noise, prior=YAW_PRIOR)
        return None if position is None or turned is None else (position, turned)

    track, gaps = _filled(track, kept, bridge_gap)
    ordered = tuple(sorted([*stretches, *gaps], key=lambda s: s.first_ns))
    return CheckedPoses(track, ordered, bool(changed.any() or any(s.kind == "copies" for s in stretches)))


def _smoothed(t_s: Array, path: RepairedPath, measured: NDArray[np.bool_]) -> RepairedPath:
    """Return a path without its noise."""
    values, sigma = smooth_path(t_s, path.values, measured, path.noise, path.limits.prior)
    sigma = np.where(measured, np.hypot(path.sigma, sigma), path.sigma)
    return replace(path, values=values, sigma=sigma, noise=float(np.median(sigma[measured])))


def _sigmas(position: RepairedPath | FittedPath, yaw: RepairedPath | FittedPath) -> Array:
    """Return the standard deviations (P, 2) of positions, m, and yaws, rad, that are repaired or bridged.

    Errors that last do not show in the noise of poses: they are not counted.
    """
    return np.stack([np.hypot(position.sigma, USUAL_SIGMA_M), np.hypot(yaw.sigma, USUAL_SIGMA_RAD)], axis=1)


def _placed(map_T_ego: Array, xyz_m: Array, turn_rad: Array) -> Array:
    """Return poses (N, 4, 4) at other positions (N, 3) and turned about the vertical by angles (N,)."""
    out = map_T_ego.copy()
    none = np.zeros(len(turn_rad))
    out[:, :3, :3] = rotation_from_rpy(none, none, turn_rad) @ map_T_ego[:, :3, :3]
    out[:, :3, 3] = xyz_m
    return out


def _filled(
    track: PoseTrack, kept: NDArray[np.bool_], bridge_gap: Callable[[Array], tuple[FittedPath, FittedPath] | None]
) -> tuple[PoseTrack, list[Stretch]]:
    """Add poses in gaps that are longer than `MAX_LINEAR_S`, as far as they are known, and leave out those that are not kept."""
    rows = np.flatnonzero(kept)
    t_ns = track.t_ns[rows]
    gaps = np.flatnonzero(np.diff(t_ns) > MAX_LINEAR_S * NS_PER_S)
    if not len(gaps):
        return (track if kept.all() or not len(rows) else join_tracks(track, rows)), []
    parts, stretches = [], []
    line = replace(track, max_gap_s=np.inf)
    for first, last in zip(t_ns[gaps].tolist(), t_ns[gaps + 1].tolist()):
        steps = int(np.ceil((last - first) / NS_PER_S / ADDED_STEP_S))
        at_ns = first + (np.arange(1, steps) * (last - first)) // steps
        short = last - first <= MAX_BRIDGED_S * NS_PER_S
        paths = bridge_gap((at_ns - track.t_ns[0]) / NS_PER_S) if short else None
        ends, worst_m = np.array([first, last]), 0.0
        if paths is not None:
            sigmas = _sigmas(*paths)
            known = (sigmas <= [MAX_SIGMA_M, MAX_SIGMA_RAD]).all(axis=1)
            if known.any():
                straight = line.at(at_ns[known])[0]
                poses = _placed(straight, paths[0].value[known], paths[1].value[known, 0] - yaw_of(straight))
                parts.append(PoseTrack(at_ns[known], poses, sigma_m=sigmas[known, 0], sigma_yaw_rad=sigmas[known, 1]))
                ends, worst_m = np.concatenate([[first], at_ns[known], [last]]), float(sigmas[known, 0].max())
        between = np.diff(ends) / NS_PER_S
        unknown_s = float(between[between > MAX_LINEAR_S].sum())
        stretches.append(Stretch("gap", first, last, sigma_m=worst_m, unknown_s=unknown_s))
    if not parts and kept.all() and np.diff(t_ns)[gaps].min() > track.max_gap_s * NS_PER_S:
        return track, stretches
    filled = join_tracks(track, rows, *parts)
    # What is not bridged stays a gap.
    return replace(filled, max_gap_s=MAX_LINEAR_S) if any(s.unknown_s for s in stretches) else filled, stretches


def join_tracks(track: PoseTrack, rows: NDArray[np.intp], *others: PoseTrack) -> PoseTrack:
    """Return some poses (rows) of a track together with those of others, in the order of time."""
    parts = [(track, track.t_ns[rows], track.map_T_ego[rows]), *((o, o.t_ns, o.map_T_ego) for o in others)]
    t_ns = np.concatenate([t for _, t, _ in parts])
    order = np.argsort(t_ns, kind="stable")
    sigmas = np.concatenate([part.sigmas_at(t) for part, t, _ in parts])[order]
    poses = np.concatenate([poses for _, _, poses in parts])[order]
    return replace(track, t_ns=t_ns[order], map_T_ego=poses, sigma_m=sigmas[:, 0], sigma_yaw_rad=sigmas[:, 1])


# At 3 m/s2, which is brisk driving, a line between poses this far apart is off by 0.25 m; poses of 2 Hz are usual.
MIN_SPARSE_S = float(np.sqrt(8 * 0.25 / 3.0))


def list_faults(log: Log, stretches: Sequence[Stretch], first_ns: int, last_ns: int) -> tuple[Finding, ...]:
    """List what is wrong with given poses between two stamps, the first and last tick of a run, where something is recorded.

    `stretches`: in the order of time.
    """
    records = np.unique(np.concatenate([stream.t_ns for stream in log.streams.values()] or [np.zeros(0, np.int64)]))
    records = records[(records >= first_ns) & (records <= last_ns)]
    # Something was recorded while poses are in question; of a gap between its ends.
    inner = [int(s.kind == "gap") for s in stretches]
    spans = np.array([(s.first_ns + k, s.last_ns + 1 - k) for s, k in zip(stretches, inner)]).reshape(-1, 2)
    relevant = [s for s, (first, stop) in zip(stretches, np.searchsorted(records, spans)) if stop > first]
    wrong = [s for s in relevant if s.kind not in ("gap", "skip", "copies")]
    # Where wrong poses are left out there is a gap, which is reported with them.
    gaps = [
        s
        for s in relevant
        if s.kind == "gap" and not any(w.first_ns < s.last_ns and s.first_ns < w.last_ns for w in wrong)
    ]
    sparse = [s for s in gaps if not s.unknown_s and s.duration_s >= MIN_SPARSE_S]
    found = [_fault(s, first_ns) for s in relevant if s.kind != "gap" or (s in gaps and s.unknown_s > 0)]
    found += [_sparse(sparse, first_ns)] if sparse else []
    return tuple(sorted(found, key=lambda fault: fault.start_s or 0.0))


def _fault(s: Stretch, t0_ns: int) -> Finding:
    """Describe a jump, poses that froze or repeat others, a step forward, or a gap that is too long to be bridged."""
    span = ((s.first_ns - t0_ns) / NS_PER_S, (s.last_ns - t0_ns) / NS_PER_S)
    if s.kind == "copies":
        values = {"shift_m": round(s.shift_m, 3), "poses": float(s.poses)}
        return Finding("frozen_poses", "ego", "left_out", *span, values, case="copies")
    if s.kind == "skip":
        return Finding("pose_jump", "ego", "kept", *span, {"shift_m": round(s.shift_m, 3)})
    values = {"duration_s": round(s.duration_s, 3), "unknown_s": round(s.unknown_s, 3)}
    if s.kind == "gap":
        return Finding("sparse_poses", "ego", "left_out", *span, values)
    values |= {"shift_m": round(s.shift_m, 3), "turn_rad": round(s.turn_rad, 4), "sigma_m": round(s.sigma_m, 3)}
    return Finding(s.kind, "ego", "left_out" if s.unknown_s else "corrected", *span, values, other=s.by)


def _sparse(gaps: Sequence[Stretch], t0_ns: int) -> Finding:
    """Describe gaps that are bridged."""
    by = "the ego's motion" if gaps[0].by == Stretch.by else gaps[0].by
    start_s, end_s = ((t_ns - t0_ns) / NS_PER_S for t_ns in (gaps[0].first_ns, gaps[-1].last_ns))
    values = {
        "longest_s": round(max(s.duration_s for s in gaps), 3),
        "gaps": float(len(gaps)),
        "sigma_m": round(max(s.sigma_m for s in gaps), 3),
    }
    return Finding("sparse_poses", "ego", "corrected", start_s, end_s, values, other=by)
