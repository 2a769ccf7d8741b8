"""Forward tracking: measurements of every tick assigned to tracks that stand or move at constant velocity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import FIRST_SPEED_MPS, GROUP_OF, GROUPS, RELATED_GROUPS, Measurements
from log2sim.files.arrays import Columns
from log2sim.geometry import CHI2_2DOF_999, NS_PER_S, Array, period_of

# Standard deviation of the change of the velocity in 1 s, by group.
ACCELERATION_MPS2 = {"vehicle": 2.5, "two_wheeler": 1.5, "pedestrian": 1.0, "other": 1.5}
# Of the vehicles and riders that move so many drive about as fast as the ego, and as many towards it as fast: about its velocity and
# about that turned round theirs spreads as it does about standstill. Where the ego is slow, all three are one.
ON_ROAD, FLOW_SHARE = ("vehicle", "two_wheeler"), 1 / 3
# A vehicle moves along its axis: lateral share of the initial velocity.
ACROSS_SHARE = {"vehicle": 0.4, "two_wheeler": 0.4, "pedestrian": 1.0, "other": 1.0, "bicycle": 0.4}
# Displacement of the box center when other sides of the object become visible.
CENTER_SIGMA_M = {"vehicle": 0.35, "two_wheeler": 0.2, "pedestrian": 0.15, "other": 0.35}

_DIAGONAL, _PLACE, _SPEED = np.arange(4), np.arange(2), np.arange(2, 4)


def predict(mean: Array, covariance: Array, dt_s: Array | float, acceleration: Array) -> tuple[Array, Array]:
    """Carry states (A, 4) x, y, vx, vy with covariances (A, 4, 4) forward; `acceleration` (A,) is the process noise."""
    dt = np.asarray(dt_s, dtype=np.float64)
    if dt.ndim and len(dt) and (dt == dt[0]).all():
        dt = dt[0]
    # One step for all where they go equally far, which they do but for gaps.
    step, noise = np.zeros((*dt.shape, 4, 4)), np.zeros((*dt.shape, 4, 4))
    span = np.abs(dt)
    step[..., _DIAGONAL, _DIAGONAL] = 1.0
    step[..., _PLACE, _SPEED] = dt[..., None]
    noise[..., _PLACE, _PLACE] = (span**3 / 3)[..., None]
    noise[..., _PLACE, _SPEED] = noise[..., _SPEED, _PLACE] = (span * dt / 2)[..., None]
    noise[..., _SPEED, _SPEED] = span[..., None]
    noise = noise * (acceleration**2)[:, None, None]
    return (step @ mean[:, :, None])[..., 0], step @ covariance @ np.swapaxes(step, -1, -2) + noise


def innovation(mean: Array, covariance: Array, xy: Array, r: Array, age_s: Array) -> tuple[Array, Array]:
    """Return squared Mahalanobis distances and log-determinants, both (A, M), of measurements (M, 2) against states (A, 4).

    `age_s` (M,) is when each was measured relative to the states: a sweep sees an object before or after the tick. Where all are
    0 the states may be places alone, (A, 2) with (A, 2, 2).
    """
    p = covariance[:, None]
    dx, dy = xy[:, 0] - mean[:, :1], xy[:, 1] - mean[:, 1:2]
    s_xx, s_xy, s_yy = p[..., 0, 0] + r[:, 0, 0], p[..., 0, 1] + r[:, 0, 1], p[..., 1, 1] + r[:, 1, 1]
    if np.any(age_s):
        dx, dy = dx - age_s * mean[:, 2:3], dy - age_s * mean[:, 3:4]
        s_xx = s_xx + age_s * (2 * p[..., 0, 2] + age_s * p[..., 2, 2])
        s_xy = s_xy + age_s * (p[..., 0, 3] + p[..., 1, 2] + age_s * p[..., 2, 3])
        s_yy = s_yy + age_s * (2 * p[..., 1, 3] + age_s * p[..., 3, 3])
    determinant = s_xx * s_yy - s_xy * s_xy
    return (s_yy * dx * dx - 2 * s_xy * dx * dy + s_xx * dy * dy) / determinant, np.log(determinant)


def update(mean: Array, covariance: Array, xy: Array, r: Array, age_s: Array) -> tuple[Array, Array]:
    """Kalman update of states (A, 4) by one measurement each (A, 2); Joseph's form, so covariances stay positive."""
    h = np.zeros((len(mean), 2, 4))
    h[:, 0, 0] = h[:, 1, 1] = 1.0
    h[:, 0, 2] = h[:, 1, 3] = age_s
    reach = h @ covariance
    gain = np.swapaxes(np.linalg.solve(reach @ np.swapaxes(h, 1, 2) + r, reach), 1, 2)
    rest = np.eye(4) - gain @ h
    mean = mean + (gain @ (xy[:, :, None] - h @ mean[:, :, None]))[..., 0]
    return mean, rest @ covariance @ np.swapaxes(rest, 1, 2) + gain @ r @ np.swapaxes(gain, 1, 2)


