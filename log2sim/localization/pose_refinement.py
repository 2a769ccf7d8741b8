"""Poses of the ego refined for a map: sweeps from places of its path are registered to each other, all together.

Poses of a log follow GNSS: over seconds they drift by centimeters to decimeters, which would draw every marking several times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Scenario, Sweep
from log2sim.geometry import NS_PER_S, Array, PoseTrack, inverse
from log2sim.localization.odometry import densest_lidar
from log2sim.localization.replaced import replace_poses
from log2sim.localization.surfaces import Registration, Surfaces, adjoint_of, exp_of, log_of, register, surfaces_of
from log2sim.perception.frames import RecordReader, work_ahead
from log2sim.perception.lidar.cloud import sweep_to_map

# Poses between sweeps that are registered are interpolated: so many cover braking and curves of a short log, and a long one costs
# no more than that.
MAX_KEYFRAMES = 30
# An ego that stands has one pose.
MIN_WAY_M = 0.5
# Each is registered to those before it at these distances in their order: near ones are precise, far ones hold the drift.
LAGS = (1, 3, 9, 27)
MIN_KEYFRAMES = 3
# What poses of GNSS are off by: a weak prior that leaves the middle of the log where it is.
PRIOR_SIGMA = np.array([0.5, 0.5, 0.5, 0.02, 0.02, 0.02])
# Registrations that are this many standard deviations off count half.
CAUCHY = 3.0
# Directions that a registration tells less well than this, at the distance of usual surfaces, are those that no surface holds.
MAX_SIGMA_M, LEVER_M = 0.1, 20.0
MAX_SLIDE_M = 0.1
ROUNDS = 5
# Points of a sweep that are looked at.
MAX_POINTS = 60_000
MIN_RANGE_M = 2.5


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A sweep that is registered.

    Attributes
    ----------
    map_T_ego : (4, 4) float64
    """

    t_ns: int
    map_T_ego: Array
    surfaces: Surfaces


def refine_poses(log: Log, scenario: Scenario, reader: RecordReader) -> Log:
    """Return the log with poses by which surfaces lie on each other; the log itself without LiDAR or with too few sweeps."""
    lidar = densest_lidar(log)
    if log.ego is None or lidar is None:
        return log
    chosen = _choose(log, scenario, lidar)
    made = work_ahead(lambda index: _keyframe(log, reader, lidar, index), chosen.tolist())
    keyframes = [keyframe for keyframe in made if keyframe is not None]
    if len(keyframes) < MIN_KEYFRAMES:
        return log
    pairs = [(j - lag, j) for j in range(len(keyframes)) for lag in LAGS if j >= lag]
    found = work_ahead(lambda pair: _registered(keyframes[pair[0]], keyframes[pair[1]]), pairs)
    links = [(*pair, registration) for pair, registration in zip(pairs, found, strict=True) if registration is not None]
    twists = solve_twists(keyframes, links)
    return replace_poses(log, corrected(log.ego, np.array([k.t_ns for k in keyframes]), twists))


def place_as_given(points_m: Array, refined: Log, given: Log) -> Array:
    """Return points (N, 3), m, of a map made by refined poses where they lie by the given poses, which agents have.

    Each moves with the ego as it was nearest to it, so lanes and the agents on them stay together.
    """
    if refined.ego is None or given.ego is None or refined.ego is given.ego or not len(points_m):
        return points_m
    from scipy.spatial import cKDTree

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


def _choose(log: Log, scenario: Scenario, lidar: str) -> NDArray[np.int64]:
    """Choose sweeps evenly by the way and by the time of the ego: poses err along both."""
    t_ns = log.streams[lidar].t_ns
    end_ns = scenario.t0_ns + round(scenario.duration_s * NS_PER_S)
    pose, known = log.map_T_sensor(lidar, t_ns)
    usable = np.flatnonzero(known & (t_ns >= scenario.t0_ns) & (t_ns <= end_ns))
    if len(usable) <= MIN_KEYFRAMES:
        return usable.astype(np.int64)
    moved = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pose[usable, :3, 3], axis=0), axis=1))])
    if moved[-1] < MIN_WAY_M:
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

    Notes
    -----
    With poses P and a registration M of j to i, exp(-x_i) G exp(x_j) = M with G = P_i^-1 P_j, which is linear in small
    twists: x_j - Ad(G^-1) x_i = log(G^-1 M). Cauchy weights on the Mahalanobis distance of each registration.
    """
    count = 6 * len(keyframes)
    twists: Array = np.zeros(count)
    prior = np.diag(np.tile(PRIOR_SIGMA**-2.0, len(keyframes)))
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


def _keyframe(log: Log, reader: RecordReader, lidar: str, index: int) -> Keyframe | None:
    """Read a sweep and find its surfaces, in the ego's frame at its stamp; None where it has too few."""
    sweep = reader.get(lidar, index)
    t_ns = int(log.streams[lidar].t_ns[index])
    mapped = None if sweep is None else sweep_to_map(log, lidar, _thinned(sweep), compensate=True)
    assert log.ego is not None
    pose, known = log.ego.at(t_ns)
    if mapped is None or not known[0] or reader.watch.lidars[lidar].repeated.get(t_ns, False):
        return None
    local = (mapped[0] - pose[0, :3, 3]) @ pose[0, :3, :3]
    # The ego itself moves with every sweep.
    surfaces = surfaces_of(local[np.hypot(local[:, 0], local[:, 1]) > MIN_RANGE_M])
    return None if surfaces is None else Keyframe(t_ns, pose[0], surfaces)


def _thinned(sweep: Sweep) -> Sweep:
    """Return every second, third ... point of a sweep, as far as there are too many."""
    step = max(len(sweep.xyz_m) // MAX_POINTS, 1)
    return replace(sweep, xyz_m=sweep.xyz_m[::step], t_ns=None if sweep.t_ns is None else sweep.t_ns[::step])


def _registered(first: Keyframe, second: Keyframe) -> Registration | None:
    return register(first.surfaces, second.surfaces, inverse(first.map_T_ego) @ second.map_T_ego)
