"""Poses of a log checked against what a vehicle can do, and repaired."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Fault, Log
from log2sim.geometry import NS_PER_S, Array, PoseTrack, rotation_from_rpy, yaw_of
from log2sim.localization.path import (
    MAX_DENSE_S,
    POSITION_PRIOR,
    YAW_PRIOR,
    Limits,
    RepairedPath,
    Skip,
    bridge,
    independent_noise,
    repair_path,
    runs_of,
    smooth_path,
)


@dataclass(frozen=True)
class Stretch:
    """A time in which poses were repaired or are not known.

    Attributes
    ----------
    kind : {"pose_jump", "frozen_poses", "gap", "skip", "copies"}
        A skip is a step that stays: the position may have jumped, or stamps may miss some time.
    first_ns, last_ns : int
        Stamps of the first and the last pose in question; of a gap those around it.
    shift_m, turn_rad : float
        By how much poses were moved at most.
    sigma_m : float
        Largest standard deviation of a repaired position that is used.
    unknown_s : float, s
        For how long no pose is known well enough.
    poses : int
        Number of poses in question.
    by : str
        What bridges it.
    """

    kind: str
    first_ns: int
    last_ns: int
    shift_m: float = 0.0
    turn_rad: float = 0.0
    sigma_m: float = 0.0
    unknown_s: float = 0.0
    poses: int = 0
    by: str = "the motion around"

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return (self.last_ns - self.first_ns) / NS_PER_S


@dataclass(frozen=True, eq=False)
class CheckedPoses:
    """Poses after the check.

    Attributes
    ----------
    track : PoseTrack
        The very poses that were given where nothing is wrong with them.
    stretches : tuple of Stretch
        In the order of time.
    moved : bool
        Whether given poses are not where they were, so that what was measured moves with them.
    """

    track: PoseTrack
    stretches: tuple[Stretch, ...]
    moved: bool = False


# From rest a vehicle gets no farther than by this acceleration until the next pose; what is less is the last digit of a position.
MAX_COPY_ACCELERATION_MPS2, MIN_COPY_STEP_M = 12.0, 0.1
# One run or two may be poses that froze.
MIN_RUNS = 3


@dataclass(frozen=True, eq=False)
class Copies:
    """Poses without those that repeat others.

    Attributes
    ----------
    track : PoseTrack
        The very one that was given where none does.
    first_ns, last_ns : int
        Stamps of the first and the last copy.
    worst_m : float
        How far the ego has moved on at most.
    """

    track: PoseTrack
    first_ns: int = 0
    last_ns: int = 0
    count: int = 0
    worst_m: float = 0.0


def leave_out_copies(track: PoseTrack) -> Copies:
    """Leave out poses that are the same as the one before although the next one is far away, if that happens again and again."""
    poses = track.map_T_ego
    copy = np.append(False, (poses[1:] == poses[:-1]).all(axis=(1, 2)))
    held, steps_m = [], []
    for first, stop in runs_of(copy):
        if stop == len(poses):
            continue
        dt_s = (track.t_ns[stop] - track.t_ns[stop - 1]) / NS_PER_S
        step_m = float(np.linalg.norm(poses[stop, :3, 3] - poses[first, :3, 3]))
        if step_m > max(MIN_COPY_STEP_M, MAX_COPY_ACCELERATION_MPS2 * dt_s**2):
            held.append((first, stop))
            steps_m.append(step_m)
    if len(held) < MIN_RUNS:
        return Copies(track)
    rows = np.concatenate([np.arange(*run) for run in held])
    last = len(poses) - int(np.argmin(copy[::-1]))
    if last < len(poses) and len(poses) - last <= 2 * np.median([stop - first for first, stop in held]):
        rows = np.append(rows, np.arange(last, len(poses)))
    kept = np.setdiff1d(np.arange(len(poses)), rows)
    thinned = replace(track, t_ns=track.t_ns[kept], map_T_ego=poses[kept])
    return Copies(thinned, int(track.t_ns[rows[0]]), int(track.t_ns[rows[-1]]), len(rows), max(steps_m))


# Vehicles on roads brake, speed up and turn with up to 10 m/s2; the rest is how their bodies pitch and bounce. They change their
# yaw rate by less than 3 rad/s2 at the limit of their tires.
MAX_ACCELERATION_MPS2, MAX_YAW_ACCELERATION_RADPS2 = 12.0, 5.0
# Smaller faults are left as they are: stamps that are off by some 10 ms at 30 m/s, GNSS without corrections, and the fits that
# would repair them err by as much.
MIN_STEP_M, MIN_STEP_RAD = 0.4, np.deg2rad(2.0)
# Standard deviations of poses of GNSS/INS with RTK or LiDAR odometry.
USUAL_SIGMA_M, USUAL_SIGMA_RAD = 0.02, 0.002
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


@dataclass(frozen=True, eq=False)
class _Path:
    """The columns of poses that are checked: positions (P, 3), m, and unwrapped yaws (P,), rad, at times (P,), s."""

    t_s: Array
    xyz_m: Array
    yaw_rad: Array


def check_poses(track: PoseTrack) -> CheckedPoses:
    """Check given poses and repair them where a vehicle cannot have moved so, or where they are far apart.

    Notes
    -----
    Stretches that are off by a constant are moved back, which keeps what they measured; what cannot be right, and gaps, are
    bridged by the most probable motion between the poses around. Of two parts of a path the one that lasts longer is taken for
    right. Roll and pitch stay as they are. Linear in the number of poses.
    """
    if len(track.t_ns) < 2:
        return CheckedPoses(track, ())
    copies = leave_out_copies(track)
    track, path = copies.track, _path_of(copies.track)
    level = repair_path(path.t_s, path.xyz_m[:, :2], POSITION)
    height = repair_path(path.t_s, path.xyz_m[:, 2:], POSITION, level.at_rest)
    yaw = repair_path(path.t_s, path.yaw_rad[:, None], YAW, level.at_rest)
    changed = level.moved | level.bridged | height.moved | height.bridged | yaw.moved | yaw.bridged
    new = _Path(path.t_s, np.hstack([level.values, height.values]), yaw.values[:, 0])
    stretches = [_stretch(track, path, new, rows, (level, yaw)) for rows in runs_of(changed)]
    if copies.count:
        stretches.append(Stretch("copies", copies.first_ns, copies.last_ns, copies.worst_m, poses=copies.count))
    stretches += _skips(track, (*level.skips, *height.skips))
    kept = ~changed | (_sigmas(level, yaw) <= [MAX_SIGMA_M, MAX_SIGMA_RAD]).all(axis=1)
    measured = ~(level.bridged | height.bridged | yaw.bridged)
    if _is_noisy(path.t_s[measured], new.xyz_m[measured, :2]) and not level.skips:
        level, height, yaw = (_smoothed(path.t_s, r, measured) for r in (level, height, yaw))
        new = _Path(path.t_s, np.hstack([level.values, height.values]), yaw.values[:, 0])
        changed = np.ones_like(changed)
    repaired = _repaired_track(track, path, new, changed, (level, yaw))
    filled, gaps = _filled(repaired, kept, _Evidence(new, measured, (level.noise, yaw.noise)))
    return CheckedPoses(
        filled, tuple(sorted([*stretches, *gaps], key=lambda s: s.first_ns)), bool(changed.any() or copies.count)
    )


def _is_noisy(t_s: Array, xy_m: Array) -> bool:
    """Return whether smoothing makes positions (P, 2) better; the noise of sparse ones does not show."""
    dense = len(t_s) > 1 and float(np.median(np.diff(t_s))) < MAX_DENSE_S
    return dense and independent_noise(t_s, xy_m) > MIN_SMOOTHED_M


def _smoothed(t_s: Array, path: RepairedPath, measured: NDArray[np.bool_]) -> RepairedPath:
    """Return a path without its noise."""
    values, sigma = smooth_path(t_s, path.values, measured, path.noise, path.limits.prior)
    sigma = np.where(measured, np.hypot(path.sigma, sigma), path.sigma)
    return replace(path, values=values, sigma=sigma, noise=float(np.median(sigma[measured])))


def _path_of(track: PoseTrack) -> _Path:
    t_s = (track.t_ns - track.t_ns[0]) / NS_PER_S
    return _Path(t_s, track.map_T_ego[:, :3, 3], np.unwrap(yaw_of(track.map_T_ego)))


def _sigmas(level: RepairedPath, yaw: RepairedPath) -> Array:
    """Return the standard deviations (P, 2) of positions, m, and yaws, rad, after their repair.

    Errors that last do not show in the noise of poses: they are not counted.
    """
    return np.stack([np.hypot(level.sigma, USUAL_SIGMA_M), np.hypot(yaw.sigma, USUAL_SIGMA_RAD)], axis=1)


def _repaired_track(
    track: PoseTrack, old: _Path, new: _Path, changed: NDArray[np.bool_], repaired: tuple[RepairedPath, RepairedPath]
) -> PoseTrack:
    """Return poses with the repaired positions and yaws where they changed, and their standard deviations."""
    level, yaw = repaired
    if not changed.any():
        return track
    sigmas = _sigmas(level, yaw)
    poses = track.map_T_ego.copy()
    poses[changed] = _placed(poses[changed], new.xyz_m[changed], new.yaw_rad[changed] - old.yaw_rad[changed])
    return replace(track, map_T_ego=poses, sigma_m=sigmas[:, 0], sigma_yaw_rad=sigmas[:, 1])


def _placed(map_T_ego: Array, xyz_m: Array, turn_rad: Array) -> Array:
    """Return poses (N, 4, 4) at other positions (N, 3) and turned about the vertical by angles (N,)."""
    out = map_T_ego.copy()
    none = np.zeros(len(turn_rad))
    out[:, :3, :3] = rotation_from_rpy(none, none, turn_rad) @ map_T_ego[:, :3, :3]
    out[:, :3, 3] = xyz_m
    return out


def _stretch(
    track: PoseTrack, old: _Path, new: _Path, rows: tuple[int, int], repaired: tuple[RepairedPath, RepairedPath]
) -> Stretch:
    """Describe the repair of the poses from one row up to another."""
    level, yaw = repaired
    k = slice(*rows)
    sigmas = _sigmas(level, yaw)[k]
    known = (sigmas <= [MAX_SIGMA_M, MAX_SIGMA_RAD]).all(axis=1)
    frozen = level.at_rest[k].mean() > 0.5
    period = float(np.median(np.diff(old.t_s)))
    return Stretch(
        "frozen_poses" if frozen else "pose_jump",
        int(track.t_ns[rows[0]]),
        int(track.t_ns[rows[1] - 1]),
        float(np.linalg.norm(new.xyz_m[k] - old.xyz_m[k], axis=1).max()),
        float(np.abs(new.yaw_rad[k] - old.yaw_rad[k]).max()),
        float(sigmas[known, 0].max(initial=0.0)),
        float(np.sum(~known)) * period,
        rows[1] - rows[0],
    )


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What tells poses in gaps: a path, which of its samples are measured, and their noise in m and rad."""

    path: _Path
    measured: NDArray[np.bool_]
    noise: tuple[float, float]


