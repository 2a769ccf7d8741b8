"""Pairs of sweeps from different places of the ego's path, and the motions between them that their surfaces show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from log2sim.calibration.surfaces import Registration, Surfaces, register, surfaces_of
from log2sim.calibration.twists import velocities_at
from log2sim.datatypes import Log
from log2sim.errors import RecordError
from log2sim.geometry import NS_PER_S, Array, PoseTrack, inverse
from log2sim.localization.ego_sweeps import EgoSweep, ego_sweep_of
from log2sim.localization.moving_points import move_points

# More sweeps make the result no better: the errors of the poses, which last for seconds, remain.
MAX_SWEEPS = 20
# Farther apart, sweeps miss how the ego changes its motion: of a long log, those of the parts in which it changes most are taken.
SPACING_S, MAX_SPACING_S, PARTS = 0.5, 1.0, 2
# Sweeps are compared with the next and with one of those after it: near ones show much in common, errors of far ones do not add up.
STEP = 4
MAX_APART_M = 40.0
# On a shorter way nothing shows that matters: errors of poses of centimeters are degrees of it.
MIN_PATH_M = 1.0
# A turn moves what is seen as much as a translation by its angle times this.
LEVER_M = 20.0
MIN_PAIRS = 8


@dataclass(frozen=True, eq=False)
class Pair:
    """Two of the sweeps, and the motion between them that their surfaces show."""

    first: int
    second: int
    found: Registration


@dataclass(frozen=True, eq=False)
class SweepPairs:
    """What the sweeps of a LiDAR show of the ego's motion.

    Attributes
    ----------
    track : PoseTrack
        The ego's poses.
    sensor_m : (3,) float64, m
        Where the LiDAR is in the ego's frame.
    t_ns : (K,) int64
        Stamps of the sweeps.
    pairs : tuple of Pair
    """

    track: PoseTrack
    sensor_m: Array
    t_ns: NDArray[np.int64]
    pairs: tuple[Pair, ...]


def pair_sweeps(
    log: Log, lidar: str, during_ns: tuple[int, int] | None, report: Callable[[int, int], None]
) -> SweepPairs | None:
    """Compare sweeps of a LiDAR on the ego with each other.

    Parameters
    ----------
    log : Log
    lidar : str
    during_ns : (2,) tuple of int or None
        First and last stamp to look at; None for all.
    report : callable
        Called as `report(done, total)`.

    Returns
    -------
    SweepPairs or None
        None where the ego hardly moves, sweeps show too little, or points are given in the map, which hides clock and mount.
    """
    track = log.ego
    if track is None:
        return None
    chosen = choose_sweeps(track, log.streams[lidar].t_ns, during_ns)
    places, surfaces = [], []
    for done, i in enumerate(chosen.tolist()):
        report(done, len(chosen))
        try:
            record = log.streams[lidar].read(i)
        except RecordError:
            continue
        if record.frame == "map":
            return None
        sweep = ego_sweep_of(log, lidar, record)
        if sweep is not None and (found := _surfaces(sweep, track)) is not None:
            places.append(sweep.t_ref_ns)
            surfaces.append(found)
    if len(surfaces) < 2:
        return None
    t_ns = np.array(places, dtype=np.int64)
    pairs = _compare(surfaces, track.at(t_ns)[0])
    sensor_m = log.lidars[lidar].mount_T_lidar[:3, 3]
    return SweepPairs(track, sensor_m, t_ns, tuple(pairs)) if len(pairs) >= MIN_PAIRS else None


def choose_sweeps(
    track: PoseTrack, t_ns: NDArray[np.int64], during_ns: tuple[int, int] | None = None
) -> NDArray[np.intp]:
    """Choose rows (K,) of sweeps at stamps (N,): none where the ego hardly moves, of a long log where its motion changes most."""
    rows = np.arange(len(t_ns))
    if during_ns is not None:
        rows = rows[(t_ns >= during_ns[0]) & (t_ns <= during_ns[1])]
    spaced = _spaced(t_ns, rows)
    velocity, known = velocities_at(track, t_ns[spaced])
    spaced, velocity = spaced[known], velocity[known]
    if len(spaced) == 0 or _path_m(track, t_ns[spaced]) < MIN_PATH_M:
        return rows[:0]
    if len(spaced) * SPACING_S > MAX_SWEEPS * MAX_SPACING_S:
        return np.sort(np.concatenate(_fastest_changes(spaced, velocity)))
    usable = rows[(rows >= spaced[0]) & (rows <= spaced[-1])]
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, MAX_SWEEPS).round().astype(np.int64))]
    return np.asarray(chosen[velocities_at(track, t_ns[chosen])[1]])


def _spaced(t_ns: NDArray[np.int64], rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Keep rows whose stamps are `SPACING_S` apart."""
    if len(rows) == 0:
        return rows
    slot = (t_ns[rows] - t_ns[rows[0]]) // round(SPACING_S * NS_PER_S)
    return np.asarray(rows[np.unique(slot, return_index=True)[1]])


def _path_m(track: PoseTrack, t_ns: NDArray[np.int64]) -> float:
    """Compute how far the ego gets, m, as the diagonal of the box around its places."""
    places = track.at(t_ns)[0][:, :3, 3]
    return float(np.linalg.norm(np.ptp(places, axis=0)))


def _fastest_changes(rows: NDArray[np.intp], velocity: Array) -> list[NDArray[np.intp]]:
    """Choose `PARTS` runs of rows in which the velocity varies most, one after the other."""
    size = MAX_SWEEPS // PARTS
    scaled = velocity * np.array([1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M])
    change = np.array([scaled[k : k + size].var(axis=0).sum() for k in range(len(rows) - size + 1)])
    parts: list[NDArray[np.intp]] = []
    for _ in range(PARTS):
        k = int(np.argmax(change))
        parts.append(rows[k : k + size])
        change[max(k - size + 1, 0) : k + size] = -1.0
        if change.max() < 0:
            break
    return parts


def _surfaces(sweep: EgoSweep, track: PoseTrack) -> Surfaces | None:
    """Find the surfaces of a sweep with the ego's motion taken out."""
    xyz = sweep.xyz_m
    if sweep.t_ns is not None:
        ref_T_map = inverse(track.at(sweep.t_ref_ns)[0][0])
        moved = move_points(xyz, sweep.t_ns, lambda t: (ref_T_map @ track.at(t)[0], track.at(t)[1]))
        if moved is None:
            return None
        xyz = moved
    return surfaces_of(xyz)


def _compare(surfaces: list[Surfaces], map_T_ego: Array) -> list[Pair]:
    """Register sweeps with the next ones, and with those `STEP` later, from what the former have shown."""
    near: dict[int, Registration] = {}
    pairs = []
    for step in (1, STEP):
        for i in range(len(surfaces) - step):
            guess = inverse(map_T_ego[i]) @ map_T_ego[i + step]
            if np.linalg.norm(guess[:3, 3]) > MAX_APART_M:
                continue
            between = [near.get(k) for k in range(i, i + step)]
            if step > 1 and all(between):
                guess = reduce(np.matmul, [found.first_T_second for found in between if found is not None])
            found = register(surfaces[i], surfaces[i + step], guess)
            if found is not None:
                pairs.append(Pair(i, i + step, found))
                if step == 1:
                    near[i] = found
    return pairs
