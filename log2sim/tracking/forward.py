"""Forward tracking: measurements of every tick assigned to tracks that stand or move at constant velocity."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import FIRST_SPEED_MPS, GROUP_OF, GROUPS, RELATED_GROUPS, Measurements
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


def _motion(dt_s: Array | float) -> tuple[Array, Array]:
    """Return the matrices (..., 4, 4) that carry states on by times (...), and the noise of unit acceleration."""
    dt, span = np.asarray(dt_s), np.abs(dt_s)
    step, noise = np.zeros((*dt.shape, 4, 4)), np.zeros((*dt.shape, 4, 4))
    step[..., _DIAGONAL, _DIAGONAL] = 1.0
    step[..., _PLACE, _SPEED] = dt[..., None]
    noise[..., _PLACE, _PLACE] = (span**3 / 3)[..., None]
    noise[..., _PLACE, _SPEED] = noise[..., _SPEED, _PLACE] = (span * dt / 2)[..., None]
    noise[..., _SPEED, _SPEED] = span[..., None]
    return step, noise


def predict(mean: Array, covariance: Array, dt_s: Array | float, acceleration: Array) -> tuple[Array, Array]:
    """Carry states (A, 4) x, y, vx, vy with covariances (A, 4, 4) forward; `acceleration` (A,) is the process noise."""
    dt = np.asarray(dt_s, dtype=np.float64)
    # One step for all where they go equally far, which they do but for gaps.
    step, noise = _motion(dt[0] if dt.ndim and len(dt) and (dt == dt[0]).all() else dt)
    noise = noise * (acceleration**2)[:, None, None]
    return (step @ mean[:, :, None])[..., 0], step @ covariance @ step.swapaxes(-1, -2) + noise


def innovation(mean: Array, covariance: Array, xy: Array, r: Array, age_s: Array) -> tuple[Array, Array]:
    """Return squared Mahalanobis distances and log-determinants, both (..., M), of measurements (M, 2) against states (..., 4).

    `age_s` (M,) is when each was measured relative to the states: a sweep sees an object before or after the tick.
    """
    p = covariance[..., None, :, :]
    dx, dy = xy[:, 0] - mean[..., :1], xy[:, 1] - mean[..., 1:2]
    s_xx, s_xy, s_yy = p[..., 0, 0] + r[:, 0, 0], p[..., 0, 1] + r[:, 0, 1], p[..., 1, 1] + r[:, 1, 1]
    if age_s.any():
        dx, dy = dx - age_s * mean[..., 2:3], dy - age_s * mean[..., 3:4]
        s_xx = s_xx + age_s * (2 * p[..., 0, 2] + age_s * p[..., 2, 2])
        s_xy = s_xy + age_s * (p[..., 0, 3] + p[..., 1, 2] + age_s * p[..., 2, 3])
        s_yy = s_yy + age_s * (2 * p[..., 1, 3] + age_s * p[..., 3, 3])
    determinant = s_xx * s_yy - s_xy * s_xy
    return (s_yy * dx * dx - 2 * s_xy * dx * dy + s_xx * dy * dy) / determinant, np.log(determinant)


def update(mean: Array, covariance: Array, xy: Array, r: Array, age_s: Array) -> tuple[Array, Array]:
    """Kalman update of states (..., 4) by one measurement each (..., 2)."""
    age = age_s[..., None]
    reach = covariance[..., :2, :] + age[..., None] * covariance[..., 2:, :]
    s = reach[..., :2] + age[..., None] * reach[..., 2:] + r
    adjugate = -s
    adjugate[..., 0, 0], adjugate[..., 1, 1] = s[..., 1, 1], s[..., 0, 0]
    determinant = s[..., 0, 0] * s[..., 1, 1] - s[..., 0, 1] * s[..., 1, 0]
    gain = reach.swapaxes(-1, -2) @ adjugate / determinant[..., None, None]
    off = xy - mean[..., :2] - age * mean[..., 2:]
    left = covariance - gain @ reach
    # What rounding leaves of asymmetry would grow from step to step.
    return mean + (gain @ off[..., None])[..., 0], (left + left.swapaxes(-1, -2)) / 2


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
_ON_ROAD, _TWO_WHEELER = np.isin(_NAMES, ON_ROAD), _NAMES.index("two_wheeler")
_GROUP_COST = np.array([
    [0.0 if a == b else OTHER_GROUP_COST if (a, b) in RELATED_GROUPS else NOT_ALLOWED for b in _NAMES] for a in _NAMES
])  # fmt: skip

Index = NDArray[np.intp]
Rows = NDArray[np.void]

TRACK = np.dtype([
    ("number", np.intp),  # in the order of births
    ("seen_ns", np.int64),  # time of the last measurement
    ("hits", np.int64),  # number of measurements
    # States x, y, vx, vy in the map at the last tick, if the object moves and if it stands.
    ("mean", np.float64, (2, 4)),
    ("covariance", np.float64, (2, 4, 4)),
    ("standing", np.float64),  # probability that the object stands; 0 once it surely moves
    ("group", np.intp),
    ("riderless", np.float64),  # share of the measurements that are bicycles without riders
    # When the first measurement was made, relative to its tick: at 30 m/s 0.1 s are 3 m.
    ("born_age_s", np.float64),
])  # fmt: skip
"""A row of the active tracks of a `ForwardTracker`."""
_MEASURED = np.dtype([
    ("row", np.intp), ("score", np.float64), ("xy", np.float64, 2), ("r", np.float64, (2, 2)), ("age_s", np.float64), ("born", TRACK),
])  # fmt: skip
"""A placed measurement: its row among all, its time relative to its tick, and the track that it may start."""


def track_forward(
    measurements: Sequence[Measurements],
    t_ns: NDArray[np.int64],
    *,
    birth_score: float,
    whole_boxes: bool = False,
    flow_mps: Array | None = None,
    joined: Measurements | None = None,
) -> list[tuple[Index, Index]]:
    """Assign the measurements of T ticks (stamps (T,)) to tracks, in the order of their births: the ticks and rows (n,) of each.

    `flow_mps`: (T, 2): velocity of the ego, as others may drive; zeros without. `joined`: all measurements in one.
    """
    if not len(measurements):
        return []
    tracker = ForwardTracker(birth_score=birth_score, period_s=period_of(t_ns), whole_boxes=whole_boxes)
    count = [len(found) for found in measurements]
    joined = Measurements.join(measurements) if joined is None else joined
    everything = _measured(joined, np.repeat(t_ns, count), whole_boxes=whole_boxes)
    first = np.searchsorted(everything["row"], np.cumsum([0, *count]))
    flow = np.zeros((len(t_ns), 2)) if flow_mps is None else flow_mps
    log = [
        tracker.advance(everything[begin:end], now_ns, flow[k])
        for k, (now_ns, begin, end) in enumerate(zip(t_ns.tolist(), first.tolist(), first[1:].tolist()))
    ]
    rows, number = (np.concatenate(column) for column in zip(*log))
    ticks = np.repeat(np.arange(len(log)), [len(taken) for taken, _ in log])
    rows = rows - np.cumsum([0, *count])[ticks]
    order = np.argsort(number, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(number[order])) + 1) if len(order) else []
    return [(ticks[i], rows[i]) for i in parts]


class ForwardTracker:
    """Active tracks, one row of `tracks` (A,) each; `step` is causal.

    `birth_score`: lowest score that can start a track. `whole_boxes`: whether the measurements come from a 3D detector: centers that
    do not move with the view, yaw along the motion.
    """

    def __init__(self, *, birth_score: float, period_s: float, whole_boxes: bool = False) -> None:
        self.birth_score = birth_score
        # Stamps jitter by less than half a period.
        self._tentative_age_s = (MAX_MISSES + 1.5) * period_s
        self._confirmed_age_s = max(CONFIRMED_AGE_S, self._tentative_age_s)
        self.whole_boxes = whole_boxes
        self.tracks = np.zeros(0, TRACK)
        self._born = 0
        self._now_ns: int | None = None

    def step(self, found: Measurements, now_ns: int) -> tuple[Index, Index]:
        """Take the measurements of a tick; return the rows assigned to tracks and the numbers of these tracks.

        Those with a score of at least the birth score may start a track; weaker ones only continue one (Zhang et al.,
        "ByteTrack", ECCV 2022), after the strong ones are assigned.
        """
        return self.advance(_measured(found, np.full(len(found), now_ns), whole_boxes=self.whole_boxes), now_ns)

    def advance(self, m: Rows, now_ns: int, flow_mps: Array | None = None) -> tuple[Index, Index]:
        """Do what `step` does, with the rows of a tick and the velocity of the ego (2,)."""
        # Tracks without a recent measurement end, the others are predicted.
        known = self.tracks
        limit_s = np.where(known["hits"] >= TENTATIVE_HITS, self._confirmed_age_s, self._tentative_age_s)
        known = self.tracks = known[(now_ns - known["seen_ns"]) / NS_PER_S <= limit_s]
        if self._now_ns is not None and len(known):
            dt_s = (now_ns - self._now_ns) / NS_PER_S
            step, carry, noise = _both_motions(dt_s)
            known["mean"] = known["mean"] @ step.T
            carried = known["covariance"].reshape(-1, 16) @ carry
            known["covariance"] = carried.reshape(-1, 2, 4, 4) + noise[known["group"]]
            known["standing"] *= np.exp(-abs(dt_s) / START_TIME_S)
        self._now_ns = now_ns
        if len(m) == 0:
            return m["row"], np.zeros(0, dtype=np.intp)
        strong = m["score"] >= self.birth_score
        fresh = strong.copy()
        numbers = tracks = taken = np.zeros(0, dtype=np.intp)
        if len(known):
            costs, inside, flows = self._costs(m, flow_mps, now_ns)
            with np.errstate(divide="ignore"):
                prior = np.log([1 - known["standing"], known["standing"]])[:, :, None]
            joined = -2 * np.logaddexp(prior[0] - costs[:, 0] / 2, prior[1] - costs[:, 1] / 2)
            tracks, taken = self._choose(m, strong, joined, inside)
        if len(tracks):
            fresh[taken] = False
            standing = known["standing"][tracks] * np.exp((joined[tracks, taken] - costs[tracks, 1, taken]) / 2)
            known["standing"][tracks] = np.where(standing < MIN_STANDING_PROBABILITY, 0.0, standing)
            mean, covariance, measured = known["mean"][tracks], known["covariance"][tracks], m[taken]
            if flows is not None:
                mean[:, 0] += flows[tracks, taken]
            one_each = (measured[name][:, None] for name in ("xy", "r", "age_s"))
            known["mean"][tracks], known["covariance"][tracks] = update(mean, covariance, *one_each)
            known["seen_ns"][tracks] = now_ns
            known["hits"][tracks] += 1
            share = known["riderless"][tracks]
            known["riderless"][tracks] = share + (measured["born"]["riderless"] - share) / known["hits"][tracks]
            numbers = known["number"][tracks]
        if fresh.any():
            (born,) = fresh.nonzero()
            new = m["born"][born]
            new["number"] = np.arange(self._born, self._born + len(born))
            self._born += len(born)
            # As `np.concatenate`, which takes its time to compare the fields.
            self.tracks = np.empty(len(known) + len(new), TRACK)
            self.tracks[: len(known)], self.tracks[len(known) :] = known, new
            numbers, taken = np.concatenate([numbers, new["number"]]), np.concatenate([taken, born])
        return m["row"][taken], numbers

    def _choose(
        self, m: Rows, strong: NDArray[np.bool_], joined: Array, inside: NDArray[np.bool_]
    ) -> tuple[Index, Index]:
        """Return tracks and measurements of the likeliest assignment inside the gate, strong measurements first.

        The cost of a pair is minus twice the logarithm of the ratio of two likelihoods: that the track was measured
        there, and that it was not detected and the measurement is another object's or nobody's (Blackman, "Multiple
        hypothesis tracking for multiple target tracking", IEEE AES Magazine 19, 2004). A pair that is less likely than
        no pair is none, so that a missed object does not shift the tracks of a whole row of parked cars.
        """
        from scipy.optimize import linear_sum_assignment

        known, group = self.tracks, m["born"]["group"]
        cost = joined + _LOG_NEW + _GROUP_COST[known["group"][:, None], group]
        two_wheeler = group == _TWO_WHEELER
        if two_wheeler.any():
            apart = np.abs(known["riderless"][:, None] - m["born"]["riderless"])
            cost = cost + RIDERLESS_COST * apart * two_wheeler
        cost = np.where(inside & (cost < 0), cost, 0.0)
        if strong.all():
            a, chosen = linear_sum_assignment(cost)
            good = cost[a, chosen] < 0
            return a[good], chosen[good]
        pairs = []
        for stage in (strong, ~strong):
            of_stage = np.where(stage, cost, 0.0)
            a, chosen = linear_sum_assignment(of_stage)
            good = of_stage[a, chosen] < 0
            pairs.append((a[good], chosen[good]))
            cost[a[good]] = 0.0
        a, chosen = (np.concatenate(side) for side in zip(*pairs))
        return a, chosen

    def _costs(self, m: Rows, flow_mps: Array | None, now_ns: int) -> tuple[Array, NDArray[np.bool_], Array | None]:
        """Return minus twice the log-likelihoods (A, 2, M) if tracks move and if they stand, and which (A, M) are inside a gate.

        Also what to add to the moving states (A, M, 4) of those measured once, which may drive with the ego or towards it.
        """
        known, added = self.tracks, None
        xy, r, age_s = m["xy"], m["r"], m["age_s"]
        squared, log_determinant = innovation(known["mean"], known["covariance"], xy, r, age_s)
        costs = squared + log_determinant
        if flow_mps is not None and flow_mps.any():
            fresh = np.flatnonzero((known["hits"] == 1) & _ON_ROAD[known["group"]])
            mean, covariance, first = known["mean"][fresh, 0], known["covariance"][fresh, 0], known[fresh]
            shares, best, added = [costs[fresh, 0]], squared[fresh, 0], np.zeros((len(known), len(m), 4))
            for flow in (flow_mps, -flow_mps):
                since_s = ((now_ns - first["seen_ns"]) / NS_PER_S - first["born_age_s"])[:, None]
                shift = np.concatenate([flow * since_s, np.broadcast_to(flow, (len(fresh), 2))], axis=1)
                apart, _ = innovation(mean + shift, covariance, xy, r, age_s)
                shares.append(apart + log_determinant[fresh, 0])
                added[fresh] = np.where((apart < best)[..., None], shift[:, None], added[fresh])
                best = np.minimum(best, apart)
            costs[fresh, 0] = -2 * np.logaddexp.reduce(np.log(FLOW_SHARE) - np.array(shares) / 2, axis=0)
            squared[fresh, 0] = best
        near = squared <= CHI2_2DOF_999
        return costs, near[:, 0] | near[:, 1] & (known["standing"] > 0)[:, None], added


@lru_cache(maxsize=64)
def _both_motions(dt_s: float) -> tuple[Array, Array, Array]:
    """Return the step (4, 4), its product (16, 16) by rows of covariances and, by group, the noise (G, 2, 4, 4) of both hypotheses."""
    step, unit = _motion(dt_s)
    noise = _ACCELERATION[:, None, None, None] ** 2 * unit * np.array([1.0, 0.0])[:, None, None]
    noise[:, 1, _PLACE, _PLACE] = STANDING_DRIFT_M**2 * abs(dt_s)
    return step, np.asarray(np.kron(step, step).T, dtype=np.float64), noise


def _measured(found: Measurements, now_ns: NDArray[np.int64], *, whole_boxes: bool) -> Rows:
    """Return the rows of all placed measurements; `now_ns` (M,) is the stamp of the tick of each."""
    row = np.flatnonzero(found.source != "")
    category = found.category[row]
    group = np.array([_INDEX[c] for c in category.tolist()], dtype=np.intp)
    bicycle = category == "bicycle"
    axis_rad = (found.yaw_rad if whole_boxes else found.box_yaw_rad)[row]
    m = np.zeros(len(row), _MEASURED)
    m["row"], m["score"], m["xy"] = row, found.score[row], found.center_m[row, :2]
    m["r"] = measurement_noise(found.covariance[row], _NAME_ARRAY[group], whole_boxes=whole_boxes)
    m["age_s"] = (found.t_ns[row] - now_ns[row]) / NS_PER_S
    born = m["born"]
    born["seen_ns"], born["hits"], born["born_age_s"] = now_ns[row], 1, m["age_s"]
    born["mean"][..., :2], born["covariance"][..., :2, :2] = m["xy"][:, None], m["r"][:, None]
    born["covariance"][:, 0, 2:, 2:] = first_velocity(axis_rad, np.where(bicycle, "bicycle", _NAME_ARRAY[group]))
    born["standing"] = np.where(bicycle, RIDERLESS_STANDING_PRIOR, STANDING_PRIOR)
    born["group"], born["riderless"] = group, bicycle
    return m
