"""Road users that the vehicle and a pole both detect, and what their places say about the pole's pose and clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from log2sim.cooperation.pose_fit import DELAY, Evidence
from log2sim.datatypes import Boxes3D
from log2sim.geometry import NS_PER_S, Array

# Nobody drives faster on roads with LiDARs at the side; a box errs by half a meter.
MAX_SPEED_MPS, MAX_JUMP_M = 35.0, 1.5
MIN_BOXES = 3
# Within so much time of a box the velocity of its track is taken from.
VELOCITY_SPAN_S = 0.5
MAX_GAP_S = 0.7
# Boxes of one object are of different sweeps; what is farther away than any limit is not linked.
MIN_STEP_S, UNLIKELY_M = 0.01, 1e6
# Kinds of road users that detectors distinguish.
GROUPS = {"car": 0, "truck": 0, "bus": 0, "pedestrian": 1, "cyclist": 2, "motorcycle": 2, "bicycle": 2}
# How far centers of boxes by both ends are apart, measured in synthetic streets and roads with exact poses: the standard
# deviation of one, and what all of one object have in common, as each end sees another side of it. Along and across the motion
# of a vehicle, of others that move, and of what stands, which says little.
SPREAD_M = {
    "vehicle": ((0.17, 0.09), (0.2, 0.1)),
    "small": ((0.07, 0.07), (0.12, 0.08)),
    "standing": ((0.1, 0.1), (0.3, 0.3)),
}
# Of boxes with so many points; those with fewer err more.
USUAL_POINTS, MAX_FACTOR = 100.0, 3.0
# Two tracks of one object have velocities as similar as boxes over a second show.
MAX_VELOCITY_APART_MPS = 4.0
# Boxes so many standard deviations apart count a quarter (Geman, McClure 1987), as they may be of different objects.
TOO_FAR = 2.5
MOVING_MPS = 1.0
# By an error of a unit's pose, and of boxes.
MAX_APART_M = 5.0


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """Places of one road user as one end saw it.

    Attributes
    ----------
    t_s : (K,) float64, s
        Since a common time, by the clock of the end, increasing.
    xyz_m : (K, 3) float64, m
        In the frame of the site.
    velocity_mps : (K, 2) float64
    group : int
    points : float
        Median number of points in its boxes.
    """

    t_s: Array
    xyz_m: Array
    velocity_mps: Array
    group: int
    points: float = np.inf

    def at(self, t_s: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Interpolate places (N, 3) and velocities (N, 2) at times (N,), and say where they are known (N,)."""
        after = np.searchsorted(self.t_s, t_s, side="left").clip(1, len(self.t_s) - 1)
        begin, gap = self.t_s[after - 1], self.t_s[after] - self.t_s[after - 1]
        share = ((t_s - begin) / gap)[:, None]
        place, velocity = (c[after - 1] + share * (c[after] - c[after - 1]) for c in (self.xyz_m, self.velocity_mps))
        return place, velocity, (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1]) & (gap <= MAX_GAP_S)


def link_boxes(boxes: Sequence[Boxes3D], site_m: Array, start_ns: int) -> list[ObjectTrack]:
    """Link boxes of successive moments to tracks."""
    growing: list[list[Array]] = []
    done: list[list[Array]] = []
    for found in boxes:
        rows = _rows_of(found, site_m, start_ns)
        if len(rows) == 0:
            continue
        costs = np.array([_costs(track, rows) for track in growing]).reshape(len(growing), len(rows))
        pairs = zip(*linear_sum_assignment(np.where(np.isfinite(costs), costs, UNLIKELY_M)))
        taken = {int(b): int(a) for a, b in pairs if np.isfinite(costs[a, b])}
        for b, a in taken.items():
            growing[a].append(rows[b])
        growing += [[row] for b, row in enumerate(rows) if b not in taken]
        over_s = rows[:, 0].max() - MAX_GAP_S
        done += [track for track in growing if track[-1][0] < over_s]
        growing = [track for track in growing if track[-1][0] >= over_s]
    return [track_of(np.array(track)) for track in (*done, *growing) if len(track) >= MIN_BOXES]


def _rows_of(boxes: Boxes3D, site_m: Array, start_ns: int) -> Array:
    """Return rows (M, 6) of time, place, group, and number of points."""
    group = [GROUPS.get(str(category), -1) for category in boxes.category]
    return np.column_stack([(boxes.t_ns - start_ns) / NS_PER_S, boxes.center_m - site_m, group, boxes.points])


def _costs(track: list[Array], rows: Array) -> Array:
    """Compute how far boxes (M,) are from where a track leads, m; infinite where they cannot be one object."""
    last = track[-1]
    ahead_s = rows[:, 0] - last[0]
    expected, limit = last[1:3], MAX_SPEED_MPS * ahead_s + MAX_JUMP_M
    if len(track) > 1:
        velocity = (last[1:3] - track[-2][1:3]) / (last[0] - track[-2][0])
        expected, limit = last[1:3] + velocity * ahead_s[:, None], np.full(len(rows), MAX_JUMP_M)
    away = np.hypot(*(rows[:, 1:3] - expected).T)
    return np.where((rows[:, 4] == last[4]) & (ahead_s > MIN_STEP_S) & (away < limit), away, np.inf)


def track_of(rows: Array) -> ObjectTrack:
    """Make a track of rows (K, 6): time, place, group, number of points."""
    t_s, xyz = rows[:, 0], rows[:, 1:4]
    near = np.abs(t_s[:, None] - t_s) <= VELOCITY_SPAN_S
    count = near.sum(axis=1)
    mean_s = near @ t_s / count
    off_s = np.where(near, t_s - mean_s[:, None], 0.0)
    velocity = (off_s @ xyz[:, :2]) / np.maximum((off_s**2).sum(axis=1), 1e-6)[:, None]
    return ObjectTrack(t_s, xyz, velocity, int(rows[0, 4]), float(np.median(rows[:, 5])))


