"""Vehicles that stand for most of their track, but start or stop within it, recognized by their observed ends.

The center of a long vehicle wanders by meters while more or less of it is seen, and its mean velocity is small if it starts
late. Its ends, where they are observed, do neither.
"""

from __future__ import annotations

import numpy as np

from log2sim.agents.ends import Ends, ends_of
from log2sim.agents.motion_evidence import (
    PLACE_SIGMA_M,
    MotionPriorSigmas,
    Positions,
    marginal_likelihood,
    noise_of,
)
from log2sim.datatypes import GROUP_OF, TYPICAL_SIZE_M, Track
from log2sim.geometry import NS_PER_S, Array, wrap_angle
from log2sim.perception.box_completion import UNIFORM_SIGMA
from log2sim.perception.box_fitting import rotate
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS
from log2sim.tracking.motion import ACCELERATION_MPS2, FIRST_SPEED_MPS

# More measurements of a track are not looked at one by one; fewer of an end show no motion.
MAX_ROWS, MIN_ROWS = 60, 5
# Error of an observed end: rounded corners and a yaw that is a little wrong, as the view changes.
END_SIGMA_M = 0.25
# Times at which a vehicle may start or stop; a shorter motion may be a neighbor that joins its points for some ticks.
TIMES, MIN_MOTION_S = 24, 1.0
# One vehicle in fifty that seems to stand starts or stops; it is said to if that is e^3 = 20 times as likely.
STARTS_LOG, MIN_LOG_ODDS = float(np.log(0.02)), 3.0


def starts_or_stops(track: Track) -> bool:
    """Return whether a vehicle stands and then sets off, or comes to rest and then stands.

    Notes
    -----
    Compared are the marginal likelihoods of ends that stay and of ends that move with a constant acceleration from or until
    an unknown time, both together since the object is rigid. Errors of an end repeat while the view stays the same. An end
    that moves because more of the object comes into view moves alone.
    """
    group = GROUP_OF[track.category]
    m = track.measurements
    rows = np.flatnonzero(np.isfinite(m.yaw_rad) & [len(c) >= MIN_CLUSTER_POINTS for c in m.cluster])
    if group != "vehicle" or len(rows) < MIN_ROWS:
        return False
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_ROWS)).round().astype(np.intp))]
    yaw, yaw_sigma = _axis(m.yaw_rad[rows])
    turned_m = TYPICAL_SIZE_M[track.category][1] * yaw_sigma
    ends = ends_of(track, rows, np.full(len(rows), yaw), np.zeros((len(rows), 2)))
    origin = rotate(m.sensor_m[rows, :2] - m.center_m[rows[0], :2], -yaw)
    # Frames that share a sweep measure the same points at the same time.
    t = (m.t_ns[rows] - m.t_ns[rows[0]]) / NS_PER_S + 1e-4 * np.arange(len(rows))
    along, across = (_observed_ends(t, ends, origin, axis, turned_m) for axis in range(2))
    # A single end may be that of a neighbor that joins the points; ends that move across, too, are those of something else.
    return len(along) == 2 and _log_odds(along, group) + STARTS_LOG > MIN_LOG_ODDS and _log_odds(across, group) <= 0


def _axis(yaw_rad: Array) -> tuple[float, float]:
    """Return the length axis of most of the yaws (n,) of one vehicle, and their standard deviation up to quarter turns, in rad."""
    mean = float(np.angle(np.exp(4j * yaw_rad).sum())) / 4
    off = wrap_angle(4 * (yaw_rad - mean)) / 4
    is_across = np.abs(np.sin(yaw_rad - mean)) > np.abs(np.cos(yaw_rad - mean))
    return mean + (np.pi / 2 if is_across.mean() > 0.5 else 0.0), float(np.sqrt(np.mean(off**2)))


def _observed_ends(t: Array, ends: Ends, origin: Array, axis: int, sigma_m: float) -> list[Positions]:
    """Return the positions of the lower and the upper end along an axis where they are observed, without outliers."""
    variance = END_SIGMA_M**2 + sigma_m**2 + (UNIFORM_SIGMA * ends.gap_m) ** 2
    found = []
    for side, along in enumerate((ends.low, ends.high)):
        seen = np.flatnonzero(ends.real[:, axis, side] > 0)
        if len(seen) < MIN_ROWS:
            continue
        place = np.column_stack([(along + origin)[seen, axis], np.zeros(len(seen))])
        positions = Positions(t[seen], place, variance[seen, axis, side])
        # What no motion of a vehicle explains is an outlier of each hypothesis.
        motion = MotionPriorSigmas(FIRST_SPEED_MPS["vehicle"], ACCELERATION_MPS2["vehicle"])
        kept = positions.take(marginal_likelihood(positions, motion).inlier)
        if len(kept) >= MIN_ROWS:
            found.append(_scattering(kept))
    return found


def _scattering(p: Positions) -> Positions:
    """Enlarge the variances of positions that scatter more about those next to them than they say (Birge, 1932)."""
    share = np.diff(p.t_s)[:-1] / (p.t_s[2:] - p.t_s[:-2])
    off = p.xy_m[1:-1, 0] - p.xy_m[:-2, 0] * (1 - share) - p.xy_m[2:, 0] * share
    noise = noise_of(p)
    weights = np.zeros((len(off), len(p)))
    rows = np.arange(len(off))
    weights[rows, rows], weights[rows, rows + 1], weights[rows, rows + 2] = share - 1, 1.0, -share
    expected = np.einsum("ij,jk,ik->i", weights, noise, weights)
    return Positions(p.t_s, p.xy_m, p.variance * max(1.0, float(np.mean(off**2 / expected))))


def _log_odds(ends: list[Positions], group: str) -> float:
    """Return the logarithm of the likelihood of ends that start or stop over that of ends that stay.

    It is the least of all ends together and of each one: what moves at one end only grows.
    """
    if not ends:
        return -np.inf
    first, last = min(p.t_s[0] for p in ends), max(p.t_s[-1] for p in ends)
    times = np.linspace(first, last, TIMES)
    starts, stops = times <= last - MIN_MOTION_S, times >= first + MIN_MOTION_S
    count = int(starts.sum() + stops.sum())
    if count == 0:
        return -np.inf
    known, pulled = np.zeros((len(ends), count)), np.zeros((len(ends), count))
    for k, p in enumerate(ends):
        late = p.t_s[:, None] - times
        moved = np.concatenate([np.maximum(late[:, starts], 0.0), np.maximum(-late[:, stops], 0.0)], axis=1) ** 2 / 2
        weight = np.linalg.inv(noise_of(p) + PLACE_SIGMA_M**2)
        known[k] = ((weight @ moved) * moved).sum(axis=0)
        pulled[k] = moved.T @ weight @ (p.xy_m[:, 0] - np.median(p.xy_m[:, 0]))
    known, pulled = np.vstack([known, known.sum(axis=0)]), np.vstack([pulled, pulled.sum(axis=0)])
    # The acceleration is integrated out: a covariance of rank one joins that of ends that stay.
    variance = ACCELERATION_MPS2[group] ** 2
    each = 0.5 * (variance * pulled**2 / (1 + variance * known) - np.log1p(variance * known))
    return float(np.logaddexp.reduce(each.min(axis=0)) - np.log(count))
