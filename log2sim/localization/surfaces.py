"""Plane pieces of surfaces in sweeps, pairs of sweeps, and the motion that lays one onto the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.datatypes import Log, Sweep
from log2sim.geometry import (
    NS_PER_S,
    Array,
    PoseTrack,
    apply,
    inverse,
    median,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
)
from log2sim.localization.odometry import MAX_POINTS, MIN_RANGE_M, is_during
from log2sim.perception.frames import work_ahead
from log2sim.perception.lidar.cloud import sweep_to_map
from log2sim.perception.records import RecordSource

# Velocities are those of a second: errors of GNSS and IMU make those of shorter times useless, and vehicles speed up and turn
# for longer.
MOTION_SPAN_NS = 500_000_000


def exp_of(twist: Array) -> Array:
    """Compute the transform (4, 4) of a twist (6,): the translation as it stands, and the rotation.

    The bend of the path, which the exponential map has, is of second order; `log_of` is the inverse.
    """
    angle = float(np.linalg.norm(twist[3:]))
    half = 0.5 * np.sinc(angle / (2 * np.pi))
    q = np.concatenate([[np.cos(angle / 2)], half * twist[3:]])
    return transform(rotation_from_quaternion(q), twist[:3])


def log_of(motion: Array) -> Array:
    """Compute the twists (..., 6) of transforms (..., 4, 4)."""
    q = quaternion_from_rotation(motion[..., :3, :3])
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    turned = sine > 1e-12
    factor = np.where(turned, 2 * np.arctan2(sine, q[..., :1]) / np.where(turned, sine, 1.0), 2.0)
    return np.concatenate([motion[..., :3, 3], factor * q[..., 1:]], axis=-1)


def cross_matrix(v: Array) -> Array:
    """Return the matrices (..., 3, 3) by which vectors (..., 3) are crossed with others."""
    out = np.zeros((*v.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., j, i], out[..., i, j] = v[..., k], -v[..., k]
    return out


def adjoint_of(dst_T_src: Array) -> Array:
    """Compute the matrices (..., 6, 6) that take twists in the frame `src` to those in `dst`, for transforms (..., 4, 4)."""
    rotation = dst_T_src[..., :3, :3]
    out = np.zeros((*dst_T_src.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., :3, 3:] = cross_matrix(dst_T_src[..., :3, 3]) @ rotation
    return out


def velocities_at(track: PoseTrack, t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
    """Compute how the ego moves at stamps (K,), by poses `MOTION_SPAN_NS` before and after, and whether these are known (K,).

    Velocities (K, 6), m/s and rad/s, are twists in the ego's frame.
    """
    (before, known), (at, is_known), (after, will_be_known) = (
        track.at(t_ns + shift) for shift in (-MOTION_SPAN_NS, 0, MOTION_SPAN_NS)
    )
    ego_T_map = inverse(at)
    velocity = (log_of(ego_T_map @ after) - log_of(ego_T_map @ before)) / (2 * MOTION_SPAN_NS / NS_PER_S)
    return velocity, known & is_known & will_be_known


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
    """Pieces of planes of one sweep."""

    # `xyz_m`, `normals`: (N, 3), m and unit vectors: middles of pieces of planes and their normals: as many that face
    # up, forward and sideways, if there are
    xyz_m: Array
    normals: Array
    tree: cKDTree
    middles: Array  # (V, 3), m: of all voxels with points, those of `tree`


@dataclass(frozen=True, eq=False)
class Registration:
    """The motion between two sweeps."""

    first_T_second: Array  # (4, 4)
    covariance: Array  # (6, 6): of a twist (m, rad) of the second sweep in its own frame
    overlap: float  # share of the pieces of planes that have a match


def surfaces_of(xyz_m: Array) -> Surfaces | None:
    """Find the pieces of planes among points (N, 3), m; None with too few."""
    near = xyz_m[np.einsum("nj,nj->n", xyz_m, xyz_m) < MAX_REACH_M**2]
    middles = thin(near, VOXEL_M)
    if len(middles) < MIN_PIECES:
        return None
    # Made in a third of the time, and asked as fast; what it finds is the same.
    tree = cKDTree(middles, balanced_tree=False, compact_nodes=False)
    tried = middles[:: -(-len(middles) // MAX_TRIED)]
    _, index = tree.query(tried, k=NEIGHBORS)
    _, _, axes, plane = fit_planes(middles[index])
    normals = np.where(plane[:, None], axes[:, :, 0], np.nan)
    chosen = _choose(normals)
    return Surfaces(tried[chosen], normals[chosen], tree, middles) if len(chosen) >= MIN_PIECES else None


def number_voxels(xyz_m: Array, voxel_m: float) -> NDArray[np.int64]:
    """Assign numbers (N,), from 0 without gaps, to the voxels of points (N, 3)."""
    cell = np.floor(xyz_m / voxel_m).astype(np.int64) + (1 << 20)
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    return np.asarray(np.unique(key, return_inverse=True)[1], dtype=np.int64)


def thin(points: Array, voxel_m: float) -> Array:
    """Replace the points (N, D), of which the first three columns are coordinates, of each voxel by their mean."""
    if len(points) == 0:
        return points
    place = number_voxels(points[:, :3], voxel_m)
    count = np.bincount(place)
    return np.stack([np.bincount(place, column) / count for column in points.T], axis=1)


def fit_planes(around: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Fit planes to neighborhoods (N, K, 3): middles, variances (N, 3) along axes (N, 3, 3), and which are pieces of planes."""
    middle = around.mean(axis=1)
    off = around - middle[:, None]
    spread, axes = np.linalg.eigh(off.transpose(0, 2, 1) @ off / around.shape[1])
    plane = (spread[:, 0] < MAX_THICKNESS_M**2) & (spread[:, 1] > MIN_WIDTH_M**2) & (spread[:, 1] > 9 * spread[:, 0])
    return middle, spread, axes, plane


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
    scale = max(MAD_TO_SIGMA * median(np.abs(residual)), MIN_SCALE_M)
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


