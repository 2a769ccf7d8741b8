"""Poses that repeat the one before while the ego moves: a slow stream that is stored more often."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from log2sim.geometry import NS_PER_S, PoseTrack
from log2sim.localization.path_repair import runs_of

# From rest a vehicle gets no farther than by this acceleration until the next pose; what is less is the last digit of a position.
MAX_ACCELERATION_MPS2, MIN_STEP_M = 12.0, 0.1
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
    count : int
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
        if step_m > max(MIN_STEP_M, MAX_ACCELERATION_MPS2 * dt_s**2):
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