def _skips(track: PoseTrack, skips: Sequence[Skip]) -> list[Stretch]:
    """List the steps that stay and are worth a word."""
    return [
        Stretch("skip", int(track.t_ns[s.first]), int(track.t_ns[s.last]), shift_m=s.size)
        for s in skips
        if s.size >= MIN_STEP_M
    ]


def _filled(track: PoseTrack, kept: NDArray[np.bool_], evidence: _Evidence) -> tuple[PoseTrack, list[Stretch]]:
    """Add poses in gaps that are longer than `MAX_LINEAR_S`, and leave out those that are not kept."""
    rows = np.flatnonzero(kept)
    t_ns = track.t_ns[rows]
    gaps = np.flatnonzero(np.diff(t_ns) > MAX_LINEAR_S * NS_PER_S)
    if not len(gaps):
        return (track if kept.all() or not len(rows) else _joined(track, [_taken(track, rows)])), []
    parts, stretches = [_taken(track, rows)], []
    line = replace(track, max_gap_s=np.inf)
    for first, last in zip(t_ns[gaps].tolist(), t_ns[gaps + 1].tolist()):
        added = _bridged(line, evidence, (first, last)) if last - first <= MAX_BRIDGED_S * NS_PER_S else None
        ends, worst_m = np.array([first, last]), 0.0
        if added is not None:
            parts.append(added)
            ends, worst_m = np.concatenate([[first], added.t_ns, [last]]), float(added.sigma_m.max())
        between = np.diff(ends) / NS_PER_S
        unknown_s = float(between[between > MAX_LINEAR_S].sum())
        stretches.append(Stretch("gap", first, last, sigma_m=worst_m, unknown_s=unknown_s))
    if len(parts) == 1 and kept.all() and np.diff(t_ns)[gaps].min() > track.max_gap_s * NS_PER_S:
        return track, stretches
    filled = _joined(track, parts)
    # What is not bridged stays a gap.
    return replace(filled, max_gap_s=MAX_LINEAR_S) if any(s.unknown_s for s in stretches) else filled, stretches