def measurement_noise(covariance: Array, groups: NDArray[Any], *, whole_boxes: bool = False) -> Array:
    """Return the noise (M, 2, 2) of box centers: the sensor's, and for partial views that of the changing view."""
    if whole_boxes:
        return covariance
    extra = np.array([CENTER_SIGMA_M[g] for g in groups.tolist()])
    return covariance + (extra**2)[:, None, None] * np.eye(2)


def first_velocity(axis_rad: Array, groups: NDArray[Any]) -> Array:
    """Return the initial covariance (M, 2, 2) of velocities; along an axis, where one is known, it is larger than across.

    `axis_rad` (M,) is the direction of the length, up to half turns, NaN where unknown.
    """
    along = np.array([FIRST_SPEED_MPS[g] for g in groups.tolist()])
    known = np.isfinite(axis_rad)
    across = along * np.where(known, np.array([ACROSS_SHARE[g] for g in groups.tolist()]), 1.0)
    angle = np.where(known, axis_rad, 0.0)
    axis = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    excess = (along**2 - across**2)[:, None, None] * axis[:, :, None] * axis[:, None, :]
    return np.asarray((across**2)[:, None, None] * np.eye(2) + excess)


NOT_ALLOWED = 1e6
# A rider is taken for a pedestrian now and then and the other way round; it costs as much as 2.4 sigma.
OTHER_GROUP_COST = 6.0
# A bicycle without a rider stands while riders pass it; one whose rider a detection missed costs as much as 2 sigma. Of bicycles
# that look so nearly all are parked.
RIDERLESS_COST, RIDERLESS_STANDING_PRIOR = 4.0, 0.95
TENTATIVE_HITS = 3
# An object is detected at so many of its ticks; measurements that belong to no track yet, of new objects or of none, come
# with this density a tick: some three in a circle of 50 m. A measurement stays without a track
# where that is likelier than that the track was measured there.
DETECTION_PROBABILITY, NEW_PER_M2 = 0.8, 4e-4
_LOG_NEW = 2 * np.log(2 * np.pi * NEW_PER_M2 * (1 - DETECTION_PROBABILITY) / DETECTION_PROBABILITY)
# An object measured once is as likely to stand as to move. A standing one starts within this time on average, as
# at a traffic light.
STANDING_PRIOR, START_TIME_S = 0.5, 30.0
# Standard deviation of what a standing object seems to move within 1 s.
STANDING_DRIFT_M = 0.1
# Below this probability the place where it stands is forgotten.
MIN_STANDING_PROBABILITY = 1e-3
# A track ends after so many ticks without a measurement; a confirmed one lives on for as long as its velocity predicts it.
MAX_MISSES = 3
CONFIRMED_AGE_S = 1.2

_NAMES = tuple(GROUPS)
_NAME_ARRAY = np.array(_NAMES)
_INDEX = {category: _NAMES.index(group) for category, group in GROUP_OF.items()}
_ACCELERATION = np.array([ACCELERATION_MPS2[g] for g in _NAMES])
_ON_ROAD = np.isin(_NAMES, ON_ROAD)
_GROUP_COST = np.array([
    [0.0 if a == b else OTHER_GROUP_COST if (a, b) in RELATED_GROUPS else NOT_ALLOWED for b in _NAMES] for a in _NAMES
])  # fmt: skip

Index = NDArray[np.intp]
_Costs = tuple[Array, Array, NDArray[np.bool_]]


