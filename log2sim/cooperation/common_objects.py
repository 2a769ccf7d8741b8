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
# Kinds of road users that detectors tell apart.
GROUPS = {"car": 0, "truck": 0, "bus": 0, "pedestrian": 1, "cyclist": 2, "motorcycle": 2, "bicycle": 2}
# Standard deviations of a box's center: of one detection, and of all those of one object seen from one place.
BOX_SIGMA_M, BOX_BIAS_M = 0.2, 0.15
# Two tracks of one object have velocities as like as boxes over a second tell.
MAX_VELOCITY_APART_MPS = 4.0
CAUCHY = 2.0
MOVING_MPS = 1.0


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
    """

    t_s: Array
    xyz_m: Array
    velocity_mps: Array
    group: int

    def at(self, t_s: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Interpolate places (N, 3) and velocities (N, 2) at times (N,), and say where they are known (N,)."""
        place = np.stack([np.interp(t_s, self.t_s, column) for column in self.xyz_m.T], axis=1)
        velocity = np.stack([np.interp(t_s, self.t_s, column) for column in self.velocity_mps.T], axis=1)
        after = np.searchsorted(self.t_s, t_s, side="left").clip(1, len(self.t_s) - 1)
        gap = self.t_s[after] - self.t_s[after - 1]
        return place, velocity, (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1]) & (gap <= MAX_GAP_S)


def link_boxes(boxes: Sequence[Boxes3D], site_m: Array, start_ns: int) -> list[ObjectTrack]:
    """Link boxes of successive moments to tracks."""
    open_tracks: list[list[Array]] = []
    done: list[list[Array]] = []
    for found in boxes:
        rows = _rows_of(found, site_m, start_ns)
        costs = np.array([[_cost(track, row) for row in rows] for track in open_tracks]).reshape(
            len(open_tracks), len(rows)
        )
        first, second = linear_sum_assignment(np.where(np.isfinite(costs), costs, 1e6))
        taken = [(a, b) for a, b in zip(first.tolist(), second.tolist()) if np.isfinite(costs[a, b])]
        for a, b in taken:
            open_tracks[a].append(rows[b])
        used = {b for _, b in taken}
        open_tracks += [[row] for b, row in enumerate(rows) if b not in used]
        now_s = max((row[0] for row in rows), default=-np.inf)
        done += [track for track in open_tracks if track[-1][0] < now_s - MAX_GAP_S]
        open_tracks = [track for track in open_tracks if track[-1][0] >= now_s - MAX_GAP_S]
    return [track_of(np.array(track)) for track in (*done, *open_tracks) if len(track) >= MIN_BOXES]


def _rows_of(boxes: Boxes3D, site_m: Array, start_ns: int) -> list[Array]:
    t_s = (boxes.t_ns - start_ns) / NS_PER_S
    group = [GROUPS.get(str(category), -1) for category in boxes.category]
    return list(np.column_stack([t_s, boxes.center_m - site_m, group]))


def _cost(track: list[Array], row: Array) -> float:
    """How far a box is from where a track leads, m; infinite where they cannot be one object."""
    last = track[-1]
    ahead_s = float(row[0] - last[0])
    if row[4] != last[4] or ahead_s <= 0.01:
        return float("inf")
    if len(track) == 1:
        away = float(np.hypot(*(row[1:3] - last[1:3])))
        return away if away < MAX_SPEED_MPS * ahead_s + MAX_JUMP_M else float("inf")
    before = track[-2]
    velocity = (last[1:3] - before[1:3]) / (last[0] - before[0])
    away = float(np.hypot(*(row[1:3] - last[1:3] - velocity * ahead_s)))
    return away if away < MAX_JUMP_M else float("inf")


def track_of(rows: Array) -> ObjectTrack:
    """Make a track of rows (K, 5): time, place, group."""
    t_s, xyz = rows[:, 0], rows[:, 1:4]
    near = np.abs(t_s[:, None] - t_s) <= VELOCITY_SPAN_S
    count = near.sum(axis=1)
    mean_s = near @ t_s / count
    off_s = np.where(near, t_s - mean_s[:, None], 0.0)
    velocity = (off_s @ xyz[:, :2]) / np.maximum((off_s**2).sum(axis=1), 1e-6)[:, None]
    return ObjectTrack(t_s, xyz, velocity, int(np.median(rows[:, 4])))


@dataclass(frozen=True, eq=False)
class CommonObjects:
    """Tracks of both ends.

    Attributes
    ----------
    vehicle, road : tuple of ObjectTrack
        The former with the vehicle itself, if its poses are known.
    """

    vehicle: tuple[ObjectTrack, ...]
    road: tuple[ObjectTrack, ...]


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
    for seen in objects.vehicle:
        best = _best_match(seen, objects.road, correction, delay_s, within_m)
        if best is None:
            continue
        place, velocity, off = best
        away2 = (off**2).sum(axis=1)
        away.append(np.sqrt(away2))
        moving += bool(np.hypot(*velocity.mean(axis=0)) > MOVING_MPS)
        gain += float(np.maximum(1 - away2 / within_m**2, 0).sum())
        share = 1.0 / (1.0 + away2 / (CAUCHY * BOX_SIGMA_M) ** 2)
        weight = share / (BOX_SIGMA_M**2 + share.sum() * BOX_BIAS_M**2)
        jacobian = _jacobian(place, velocity)
        information += np.einsum("naj,n,nak->jk", jacobian, weight, jacobian)
        gradient += np.einsum("naj,n,na->j", jacobian, weight, off)
    if not away:
        return None
    # Of a distance in the plane, the median is 1.18 times the standard deviation along an axis.
    rms_m = float(np.median(np.concatenate(away))) / 1.18 * np.sqrt(2.0)
    return Matched(Evidence(information, gradient), len(away), moving, gain, rms_m)


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
) -> tuple[Array, Array, Array] | None:
    """Find the track of the road that a vehicle's track is nearest to: its places, velocities, and offsets from the latter's."""
    best, best_gain = None, 0.0
    for other in road:
        if other.group != seen.group:
            continue
        place, velocity, known = other.at(seen.t_s + delay_s)
        known &= np.hypot(*(velocity - seen.velocity_mps).T) < MAX_VELOCITY_APART_MPS
        if not known.any():
            continue
        place = place @ correction[:3, :3].T + correction[:3, 3]
        off = (place - seen.xyz_m)[:, :2]
        known &= np.hypot(*off.T) < within_m
        gain = float((1 - (off[known] ** 2).sum(axis=1) / within_m**2).sum())
        if gain > best_gain and known.sum() >= min(MIN_BOXES, len(known)):
            best, best_gain = (place[known], velocity[known], off[known]), gain
    return best
