"""Poses of the ego refined: sweeps from places of its path are registered to each other, all together.

Poses of a log follow GNSS: over seconds some drift by decimeters, which smears what stands and draws markings several times.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree

from log2sim.datatypes import Log, Sweep
from log2sim.geometry import NS_PER_S, Array, PoseTrack, inverse
from log2sim.localization.odometry import densest_lidar, is_during
from log2sim.localization.surfaces import (
    LEVER_M,
    Registration,
    Surfaces,
    adjoint_of,
    exp_of,
    log_of,
    register,
    surfaces_of_sweep,
)
from log2sim.perception.frames import work_ahead
from log2sim.perception.records import RecordSource

# Corrections between keyframes are interpolated: so many cover braking and curves of a short log, and in a long one they are
# so near to each other that errors of GNSS last from one to the next.
SHORT_LOG_KEYFRAMES, MAX_SPACING_S = 30, 1.0
# An ego that stands has one pose.
MIN_WAY_M = 0.5
# Each is registered to those before it at these distances in their order: near ones are precise, far ones hold the drift.
LAGS = (1, 3, 9, 27)
MIN_KEYFRAMES = 3
# What poses of GNSS with an IMU are off by: a weak prior that leaves the middle of the log where it is, and what they drift by
# over a second, which holds the directions that surfaces do not.
PRIOR_SIGMA = np.array([0.5, 0.5, 0.5, 0.02, 0.02, 0.02])
DRIFT_SIGMA = np.array([0.05, 0.05, 0.05, 0.0025, 0.0025, 0.0025])
# Registrations that are this many standard deviations off count half.
CAUCHY = 3.0
# Directions that a registration tells less well than this, at the distance of usual surfaces, are those that no surface holds.
MAX_SIGMA_M = 0.1
MAX_SLIDE_M = 0.1
ROUNDS = 5


Link = tuple[int, int, Registration]  # of the second one of two keyframes to the first


def refine_poses(log: Log, during_ns: tuple[int, int] | None = None, *, every_sweep: bool = False) -> PoseTrack | None:
    """Return poses of the ego by which surfaces in the sweeps of a time lie on each other.

    Corrections of keyframes are interpolated, which takes drift out; with `every_sweep`, where all sweeps are keyframes, pitch
    and roll lose their jitter, too. Memory does not grow with the log: surfaces of the last `max(LAGS)` keyframes are kept.

    None without LiDAR on the ego, where the ego stands, and with too few sweeps.
    """
    lidar = densest_lidar(log)
    if log.ego is None or lidar is None:
        return None
    chosen, records = _choose(log, lidar, during_ns, every_sweep), RecordSource(log)
    t_ns, poses = list[int](), list[Array]()

    def surfaces_at(index: int) -> tuple[int, Array, Surfaces] | None:
        sweep: Sweep | None = records.get(lidar, index)
        return None if sweep is None else surfaces_of_sweep(log, lidar, sweep)

    def neighbors() -> Iterator[list[tuple[int, int, Surfaces, Surfaces]]]:
        recent = deque[Surfaces](maxlen=max(LAGS) + 1)
        for stamp_ns, pose, surfaces in filter(None, work_ahead(surfaces_at, chosen.tolist())):
            j = len(poses)
            t_ns.append(stamp_ns)
            poses.append(pose)
            recent.append(surfaces)
            yield [(j - lag, j, recent[-1 - lag], surfaces) for lag in LAGS if lag <= j]

    def registered(pairs: list[tuple[int, int, Surfaces, Surfaces]]) -> list[Link]:
        all_links = ((i, j, register(first, second, inverse(poses[i]) @ poses[j])) for i, j, first, second in pairs)
        return [(i, j, registration) for i, j, registration in all_links if registration is not None]

    links = [link for some in work_ahead(registered, neighbors()) for link in some]
    if len(poses) < MIN_KEYFRAMES:
        return None
    stamps_ns = np.array(t_ns)
    return corrected(log.ego, stamps_ns, solve_twists(stamps_ns, np.array(poses), links))


def place_as_given(points_m: Array, refined: Log, given: Log) -> Array:
    """Return points (N, 3), m, of a map made by refined poses where they lie by the given poses, which agents have.

    Each moves with the ego as it was nearest to it, so lanes and the agents on them stay together.
    """
    if refined.ego is None or given.ego is None or refined.ego is given.ego or not len(points_m):
        return points_m
    nearest = cKDTree(refined.ego.map_T_ego[:, :2, 3]).query(points_m[:, :2])[1]
    given_T_refined = given.ego.map_T_ego @ inverse(refined.ego.map_T_ego)
    rotation, translation = given_T_refined[nearest, :3, :3], given_T_refined[nearest, :3, 3]
    return np.asarray(np.einsum("nij,nj->ni", rotation, points_m) + translation)


def _told(covariance: Array, measured: Array) -> Array | None:
    """Return the information (6, 6) of a registration along the directions that its surfaces hold, none along others.

    Without walls nothing holds a sweep along the road, and what noise says of it must not add up over many registrations. One that
    slid far along such a direction, with a twist `measured` (6,), is of other surfaces than it began with: None.
    """
    length = np.diag([1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M])
    squares, directions = np.linalg.eigh(length @ covariance @ length)
    held = squares < MAX_SIGMA_M**2
    if np.linalg.norm(directions[:, ~held].T @ length @ measured) > MAX_SLIDE_M:
        return None
    known = np.where(held, 1 / np.maximum(squares, 1e-12), 0.0)
    return np.asarray(length @ (directions * known) @ directions.T @ length)


def _choose(log: Log, lidar: str, during_ns: tuple[int, int] | None, every_sweep: bool) -> NDArray[np.int64]:
    """Choose all sweeps of an ego that moves, or some evenly by its way and by its time: poses err along both."""
    t_ns = log.streams[lidar].t_ns
    pose, known = log.map_T_sensor(lidar, t_ns)
    known &= is_during(t_ns, during_ns)
    usable = np.flatnonzero(known).astype(np.int64)
    if len(usable) <= MIN_KEYFRAMES:
        return usable
    moved = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pose[usable, :3, 3], axis=0), axis=1))])
    span_s = (t_ns[usable[-1]] - t_ns[usable[0]]) / NS_PER_S
    if moved[-1] < MIN_WAY_M:
        return usable[:0]
    if every_sweep:
        return usable
    since = (t_ns[usable] - t_ns[usable[0]]) / float(t_ns[usable[-1]] - t_ns[usable[0]])
    progress = (moved / moved[-1] + since) / 2
    count = min(max(SHORT_LOG_KEYFRAMES, round(span_s / MAX_SPACING_S)), len(usable))
    return usable[np.unique(np.searchsorted(progress, np.linspace(0, 1, count) - 1e-9))]


def corrected(track: PoseTrack, t_ns: NDArray[np.int64], twists: Array) -> PoseTrack:
    """Move the poses of a track by twists (K, 6) of the ego's own frame at stamps (K,), interpolated; the ends are held."""
    since = (track.t_ns - t_ns[0]).astype(np.float64)
    at = (t_ns - t_ns[0]).astype(np.float64)
    between = np.stack([np.interp(since, at, twists[:, k]) for k in range(6)], axis=1)
    return replace(track, map_T_ego=track.map_T_ego @ np.stack([exp_of(twist) for twist in between]))


