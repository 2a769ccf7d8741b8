"""Tracking in the map frame: forward assignment, stitching of tracks that an occlusion interrupted, one category a track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import FIRST_SPEED_MPS, GROUP_OF, RELATED_GROUPS, Measurements, Track
from log2sim.files.arrays import Columns
from log2sim.geometry import CHI2_4DOF_999, NS_PER_S, Array, choose_pairs, period_of
from log2sim.tracking.forward import (
    ACCELERATION_MPS2,
    MAX_MISSES,
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
# Share of the measurements of a ridden bicycle that show the rider, who is larger than the bicycle, as one of these.
MIN_RIDER_SHARE, SHOW_A_RIDER = 0.25, ("cyclist", "pedestrian")
# Measurements at either end of a track whose median position counts, so that single wrong ones do not.
CATEGORY_END_MEASUREMENTS = 5


def decide_category(m: Measurements, rows: Any = slice(None), *, whole_boxes: bool = False) -> str:
    """Decide the category of a track from its measurements, rows of `m` that are sorted by time.

    It is the one with most of the score of the group that has most of it; ties go to the first by name. Without `whole_boxes`, a
    pedestrian faster than people run is a cyclist whose bicycle the detector missed, and a bicycle that moves and sometimes shows
    a rider has one.
    """
    shown = m.category[rows]
    category = str(shown[0])
    alike = shown == category
    if not alike.all():
        score, groups = m.score[rows], np.array([GROUP_OF[c] for c in shown.tolist()])
        group = _most_scored(groups, score)
        voters = groups == group
        # A motorcycle, a bicycle and their riders have much the same points but look different.
        with_image = voters & (m.camera[rows] != "")
        voters = with_image if group == "two_wheeler" and with_image.any() else voters
        category = _most_scored(shown[voters], score[voters])
    if whole_boxes:
        return category
    if category == "pedestrian":
        # The robust maximum of the speeds over a while.
        t_ns, xy = m.t_ns[rows], m.center_m[rows, :2]
        t = (t_ns - t_ns[0]) / NS_PER_S
        later = np.searchsorted(t, t + SPEED_BASELINE_S)
        start = np.flatnonzero(later < len(t))
        later = later[start]
        speed_mps = np.hypot(*(xy[later] - xy[start]).T) / (t[later] - t[start])
        if len(start) and float(np.quantile(speed_mps, SPEED_QUANTILE)) > MAX_PEDESTRIAN_SPEED_MPS:
            return "cyclist"
    count = min(CATEGORY_END_MEASUREMENTS, len(shown) // 2)
    if category == "bicycle" and count and np.isin(shown, SHOW_A_RIDER).mean() >= MIN_RIDER_SHARE:
        xy = m.center_m[rows, :2]
        first, last = np.median(xy[:count], axis=0), np.median(xy[-count:], axis=0)
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
# Half the side of the square in which tracks that begin tell how many do.
NEARBY_M = 10.0
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
    m: Measurements, parts: Sequence[NDArray[np.intp]], *, max_gap_s: float, whole_boxes: bool = False
) -> list[tuple[str, NDArray[np.intp]]]:
    """Join tracks whose ends agree, by optimal assignment, until no pair is left; return the category and the rows of each.

    `parts`: rows of `m` of each track, in the order of time. Both ends are predicted to the middle of the gap and must agree there in
    position and velocity, within their uncertainty.
    """
    current = [(decide_category(m, rows, whole_boxes=whole_boxes), rows) for rows in parts]
    ends = _ends(m, current, whole_boxes=whole_boxes) if len(current) > 1 else None
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
        joined = [np.concatenate([current[k][1] for k in chain]) for chain in chains if len(chain) > 1]
        everyone = [*current, *((decide_category(m, rows, whole_boxes=whole_boxes), rows) for rows in joined)]
        # Only what was joined is filtered again.
        number = iter(range(len(current), len(everyone)))
        kept = [next(number) if len(c) > 1 else c[0] for c in chains]
        ends = _Ends.join([ends, _ends(m, everyone[len(current) :], whole_boxes=whole_boxes)]).take(kept)
        current = [everyone[k] for k in kept]
    return current


def _joining_costs(ends: _Ends, max_gap_s: float) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Return the pairs (P,), (P,) of tracks of which the second may continue the first, and the cost (P,) of each."""
    from scipy.spatial import cKDTree

    # The second of two tracks of related groups starts after the first ends: soon, or where it stood.
    order = np.argsort(ends.first_ns, kind="stable")
    starts = ends.first_ns[order]
    # A margin of a microsecond for the comparison in seconds that follows.
    after = np.searchsorted(starts, ends.last_ns, side="right")
    latest_ns = ends.last_ns + round(max_gap_s * NS_PER_S) + 1000
    until = np.searchsorted(starts, latest_ns, side="right")
    count = np.maximum(until - after, 0)
    a = np.repeat(np.arange(len(starts)), count)
    b = order[np.arange(len(a)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(after, count)]
    ends_stationary = np.hypot(*ends.last[:, 2:].T) < MAX_STATIONARY_MPS
    starts_stationary = np.hypot(*ends.first[:, 2:].T) < MAX_STATIONARY_MPS
    slow_end, slow_start = np.flatnonzero(ends_stationary), np.flatnonzero(starts_stationary)
    if len(slow_end) and len(slow_start):
        places = cKDTree(ends.first[slow_start, :2])
        found = places.query_ball_point(ends.last[slow_end, :2], MAX_STATIONARY_OFFSET_M)
        one = np.repeat(slow_end, [len(k) for k in found])
        other = slow_start[np.concatenate([*found, []]).astype(np.intp)]
        later = ends.first_ns[other] > latest_ns[one]
        a, b = np.concatenate([a, one[later]]), np.concatenate([b, other[later]])
    group, related = np.unique(ends.group, return_inverse=True)[1], np.isin(ends.group, RELATED_GROUPS)
    alike = (group[a] == group[b]) | related[a] & related[b]
    a, b = a[alike], b[alike]
    gap_s = (ends.first_ns[b] - ends.last_ns[a]) / NS_PER_S
    stationary = ends_stationary[a] & starts_stationary[b]
    apart_m = ends.last[a, :2] - ends.first[b, :2]
    offset_m = np.hypot(*apart_m.T)
    other_group = np.where(group[a] == group[b], 0.0, OTHER_GROUP_COST)
    same_place = stationary & (offset_m < MAX_STATIONARY_OFFSET_M) & (other_group == 0)
    cost = np.where(same_place, offset_m, np.inf)
    midpoint_m = apart_m + gap_s[:, None] / 2 * (ends.last[a, 2:] + ends.first[b, 2:])
    # Beyond this distance no allowed uncertainty passes the gate.
    reach_m = np.sqrt(CHI2_4DOF_999) * MAX_POSITION_SIGMA_M
    near = np.flatnonzero(~same_place & (gap_s <= max_gap_s) & (np.hypot(*midpoint_m.T) <= reach_m))
    noise = np.array([ACCELERATION_MPS2[g] for g in ends.group.tolist()])
    speed_mps = np.array([FIRST_SPEED_MPS[g] for g in ends.group.tolist()])
    one, other, half_gap_s = a[near], b[near], gap_s[near] / 2
    forward = predict(ends.last[one], ends.last_covariance[one], half_gap_s, noise[one])
    backward = predict(ends.first[other], ends.first_covariance[other], -half_gap_s, noise[one])
    difference, covariance = forward[0] - backward[0], forward[1] + backward[1]
    whitened = np.linalg.solve(covariance, difference[..., None])[..., 0]
    squared = np.einsum("ni,ni->n", difference, whitened) + other_group[near]
    agrees = np.flatnonzero(squared <= CHI2_4DOF_999)
    near, other, squared, covariance = near[agrees], other[agrees], squared[agrees], covariance[agrees]
    # Minus twice the logarithm of how much likelier it is that this one goes on there than that another starts, of which as many start
    # within `max_gap_s` as tracks do in a square and time around, in any direction.
    begin_s = (ends.first_ns - ends.first_ns.min()) / NS_PER_S
    around = np.column_stack([max_gap_s * ends.first[:, :2], NEARBY_M * begin_s])
    known, at = np.unique(other, return_inverse=True)
    begun = cKDTree(around).query_ball_point(around[known], max_gap_s * NEARBY_M, p=np.inf, return_length=True)
    log_another = np.log(begun[at] / (2 * (2 * NEARBY_M) ** 2) / (2 * np.pi * speed_mps[other] ** 2))
    log_odds = squared + np.log(np.linalg.det(2 * np.pi * covariance)) + 2 * log_another
    position_covariance = covariance[:, :2, :2]
    certain = np.sqrt(np.linalg.eigvalsh(position_covariance)[:, -1]) <= MAX_POSITION_SIGMA_M
    good = certain & (log_odds <= 0)
    # The determinant keeps an uncertain agreement from costing less than a certain one.
    cost[near[good]] = squared[good] + np.log(np.linalg.det(position_covariance[good])) + 10.0
    possible = np.isfinite(cost)
    return a[possible], b[possible], cost[possible]


def _ends(m: Measurements, tracks: Sequence[tuple[str, NDArray[np.intp]]], *, whole_boxes: bool) -> _Ends:
    group = np.array([GROUP_OF[category] for category, _ in tracks])
    parts = [rows for _, rows in tracks]
    orders = [*(rows[:END_MEASUREMENTS][::-1] for rows in parts), *(rows[-END_MEASUREMENTS:] for rows in parts)]
    mean, covariance = _filtered(m, orders, np.tile(group, 2), whole_boxes=whole_boxes)
    begin_ns, n = m.t_ns[[rows[0] for rows in parts]], len(parts)
    # Stamps may run backward where two ticks share a sweep; no track ends before it begins, so that none continues itself.
    end_ns = np.maximum(begin_ns, m.t_ns[[rows[-1] for rows in parts]])
    return _Ends(begin_ns, end_ns, mean[:n], covariance[:n], mean[n:], covariance[n:], group)


def _filtered(
    m: Measurements, orders: Sequence[NDArray[np.intp]], group: NDArray[np.str_], *, whole_boxes: bool
) -> tuple[Array, Array]:
    """Filter the rows of every track in the given orders; return the final states (A, 4) and covariances (A, 4, 4)."""
    count = np.array([len(o) for o in orders])
    start, rows = np.cumsum(count) - count, np.concatenate(orders)
    xy, t_ns = m.center_m[rows, :2], m.t_ns[rows]
    r = measurement_noise(m.covariance[rows], np.repeat(group, count), whole_boxes=whole_boxes)
    axis = (m.yaw_rad if whole_boxes else m.box_yaw_rad)[rows[start]]
    mean, covariance = np.zeros((len(count), 4)), np.zeros((len(count), 4, 4))
    mean[:, :2], covariance[:, :2, :2] = xy[start], r[start]
    bicycle = m.category[rows[start]] == "bicycle"
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


def mark_unrecorded(
    tracks: Sequence[Track], recorded: Mapping[str, NDArray[np.bool_]], ticks_per_search: int = 1
) -> list[Track]:
    """Return tracks that know at which ticks none of the sensors that measured them recorded, and how often pictures were searched.

    `recorded`: (T,) each: whether a camera, or `SWEEPS` any LiDAR, recorded something usable at each tick. `ticks_per_search`: within
    which all tiles of a picture are searched.
    """
    marked = []
    for one in tracks:
        m = one.measurements
        by_camera = [recorded[name] for name in {str(c) for c in m.camera} - {SWEEPS} if name in recorded]
        in_sweeps = SWEEPS in recorded and np.isfinite(m.box_yaw_rad).any()
        by_any = [*by_camera, recorded[SWEEPS]] if in_sweeps else by_camera
        unrecorded = np.flatnonzero(~np.any(by_any, axis=0)) if by_any else np.zeros(0, dtype=np.int64)
        searched = float(np.any(by_camera, axis=0)[one.tick].mean()) if by_camera else 1.0
        marked.append(replace(one, unrecorded=unrecorded, searched=searched, ticks_per_search=ticks_per_search))
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
    count = [len(m) for m in measurements]
    tick, first_row = np.repeat(np.arange(len(count)), count), np.cumsum([0, *count])
    found = track_forward(
        measurements, t_ns, birth_score=birth_score, whole_boxes=whole_boxes, flow_mps=flow_mps, joined=everything
    )
    if not found:
        return []
    whole = [first_row[ticks] + rows for ticks, rows in found]
    parts = whole
    if whole_boxes:
        # What the forward pass resumed after several misses is decided again by the motion on both sides of the gap. Centers of partial
        # views wander where an occlusion begins and ends, so that motions of one object disagree.
        rows = np.concatenate(whole)
        begun = np.cumsum([len(part) for part in whole])[:-1]
        parts = np.split(rows, np.union1d(begun, np.flatnonzero(np.diff(tick[rows]) > MAX_MISSES) + 1))
    stitched = stitch(everything, parts, max_gap_s=max_gap_s, whole_boxes=whole_boxes)
    if whole_boxes:
        stitched = _with_single_boxes(stitched, whole, tick)
    least = min_hits(t_ns, min_life_s)
    kept = [(category, rows) for category, rows in stitched if len(rows) >= least]
    # One copy in the order of the tracks, of which each is a part.
    end = np.cumsum([len(rows) for _, rows in kept])
    in_order = everything.take(np.concatenate([rows for _, rows in kept])) if kept else everything
    tracks = [
        Track(category, tick[rows], in_order.take(slice(stop - len(rows), stop)))
        for (category, rows), stop in zip(kept, end.tolist(), strict=True)
    ]
    return sorted(tracks, key=lambda t: (int(t.tick[0]), float(t.measurements.center_m[0, 0])))


def _with_single_boxes(
    stitched: list[tuple[str, NDArray[np.intp]]], whole: Sequence[NDArray[np.intp]], tick: NDArray[np.intp]
) -> list[tuple[str, NDArray[np.intp]]]:
    """Let single boxes that were cut off stay where the forward pass, with tracks `whole`, had them, if what is around them is one track.

    A box that is alone shows no motion by which both sides could decide; `tick`: of all rows.
    """
    track, rows = np.repeat(np.arange(len(whole)), [len(part) for part in whole]), np.concatenate(whole)
    owner = np.zeros(len(tick), dtype=np.intp)
    for k, (_, part) in enumerate(stitched):
        owner[part] = k
    of, size = owner[rows], np.array([len(part) for _, part in stitched])
    between = (of[:-2] == of[2:]) & (of[:-2] != of[1:-1]) & (track[:-2] == track[2:]) & (size[of[1:-1]] == 1)
    out = dict(enumerate(stitched))
    for k in (np.flatnonzero(between) + 1).tolist():
        category, part = out[int(of[k - 1])]
        if tick[rows[k]] not in tick[part]:
            out[int(of[k - 1])] = category, np.sort(np.append(part, rows[k]))
            del out[int(of[k])]
    return list(out.values())


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
