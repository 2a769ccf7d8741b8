"""Plane pieces of surfaces in a sweep, and the motion between two sweeps that lays them onto each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from log2sim.calibration.twists import exp_of
from log2sim.geometry import Array, apply, inverse

# Points farther away are too sparse to lie next to each other in sweeps from two places.
MAX_REACH_M = 60.0
VOXEL_M, NEIGHBORS = 0.4, 10
# A piece of a plane is thin (RMS over its points, range noise and all) and no line, as the points of one ring are.
MAX_THICKNESS_M, MIN_WIDTH_M = 0.06, 0.1
# Ground, walls across and walls along count the same, however many points each of them has.
MAX_FACING, MAX_TRIED = 300, 3000
MIN_NORMAL_Z = 0.8
MIN_PIECES = 150
# Matches within a meter at first, since 3 degrees are 1 m after 20 m of driving; then within what noise and edges leave.
MATCH_WITHIN_M = (2.0, 1.0, 0.5, 0.3, 0.3)
MIN_SCALE_M = 0.01
MAD_TO_SIGMA = 1.4826
# Pieces so many standard deviations off count half.
CAUCHY = 2.0
MIN_OVERLAP = 0.3
# A direction that no surface holds stays where it was guessed: information of a guess that is right to 0.5 m and 3 degrees.
GUESS_SIGMA = np.array([0.5, 0.5, 0.5, 0.05, 0.05, 0.05])
# Points on one surface err together, by the incidence of the beam and the shape of the wall: variance over that of independent
# points, measured in synthetic streets with exact poses.
CORRELATION = 20.0
# Pieces that move or are matched with others by mistake decide where few hold a direction: so many pieces count half. A turn
# moves pieces at this distance as much as a translation does.
FEW_PIECES, LEVER_M = 30.0, 20.0


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Pieces of planes of one sweep.

    Attributes
    ----------
    xyz_m, normals : (N, 3) float64, m and unit vectors
        Middles of pieces of planes and their normals: as many that face up, forward and sideways, if there are.
    tree : cKDTree
    middles : (V, 3) float64, m
        Of all voxels with points, those of `tree`.
    """

    xyz_m: Array
    normals: Array
    tree: cKDTree
    middles: Array


@dataclass(frozen=True, eq=False)
class Registration:
    """The motion between two sweeps.

    Attributes
    ----------
    first_T_second : (4, 4) float64
    covariance : (6, 6) float64
        Of a twist (m, rad) of the second sweep in its own frame.
    overlap : float
        Share of the pieces of planes that have a match.
    """

    first_T_second: Array
    covariance: Array
    overlap: float


def surfaces_of(xyz_m: Array) -> Surfaces | None:
    """Find the pieces of planes among points (N, 3), m; None with too few."""
    near = xyz_m[np.einsum("nj,nj->n", xyz_m, xyz_m) < MAX_REACH_M**2]
    middles = _thin(near)
    if len(middles) < MIN_PIECES:
        return None
    # Made in a third of the time, and asked as fast; what it finds is the same.
    tree = cKDTree(middles, balanced_tree=False, compact_nodes=False)
    tried = middles[:: -(-len(middles) // MAX_TRIED)]
    _, index = tree.query(tried, k=NEIGHBORS)
    around = middles[index]
    off = around - around.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(off.transpose(0, 2, 1) @ off / NEIGHBORS)
    plane = (spread[:, 0] < MAX_THICKNESS_M**2) & (spread[:, 1] > MIN_WIDTH_M**2) & (spread[:, 1] > 9 * spread[:, 0])
    normals = np.where(plane[:, None], axes[:, :, 0], np.nan)
    chosen = _choose(normals)
    return Surfaces(tried[chosen], normals[chosen], tree, middles) if len(chosen) >= MIN_PIECES else None


def _thin(xyz_m: Array) -> Array:
    """Replace the points (N, 3) of each voxel by their mean."""
    cell = np.floor(xyz_m / VOXEL_M).astype(np.int64) + (1 << 20)
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    _, place, count = np.unique(key, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(place, xyz_m[:, j]) / count for j in range(3)], axis=1)


def _choose(normals: Array) -> Array:
    """Choose rows (K,) of planes, `MAX_FACING` at most that face up, forward, and sideways."""
    plane, size = np.isfinite(normals[:, 0]), np.abs(normals)
    up = plane & (size[:, 2] > MIN_NORMAL_Z)
    forward = plane & ~up & (size[:, 0] > size[:, 1])
    rows = []
    for facing in (up, forward, plane & ~up & ~forward):
        found = np.flatnonzero(facing)
        rows.append(found[np.linspace(0, len(found) - 1, min(MAX_FACING, len(found))).astype(np.int64)])
    return np.concatenate(rows)


def register(first: Surfaces, second: Surfaces, guess: Array) -> Registration | None:
    """Find the motion (4, 4) from a second sweep's frame to the first one's, from a guess; None where they show too little in common.

    Notes
    -----
    Point-to-plane ICP (Chen, Medioni, IVC 1992) with the normals of the first sweep and Cauchy weights.
    """
    pose = guess
    match: _Match | None = None
    for within_m in MATCH_WITHIN_M:
        match = _match(first, second, inverse(pose), within_m)
        if match is None:
            return None
        step = np.asarray(np.linalg.solve(match.information + np.diag(GUESS_SIGMA**-2.0), -match.gradient), np.float64)
        pose = np.asarray(pose @ exp_of(step), dtype=np.float64)
    if match is None or match.count < MIN_OVERLAP * len(first.xyz_m):
        return None
    return Registration(pose, _covariance(match.information, match.scale_m), match.count / len(first.xyz_m))


@dataclass(frozen=True, eq=False)
class _Match:
    """Pieces of one sweep beside points of another: how many, how far apart (robust RMS), and information about a twist."""

    count: int
    scale_m: float
    information: Array
    gradient: Array


def _match(first: Surfaces, second: Surfaces, second_T_first: Array, within_m: float) -> _Match | None:
    """Match pieces of the first sweep with points of the second one; None with too few."""
    at, normals = apply(second_T_first, first.xyz_m), first.normals @ second_T_first[:3, :3].T
    away, index = second.tree.query(at, distance_upper_bound=within_m)
    found = np.flatnonzero(np.isfinite(away))
    if len(found) < MIN_PIECES // 2:
        return None
    (x, y, z), (u, v, w) = second.middles[index[found]].T, normals[found].T
    residual = u * (x - at[found, 0]) + v * (y - at[found, 1]) + w * (z - at[found, 2])
    scale = max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), MIN_SCALE_M)
    jacobian = np.stack([u, v, w, y * w - z * v, z * u - x * w, x * v - y * u])
    weighted = jacobian / (scale**2 + (residual / CAUCHY) ** 2)
    return _Match(len(found), scale, weighted @ jacobian.T, weighted @ residual)


def _covariance(information: Array, scale_m: float) -> Array:
    """Compute the covariance (6, 6) of a twist from the information of independent points, of which a few must not decide."""
    length = np.diag([1.0, 1.0, 1.0, 1 / LEVER_M, 1 / LEVER_M, 1 / LEVER_M])
    pieces, directions = np.linalg.eigh(scale_m**2 * length @ information @ length)
    pieces = np.maximum(pieces, 0.0)
    trusted = (directions * (pieces**2 / (pieces + FEW_PIECES) / (CORRELATION * scale_m**2))) @ directions.T
    back = np.linalg.inv(length)
    return np.asarray(np.linalg.inv(back @ trusted @ back + np.diag(GUESS_SIGMA**-2.0)))
