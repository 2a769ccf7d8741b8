"""Boxes of two ends that are the same object become one, side by side: each side from whoever sees it better.

A box is four sides with errors of their own (`box_errors`). Besides, all sides of an object move on together between the times
at which the ends saw it, and all sides of a box are off together where the pose of its sensor is. Generalized least squares
with the covariance of all three gives the sides at one time: Aitken, "On least squares and linear combination of observations"
(1935).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, GROUPS, Boxes3D
from log2sim.geometry import NS_PER_S, Array, wrap_angle
from log2sim.log_odds import log_odds_of, probability_of
from log2sim.perception.box_fitting import rotate
from log2sim.perception.cooperative.box_errors import BoxErrors
from log2sim.perception.cooperative.matching import (
    POSE_SIGMA_M,
    Pairs,
    SeenBoxes,
    first_speeds,
    is_walking,
    match_by_covariance,
    match_by_overlap,
)
from log2sim.perception.cooperative.offset import take_off_offset
from log2sim.perception.detect3d.suppression import Rectangles, suppress

# Lower and upper side of the one box, then of the other.
_SIDES = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
_OF_OTHER = np.array([0.0, 0.0, 1.0, 1.0])
# Scores nearer to 1 are not believed; nor are headings.
MAX_SCORE = 0.999
# Axes that differ by more are those of a length and of a width.
MAX_TURN_RAD = np.pi / 4
MIN_SIZE_M = 0.2
# Boxes whose four sides and axes differ by more contradict each other: quantile of the chi-square distribution at 99.9 % with
# two degrees of freedom for each of the two axes, and one for the yaw.
CHI2_5DOF_999 = 20.5

# What was too far off to match at first does once others have shown the offset.
OFFSET_ROUNDS = 2

Merge = Callable[[SeenBoxes, SeenBoxes], SeenBoxes]


@dataclass(frozen=True)
class Method:
    """How boxes of two ends are joined.

    Attributes
    ----------
    match : callable
        Of two sets of boxes, which belong together.
    merge : callable
        Of two sets of P boxes that belong together row by row, the joined ones.
    refines : bool
        Whether boxes are first laid against the points of their end, and those of the road moved by what pairs show of its
        pose.
    """

    match: Callable[[SeenBoxes, SeenBoxes], Pairs]
    merge: Merge
    refines: bool


def fuse_boxes(a: SeenBoxes, b: SeenBoxes, method: Method) -> SeenBoxes:
    """Join the boxes of two ends (M,), (N,); those that only one of them sees stay as they are.

    Boxes that stand where a stronger one stands, and still were no match, are left out.
    """
    if not len(a) or not len(b):
        return a if len(a) else b
    i, j = method.match(a, b)
    if method.refines:
        for _ in range(OFFSET_ROUNDS):
            b = take_off_offset(a.take(i), b.take(j), b)
            i, j = method.match(a, b)
    rest_a, rest_b = (np.setdiff1d(np.arange(len(seen)), taken) for seen, taken in ((a, i), (b, j)))
    parts = [method.merge(a.take(i), b.take(j)), a.take(rest_a), b.take(rest_b)]
    out = join([part for part in parts if len(part)])
    names = tuple(GROUPS)
    group = np.array([names.index(GROUP_OF[str(c)]) for c in out.boxes.category], dtype=np.intp)
    flat = Rectangles(out.boxes.center_m[:, :2], out.boxes.size_m[:, :2], out.boxes.yaw_rad)
    return out.take(suppress(flat, out.boxes.score, group))


def join(parts: list[SeenBoxes]) -> SeenBoxes:
    """Concatenate at least one set of boxes."""
    errors = BoxErrors(*(np.concatenate([getattr(p.errors, k) for p in parts]) for k in ("side_m", "yaw_rad")))
    return SeenBoxes(Boxes3D.join([p.boxes for p in parts]), errors)


def merge_by_covariance(a: SeenBoxes, b: SeenBoxes) -> SeenBoxes:
    """Merge boxes (P,) of two ends row by row, each side by its variance; b are those of the road.

    Pairs that contradict each other, in their axes or their sides, take the box whose sides are better known as a whole.
    """
    axes, apart_rad = _join_axes(a, b)
    first, second = (_in_axes(seen, axes, a.boxes.center_m[:, :2]) for seen in (a, b))
    # The time of those points that say most, which later stages measure again.
    t_ns = np.where(b.boxes.points > a.boxes.points, b.boxes.t_ns, a.boxes.t_ns)
    late_s = np.stack([(t - t_ns) / NS_PER_S for t in (a.boxes.t_ns, a.boxes.t_ns, b.boxes.t_ns, b.boxes.t_ns)], axis=1)
    speed = first_speeds(a.boxes)[:, None]
    moves = np.concatenate([speed, np.where(is_walking(a.boxes)[:, None], speed, 0.0)], axis=1)
    pose_m = _pose_sigma(first, second, late_s, moves)
    sides, covariance, misfit = _solve(first, second, late_s, moves, pose_m)
    low, high = sides[..., 0], sides[..., 1]
    center = rotate((low + high) / 2, axes.boxes.yaw_rad) + a.boxes.center_m[:, :2]
    weight = _share_of_second(a, b)
    z, height = (u + weight * (v - u) for u, v in zip(_vertical(a.boxes), _vertical(b.boxes)))
    merged = replace(
        axes.boxes,
        t_ns=t_ns,
        center_m=np.column_stack([center, z]),
        size_m=np.column_stack([np.maximum(high - low, MIN_SIZE_M), height]),
    )
    whole = _take_better(a, b)
    misfit = misfit + apart_rad**2 / (a.errors.yaw_rad**2 + b.errors.yaw_rad**2)
    contradict = (np.abs(apart_rad) > MAX_TURN_RAD) | (misfit > CHI2_5DOF_999)
    variance = np.stack([covariance[..., 0, 0], covariance[..., 1, 1]], axis=-1)
    errors = BoxErrors(
        np.where(contradict[:, None, None], whole.errors.side_m, np.sqrt(variance)),
        np.where(contradict, whole.errors.yaw_rad, axes.errors.yaw_rad),
    )
    return SeenBoxes(_with_both(_choose(contradict, whole.boxes, merged), a.boxes, b.boxes), errors)


def merge_by_points(a: SeenBoxes, b: SeenBoxes) -> SeenBoxes:
    """Merge boxes (P,) of two ends row by row: the mean center, weighted by points, and the rest from the one with more points."""
    more = (b.boxes.points > a.boxes.points)[:, None]
    share = (b.boxes.points / np.maximum(a.boxes.points + b.boxes.points, 1))[:, None]
    chosen = _choose(more[:, 0], b.boxes, a.boxes)
    center = a.boxes.center_m + share * (b.boxes.center_m - a.boxes.center_m)
    errors = BoxErrors(
        np.where(more[..., None], b.errors.side_m, a.errors.side_m),
        np.where(more[:, 0], b.errors.yaw_rad, a.errors.yaw_rad),
    )
    merged = replace(chosen, center_m=center, t_ns=_mean_time(a.boxes, b.boxes))
    return SeenBoxes(_with_both(merged, a.boxes, b.boxes), errors)


METHODS = {
    "covariance": Method(match_by_covariance, merge_by_covariance, True),
    "overlap": Method(match_by_overlap, merge_by_points, False),
}
"""Overlap alone is the feature-level fusion of Chen, "Intelligent Perception System for Vehicle-Road Cooperation"."""


def _mean_time(a: Boxes3D, b: Boxes3D) -> NDArray[np.int64]:
    """Return the mean times (P,) of the points in both boxes, ns."""
    share = b.points / np.maximum(a.points + b.points, 1)
    return np.asarray(a.t_ns + np.round(share * (b.t_ns - a.t_ns)).astype(np.int64))


def _vertical(boxes: Boxes3D) -> tuple[Array, Array]:
    return boxes.center_m[:, 2], boxes.size_m[:, 2]


def _share_of_second(a: SeenBoxes, b: SeenBoxes) -> Array:
    """Return the share (P,) of the second box in what has no error of its own, by the variance of the sides."""
    va, vb = ((seen.errors.side_m**2).sum(axis=(1, 2)) for seen in (a, b))
    return np.asarray(va / (va + vb))


def _take_better(a: SeenBoxes, b: SeenBoxes) -> SeenBoxes:
    """Take of each pair the box whose sides are better known."""
    second = _share_of_second(a, b) > 0.5
    errors = BoxErrors(
        np.where(second[:, None, None], b.errors.side_m, a.errors.side_m),
        np.where(second, b.errors.yaw_rad, a.errors.yaw_rad),
    )
    return SeenBoxes(_choose(second, b.boxes, a.boxes), errors)


def _choose(mask: NDArray[np.bool_], one: Boxes3D, other: Boxes3D) -> Boxes3D:
    """Take rows (P,) of the one where the mask is set, else of the other."""
    return Boxes3D.join([one, other]).take(np.where(mask, 0, len(one)) + np.arange(len(one)))


def _with_both(boxes: Boxes3D, a: Boxes3D, b: Boxes3D) -> Boxes3D:
    """Return joined boxes (P,) with the points of both, scores as independent evidence, and the category of the surer one."""
    score = np.minimum(1 - (1 - a.score) * (1 - b.score), MAX_SCORE)
    category = np.where(b.score > a.score, b.category, a.category)
    seen_by = None if a.seen_by is None or b.seen_by is None else a.seen_by | b.seen_by
    return replace(boxes, score=score, category=category, points=a.points + b.points, seen_by=seen_by)


def _join_axes(a: SeenBoxes, b: SeenBoxes) -> tuple[SeenBoxes, Array]:
    """Return boxes (P,) with the mean axis and heading of both, and the angles (P,) between their axes.

    The axes of pedestrians say little: the surer one is taken, and none is said to be off.
    """
    better, walking = _take_better(a, b), is_walking(a.boxes)
    apart = wrap_angle(2 * (b.boxes.yaw_rad - a.boxes.yaw_rad)) / 2
    va, vb = a.errors.yaw_rad**2, b.errors.yaw_rad**2
    axis = np.where(walking, better.boxes.yaw_rad, a.boxes.yaw_rad + va / (va + vb) * apart)
    ahead = sum(
        np.sign(np.cos(seen.boxes.yaw_rad - axis)) * log_odds_of(np.clip(seen.boxes.heading_score, 0.5, MAX_SCORE))
        for seen in (a, b)
    )
    ahead = np.where(walking, log_odds_of(np.clip(better.boxes.heading_score, 0.5, MAX_SCORE)), ahead)
    yaw = wrap_angle(axis + np.where(ahead < 0, np.pi, 0.0))
    heading = np.minimum(probability_of(np.abs(ahead)), MAX_SCORE)
    boxes = replace(better.boxes, yaw_rad=np.asarray(yaw), heading_score=heading)
    errors = BoxErrors(better.errors.side_m, np.sqrt(va * vb / (va + vb)))
    return SeenBoxes(boxes, errors), np.where(walking, 0.0, apart)


def _in_axes(seen: SeenBoxes, axes: SeenBoxes, origin: Array) -> tuple[Array, Array]:
    """Return the sides (P, 2, 2) of boxes along the axes of others, relative to origins (P, 2), and their standard deviations."""
    center = rotate(seen.boxes.center_m[:, :2] - origin, -axes.boxes.yaw_rad)
    half = seen.boxes.size_m[:, :2] / 2
    turned = np.cos(seen.boxes.yaw_rad - axes.boxes.yaw_rad) < 0
    sigma = np.where(turned[:, None, None], seen.errors.side_m[..., ::-1], seen.errors.side_m)
    return np.stack([center - half, center + half], axis=-1), sigma


def _covariance(first: Array, second: Array, late_s: Array, moves: Array, pose_m: Array | float) -> Array:
    """Return the covariances (P, 2, 4, 4) of the four sides along both axes."""
    out = np.zeros((*first.shape[:2], 4, 4))
    out[..., np.arange(4), np.arange(4)] = np.concatenate([first, second], axis=-1) ** 2
    late = late_s[:, None, :, None] * late_s[:, None, None, :]
    out += (moves**2)[..., None, None] * late
    out += np.asarray(pose_m) ** 2 * np.outer(_OF_OTHER, _OF_OTHER)
    return out


def _pose_sigma(first: tuple[Array, Array], second: tuple[Array, Array], late_s: Array, moves: Array) -> float:
    """Estimate how far the road's sensors are off: what the distances of all pairs show beyond the errors of their boxes.

    The moment estimator of DerSimonian & Laird, "Meta-analysis in clinical trials" (1986), of all axes with equal weights.
    """
    away = second[0].mean(axis=-1) - first[0].mean(axis=-1)
    c = _covariance(first[1], second[1], late_s, moves, 0.0)
    difference = np.array([-0.5, -0.5, 0.5, 0.5])
    expected = np.einsum("i,paij,j->pa", difference, c, difference)
    weight = 1 / (expected + POSE_SIGMA_M**2)
    beyond = float((weight * (away**2 - expected)).sum() / weight.sum()) if weight.size else 0.0
    return float(np.sqrt(max(beyond, POSE_SIGMA_M**2)))


def _solve(
    first: tuple[Array, Array], second: tuple[Array, Array], late_s: Array, moves: Array, pose_m: float
) -> tuple[Array, Array, Array]:
    """Solve for lower and upper sides (P, 2, 2): with their covariances (P, 2, 2, 2) and the squared misfit (P,), 4 degrees."""
    observed = np.concatenate([first[0], second[0]], axis=-1)[..., None]
    weight = np.linalg.inv(_covariance(first[1], second[1], late_s, moves, pose_m))
    covariance = np.linalg.inv(_SIDES.T @ weight @ _SIDES)
    sides = covariance @ _SIDES.T @ weight @ observed
    rest = observed - _SIDES @ sides
    misfit = (np.swapaxes(rest, -1, -2) @ weight @ rest)[..., 0, 0].sum(axis=1)
    return sides[..., 0], covariance, misfit