@dataclass(frozen=True, eq=False)
class CommonObjects:
    """Tracks of the vehicle, with the vehicle itself, and for each those of the road that may show the same road user.

    Attributes
    ----------
    pairs : tuple of (ObjectTrack, tuple of ObjectTrack)
    """

    pairs: tuple[tuple[ObjectTrack, tuple[ObjectTrack, ...]], ...]

    @classmethod
    def of(cls, vehicle: Sequence[ObjectTrack], road: Sequence[ObjectTrack]) -> CommonObjects:
        """Pair tracks of one group that come near each other, at whatever time."""
        near = [(seen, tuple(other for other in road if _may_be_one(seen, other))) for seen in vehicle]
        return cls(tuple((seen, others) for seen, others in near if others))


def _may_be_one(first: ObjectTrack, second: ObjectTrack) -> bool:
    if first.group != second.group:
        return False
    (low, high), (other_low, other_high) = (
        (track.xyz_m[:, :2].min(axis=0), track.xyz_m[:, :2].max(axis=0)) for track in (first, second)
    )
    return bool((low < other_high + MAX_APART_M).all() and (other_low < high + MAX_APART_M).all())


@dataclass(frozen=True, eq=False)
class Matched:
    """Places of common objects at common times.

    Attributes
    ----------
    evidence : Evidence
    pairs : int
        Of tracks.
    moving : int
        Of those, how many move.
    gain : float
        How well all fits together: 1 for each place that fits perfectly, 0 for one that does not.
    rms_m : float, m
        Robust, of the distances between places.
    """

    evidence: Evidence
    pairs: int
    moving: int
    gain: float
    rms_m: float


def match_objects(objects: CommonObjects, correction: Array, delay_s: float, within_m: float) -> Matched | None:
    """Match places of road users with those nearest to them, given a correction (4, 4) and a delay of the road's stamps."""
    information, gradient = np.zeros((7, 7)), np.zeros(7)
    away, moving, gain = [], 0, 0.0
    for seen, others in objects.pairs:
        best = _best_match(seen, others, correction, delay_s, within_m)
        if best is None:
            continue
        place, velocity, off, points = best
        away.append(np.hypot(*off.T))
        moves, turn, sigma, bias = _spread_of(seen, velocity, min(points, seen.points))
        moving += moves
        gain += float((1 - away[-1] ** 2 / within_m**2).sum())
        turned, jacobian = off @ turn.T, turn @ _jacobian(place, velocity)
        # Boxes that jump say less than their number, all together too.
        sigma, bias = np.maximum(sigma, turned.std(axis=0)), np.maximum(bias, turned.std(axis=0))
        share = (1.0 + (turned**2 / (sigma**2 + bias**2)).sum(axis=1) / TOO_FAR**2) ** -2.0
        weight = share[:, None] / (sigma**2 + share.sum() * bias**2)
        information += np.einsum("naj,na,nak->jk", jacobian, weight, jacobian)
        gradient += np.einsum("naj,na,na->j", jacobian, weight, turned)
    if not away:
        return None
    # Of a distance in the plane, the median is 1.18 times the standard deviation along an axis.
    rms_m = float(np.median(np.concatenate(away))) / 1.18 * np.sqrt(2.0)
    return Matched(Evidence(information, gradient), len(away), moving, gain, float(rms_m))


def _spread_of(seen: ObjectTrack, velocity: Array, points: float) -> tuple[bool, Array, Array, Array]:
    """Return whether an object moves, the axes (2, 2) along and across its motion, and the sigmas and biases (2,) along them."""
    forward = velocity.mean(axis=0)
    speed = float(np.hypot(*forward))
    moves = speed > MOVING_MPS
    kind = "standing" if not moves else "vehicle" if seen.group == GROUPS["car"] else "small"
    sigma, bias = np.array(SPREAD_M[kind]) * np.clip(np.sqrt(USUAL_POINTS / points), 1.0, MAX_FACTOR)
    x, y = forward / speed if moves else (1.0, 0.0)
    return moves, np.array([[x, y], [-y, x]]), sigma, bias


def _jacobian(place: Array, velocity: Array) -> Array:
    """Differentiate places (N, 3) along x and y by a correction: (N, 2, 7)."""
    (x, y, z), out = place.T, np.zeros((len(place), 2, 7))
    out[:, 0, 0] = out[:, 1, 1] = 1.0
    out[:, 0, 4], out[:, 0, 5] = z, -y
    out[:, 1, 3], out[:, 1, 5] = -z, x
    out[:, :, DELAY] = velocity
    return out


def _best_match(
    seen: ObjectTrack, road: Sequence[ObjectTrack], correction: Array, delay_s: float, within_m: float
) -> tuple[Array, Array, Array, float] | None:
    """Find the track of the road that a vehicle's track is nearest to: places, velocities, offsets from the latter's, and points."""
    best, best_gain = None, 0.0
    for other in road:
        place, velocity, known = other.at(seen.t_s + delay_s)
        known &= np.hypot(*(velocity - seen.velocity_mps).T) < MAX_VELOCITY_APART_MPS
        if not known.any():
            continue
        place = place @ correction[:3, :3].T + correction[:3, 3]
        off = (place - seen.xyz_m)[:, :2]
        known &= np.hypot(*off.T) < within_m
        gain = float((1 - (off[known] ** 2).sum(axis=1) / within_m**2).sum())
        if gain > best_gain and known.sum() >= min(MIN_BOXES, len(known)):
            best, best_gain = (place[known], velocity[known], off[known], other.points), gain
    return best