@dataclass(frozen=True, eq=False)
class _Rows:
    """Stamps, poses and standard deviations of some poses of a track."""

    t_ns: NDArray[np.int64]
    map_T_ego: Array
    sigma_m: Array
    sigma_rad: Array


def _taken(track: PoseTrack, rows: NDArray[np.intp]) -> _Rows:
    sigmas = track.sigmas_at(track.t_ns[rows], (USUAL_SIGMA_M, USUAL_SIGMA_RAD))
    return _Rows(track.t_ns[rows], track.map_T_ego[rows], sigmas[:, 0], sigmas[:, 1])


def _joined(track: PoseTrack, parts: list[_Rows]) -> PoseTrack:
    """Return a track of the poses of several parts, in the order of time."""
    order = np.argsort(np.concatenate([p.t_ns for p in parts]), kind="stable")
    t_ns, poses, sigma_m, sigma_rad = (
        np.concatenate([getattr(p, name) for p in parts])[order]
        for name in ("t_ns", "map_T_ego", "sigma_m", "sigma_rad")
    )
    return replace(track, t_ns=t_ns, map_T_ego=poses, sigma_m=sigma_m, sigma_yaw_rad=sigma_rad)


def _bridged(line: PoseTrack, evidence: _Evidence, around_ns: tuple[int, int]) -> _Rows | None:
    """Interpolate poses between two stamps by the motion around, as far as they are known well enough; None without any."""
    first, last = around_ns
    path, measured, noise = evidence.path, evidence.measured, evidence.noise
    steps = int(np.ceil((last - first) / NS_PER_S / ADDED_STEP_S))
    t_ns = first + (np.arange(1, steps) * (last - first)) // steps
    t_s = (t_ns - line.t_ns[0]) / NS_PER_S
    xyz = bridge(path.t_s, path.xyz_m, measured, t_s, noise[0], POSITION_PRIOR)
    yaw = bridge(path.t_s, path.yaw_rad[:, None], measured, t_s, noise[1], YAW_PRIOR)
    if xyz is None or yaw is None:
        return None
    sigma_m = np.hypot(xyz.sigma, USUAL_SIGMA_M)
    sigma_rad = np.hypot(yaw.sigma, USUAL_SIGMA_RAD)
    known = (sigma_m <= MAX_SIGMA_M) & (sigma_rad <= MAX_SIGMA_RAD)
    if not known.any():
        return None
    straight = line.at(t_ns[known])[0]
    turned = yaw.value[known, 0] - yaw_of(straight)
    return _Rows(t_ns[known], _placed(straight, xyz.value[known], turned), sigma_m[known], sigma_rad[known])


