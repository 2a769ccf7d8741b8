"""Poses of the ego refined: sweeps from places of its path are registered to each other, all together.

Poses of a log follow GNSS: over seconds some drift by decimeters, which smears what stands and draws markings several times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
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

# Poses between sweeps that are registered are interpolated: so many cover braking and curves of a log, unless they are farther
# apart than errors of GNSS last.
MAX_KEYFRAMES, MAX_SPACING_S = 30, 3.0
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


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A sweep that is registered."""

    t_ns: int
    map_T_ego: Array  # (4, 4)
    surfaces: Surfaces


def refine_poses(log: Log, during_ns: tuple[int, int] | None = None) -> PoseTrack | None:
    """Return poses of the ego by which surfaces in the sweeps of a time lie on each other.

    None without LiDAR on the ego, with too few sweeps, or over too long a time.
    """
    lidar = densest_lidar(log)
    if log.ego is None or lidar is None:
        return None
    chosen = _choose(log, lidar, during_ns)
    records = RecordSource(log)

    def surfaces_at(index: int) -> tuple[int, Array, Surfaces] | None:
        sweep: Sweep | None = records.get(lidar, index)
        return None if sweep is None else surfaces_of_sweep(log, lidar, sweep)

    keyframes = [Keyframe(*found) for found in work_ahead(surfaces_at, chosen.tolist()) if found is not None]
    if len(keyframes) < MIN_KEYFRAMES:
        return None
    pairs = [(j - lag, j) for j in range(len(keyframes)) for lag in LAGS if j >= lag]

    def registered(pair: tuple[int, int]) -> Registration | None:
        first, second = (keyframes[k] for k in pair)
        return register(first.surfaces, second.surfaces, inverse(first.map_T_ego) @ second.map_T_ego)

    found = work_ahead(registered, pairs)
    links = [(*pair, registration) for pair, registration in zip(pairs, found, strict=True) if registration is not None]
    twists = solve_twists(keyframes, links)
    return corrected(log.ego, np.array([k.t_ns for k in keyframes]), twists)


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


def _choose(log: Log, lidar: str, during_ns: tuple[int, int] | None) -> NDArray[np.int64]:
    """Choose sweeps evenly by the way and by the time of the ego: poses err along both."""
    t_ns = log.streams[lidar].t_ns
    pose, known = log.map_T_sensor(lidar, t_ns)
    known &= is_during(t_ns, during_ns)
    usable = np.flatnonzero(known)
    if len(usable) <= MIN_KEYFRAMES:
        return usable.astype(np.int64)
    moved = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pose[usable, :3, 3], axis=0), axis=1))])
    span_s = (t_ns[usable[-1]] - t_ns[usable[0]]) / NS_PER_S
    if moved[-1] < MIN_WAY_M or span_s > MAX_KEYFRAMES * MAX_SPACING_S:
        return usable[:0].astype(np.int64)
    since = (t_ns[usable] - t_ns[usable[0]]) / float(t_ns[usable[-1]] - t_ns[usable[0]])
    progress = (moved / moved[-1] + since) / 2
    at = np.linspace(0, 1, min(MAX_KEYFRAMES, len(usable)))
    return usable[np.unique(np.searchsorted(progress, at - 1e-9))].astype(np.int64)


def corrected(track: PoseTrack, t_ns: NDArray[np.int64], twists: Array) -> PoseTrack:
    """Move the poses of a track by twists (K, 6) of the ego's own frame at stamps (K,), interpolated; the ends are held."""
    since = (track.t_ns - t_ns[0]).astype(np.float64)
    at = (t_ns - t_ns[0]).astype(np.float64)
    between = np.stack([np.interp(since, at, twists[:, k]) for k in range(6)], axis=1)
    return replace(track, map_T_ego=track.map_T_ego @ np.stack([exp_of(twist) for twist in between]))


def solve_twists(keyframes: list[Keyframe], links: list[tuple[int, int, Registration]]) -> Array:
    """Solve for the twists (K, 6), m and rad, of keyframes in their own frames that fit all registrations best.

    With poses P and a registration M of j to i, exp(-x_i) G exp(x_j) = M with G = P_i^-1 P_j, which is linear in small
    twists: x_j - Ad(G^-1) x_i = log(G^-1 M). Cauchy weights on the Mahalanobis distance of each registration.
    """
    count = 6 * len(keyframes)
    twists: Array = np.zeros(count)
    prior = np.diag(np.tile(PRIOR_SIGMA**-2.0, len(keyframes)))
    for k, (one, other) in enumerate(pairwise(keyframes)):
        drift = np.diag(DRIFT_SIGMA**-2.0 * NS_PER_S / (other.t_ns - one.t_ns))
        rows = slice(6 * k, 6 * k + 12)
        prior[rows, rows] += np.block([[drift, -drift], [-drift, drift]])
    equations = []
    for i, j, registration in links:
        j_T_i = inverse(keyframes[j].map_T_ego) @ keyframes[i].map_T_ego
        measured = log_of(j_T_i @ registration.first_T_second)
        information = _told(registration.covariance, measured)
        if information is not None:
            equations.append((6 * i, 6 * j, -adjoint_of(j_T_i), measured, information))
    for _ in range(ROUNDS):
        normal: Array = prior.copy()
        right: Array = np.zeros(count)
        for i, j, of_i, measured, information in equations:
            residual = twists[j : j + 6] + of_i @ twists[i : i + 6] - measured
            weight = 1 / (1 + float(residual @ information @ residual) / (6 * CAUCHY**2))
            scaled = weight * information
            normal[j : j + 6, j : j + 6] += scaled
            normal[i : i + 6, i : i + 6] += of_i.T @ scaled @ of_i
            normal[i : i + 6, j : j + 6] += of_i.T @ scaled
            normal[j : j + 6, i : i + 6] += scaled @ of_i
            right[j : j + 6] += scaled @ measured
            right[i : i + 6] += of_i.T @ scaled @ measured
        twists = np.asarray(np.linalg.solve(normal, right))
    return twists.reshape(-1, 6)