def track_forward(
    measurements: Sequence[Measurements],
    t_ns: NDArray[np.int64],
    *,
    birth_score: float,
    whole_boxes: bool = False,
    flow_mps: Array | None = None,
) -> list[tuple[Index, Index]]:
    """Assign the measurements of T ticks (stamps (T,)) to tracks, in the order of their births: the ticks and rows (n,) of each.

    `flow_mps`: (T, 2): velocity of the ego in the map, by which others drive that are first seen; zeros without.
    """
    if not len(measurements):
        return []
    tracker = ForwardTracker(birth_score=birth_score, period_s=period_of(t_ns), whole_boxes=whole_boxes)
    count = [len(found) for found in measurements]
    everything = _Columns.of(Measurements.join(measurements), np.repeat(t_ns, count), whole_boxes=whole_boxes)
    first = np.searchsorted(everything.row, np.cumsum([0, *count]))
    flow = np.zeros((len(t_ns), 2)) if flow_mps is None else flow_mps
    log = [
        tracker.advance(everything.take(slice(first[k], first[k + 1])), int(now_ns), flow[k])
        for k, now_ns in enumerate(t_ns)
    ]
    rows, number = (np.concatenate(column) for column in zip(*log))
    ticks = np.repeat(np.arange(len(log)), [len(taken) for taken, _ in log])
    rows = rows - np.cumsum([0, *count])[ticks]
    order = np.argsort(number, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(number[order])) + 1) if len(order) else []
    return [(ticks[i], rows[i]) for i in parts]


COLUMNS = (
    "number", "mean", "covariance", "seen_ns", "hits", "standing", "place_m", "place_covariance", "_group", "_riderless",
    "_born_age_s",
)  # fmt: skip
"""Of the active tracks of a `ForwardTracker`."""