# At 3 m/s2, which is brisk driving, a line between poses this far apart is off by 0.25 m; poses of 2 Hz are usual.
MIN_SPARSE_S = float(np.sqrt(8 * 0.25 / 3.0))


def list_faults(log: Log, stretches: Sequence[Stretch], during_ns: tuple[int, int] | None) -> tuple[Fault, ...]:
    """List the faults of given poses, those of the time that is used and of which something is recorded.

    Parameters
    ----------
    stretches : sequence of Stretch
        In the order of time.
    during_ns : (int, int), optional
        First and last stamp that is used; None for all.
    """
    if log.ego is None or not stretches:
        return ()
    records = np.unique(np.concatenate([stream.t_ns for stream in log.streams.values()] or [log.ego.t_ns]))
    if during_ns is not None:
        records = records[(records >= during_ns[0]) & (records <= during_ns[1])]
    if not len(records):
        return ()
    ends_ns = int(log.ego.t_ns[0]), int(log.ego.t_ns[-1])
    relevant = [s for s in stretches if _concerns(s, records)]
    skips = [_skip(s, int(records[0])) for s in relevant if s.kind == "skip"]
    copies = [_copies(s, int(records[0])) for s in relevant if s.kind == "copies"]
    wrong = [s for s in relevant if s.kind not in ("gap", "skip", "copies")]
    # Where wrong poses are left out there is a gap, which is reported with them.
    gaps = [
        s
        for s in relevant
        if s.kind == "gap" and not any(w.first_ns < s.last_ns and s.first_ns < w.last_ns for w in wrong)
    ]
    repairs = [_repair(s, int(records[0]), ends_ns) for s in wrong]
    lost = [_lost(s, int(records[0])) for s in gaps if s.unknown_s > 0]
    sparse = [s for s in gaps if not s.unknown_s and s.duration_s >= MIN_SPARSE_S]
    found = [*copies, *repairs, *skips, *lost, *([_sparse(sparse, int(records[0]))] if sparse else [])]
    return tuple(sorted(found, key=lambda fault: fault.start_ns or 0))


def _concerns(stretch: Stretch, records: NDArray[np.int64]) -> bool:
    """Return whether something was recorded while poses are in question; of a gap between its ends."""
    margin = 1 if stretch.kind == "gap" else 0
    first, stop = np.searchsorted(records, [stretch.first_ns + margin, stretch.last_ns + 1 - margin])
    return bool(stop > first)


