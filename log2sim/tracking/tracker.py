"""Tracking in the map frame: forward assignment, stitching of tracks that an occlusion interrupted, one category a track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, RELATED_GROUPS, Measurements, Track
from log2sim.files.arrays import Columns
from log2sim.geometry import CHI2_4DOF_999, NS_PER_S, Array, choose_pairs, period_of
from log2sim.tracking.forward import (
    ACCELERATION_MPS2,
    OTHER_GROUP_COST,
    first_velocity,
    measurement_noise,
    predict,
    track_forward,
    update,
)

# People run at up to 3 m/s in traffic; the speed is measured over this time, in which noise moves a center little.
MAX_PEDESTRIAN_SPEED_MPS = 3.0
SPEED_BASELINE_S = 0.6
# Quantile of a track's speeds that has to exceed the limit, so that a few wrong positions do not.
SPEED_QUANTILE = 0.75
# A bicycle that got farther than its own length and the errors of both positions moved, and none moves without a rider.
MIN_RIDDEN_M = 3.0
# Share of the measurements of a ridden bicycle that show the rider, who is larger than the bicycle.
MIN_RIDER_SHARE = 0.25
# Measurements at either end of a track whose median position counts, so that single wrong ones do not.
CATEGORY_END_MEASUREMENTS = 5


def decide_category(m: Measurements, *, whole_boxes: bool = False) -> str:
    """Decide the category of a track from its measurements, which are sorted by time.

    It is the one with most of the score of the group that has most of it; ties go to the first by name. Without `whole_boxes`, a
    pedestrian faster than people run is a cyclist whose bicycle the detector missed, and a bicycle that moves and sometimes shows
    a rider has one.
    """
    category, groups = str(m.category[0]), np.array([GROUP_OF[c] for c in m.category.tolist()])
    if (m.category != category).any():
        group = _most_scored(groups, m.score)
        voters = groups == group
        # A motorcycle, a bicycle and their riders have much the same points but look different.
        with_image = voters & (m.camera != "")
        voters = with_image if group == "two_wheeler" and with_image.any() else voters
        category = _most_scored(m.category[voters], m.score[voters])
    if whole_boxes:
        return category
    if category == "pedestrian":
        # The robust maximum of the speeds over a while.
        t = (m.t_ns - m.t_ns[0]) / NS_PER_S
        later = np.searchsorted(t, t + SPEED_BASELINE_S)
        start = np.flatnonzero(later < len(t))
        later = later[start]
        speed_mps = np.hypot(*(m.center_m[later, :2] - m.center_m[start, :2]).T) / (t[later] - t[start])
        if len(start) and float(np.quantile(speed_mps, SPEED_QUANTILE)) > MAX_PEDESTRIAN_SPEED_MPS:
            return "cyclist"
    count = min(CATEGORY_END_MEASUREMENTS, len(m) // 2)
    if category == "bicycle" and count and (m.category != category).mean() >= MIN_RIDER_SHARE:
        first, last = np.median(m.center_m[:count, :2], axis=0), np.median(m.center_m[-count:, :2], axis=0)
        if np.hypot(*(last - first)) > MIN_RIDDEN_M:
            return "cyclist"
    return category


def _most_scored(names: NDArray[np.str_], score: Array) -> str:
    """Return the name, of names (n,), with the largest sum of scores (n,)."""
    unique, index = np.unique(names, return_inverse=True)
    return str(unique[np.argmax(np.bincount(index, weights=score))])


# Largest standard deviation of the position difference; above it agreement is no evidence.
MAX_POSITION_SIGMA_M = 2.0
# A stationary object is joined across a gap of any length if its position stays within the offset.
MAX_STATIONARY_MPS = 0.5
MAX_STATIONARY_OFFSET_M = 1.0
# Number of measurements from the end of a track that the filter uses; earlier ones no longer influence the state.
END_MEASUREMENTS = 20


@dataclass(frozen=True, eq=False)
class _Ends(Columns):
    """States of tracks at both ends, from one filter pass in each direction."""

    first_ns: NDArray[np.int64]  # (A,)
    last_ns: NDArray[np.int64]  # (A,)
    first: Array  # `first`, `last`: (A, 4): states
    first_covariance: Array  # `first_covariance`, `last_covariance`: (A, 4, 4)
    last: Array
    last_covariance: Array
    group: NDArray[np.str_]  # (A,)


def stitch(
    tracks: Sequence[Track], t_ns: NDArray[np.int64], *, max_gap_s: float, whole_boxes: bool = False
) -> list[Track]:
    """Join tracks whose ends agree, by optimal assignment, until no pair is left.

    Both ends are predicted to the middle of the gap and must agree there in position and velocity, within their
    uncertainty.
    """
    current = list(tracks)
    ends = _ends(current, whole_boxes=whole_boxes) if len(current) > 1 else None
    while ends is not None:
        i, j, cost = _joining_costs(ends, max_gap_s)
        chosen = choose_pairs(i, j, cost)
        if not len(chosen):
            break
        following = dict(zip(i[chosen].tolist(), j[chosen].tolist()))
        chains = [[head] for head in sorted(set(range(len(current))) - set(following.values()))]
        for chain in chains:
            while chain[-1] in following:
                chain.append(following[chain[-1]])
        joined = []
        for chain in chains:
            if len(chain) > 1:
                m = Measurements.join([current[k].measurements for k in chain])
                ticks = np.concatenate([current[k].tick for k in chain])
                joined.append(Track(decide_category(m, whole_boxes=whole_boxes), ticks, m))
        # Only what was joined is filtered again.
        number = iter(range(len(current), len(current) + len(joined)))
        rows = [next(number) if len(c) > 1 else c[0] for c in chains]
        everyone = [*current, *joined]
        ends = _Ends.join([ends, _ends(joined, whole_boxes=whole_boxes)]).take(rows)
        current = [everyone[k] for k in rows]
    return current


def _joining_costs(ends: _Ends, max_gap_s: float) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Return the pairs (P,), (P,) of tracks of which the second may continue the first, and the cost (P,) of each."""
    from scipy.spatial import cKDTree

    # The second of two tracks of related groups starts after the first ends: soon, or where it stood.
    order = np.argsort(ends.first_ns, kind="stable")
    starts = ends.first_ns[order]
    # A margin of a microsecond for the comparison in seconds that follows.
    after = np.searchsorted(starts, ends.last_ns, side="right")
    until = np.searchsorted(starts, ends.last_ns + round(max_gap_s * NS_PER_S) + 1000, side="right")
    count = np.maximum(until - after, 0)
    a = np.repeat(np.arange(len(starts)), count)
    b = order[np.arange(len(a)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(after, count)]
    ends_stationary, starts_stationary = (
        np.hypot(*state[:, 2:].T) < MAX_STATIONARY_MPS for state in (ends.last, ends.first)
    )
    slow_end, slow_start = np.flatnonzero(ends_stationary), np.flatnonzero(starts_stationary)
    if len(slow_end) and len(slow_start):
        places = cKDTree(ends.first[slow_start, :2])
        found = places.query_ball_point(ends.last[slow_end, :2], MAX_STATIONARY_OFFSET_M)
        a = np.concatenate([a, np.repeat(slow_end, [len(k) for k in found])])
        b = np.concatenate([b, slow_start[np.concatenate([*found, []]).astype(np.intp)]])
    pairs = np.unique(a * len(starts) + b)
    a, b = pairs // len(starts), pairs % len(starts)
    related = np.isin(ends.group, RELATED_GROUPS)
    alike = (ends.group[a] == ends.group[b]) | related[a] & related[b]
    possible = alike & (ends.first_ns[b] > ends.last_ns[a])
    a, b = a[possible], b[possible]
    gap_s = (ends.first_ns[b] - ends.last_ns[a]) / NS_PER_S
    stationary = ends_stationary[a] & starts_stationary[b]
    last, first = ends.last[a], ends.first[b]
    offset_m = np.hypot(*(last - first)[:, :2].T)
    other_group = np.where(ends.group[a] == ends.group[b], 0.0, OTHER_GROUP_COST)
    same_place = stationary & (offset_m < MAX_STATIONARY_OFFSET_M) & (other_group == 0)
    cost = np.where(same_place, offset_m, np.inf)
    half = gap_s[:, None] / 2
    midpoint_offset_m = np.hypot(*(last[:, :2] + half * last[:, 2:] - first[:, :2] + half * first[:, 2:]).T)
    # Beyond this distance no allowed uncertainty passes the gate.
    near = np.flatnonzero(
        ~same_place & (gap_s <= max_gap_s) & (midpoint_offset_m <= np.sqrt(CHI2_4DOF_999) * MAX_POSITION_SIGMA_M)
    )
    one, other, half_gap_s = a[near], b[near], gap_s[near] / 2
    noise = np.array([ACCELERATION_MPS2[g] for g in ends.group[one].tolist()])
    forward = predict(ends.last[one], ends.last_covariance[one], half_gap_s, noise)
    backward = predict(ends.first[other], ends.first_covariance[other], -half_gap_s, noise)
    difference, covariance = forward[0] - backward[0], forward[1] + backward[1]
    squared = (
        np.einsum("ni,ni->n", difference, np.linalg.solve(covariance, difference[..., None])[..., 0])
        + other_group[near]
    )
    position_covariance = covariance[:, :2, :2]
    certain = np.sqrt(np.linalg.eigvalsh(position_covariance)[:, -1]) <= MAX_POSITION_SIGMA_M
    good = certain & (squared <= CHI2_4DOF_999)
    # The determinant keeps an uncertain agreement from costing less than a certain one.
    cost[near[good]] = squared[good] + np.log(np.linalg.det(position_covariance[good])) + 10.0
    possible = np.isfinite(cost)
    return a[possible], b[possible], cost[possible]


def _ends(tracks: Sequence[Track], *, whole_boxes: bool) -> _Ends:
    group = np.array([GROUP_OF[t.category] for t in tracks])
    parts = [t.measurements for t in tracks]
    return _Ends(
        np.array([m.t_ns[0] for m in parts]),
        np.array([m.t_ns[-1] for m in parts]),
        *_filtered([np.arange(len(m))[:END_MEASUREMENTS][::-1] for m in parts], parts, group, whole_boxes=whole_boxes),
        *_filtered([np.arange(len(m))[-END_MEASUREMENTS:] for m in parts], parts, group, whole_boxes=whole_boxes),
        group,
    )


def _filtered(
    orders: Sequence[NDArray[np.intp]], parts: Sequence[Measurements], group: NDArray[np.str_], *, whole_boxes: bool
) -> tuple[Array, Array]:
    """Filter the rows of every track in the given orders; return the final states (A, 4) and covariances (A, 4, 4)."""
    count = np.array([len(o) for o in orders])
    start = np.cumsum(count) - count
    xy = np.concatenate([m.center_m[o, :2] for m, o in zip(parts, orders)])
    t_ns = np.concatenate([m.t_ns[o] for m, o in zip(parts, orders)])
    r = np.concatenate([m.covariance[o] for m, o in zip(parts, orders)])
    r = measurement_noise(r, np.repeat(group, count), whole_boxes=whole_boxes)
    axis = np.array([(m.yaw_rad if whole_boxes else m.box_yaw_rad)[o[0]] for m, o in zip(parts, orders)])
    mean, covariance = np.zeros((len(parts), 4)), np.zeros((len(parts), 4, 4))
    mean[:, :2], covariance[:, :2, :2] = xy[start], r[start]
    bicycle = np.array([m.category[o[0]] == "bicycle" for m, o in zip(parts, orders)])
    covariance[:, 2:, 2:] = first_velocity(axis, np.where(bicycle, "bicycle", group))
    noise = np.array([ACCELERATION_MPS2[g] for g in group.tolist()])
    for k in range(1, int(count.max())):
        on = np.flatnonzero(count > k)
        row = start[on] + k
        predicted = predict(mean[on], covariance[on], (t_ns[row] - t_ns[row - 1]) / NS_PER_S, noise[on])
        mean[on], covariance[on] = update(*predicted, xy[row], r[row], np.zeros(len(on)))
    return mean, covariance


SWEEPS = ""
"""Represents the LiDARs among the cameras, as in the column `camera` of measurements."""


def mark_unrecorded(tracks: Sequence[Track], recorded: Mapping[str, NDArray[np.bool_]]) -> list[Track]:
    """Return tracks that know at which ticks none of the sensors that measured them recorded, and how often pictures were searched.

    `recorded`: (T,) each: whether a camera, or `SWEEPS` any LiDAR, recorded something usable at each tick.
    """
    marked = []
    for one in tracks:
        m = one.measurements
        by_camera = [recorded[name] for name in {str(c) for c in m.camera} - {SWEEPS} if name in recorded]
        in_sweeps = SWEEPS in recorded and np.isfinite(m.box_yaw_rad).any()
        by_any = [*by_camera, recorded[SWEEPS]] if in_sweeps else by_camera
        unrecorded = np.flatnonzero(~np.any(by_any, axis=0)) if by_any else np.zeros(0, dtype=np.int64)
        searched = float(np.any(by_camera, axis=0)[one.tick].mean()) if by_camera else 1.0
        marked.append(replace(one, unrecorded=unrecorded, searched=searched))
    return marked


def track(
    measurements: Sequence[Measurements],
    t_ns: NDArray[np.int64],
    *,
    birth_score: float,
    max_gap_s: float,
    min_life_s: float,
    whole_boxes: bool = False,
    flow_mps: Array | None = None,
) -> list[Track]:
    """Turn the measurements of T ticks into tracks, sorted by their first tick.

    `t_ns`: (T,). `birth_score`: lowest score that can start a track. `max_gap_s`: longest occlusion that is bridged, s.
    `whole_boxes`: whether the measurements come from a 3D detector: centers that do not move with the view, yaw along the
    motion. `flow_mps`: (T, 2): velocity of the ego, as others may drive. `min_life_s`: shorter tracks,
    after stitching, are dropped as false alarms, unless the log itself is as short.
    """
    everything = Measurements.join(measurements)
    first_row = np.cumsum([0, *(len(m) for m in measurements)])
    tracks = []
    for ticks, rows in track_forward(
        measurements, t_ns, birth_score=birth_score, whole_boxes=whole_boxes, flow_mps=flow_mps
    ):
        found = everything.take(first_row[ticks] + rows)
        tracks.append(Track(decide_category(found, whole_boxes=whole_boxes), ticks, found))
    tracks = stitch(tracks, t_ns, max_gap_s=max_gap_s, whole_boxes=whole_boxes)
    kept = [t for t in tracks if len(t) >= min_hits(t_ns, min_life_s)]
    return sorted(kept, key=lambda t: (int(t.tick[0]), float(t.measurements.center_m[0, 0])))


def min_hits(t_ns: NDArray[np.int64], min_life_s: float) -> int:
    """Return the number of measurements that a track needs: the ticks in `min_life_s`, 1 in a log of one or two ticks."""
    if len(t_ns) < 3:
        return 1
    return max(2, min(round(min_life_s / period_of(t_ns)), len(t_ns) // 2))


# Velocities are those of lines through the measurements within this time of each.
VELOCITY_WINDOW_S = 0.5


def velocities(track_: Track) -> Array:
    """Return the velocities (n, 2), m/s, of a track at its measurements: the slopes of lines through those around each."""
    t_s = (track_.measurements.t_ns - track_.measurements.t_ns[0]) / NS_PER_S
    xy, out = track_.measurements.center_m[:, :2], np.zeros((len(t_s), 2))
    first, last = (np.searchsorted(t_s, t_s + s * VELOCITY_WINDOW_S, side=d) for s, d in ((-1, "left"), (1, "right")))  # type: ignore[call-overload]
    for k, (begin, end) in enumerate(zip(first.tolist(), last.tolist())):
        t = t_s[begin:end] - t_s[begin:end].mean()
        if t @ t > 0:
            out[k] = t @ xy[begin:end] / (t @ t)
    return out