# More sweeps make the result no better: the errors of the poses, which last for seconds, remain.
MAX_SWEEPS = 20
# Farther apart, sweeps miss how the ego changes its motion: of a long log, those of the parts in which it changes most are taken.
SPACING_S, MAX_SPACING_S, PARTS = 0.5, 1.0, 2
# Sweeps are compared with the next and with one of those after it: near ones show much in common, errors of far ones do not add up.
STEP = 4
MAX_APART_M = 40.0
# On a shorter way nothing shows that matters: errors of poses of centimeters are degrees of it.
MIN_PATH_M = 1.0
MIN_PAIRS = 8


@dataclass(frozen=True, eq=False)
class Pair:
    """Two of the sweeps, and the motion between them that their surfaces show."""

    first: int
    second: int
    found: Registration


@dataclass(frozen=True, eq=False)
class SweepPairs:
    """What the sweeps of a LiDAR show of the ego's motion."""

    track: PoseTrack  # the ego's poses
    sensor_m: Array  # (3,): where the LiDAR is in the ego's frame
    t_ns: NDArray[np.int64]  # (K,): stamps of the sweeps
    pairs: tuple[Pair, ...]


def pair_sweeps(
    log: Log, lidar: str, during_ns: tuple[int, int] | None, report: Callable[[int, int], None]
) -> SweepPairs | None:
    """Compare sweeps of a LiDAR on the ego with each other.

    None where the ego hardly moves, sweeps show too little, or points are given in the map, which hides clock and mount.
    """
    track = log.ego
    if track is None:
        return None
    records = RecordSource(log)

    def surfaces_at(i: int) -> tuple[bool, tuple[int, Array, Surfaces] | None]:
        """Whether the points of a sweep are given in the map, and its surfaces."""
        record = records.get(lidar, i)
        in_map = record is not None and record.frame == "map"
        return in_map, None if record is None or in_map else surfaces_of_sweep(log, lidar, record)

    chosen = choose_sweeps(track, log.streams[lidar].t_ns, during_ns).tolist()
    places, surfaces = [], []
    for done, (in_map, found) in enumerate(work_ahead(surfaces_at, chosen)):
        report(done, len(chosen))
        if in_map:
            return None
        if found is not None:
            places.append(found[0])
            surfaces.append(found[2])
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
    rows = np.flatnonzero(is_during(t_ns, during_ns))
    # Rows whose stamps are `SPACING_S` apart.
    slot = (t_ns[rows] - t_ns[rows[:1]]) // round(SPACING_S * NS_PER_S)
    spaced = rows[np.unique(slot, return_index=True)[1]]
    velocity, known = velocities_at(track, t_ns[spaced])
    spaced, velocity = spaced[known], velocity[known]
    if len(spaced) == 0 or np.linalg.norm(np.ptp(track.at(t_ns[spaced])[0][:, :3, 3], axis=0)) < MIN_PATH_M:
        return rows[:0]
    if len(spaced) * SPACING_S > MAX_SWEEPS * MAX_SPACING_S:
        # Runs of sweeps in which the velocity varies most, one after the other.
        size, parts = MAX_SWEEPS // PARTS, list[NDArray[np.intp]]()
        scaled = velocity * np.array([1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M])
        change = np.array([scaled[k : k + size].var(axis=0).sum() for k in range(len(spaced) - size + 1)])
        while len(parts) < PARTS and change.max() >= 0:
            k = int(np.argmax(change))
            parts.append(spaced[k : k + size])
            change[max(k - size + 1, 0) : k + size] = -1.0
        return np.sort(np.concatenate(parts))
    usable = rows[(rows >= spaced[0]) & (rows <= spaced[-1])]
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, MAX_SWEEPS).round().astype(np.int64))]
    return np.asarray(chosen[velocities_at(track, t_ns[chosen])[1]])