class ForwardTracker:
    """Active tracks, one row each; `step` is causal.

    `number`: (A,): index of the track in the order of births. `mean`: (A, 4): states x, y, vx, vy in the map at the last tick.
    `covariance`: (A, 4, 4). `seen_ns`: (A,): time of the last measurement. `hits`: (A,): number of measurements. `standing`:
    (A,): probability that the object stands; 0 once it surely moves. `place_m`: (A, 2): where it stands if it does, with
    covariances `place_covariance` (A, 2, 2). `birth_score`: lowest score that can start a track. `whole_boxes`: whether the
    measurements come from a 3D detector: centers that do not move with the view, yaw along the motion.
    """

    def __init__(self, *, birth_score: float, period_s: float, whole_boxes: bool = False) -> None:
        self.birth_score = birth_score
        # Stamps jitter by less than half a period.
        self._tentative_age_s = (MAX_MISSES + 1.5) * period_s
        self._confirmed_age_s = max(CONFIRMED_AGE_S, self._tentative_age_s)
        self.whole_boxes = whole_boxes
        self.number = np.zeros(0, dtype=np.intp)
        self.mean, self.covariance = np.zeros((0, 4)), np.zeros((0, 4, 4))
        self.seen_ns, self.hits = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        self.standing, self.place_m, self.place_covariance = np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 2))
        self._group = np.zeros(0, dtype=np.intp)
        # Share of the measurements of a track that are bicycles without riders.
        self._riderless = np.zeros(0)
        # When the first measurement was made, relative to its tick: at 30 m/s 0.1 s are 3 m.
        self._born_age_s = np.zeros(0)
        self._born = 0
        self._now_ns: int | None = None

    def step(self, found: Measurements, now_ns: int) -> tuple[Index, Index]:
        """Take the measurements of a tick; return the rows assigned to tracks and the numbers of these tracks.

        Those with a score of at least the birth score may start a track; weaker ones only continue one (Zhang et al.,
        "ByteTrack", ECCV 2022), after the strong ones are assigned.
        """
        return self.advance(_Columns.of(found, np.full(len(found), now_ns), whole_boxes=self.whole_boxes), now_ns)

    def advance(self, columns: _Columns, now_ns: int, flow_mps: Array | None = None) -> tuple[Index, Index]:
        """Do what `step` does, with the columns of a tick and the velocity of the ego (2,)."""
        # Tracks without a recent measurement end, the others are predicted.
        age_s = (now_ns - self.seen_ns) / NS_PER_S
        alive = age_s <= np.where(self.hits >= TENTATIVE_HITS, self._confirmed_age_s, self._tentative_age_s)
        if not alive.all():
            for name in COLUMNS:
                setattr(self, name, getattr(self, name)[alive])
        if self._now_ns is not None and len(self.number):
            dt_s = (now_ns - self._now_ns) / NS_PER_S
            self.mean, self.covariance = predict(self.mean, self.covariance, dt_s, _ACCELERATION[self._group])
            self.place_covariance = self.place_covariance + STANDING_DRIFT_M**2 * abs(dt_s) * np.eye(2)
            self.standing = self.standing * np.exp(-abs(dt_s) / START_TIME_S)
        self._now_ns = now_ns
        if len(columns.row) == 0:
            return columns.row, np.zeros(0, dtype=np.intp)
        strong = columns.score >= self.birth_score
        costs, flows = self._costs(columns, np.zeros(2) if flow_mps is None else flow_mps, now_ns)
        tracks, taken = self._choose(columns, strong, costs)
        fresh = strong.copy()
        fresh[taken] = False
        if len(tracks):
            xy, r = columns.xy[taken], columns.r[taken]
            moving, standing, prior = costs[0][tracks, taken], costs[1][tracks, taken], self.standing[tracks]
            posterior = prior * np.exp((_joined(moving, standing, prior) - standing) / 2)
            self.standing[tracks] = np.where(posterior < MIN_STANDING_PROBABILITY, 0.0, posterior)
            gain = self.place_covariance[tracks] @ np.linalg.inv(self.place_covariance[tracks] + r)
            self.place_m[tracks] += (gain @ (xy - self.place_m[tracks])[:, :, None])[..., 0]
            self.place_covariance[tracks] -= gain @ self.place_covariance[tracks]
            mean, covariance = self.mean[tracks] + flows[tracks, taken], self.covariance[tracks]
            self.mean[tracks], self.covariance[tracks] = update(mean, covariance, xy, r, columns.age_s[taken])
            self.seen_ns[tracks] = now_ns
            self.hits[tracks] += 1
            self._riderless[tracks] += (columns.riderless[taken] - self._riderless[tracks]) / self.hits[tracks]
        numbers, born = self.number[tracks], np.flatnonzero(fresh)
        if len(born):
            count = len(born)
            number, one = np.arange(self._born, self._born + count), np.ones(count, dtype=np.int64)
            mean, covariance = np.zeros((count, 4)), np.zeros((count, 4, 4))
            mean[:, :2], covariance[:, :2, :2] = columns.xy[born], columns.r[born]
            covariance[:, 2:, 2:] = columns.velocity[born]
            prior = np.where(columns.riderless[born] > 0, RIDERLESS_STANDING_PRIOR, STANDING_PRIOR)
            of_born = (
                number, mean, covariance, now_ns * one, one, prior, columns.xy[born], columns.r[born],
                columns.group[born], columns.riderless[born], columns.age_s[born],
            )  # fmt: skip
            for name, values in zip(COLUMNS, of_born, strict=True):
                setattr(self, name, np.concatenate([getattr(self, name), values]))
            self._born += count
            numbers, taken = np.concatenate([numbers, number]), np.concatenate([taken, born])
        return columns.row[taken], numbers

    def _choose(self, columns: _Columns, strong: NDArray[np.bool_], costs: _Costs) -> tuple[Index, Index]:
        """Return tracks and measurements of the likeliest assignment inside the gate, strong measurements first.

        The cost of a pair is minus twice the logarithm of the ratio of two likelihoods: that the track was measured
        there, and that it was not detected and the measurement is another object's or nobody's (Blackman, "Multiple
        hypothesis tracking for multiple target tracking", IEEE AES Magazine 19, 2004). A pair that is less likely than
        no pair is none, so that a missed object does not shift the tracks of a whole row of parked cars.
        """
        from scipy.optimize import linear_sum_assignment

        none = np.zeros(0, dtype=np.intp)
        if len(self.number) == 0:
            return none, none
        moving, standing, inside = costs
        cost = _joined(moving, standing, self.standing[:, None])
        cost = cost + _LOG_NEW + _GROUP_COST[self._group[:, None], columns.group]
        cost = cost + RIDERLESS_COST * np.abs(self._riderless[:, None] - columns.riderless) * columns.two_wheeler
        cost[~inside | (cost > 0)] = 0.0
        chosen = []
        for stage in (strong, ~strong):
            rows = np.flatnonzero(stage)
            if len(rows) == 0:
                continue
            a, m = linear_sum_assignment(cost[:, rows])
            m = rows[m]
            good = cost[a, m] < 0
            chosen.append((a[good], m[good]))
            cost[a[good]] = 0.0
        tracks, taken = (np.concatenate(c) for c in zip(*chosen))
        return tracks, taken

    def _costs(self, columns: _Columns, flow_mps: Array, now_ns: int) -> tuple[_Costs, Array]:
        """Return minus twice the log-likelihoods (A, M) if tracks move, if they stand, and which are inside a gate.

        Also what to add to the states (A, M, 4) of those measured once, which may drive with the ego or towards it.
        """
        squared, log_determinant = innovation(self.mean, self.covariance, columns.xy, columns.r, columns.age_s)
        moving, added = squared + log_determinant, np.zeros((*squared.shape, 4))
        fresh = np.flatnonzero((self.hits == 1) & _ON_ROAD[self._group]) if flow_mps.any() else np.zeros(0, np.intp)
        if len(fresh):
            shares, best = [moving[fresh]], squared[fresh]
            for flow in (flow_mps, -flow_mps):
                age_s = ((now_ns - self.seen_ns[fresh]) / NS_PER_S - self._born_age_s[fresh])[:, None]
                shift = np.concatenate([flow * age_s, np.broadcast_to(flow, (len(fresh), 2))], axis=1)
                apart, _ = innovation(
                    self.mean[fresh] + shift, self.covariance[fresh], columns.xy, columns.r, columns.age_s
                )
                shares.append(apart + log_determinant[fresh])
                added[fresh] = np.where((apart < best)[..., None], shift[:, None], added[fresh])
                best = np.minimum(best, apart)
            moving[fresh] = -2 * np.logaddexp.reduce(np.log(FLOW_SHARE) - np.array(shares) / 2, axis=0)
            squared[fresh] = best
        squared_at_rest, log_determinant_at_rest = innovation(
            self.place_m, self.place_covariance, columns.xy, columns.r, np.zeros(len(columns.xy))
        )
        inside = (squared <= CHI2_2DOF_999) | (self.standing[:, None] > 0) & (squared_at_rest <= CHI2_2DOF_999)
        return (moving, squared_at_rest + log_determinant_at_rest, inside), added


