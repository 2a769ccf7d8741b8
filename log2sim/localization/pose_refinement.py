"""Poses of the ego refined: sweeps from places of its path are registered to each other, all together.

Poses of a log follow GNSS: over seconds some drift by decimeters, which smears what stands and draws markings several times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Sweep
from log2sim.geometry import NS_PER_S, Array, PoseTrack, inverse
from log2sim.localization.odometry import densest_lidar
from log2sim.localization.replaced import replace_poses
from log2sim.localization.surfaces import Registration, Surfaces, adjoint_of, exp_of, log_of, register, surfaces_of
from log2sim.perception.frames import RecordReader, work_ahead
from log2sim.perception.lidar.cloud import sweep_to_map

# Poses between sweeps that are registered are interpolated: so many cover braking and curves of a log, unless they are farther
# apart than errors of GNSS last.
MAX_KEYFRAMES, MAX_SPACING_S = 30, 3.0
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
# Registrations of all sweeps err by up to 0.04 m together where poses are exact (RMS, in simulated and recorded streets): given
# poses are replaced where they are off by more for certain.
MIN_SHIFT_M = 0.1
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


def refine_poses(log: Log, during_ns: tuple[int, int] | None = None) -> Log:
    """Return the log with poses by which surfaces lie on each other, by the sweeps between two stamps.

    The log itself without LiDAR on the ego, with too few sweeps, over too long a time, or where its poses are no worse than that.
    """
    lidar = densest_lidar(log)
    if log.ego is None or lidar is None:
        return log
    reader = RecordReader(log)
    chosen = _choose(log, lidar, during_ns)
    made = work_ahead(lambda index: _keyframe(log, reader, lidar, index), chosen.tolist())
    keyframes = [keyframe for keyframe in made if keyframe is not None]
    if len(keyframes) < MIN_KEYFRAMES:
        return log
    pairs = [(j - lag, j) for j in range(len(keyframes)) for lag in LAGS if j >= lag]
    found = work_ahead(lambda pair: _registered(keyframes[pair[0]], keyframes[pair[1]]), pairs)
    links = [(*pair, registration) for pair, registration in zip(pairs, found, strict=True) if registration is not None]
    twists = solve_twists(keyframes, links)
    if np.sqrt(np.mean(np.sum(twists[:, :3] ** 2, axis=1))) < MIN_SHIFT_M:
        return log
    return replace_poses(log, corrected(log.ego, np.array([k.t_ns for k in keyframes]), twists))


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
    if during_ns is not None:
        known &= (t_ns >= during_ns[0]) & (t_ns <= during_ns[1])
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