def surfaces_of_sweep(log: Log, lidar: str, sweep: Sweep) -> tuple[int, Array, Surfaces] | None:
    """Find the surfaces of a sweep with the motion of the ego by the log's poses taken out.

    Returns the stamp of the sweep, the pose (4, 4) of the ego at it, and the surfaces in the ego's frame there; None where no pose is
    known or there are too few.
    """
    stamp_ns = int(sweep.stamp_ns if sweep.compensated_ns is None else sweep.compensated_ns)
    mapped = sweep_to_map(log, lidar, sweep.thinned(MAX_POINTS), compensate=True)
    if log.ego is None or mapped is None:
        return None
    pose, known = log.ego.at(stamp_ns)
    xyz_m = apply(inverse(pose[0]), mapped[0])
    away = np.linalg.norm(xyz_m - log.lidars[lidar].mount_T_lidar[:3, 3], axis=1)
    surfaces = surfaces_of(xyz_m[away > MIN_RANGE_M]) if known[0] else None
    return None if surfaces is None else (stamp_ns, pose[0], surfaces)


def _compare(surfaces: list[Surfaces], map_T_ego: Array) -> list[Pair]:
    """Register sweeps with the next ones, and with those `STEP` later, from what the former have shown."""
    near: dict[int, Registration | None] = {}

    def compare(ends: tuple[int, int]) -> Registration | None:
        first, second = ends
        guess = inverse(map_T_ego[first]) @ map_T_ego[second]
        if np.linalg.norm(guess[:3, 3]) > MAX_APART_M:
            return None
        between = [found.first_T_second for k in range(first, second) if (found := near.get(k)) is not None]
        if len(between) == second - first:
            guess = reduce(np.matmul, between)
        return register(surfaces[first], surfaces[second], guess)

    pairs = []
    for step in (1, STEP):
        ends = [(i, i + step) for i in range(len(surfaces) - step)]
        found = list(work_ahead(compare, ends))
        pairs += [Pair(*of, one) for of, one in zip(ends, found) if one is not None]
        if step == 1:
            near.update(enumerate(found))
    return pairs