@dataclass(frozen=True, eq=False)
class _Columns(Columns):
    """Placed measurements as arrays (M, ...) for the filter; `row` is that of each among all, `age_s` relative to its tick."""

    row: Index
    score: Array
    xy: Array
    r: Array
    velocity: Array
    age_s: Array
    group: Index
    riderless: Array
    two_wheeler: NDArray[np.bool_]

    @classmethod
    def of(cls, found: Measurements, now_ns: NDArray[np.int64], *, whole_boxes: bool) -> _Columns:
        row = np.flatnonzero(found.source != "")
        category = found.category[row]
        group = np.array([_INDEX[c] for c in category.tolist()], dtype=np.intp)
        start = np.where(category == "bicycle", "bicycle", _NAME_ARRAY[group])
        axis_rad = (found.yaw_rad if whole_boxes else found.box_yaw_rad)[row]
        return cls(
            row, found.score[row], found.center_m[row, :2],
            measurement_noise(found.covariance[row], _NAME_ARRAY[group], whole_boxes=whole_boxes), first_velocity(axis_rad, start),
            (found.t_ns[row] - now_ns[row]) / NS_PER_S, group, (category == "bicycle").astype(np.float64),
            group == _NAMES.index("two_wheeler"),
        )  # fmt: skip


def _joined(moving: Array, standing: Array, probability: Array) -> Array:
    """Return minus twice the log-likelihood of objects that stand with a probability, from those of both motions."""
    with np.errstate(divide="ignore"):
        return np.asarray(-2 * np.logaddexp(np.log(1 - probability) - moving / 2, np.log(probability) - standing / 2))