def _span(stretch: Stretch, start_ns: int) -> str:
    first, last = (max((t - start_ns) / NS_PER_S, 0.0) for t in (stretch.first_ns, stretch.last_ns))
    return f"from {first:.2f} to {last:.2f} s" if last > first else f"at {first:.2f} s"


def _repair(stretch: Stretch, start_ns: int, ends_ns: tuple[int, int]) -> Fault:
    """Describe a jump, or poses that froze."""
    if stretch.kind == "frozen_poses":
        what = f"the pose stays {_span(stretch, start_ns)} while the ego moves on by up to {stretch.shift_m:.1f} m"
        done = f"{stretch.by} bridges it"
    else:
        by = [f"{stretch.shift_m:.1f} m"] if stretch.shift_m >= MIN_STEP_M else []
        by += [f"{np.rad2deg(stretch.turn_rad):.1f} degrees"] if stretch.turn_rad >= MIN_STEP_RAD else []
        what = f"the poses {_span(stretch, start_ns)} are off the others by {' and '.join(by)}, which no vehicle moves so fast"
        done = "they are moved back"
        if stretch.first_ns == ends_ns[0] or stretch.last_ns == ends_ns[1]:
            done += " to those of the longer part, as which part is right does not show"
    if stretch.unknown_s:
        done += f"; for {stretch.unknown_s:.1f} s of it the pose is not known, and what was recorded then is left out"
    values = {
        "shift_m": round(stretch.shift_m, 3),
        "turn_rad": round(stretch.turn_rad, 4),
        "sigma_m": round(stretch.sigma_m, 3),
        "duration_s": round(stretch.duration_s, 3),
        "unknown_s": round(stretch.unknown_s, 3),
    }
    return Fault(
        stretch.kind,
        "ego",
        f"{what}: {done}",
        "left_out" if stretch.unknown_s else "corrected",
        stretch.first_ns,
        stretch.last_ns,
        values,
    )


def _copies(stretch: Stretch, start_ns: int) -> Fault:
    """Describe poses that repeat others."""
    message = (
        f"{stretch.poses} poses {_span(stretch, start_ns)} repeat the one before while the ego moves on by up to "
        f"{stretch.shift_m:.1f} m, as those of a slower source do: they are not used"
    )
    values = {"shift_m": round(stretch.shift_m, 3), "poses": float(stretch.poses)}
    return Fault("frozen_poses", "ego", message, "left_out", stretch.first_ns, stretch.last_ns, values)


def _skip(stretch: Stretch, start_ns: int) -> Fault:
    """Describe a step forward."""
    message = (
        f"the position steps by {stretch.shift_m:.1f} m {_span(stretch, start_ns)}, farther than a vehicle moves: it "
        "jumped, or the stamps miss some time, which does not show; used as it is"
    )
    values = {"shift_m": round(stretch.shift_m, 3)}
    return Fault("pose_jump", "ego", message, "kept", stretch.first_ns, stretch.last_ns, values)


def _lost(stretch: Stretch, start_ns: int) -> Fault:
    """Describe a gap that is too long to be bridged."""
    message = (
        f"no pose {_span(stretch, start_ns)}, too long for the motion around to bridge more than "
        f"{max(stretch.duration_s - stretch.unknown_s, 0.0):.1f} s of it: what was recorded in the rest is left out"
    )
    values = {"duration_s": round(stretch.duration_s, 3), "unknown_s": round(stretch.unknown_s, 3)}
    return Fault("sparse_poses", "ego", message, "left_out", stretch.first_ns, stretch.last_ns, values)


def _sparse(gaps: Sequence[Stretch], start_ns: int) -> Fault:
    """Describe gaps that are bridged."""
    by = "the ego's motion" if gaps[0].by == Stretch.by else gaps[0].by
    longest, sigma_m = max(s.duration_s for s in gaps), max(s.sigma_m for s in gaps)
    whole = Stretch("gap", gaps[0].first_ns, gaps[-1].last_ns)
    number = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
    message = (
        f"poses are up to {longest:.2f} s apart {_span(whole, start_ns)} ({number}): {by} interpolates them, "
        f"to {sigma_m:.2f} m (1 sigma)"
    )
    values = {"longest_s": round(longest, 3), "gaps": float(len(gaps)), "sigma_m": round(sigma_m, 3)}
    return Fault("sparse_poses", "ego", message, "corrected", whole.first_ns, whole.last_ns, values)
