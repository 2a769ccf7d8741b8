"""Stitching of tracks that an occlusion interrupted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, Measurements, Track
from log2sim.geometry import NS_PER_S, Array
from log2sim.tracking.category import voted_category
from log2sim.tracking.gates import CHI2_4DOF_999
from log2sim.tracking.motion import ACCELERATION_MPS2, first_velocity, measurement_noise, predict, update

FORBIDDEN = 1e6
# Largest standard deviation of the position difference; above it agreement is no evidence.
MAX_POSITION_SIGMA_M = 2.0
# A stationary object is joined across a gap of any length if its position stays within the offset.
MAX_STATIONARY_MPS = 0.5
MAX_STATIONARY_OFFSET_M = 1.0
# Number of measurements from the end of a track that the filter uses; earlier ones no longer influence the state.
END_MEASUREMENTS = 20


@dataclass(frozen=True, eq=False)
class _Ends:
    """States of tracks at both ends, from one filter pass in each direction.

    Attributes
    ----------
    first_ns : (A,) int64
    last_ns : (A,) int64
    first : tuple of (A, 4) and (A, 4, 4) float64
        States and covariances.
    last : tuple of (A, 4) and (A, 4, 4) float64
        States and covariances.
    group : (A,) str
    """

    first_ns: NDArray[np.int64]
    last_ns: NDArray[np.int64]
    first: tuple[Array, Array]
    last: tuple[Array, Array]
    group: NDArray[np.str_]


def stitch(
    tracks: Sequence[Track], t_ns: NDArray[np.int64], *, max_gap_s: float, whole_boxes: bool = False
) -> list[Track]:
    """Join tracks whose ends agree, by optimal assignment, until no pair is left.

    Both ends are predicted to the middle of the gap and must agree there in position and velocity, within their
    uncertainty.
    """
    from scipy.optimize import linear_sum_assignment

    current = list(tracks)
    while len(current) > 1:
        cost = _joining_costs(_ends(current, whole_boxes=whole_boxes), max_gap_s)
        i, j = linear_sum_assignment(cost)
        joins = cost[i, j] < FORBIDDEN
        if not joins.any():
            break
        following = dict(zip(i[joins].tolist(), j[joins].tolist()))
        heads = sorted(set(range(len(current))) - set(following.values()))
        joined = []
        for head in heads:
            chain = [head]
            while chain[-1] in following:
                chain.append(following[chain[-1]])
            joined.append(_concatenate([current[k] for k in chain]))
        current = joined
    return current


def _joining_costs(ends: _Ends, max_gap_s: float) -> Array:
    """Return the cost (A, A) of continuing the first track with the second, `FORBIDDEN` where that is impossible."""
    cost = np.full((len(ends.group), len(ends.group)), FORBIDDEN)
    gap_s = (ends.first_ns[None, :] - ends.last_ns[:, None]) / NS_PER_S
    ends_stationary, starts_stationary = (
        np.hypot(*state[:, 2:].T) < MAX_STATIONARY_MPS for state in (ends.last[0], ends.first[0])
    )
    stationary = ends_stationary[:, None] & starts_stationary[None, :]
    a, b = np.nonzero((gap_s > 0) & (stationary | (gap_s <= max_gap_s)) & (ends.group[:, None] == ends.group[None, :]))
    gap_s, stationary = gap_s[a, b], stationary[a, b]
    last, first = ends.last[0][a], ends.first[0][b]
    offset_m = np.hypot(*(last - first)[:, :2].T)
    same_place = stationary & (offset_m < MAX_STATIONARY_OFFSET_M)
    cost[a[same_place], b[same_place]] = offset_m[same_place]
    half = gap_s[:, None] / 2
    midpoint_offset_m = np.hypot(*(last[:, :2] + half * last[:, 2:] - first[:, :2] + half * first[:, 2:]).T)
    # Beyond this distance no allowed uncertainty passes the gate.
    near = np.flatnonzero(
        ~same_place & (gap_s <= max_gap_s) & (midpoint_offset_m <= np.sqrt(CHI2_4DOF_999) * MAX_POSITION_SIGMA_M)
    )
    a, b, half = a[near], b[near], gap_s[near] / 2
    noise = np.array([ACCELERATION_MPS2[g] for g in ends.group[a].tolist()])
    forward = predict(ends.last[0][a], ends.last[1][a], half, noise)
    backward = predict(ends.first[0][b], ends.first[1][b], -half, noise)
    difference, covariance = forward[0] - backward[0], forward[1] + backward[1]
    squared = np.einsum("ni,ni->n", difference, np.linalg.solve(covariance, difference[..., None])[..., 0])
    position_covariance = covariance[:, :2, :2]
    certain = np.sqrt(np.linalg.eigvalsh(position_covariance)[:, -1]) <= MAX_POSITION_SIGMA_M
    good = certain & (squared <= CHI2_4DOF_999)
    # The determinant keeps an uncertain agreement from costing less than a certain one.
    cost[a[good], b[good]] = squared[good] + np.log(np.linalg.det(position_covariance[good])) + 10.0
    return cost


def _ends(tracks: Sequence[Track], *, whole_boxes: bool) -> _Ends:
    group = np.array([GROUP_OF[t.category] for t in tracks])
    parts = [t.measurements for t in tracks]
    return _Ends(
        np.array([m.t_ns[0] for m in parts]),
        np.array([m.t_ns[-1] for m in parts]),
        _filtered([np.arange(len(m))[:END_MEASUREMENTS][::-1] for m in parts], parts, group, whole_boxes=whole_boxes),
        _filtered([np.arange(len(m))[-END_MEASUREMENTS:] for m in parts], parts, group, whole_boxes=whole_boxes),
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


def _concatenate(parts: Sequence[Track]) -> Track:
    if len(parts) == 1:
        return parts[0]
    m = Measurements.join([p.measurements for p in parts])
    return Track(voted_category(m), np.concatenate([p.tick for p in parts]), m)
