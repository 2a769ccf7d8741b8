"""How sharp the surroundings are that sweeps show under given poses: a measure of poses that needs no truth.

Two sweeps are laid over each other by the poses. Upright surfaces, that is walls, poles and parked cars, of one should lie on
those of the other. The mean squared distance from surface to surface is the plane variance (Razlaw, Droeschel, Holz, Behnke:
Evaluation of registration methods for sparse 3D laser scans, ECMR 2015). Surfaces that face along and across the ego count the
same, however many there are, as in the mutually orthogonal metric (Kornilova, Ferrer: Be your own benchmark, ECMR 2021): a
street has many walls across and little that shows an error along it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S, Array, PoseTrack, apply, inverse, nearest_index
from log2sim.localization.ego_sweeps import EgoSweep, read_ego_sweep
from log2sim.localization.moving_points import move_points
from log2sim.localization.registration import load_small_gicp

PAIRS = 15
APART_S = 2.0
VOXEL_M, NEIGHBORS = 0.25, 10
# A surface is upright if its normal leaves the horizontal by less than 20 degrees, and faces a direction within 45 degrees.
MAX_NORMAL_Z = 0.35
MIN_FACING = np.sqrt(0.5)
MIN_POINTS_FACING = 50
MAX_REACH_M, MATCH_WITHIN_M, MAX_DISTANCE_M = 50.0, 2.0, 0.5


@dataclass(frozen=True, eq=False)
class Scatter:
    """Distances between the surfaces of pairs of sweeps under some poses.

    Attributes
    ----------
    neighbors_m, apart_m : (K,) float64, m
        RMS over the surfaces of each pair of neighbors, and of sweeps `apart_s` apart; NaN for a pair that shows too little.
    apart_s : float, s
        `APART_S`, or half of a shorter log.
    """

    neighbors_m: Array
    apart_m: Array
    apart_s: float


def compare_poses(log: Log, lidar: str, tracks: Mapping[str, PoseTrack], t_ns: NDArray[np.int64]) -> dict[str, Scatter]:
    """Measure how sharp the surroundings are under several poses, on the same pairs of sweeps.

    Parameters
    ----------
    log : Log
    lidar : str
    tracks : mapping of str to PoseTrack
    t_ns : (P,) int64
        Stamps of the sweeps to choose from, two at least.
    """
    library, stream_t_ns = load_small_gicp(), log.streams[lidar].t_ns
    apart_ns = min(round(APART_S * NS_PER_S), int(t_ns[-1] - t_ns[0]) // 2)
    starts = np.unique(np.linspace(t_ns[0], t_ns[-1] - apart_ns, PAIRS).astype(np.int64))
    first = np.unique(np.minimum(nearest_index(t_ns, starts), len(t_ns) - 2))
    second = np.maximum(nearest_index(t_ns, t_ns[first] + apart_ns), first + 1)
    index = nearest_index(stream_t_ns, t_ns)
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in tracks}
    for i, j in zip(first.tolist(), second.tolist()):
        sweeps = [read_ego_sweep(log, lidar, int(index[k])) for k in (i, i + 1, j)]
        for name, track in tracks.items():
            found[name].append(_distances(library, sweeps, track))
    table = {name: np.array(rows).reshape(-1, 2) for name, rows in found.items()}
    usable = np.isfinite(np.stack(list(table.values()))).all(axis=0)
    apart_s = float(np.median(t_ns[second] - t_ns[first])) / NS_PER_S
    columns = {name: np.where(usable, rows, np.nan) for name, rows in table.items()}
    return {name: Scatter(rows[:, 0], rows[:, 1], apart_s) for name, rows in columns.items()}


def _distances(library: ModuleType, sweeps: list[EgoSweep | None], track: PoseTrack) -> tuple[float, float]:
    """Measure a sweep against the next one and against one seconds later: RMS distances, m."""
    at, *others = [None if sweep is None else _placed(sweep, track) for sweep in sweeps]
    if at is None:
        return np.nan, np.nan
    map_T_ego, xyz = at
    target, tree = library.preprocess_points(xyz, VOXEL_M, NEIGHBORS, 1)
    points = np.array(target.points())[:, :3]
    out = []
    for other in others:
        if other is None:
            out.append(np.nan)
            continue
        source, _ = library.preprocess_points(other[1], VOXEL_M, NEIGHBORS, 1)
        first_T_other = inverse(map_T_ego) @ other[0]
        normals = np.array(source.normals())[:, :3] @ first_T_other[:3, :3].T
        moved = apply(first_T_other, np.array(source.points())[:, :3])
        out.append(_surface_distance(tree, points, moved, normals))
    return out[0], out[1]


def _placed(sweep: EgoSweep, track: PoseTrack) -> tuple[Array, Array] | None:
    """Return the pose (4, 4) of a sweep and its points (N, 3) in the ego's frame, compensated by the same poses."""
    pose, known = track.at(sweep.t_ref_ns)
    if not known[0] or len(sweep.xyz_m) < NEIGHBORS:
        return None
    if sweep.t_ns is None:
        return pose[0], sweep.xyz_m
    ref_T_map = inverse(pose[0])
    moved = move_points(sweep.xyz_m, sweep.t_ns, lambda t: (ref_T_map @ track.at(t)[0], track.at(t)[1]))
    return None if moved is None else (pose[0], moved)


def _surface_distance(tree: object, target: Array, points: Array, normals: Array) -> float:
    """Compute the RMS distance, m, from points (N, 3) on upright surfaces with normals (N, 3) to their nearest targets.

    Half of the mean square is of surfaces that face along x, half of those along y; NaN with too few of both.
    """
    upright = (np.abs(normals[:, 2]) < MAX_NORMAL_Z) & (np.hypot(points[:, 0], points[:, 1]) < MAX_REACH_M)
    points, normals = points[upright], normals[upright]
    if len(points) == 0:
        return np.nan
    index, squared = tree.batch_nearest_neighbor_search(points)  # type: ignore[attr-defined]  # small_gicp has no types
    near = np.array(squared) < MATCH_WITHIN_M**2
    points, normals, nearest = points[near], normals[near], target[np.array(index)[near]]
    distance = np.minimum(np.abs(np.einsum("nj,nj->n", nearest - points, normals)), MAX_DISTANCE_M)
    squares = [
        float(np.mean(distance[facing] ** 2))
        for axis in range(2)
        if (facing := np.abs(normals[:, axis]) > MIN_FACING).sum() >= MIN_POINTS_FACING
    ]
    return float(np.sqrt(np.mean(squares))) if squares else np.nan