def solve_twists(t_ns: NDArray[np.int64], map_T_ego: Array, links: Sequence[Link]) -> Array:
    """Solve for the twists (K, 6), m and rad, of keyframes at stamps (K,) and poses (K, 4, 4), in their own frames, that fit all registrations best.

    With poses P and a registration M of j to i, exp(-x_i) G exp(x_j) = M with G = P_i^-1 P_j, which is linear in small
    twists: x_j - Ad(G^-1) x_i = log(G^-1 M). Cauchy weights on the Mahalanobis distance of each registration.
    """
    count = len(t_ns)
    drift = DRIFT_SIGMA**-2.0 * NS_PER_S / np.diff(t_ns)[:, None]
    prior = np.tile(PRIOR_SIGMA**-2.0, (count, 1))
    prior[:-1] += drift
    prior[1:] += drift
    every, diagonal = np.arange(count), np.eye(6)
    fixed = [(every, every, prior[:, :, None] * diagonal), (every[1:], every[:-1], -drift[:, :, None] * diagonal)]
    equations = []
    for first, second, registration in links:
        j_T_i = inverse(map_T_ego[second]) @ map_T_ego[first]
        twist = log_of(j_T_i @ registration.first_T_second)
        information = _told(registration.covariance, twist)
        if information is not None:
            equations.append((first, second, -adjoint_of(j_T_i), twist, information))
    twists = np.zeros((count, 6))
    if not equations:
        return twists
    i, j, of_i, measured, weight = (np.array(column) for column in zip(*equations, strict=True))
    # Lower triangle of the normal equations, by diagonals: keyframes are tied to those at most `max(LAGS)` before them.
    offset = np.arange(6)
    for _ in range(ROUNDS):
        residual = twists[j] + np.einsum("nij,nj->ni", of_i, twists[i]) - measured
        square = np.einsum("ni,nij,nj->n", residual, weight, residual)
        scaled = weight / (1 + square / (6 * CAUCHY**2))[:, None, None]
        to_i = of_i.transpose(0, 2, 1) @ scaled
        blocks = [*fixed, (j, j, scaled), (i, i, to_i @ of_i), (j, i, scaled @ of_i)]
        band, right = np.zeros((6 * int((j - i).max() + 1), 6 * count)), np.zeros((count, 6))
        for of_row, of_column, block in blocks:
            row, column = np.broadcast_arrays(
                6 * of_row[:, None, None] + offset[:, None], 6 * of_column[:, None, None] + offset
            )
            lower = row >= column
            np.add.at(band, ((row - column)[lower], column[lower]), block[lower])
        np.add.at(right, j, np.einsum("nij,nj->ni", scaled, measured))
        np.add.at(right, i, np.einsum("nij,nj->ni", to_i, measured))
        twists = solveh_banded(band, right.ravel(), lower=True).reshape(count, 6)
    return np.asarray(twists)
