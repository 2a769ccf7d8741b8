"""Boxes of the vehicle's and the road's sensors joined: matched, merged side by side, put to one time; or their points aligned.

A detector sees the near sides of an object and guesses where the far ones are. So the sides, not the center, have errors of
their own; those of center and size follow.

A box is four sides with errors of their own (`SeenBoxes`). Besides, all sides of an object move on together between the times
at which the ends saw it, and all sides of a box are off together where the pose of its sensor is. Generalized least squares
with the covariance of all three gives the sides at one time: Aitken, "On least squares and linear combination of observations"
(1935).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import FIRST_SPEED_MPS, ROAD, Boxes3D, Log, Measurements, end_of, groups_of, seen_from
from log2sim.datatypes.log_odds import log_odds_of, probability_of
from log2sim.geometry import CHI2_2DOF_99, NS_PER_S, Array, choose_pairs, rectangle_iou, wrap_angle
from log2sim.perception.boxes import corner_correction, oriented_covariance, real_ends, rotate
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.detect3d.boxes import suppress
from log2sim.perception.detect3d.detectors import LidarDetector, create_lidar_detector
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.measure import measure
from log2sim.plan import ROADSIDE_NETWORK, VEHICLE_NETWORK, FusionLevel, fusion_level, network_for

# Weights of `side_terms` in the logarithm of the standard deviation of a side, m, and of `yaw_terms` in that of the yaw, rad.
# Fitted by `tools/fit.py box_errors` to what lidar:vehicle and lidar:roadside find in random scenes with exact truth.
SIDE_WEIGHTS: dict[str, Array] = {
    "vehicle": np.array([-1.65, -0.15, -0.07, -0.32, 1.31, -0.74, 0.42]),
    "two_wheeler": np.array([-2.03, -0.03, -0.08, -0.12, 0.79, 0.02, 0.4]),
    "pedestrian": np.array([-1.74, -0.1, -0.13, -0.08, 0.68, 0.04, 0.35]),
}
YAW_WEIGHTS: dict[str, Array] = {
    "vehicle": np.array([-1.03, -0.32, -0.19, -0.33]),
    "two_wheeler": np.array([-2.28, 0.08, 0.0, -0.15]),
}
# Scores nearer to 0 or 1 say no more.
MIN_SCORE, MAX_ERROR_SCORE = 0.02, 0.98
# No side is known better than the noise of a LiDAR's ranges and the roundness of bodies allow, and no yaw worse than any.
MIN_SIDE_SIGMA_M, MAX_YAW_SIGMA_RAD = 0.03, np.pi / np.sqrt(12)


def yaw_terms(points: NDArray[np.int64], range_m: Array, score: Array) -> Array:
    """Return 1, log(1 + points), distance in units of 10 m, and the log-odds of the score (M, 4) of boxes."""
    sure = log_odds_of(np.clip(score, MIN_SCORE, MAX_ERROR_SCORE))
    return np.column_stack([np.ones(len(points)), np.log1p(points), range_m / 10.0, sure])


def yaw_sigma(group: Sequence[str] | NDArray[np.str_], terms: Array) -> Array:
    """Return the standard deviations (M,), rad, of the yaws of boxes up to half turns, by their groups (M,) and `yaw_terms` (M, 4)."""
    weights = np.array([YAW_WEIGHTS.get(str(g), np.zeros(4)) for g in group]).reshape(-1, 4)
    return np.asarray(np.minimum(np.exp((weights * terms).sum(axis=-1)), MAX_YAW_SIGMA_RAD))


def _terms_of(boxes: Boxes3D, sensor_m: Array) -> Array:
    return yaw_terms(boxes.points, np.hypot(*(boxes.center_m[:, :2] - sensor_m[:2]).T), boxes.score)


def side_terms(boxes: Boxes3D, sensor_m: Array) -> Array:
    """Return the terms (M, 2, 2, 7) of the errors of the lower and upper ends of boxes along length and width.

    Those of `yaw_terms`, the logarithm of the extent along the axis in m, and the sine of the angle at which the side is seen:
    from the front, else 0, and from behind, else 0.
    """
    half = boxes.size_m[:, :2] / 2
    sensor = rotate(sensor_m[:2] - boxes.center_m[:, :2], -boxes.yaw_rad)
    facing = np.zeros((len(boxes), 2, 2))
    for end, sign in enumerate((-1.0, 1.0)):
        beyond = sign * sensor - half
        facing[..., end] = beyond / np.hypot(beyond, sensor[:, ::-1])
    shared = np.broadcast_to(_terms_of(boxes, sensor_m)[:, None, None], (len(boxes), 2, 2, 4))
    extent = np.broadcast_to(np.log(2 * half)[..., None], facing.shape)
    seen = [extent, np.maximum(facing, 0.0), np.maximum(-facing, 0.0)]
    return np.concatenate([shared, np.stack(seen, axis=-1)], axis=-1)


# Fewer points are too far apart to say where a side ends: in random scenes they made boxes worse.
MIN_REFINED_POINTS = 20
# Networks guess the length of a vehicle better: where points say otherwise, a part of it was not observed.
MAX_LENGTH_SHARE = 0.25
# Some bodies return few rays, and not from their ends: in random scenes two lengths were a meter too short with some 100 points, and
# those with 150 and more mostly right. Not varied one by one.
MIN_WHOLE_POINTS = 150
# Of a body that returns no light, wheels, sills and what is behind windows are seen, and none of the ends. Between its wheels its flank has a
# gap of half its length, others of a wheel at most; above sills and below windows, as shares of the height.
MAX_GAP_SHARE, FLANK_SHARES = 0.25, (0.25, 0.5)
# Between the sweeps of two ends, road users in towns move so far.
MOVED_M = 0.3


def refine_boxes(boxes: Boxes3D, view: Cloud) -> Boxes3D:
    """Move and turn boxes (M,) to the sides that points of a viewpoint show; they grow to hold them.

    A vehicle whose flank is observed, with rays that pass both of its ends, is as long as its points: the network's estimate would be
    wrong for all viewpoints alike.
    """
    mine = np.flatnonzero(boxes.points >= MIN_REFINED_POINTS)
    rows = measure([], boxes.take(mine), view)
    size, yaw, center = boxes.size_m.copy(), boxes.yaw_rad.copy(), boxes.center_m.copy()
    # The yaw of points is known up to half turns.
    turned = np.cos(rows.yaw_rad - yaw[mine]) < 0
    yaw[mine] = rows.yaw_rad + np.where(turned, np.pi, 0.0)
    center[mine, :2] = rows.center_m[:, :2]
    size[mine, :2] = np.fmax(size[mine, :2], rows.high_m - rows.low_m)
    real = real_ends(rows.low_m, rows.high_m, np.zeros(2), rows.ends_visible)
    low, high = corner_correction(rows.low_m, rows.high_m, real, size[mine, 1])
    length = (high - low)[:, 0]
    is_whole = (
        (groups_of(boxes.category[mine]) == "vehicle")
        & real[:, 0].all(axis=1)
        & (rows.points >= MIN_WHOLE_POINTS)
        & (np.abs(length / boxes.size_m[mine, 0] - 1) <= MAX_LENGTH_SHARE)
        & (_largest_gaps(rows) <= MAX_GAP_SHARE * length)
    )
    # Along its length to the middle of what is observed.
    axis = np.column_stack([np.cos(rows.yaw_rad), np.sin(rows.yaw_rad)])
    toward = (low + high)[:, 0] / 2 - ((rows.center_m - rows.sensor_m)[:, :2] * axis).sum(axis=1)
    center[mine, :2] += np.where(is_whole, toward, 0.0)[:, None] * axis
    size[mine, 0] = np.where(is_whole, length, size[mine, 0])
    return replace(boxes, center_m=center, size_m=size, yaw_rad=yaw)


def _largest_gaps(rows: Measurements) -> Array:
    """Return the largest distance (M,) along the length, m, between points of flanks, below windows, and between these and the ends.

    0 where rays miss the flank at these heights.
    """
    out = np.zeros(len(rows))
    for k in range(len(rows)):
        points = rows.points_of(k)
        share = (points[:, 2] - rows.bottom_m[k]) / (rows.top_m[k] - rows.bottom_m[k])
        flank = points[(share >= FLANK_SHARES[0]) & (share <= FLANK_SHARES[1]), :2] - rows.sensor_m[k, :2]
        if len(flank):
            along = np.append(rotate(flank, -float(rows.yaw_rad[k]))[:, 0], [rows.low_m[k, 0], rows.high_m[k, 0]])
            out[k] = np.diff(np.sort(along)).max()
    return out


# Boxes of one class with such an IoU are one object (Chen, "Vehicle-Road Cooperation", gives no value; half of what is
# asked of a detection is usual for boxes of two detectors).
MIN_CLASS_IOU = 0.3
# Road users do not share ground: boxes of one group that overlap by more are one object, whatever their errors.
MIN_GROUP_IOU = 0.1
# Standard deviations of where the road's sensors are and how they are turned after registration, m and rad.
POSE_SIGMA_M, POSE_SIGMA_RAD = 0.1, np.deg2rad(0.3)


@dataclass(frozen=True, eq=False)
class SeenBoxes:
    """Boxes with standard deviations of their errors."""

    boxes: Boxes3D  # M Boxes3D
    sigma_m: Array  # (M, 2, 2): of the lower and the upper end along the length and the width
    sigma_rad: Array  # (M,): of the yaw, up to half turns
    sensor_m: Array | None = None  # (3,): where they are all seen from, m, map frame

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.boxes)

    @classmethod
    def of(cls, boxes: Boxes3D, sensor_m: Array) -> Self:
        """Estimate the errors of boxes (M,) that were seen from a sensor at (3,), m, map frame."""
        group = groups_of(boxes.category)
        of_sides = np.array([SIDE_WEIGHTS.get(g, SIDE_WEIGHTS["vehicle"]) for g in group]).reshape(-1, 1, 1, 7)
        side = np.exp((of_sides * side_terms(boxes, sensor_m)).sum(axis=-1))
        yaw = yaw_sigma(group, _terms_of(boxes, sensor_m))
        return cls(boxes, np.maximum(side, MIN_SIDE_SIGMA_M), yaw, sensor_m)

    def take(self, index: NDArray[Any]) -> SeenBoxes:
        """Take the boxes at `index`, integers or a mask."""
        return SeenBoxes(self.boxes.take(index), self.sigma_m[index], self.sigma_rad[index], self.sensor_m)

    @property
    def rectangles(self) -> Array:
        """The boxes in the plane (M, 5): x, y, length, width, yaw."""
        b = self.boxes
        return np.column_stack([b.center_m[:, :2], b.size_m[:, :2], b.yaw_rad])

    @property
    def center_covariance(self) -> Array:
        """Covariances (M, 2, 2) of the centers, m2, map frame."""
        sigma_m = np.hypot(self.sigma_m[..., 0], self.sigma_m[..., 1]) / 2
        return oriented_covariance(sigma_m, self.boxes.yaw_rad)


Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Rows of the one and of the other end that belong together."""


def match_by_overlap(a: SeenBoxes, b: SeenBoxes) -> Pairs:
    """Match boxes of one class by their IoU in the ground plane, the pairs with the greatest sum."""
    i, j = _touching(a, b)
    iou = rectangle_iou(a.take(i).rectangles, b.take(j).rectangles)
    allowed = (iou >= MIN_CLASS_IOU) & (a.boxes.category[i] == b.boxes.category[j])
    return _best(i, j, 1 - iou, allowed)


def match_by_covariance(a: SeenBoxes, b: SeenBoxes) -> Pairs:
    """Match boxes of one group by the distance of their centers in relation to its standard deviation.

    Boxes that hardly overlap are matched if they are as near as their errors, those of the poses, and the motion between
    their times allow; never those whose centers are farther apart than they are long.
    """
    i, j = _touching(a, b)
    one, other = a.take(i), b.take(j)
    away = one.boxes.center_m[:, :2] - other.boxes.center_m[:, :2]
    c = one.center_covariance + other.center_covariance + POSE_SIGMA_M**2 * np.eye(2) + motion_covariance(one, other)
    squared = np.einsum("pi,pi->p", away, np.linalg.solve(c, away[..., None])[..., 0])
    reach = (one.boxes.size_m[:, 0] + other.boxes.size_m[:, 0]) / 2
    near = (squared <= CHI2_2DOF_99) & (np.hypot(away[:, 0], away[:, 1]) <= reach)
    overlap = rectangle_iou(one.rectangles, other.rectangles) >= MIN_GROUP_IOU
    allowed = (near | overlap) & (groups_of(one.boxes.category) == groups_of(other.boxes.category))
    return _best(i, j, np.minimum(squared, CHI2_2DOF_99), allowed)


def _best(i: NDArray[np.intp], j: NDArray[np.intp], cost: Array, allowed: NDArray[np.bool_]) -> Pairs:
    """Choose pairs (P,) one to one, as many as possible and of these the cheapest, among those that are allowed."""
    i, j = i[allowed], j[allowed]
    chosen = choose_pairs(i, j, cost[allowed])
    return i[chosen], j[chosen]


def _touching(a: SeenBoxes, b: SeenBoxes) -> Pairs:
    """Find the pairs of boxes that may overlap: circles around them do."""
    away = a.boxes.center_m[:, None, :2] - b.boxes.center_m[:, :2]
    radius_a, radius_b = (np.hypot(*seen.boxes.size_m[:, :2].T) / 2 for seen in (a, b))
    i, j = np.nonzero(np.hypot(away[..., 0], away[..., 1]) <= radius_a[:, None] + radius_b)
    return i, j


def motion_covariance(a: SeenBoxes, b: SeenBoxes) -> Array:
    """Return the covariances (P, 2, 2) of what objects move between the times of boxes a and b, row by row the same objects.

    Road users move along their axis, but for those who walk.
    """
    moved_m = first_speeds(a.boxes) * np.abs(a.boxes.t_ns - b.boxes.t_ns) / NS_PER_S
    across_m = np.where(is_walking(a.boxes), moved_m, 0.0)
    return oriented_covariance(np.stack([moved_m, across_m], axis=-1), a.boxes.yaw_rad)


def first_speeds(boxes: Boxes3D) -> Array:
    """Return the standard deviations (M,) of the speeds of objects of which no more is known than their group, m/s."""
    return np.array([FIRST_SPEED_MPS[group] for group in groups_of(boxes.category)], dtype=np.float64)


def is_walking(boxes: Boxes3D) -> NDArray[np.bool_]:
    """Mark the boxes (M,) of objects that move in any direction, and whose axes say little."""
    return np.isin(groups_of(boxes.category), ("pedestrian", "other"))


ROUNDS = 4
# Pairs that are off by more standard deviations lose weight: boxes of different objects, or of a part of one.
CAUCHY_SIGMAS = 2.0


def take_off_offset(a: SeenBoxes, b: SeenBoxes, b_all: SeenBoxes) -> SeenBoxes:
    """Move all boxes of the road to where pairs of boxes (P,) that belong together show that they are.

    `a`, `b`: of the vehicle and of the road, row by row the same objects. `b_all`: N SeenBoxes: of the road.

    A shift and a turn about the sensor by weighted least squares. Their prior is what registration leaves: a single pair says
    little, and many move the boxes where they agree to. Cauchy's weights make single wrong pairs harmless (Holland & Welsch,
    "Robust regression using iteratively reweighted least-squares", 1977).
    """
    if not len(a) or b_all.sensor_m is None:
        return b_all
    pivot = b_all.sensor_m[:2]
    away = b.boxes.center_m[:, :2] - pivot
    difference = a.boxes.center_m[:, :2] - b.boxes.center_m[:, :2]
    precision = np.linalg.inv(a.center_covariance + b.center_covariance + motion_covariance(a, b))
    design = np.zeros((len(a), 2, 3))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    design[:, 0, 2], design[:, 1, 2] = -away[:, 1], away[:, 0]
    turned = wrap_angle(2 * (a.boxes.yaw_rad - b.boxes.yaw_rad)) / 2
    of_yaw = np.where(is_walking(a.boxes), 0.0, 1 / (a.sigma_rad**2 + b.sigma_rad**2))
    prior = np.diag([POSE_SIGMA_M**-2, POSE_SIGMA_M**-2, POSE_SIGMA_RAD**-2])
    x = np.zeros(3)
    for _ in range(ROUNDS):
        rest, rest_yaw = difference - design @ x, turned - x[2]
        squared = np.einsum("pi,pij,pj->p", rest, precision, rest) + of_yaw * rest_yaw**2
        weight = 1 / (1 + squared / CAUCHY_SIGMAS**2)
        weighted = weight[:, None, None] * precision
        normal = prior + np.einsum("pik,pij,pjl->kl", design, weighted, design)
        right = np.einsum("pik,pij,pj->k", design, weighted, difference)
        normal[2, 2] += (weight * of_yaw).sum()
        right[2] += (weight * of_yaw * turned).sum()
        x = np.linalg.solve(normal, right)
    boxes, away, turn = b_all.boxes, b_all.boxes.center_m[:, :2] - pivot, float(x[2])
    moved = boxes.center_m.copy()
    moved[:, :2] += x[:2] + turn * np.column_stack([-away[:, 1], away[:, 0]])
    return replace(b_all, boxes=replace(boxes, center_m=moved, yaw_rad=boxes.yaw_rad + turn))


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


@dataclass(frozen=True)
class Method:
    """How boxes of two ends are joined."""

    match: Callable[[SeenBoxes, SeenBoxes], Pairs]  # of two sets of boxes, which belong together
    # Of two sets of P boxes that belong together row by row, the joined ones
    merge: Callable[[SeenBoxes, SeenBoxes], SeenBoxes]
    # Whether boxes are first laid against the points of their end, and the road's moved by what pairs show of its pose
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
    out = join([method.merge(a.take(i), b.take(j)), a.take(rest_a), b.take(rest_b)])
    return out.take(suppress(out.rectangles, out.boxes.score, groups_of(out.boxes.category)))


def join(parts: list[SeenBoxes]) -> SeenBoxes:
    """Concatenate at least one set of boxes."""
    sigmas = (np.concatenate([getattr(p, name) for p in parts]) for name in ("sigma_m", "sigma_rad"))
    return SeenBoxes(Boxes3D.join([p.boxes for p in parts]), *sigmas)


def merge_by_covariance(a: SeenBoxes, b: SeenBoxes) -> SeenBoxes:
    """Merge boxes (P,) of two ends row by row, each side by its variance; b are those of the road.

    Pairs that contradict each other, in their axes or their sides, take the box whose sides are better known as a whole.
    """
    # The share of the second box in what has no error of its own, by the variance of the sides.
    variance_a, variance_b = ((seen.sigma_m**2).sum(axis=(1, 2)) for seen in (a, b))
    weight = variance_a / (variance_a + variance_b)
    # The mean axis and heading; the axes of pedestrians say little: the surer one is taken, and none is said to be off.
    better, walking = _choose(weight > 0.5, b, a), is_walking(a.boxes)
    apart_rad = wrap_angle(2 * (b.boxes.yaw_rad - a.boxes.yaw_rad)) / 2
    va, vb = a.sigma_rad**2, b.sigma_rad**2
    axis = np.where(walking, better.boxes.yaw_rad, a.boxes.yaw_rad + va / (va + vb) * apart_rad)
    ahead = sum(
        np.sign(np.cos(seen.boxes.yaw_rad - axis)) * log_odds_of(np.clip(seen.boxes.heading_score, 0.5, MAX_SCORE))
        for seen in (a, b)
    )
    ahead = np.where(walking, log_odds_of(np.clip(better.boxes.heading_score, 0.5, MAX_SCORE)), ahead)
    yaw, apart_rad = wrap_angle(axis + np.where(ahead < 0, np.pi, 0.0)), np.where(walking, 0.0, apart_rad)
    # Sides (P, 2, 2) along this axis relative to the centers of a, and their standard deviations.
    sides_of = []
    for seen in (a, b):
        center, half = rotate(seen.boxes.center_m[:, :2] - a.boxes.center_m[:, :2], -yaw), seen.boxes.size_m[:, :2] / 2
        turned = np.cos(seen.boxes.yaw_rad - yaw) < 0
        sigma_m = np.where(turned[:, None, None], seen.sigma_m[..., ::-1], seen.sigma_m)
        sides_of.append((np.stack([center - half, center + half], axis=-1), sigma_m))
    first, second = sides_of
    # The time of those points that say most, which later stages measure again.
    t_ns = np.where(b.boxes.points > a.boxes.points, b.boxes.t_ns, a.boxes.t_ns)
    late_s = np.stack([(t - t_ns) / NS_PER_S for t in (a.boxes.t_ns, a.boxes.t_ns, b.boxes.t_ns, b.boxes.t_ns)], axis=1)
    speed = first_speeds(a.boxes)[:, None]
    moves = np.concatenate([speed, np.where(is_walking(a.boxes)[:, None], speed, 0.0)], axis=1)
    # How far the road's sensors are off: what the distances of all pairs show beyond the errors of their boxes, by the moment
    # estimator of DerSimonian & Laird, "Meta-analysis in clinical trials" (1986), of all axes with equal weights.
    off_m = second[0].mean(axis=-1) - first[0].mean(axis=-1)
    c, difference = _covariance(first[1], second[1], late_s, moves, 0.0), np.array([-0.5, -0.5, 0.5, 0.5])
    expected = np.einsum("i,paij,j->pa", difference, c, difference)
    of_pair = 1 / (expected + POSE_SIGMA_M**2)
    beyond = float((of_pair * (off_m**2 - expected)).sum() / of_pair.sum()) if of_pair.size else 0.0
    pose_m = float(np.sqrt(max(beyond, POSE_SIGMA_M**2)))
    # Lower and upper sides (P, 2, 2), their covariances (P, 2, 2, 2) and the squared misfit (P,), of 4 degrees of freedom.
    observed = np.concatenate([first[0], second[0]], axis=-1)[..., None]
    precision = np.linalg.inv(_covariance(first[1], second[1], late_s, moves, pose_m))
    covariance = np.linalg.inv(_SIDES.T @ precision @ _SIDES)
    sides = covariance @ _SIDES.T @ precision @ observed
    rest = observed - _SIDES @ sides
    misfit = (np.swapaxes(rest, -1, -2) @ precision @ rest)[..., 0, 0].sum(axis=1) + apart_rad**2 / (va + vb)
    low, high = sides[..., 0, 0], sides[..., 1, 0]
    center = rotate((low + high) / 2, yaw) + a.boxes.center_m[:, :2]
    z, height = (
        getattr(a.boxes, name)[:, 2] + weight * (getattr(b.boxes, name)[:, 2] - getattr(a.boxes, name)[:, 2])
        for name in ("center_m", "size_m")
    )
    merged = replace(
        better.boxes,
        t_ns=t_ns,
        center_m=np.column_stack([center, z]),
        size_m=np.column_stack([np.maximum(high - low, MIN_SIZE_M), height]),
        yaw_rad=np.asarray(yaw),
        heading_score=np.minimum(probability_of(np.abs(ahead)), MAX_SCORE),
    )
    contradict = (np.abs(apart_rad) > MAX_TURN_RAD) | (misfit > CHI2_5DOF_999)
    variance = np.stack([covariance[..., 0, 0], covariance[..., 1, 1]], axis=-1)
    chosen = _choose(contradict, better, SeenBoxes(merged, np.sqrt(variance), np.sqrt(va * vb / (va + vb))))
    return replace(chosen, boxes=_join_evidence(chosen.boxes, a.boxes, b.boxes))


def merge_by_points(a: SeenBoxes, b: SeenBoxes) -> SeenBoxes:
    """Merge boxes (P,) of two ends row by row: the mean center, weighted by points, and the rest from the one with more points."""
    chosen = _choose(b.boxes.points > a.boxes.points, b, a)
    share = b.boxes.points / np.maximum(a.boxes.points + b.boxes.points, 1)
    center = a.boxes.center_m + share[:, None] * (b.boxes.center_m - a.boxes.center_m)
    t_ns = a.boxes.t_ns + np.round(share * (b.boxes.t_ns - a.boxes.t_ns)).astype(np.int64)
    merged = replace(chosen.boxes, center_m=center, t_ns=t_ns)
    return replace(chosen, boxes=_join_evidence(merged, a.boxes, b.boxes))


def refine_by_views(boxes: Boxes3D, views: Sequence[Cloud]) -> Boxes3D:
    """Move the sides of boxes (M,) that were found in the points of several viewpoints to where each of these sees them.

    What a network makes of the points of both ends is less exact than what the sides show that each end sees well, put to one time.
    """
    rows, known = np.zeros(0, dtype=np.intp), list[SeenBoxes]()
    for view in views:
        # Objects move between the times of the viewpoints.
        around = boxes.center_m - view.origin, boxes.size_m + 2 * MOVED_M, boxes.yaw_rad
        inside = points_of_boxes(view.xyz, *around, ~view.ground)
        count = np.bincount(inside.box, minlength=len(boxes))
        late_s = np.bincount(inside.box, view.t_s[inside.point], len(boxes)) / np.maximum(count, 1)
        t_ns = view.stamp_ns + np.round(late_s * NS_PER_S).astype(np.int64)
        own = np.flatnonzero(count >= MIN_REFINED_POINTS)
        found = refine_boxes(replace(boxes, points=count, t_ns=t_ns).take(own), view)
        seen = SeenBoxes.of(found, view.sensor.astype(np.float64) + view.origin)
        if known:
            _, i, j = np.intersect1d(rows, own, return_indices=True)
            alone, new = np.setdiff1d(np.arange(len(rows)), i), np.setdiff1d(np.arange(len(own)), j)
            parts = [merge_by_covariance(known[0].take(i), seen.take(j)), known[0].take(alone), seen.take(new)]
            rows, known = np.concatenate([rows[i], rows[alone], own[new]]), [join(parts)]
        else:
            rows, known = own, [seen]
    if not known:
        return boxes
    t_ns, center, size, yaw = boxes.t_ns.copy(), boxes.center_m.copy(), boxes.size_m.copy(), boxes.yaw_rad.copy()
    refined = known[0].boxes
    t_ns[rows], center[rows], size[rows], yaw[rows] = refined.t_ns, refined.center_m, refined.size_m, refined.yaw_rad
    return replace(boxes, t_ns=t_ns, center_m=center, size_m=size, yaw_rad=yaw)


METHODS = {
    "covariance": Method(match_by_covariance, merge_by_covariance, True),
    "overlap": Method(match_by_overlap, merge_by_points, False),
}
"""Overlap alone is the feature-level fusion of Chen, "Intelligent Perception System for Vehicle-Road Cooperation"."""


def _choose(mask: NDArray[np.bool_], one: SeenBoxes, other: SeenBoxes) -> SeenBoxes:
    """Take rows (P,) of the one where the mask is set, else of the other."""
    return join([one, other]).take(np.where(mask, 0, len(one)) + np.arange(len(one)))


def _join_evidence(boxes: Boxes3D, a: Boxes3D, b: Boxes3D) -> Boxes3D:
    """Return joined boxes (P,) with the points of both, scores as independent evidence, and the category of the surer one."""
    score = np.minimum(1 - (1 - a.score) * (1 - b.score), MAX_SCORE)
    category = np.where(b.score > a.score, b.category, a.category)
    seen_by = None if a.seen_by is None or b.seen_by is None else a.seen_by | b.seen_by
    return replace(boxes, score=score, category=category, points=a.points + b.points, seen_by=seen_by)


def _covariance(first: Array, second: Array, late_s: Array, moves: Array, pose_m: Array | float) -> Array:
    """Return the covariances (P, 2, 4, 4) of the four sides along both axes."""
    out = np.zeros((*first.shape[:2], 4, 4))
    out[..., np.arange(4), np.arange(4)] = np.concatenate([first, second], axis=-1) ** 2
    late = late_s[:, None, :, None] * late_s[:, None, None, :]
    out += (moves**2)[..., None, None] * late
    out += np.asarray(pose_m) ** 2 * np.outer(_OF_OTHER, _OF_OTHER)
    return out


# Boxes that are no road users must not move points.
MIN_MOVED_SCORE = 0.3
# Slower objects move less between the sweeps of a tick than a box is off; none is faster on a road with people beside it.
MIN_SPEED_MPS, MAX_SPEED_MPS = 4.0, 40.0
# Vehicles go where they point: of what moves across, the boxes are wrong.
MAX_ACROSS_SHARE = 0.3
# A box is off by less than this after it was moved on.
MARGIN_M = 0.3


def align_parts(cloud: Cloud, before: Sequence[Boxes3D]) -> Cloud:
    """Move the points of vehicles and riders, by how these moved between two earlier moments, to the time of most of their points.

    A cloud without parts is returned as it is. `before`: what was found at the two moments before, the earlier first.
    """
    if not cloud.parts or len(before) < 2:
        return cloud
    boxes, speed = moving_boxes(*before)
    if not len(boxes):
        return cloud
    xyz, t_s = cloud.xyz.copy(), cloud.t_s.copy()
    first = np.cumsum([0, *(len(part.xyz) for part in cloud.parts)])
    of_parts = [np.arange(a, b)[part.obstacles] for part, a, b in zip(cloud.parts, first, first[1:])]
    axis, members = np.column_stack([np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)]), []
    for index in of_parts:
        if not len(index):
            members.append([index] * len(boxes))
            continue
        # The points in each box where it is at the mean time of all.
        at_ns = cloud.stamp_ns + int(cloud.t_s[index].mean(dtype=np.float64) * NS_PER_S)
        center = boxes.center_m - cloud.origin
        center[:, :2] += (speed * (at_ns - boxes.t_ns) / NS_PER_S)[:, None] * axis
        found = points_of_boxes(cloud.xyz[index], center, boxes.size_m + 2 * MARGIN_M, boxes.yaw_rad)
        members.append([index[found.point[found.box == k]] for k in range(len(boxes))])
    for k in range(len(boxes)):
        own = [m[k] for m in members]
        most = max(own, key=len)
        if not len(most):
            continue
        points = np.concatenate(own)
        at_s = np.float32(cloud.t_s[most].mean())
        xyz[points, :2] += (at_s - cloud.t_s[points])[:, None] * (speed[k] * axis[k]).astype(np.float32)
        t_s[points] = at_s
    return replace(cloud, xyz=xyz, t_s=t_s)


def moving_boxes(earlier: Boxes3D, later: Boxes3D) -> tuple[Boxes3D, Array]:
    """Return the boxes (M,) of the later moment that moved along their axis since the earlier one, and their speeds (M,), m/s."""
    a, b = (
        found.take(np.isin(groups_of(found.category), ("vehicle", "two_wheeler")) & (found.score >= MIN_MOVED_SCORE))
        for found in (earlier, later)
    )
    if not len(a) or not len(b):
        return b.take(np.zeros(0, dtype=np.intp)), np.zeros(0)
    away = b.center_m[:, None, :2] - a.center_m[:, :2]
    passed_s = np.maximum((b.t_ns[:, None] - a.t_ns) / NS_PER_S, 1.0 / NS_PER_S)
    distance = np.hypot(away[..., 0], away[..., 1])
    allowed = (distance <= MAX_SPEED_MPS * passed_s) & (b.category[:, None] == a.category)
    first, second = np.indices(allowed.shape)
    i, j = _best(first, second, distance, allowed)
    local = rotate(away[i, j], -b.yaw_rad[i])
    speed = local[:, 0] / passed_s[i, j]
    moves = (np.abs(speed) >= MIN_SPEED_MPS) & (np.abs(local[:, 1]) <= MAX_ACROSS_SHARE * np.abs(local[:, 0]))
    return b.take(i[moves]), speed[moves]


AUTO = "auto"
# LiDARs at the road do not move; poses scatter by less.
SAME_PLACE_M = 1.0
# What labels say is not to be moved.
LABELS = "lidar:labels"


@dataclass(frozen=True, eq=False)
class EndsDetector:
    """Detector of road users in the clouds of both ends."""

    vehicle: LidarDetector  # `vehicle`, `road`: for the clouds of each end
    road: LidarDetector | None  # without it the points of both ends are searched together, by the vehicle's
    method: Method | None  # how boxes of the ends are joined; None without a detector of the road's

    @property
    def name(self) -> str:
        """Names of both detectors, the vehicle's first; one where they are the same."""
        names = dict.fromkeys(d.name for d in (self.vehicle, self.road) if d is not None)
        return "|".join(names)

    @property
    def cache_key(self) -> str | None:
        """What its boxes depend on besides the clouds; None where a detector does not say."""
        keys = ["" if d is None else getattr(d, "cache_key", None) for d in (self.vehicle, self.road)]
        method = [name for name, method in METHODS.items() if method is self.method]
        return f"{keys} {method}" if all(isinstance(key, str) for key in keys) else None

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        """Detect road users in the cloud of each viewpoint and join them; `earlier` clouds are those of the same viewpoint."""
        road, method = self.road, self.method
        if road is None or method is None:
            return refine_by_views(self.vehicle.detect(cloud, earlier), cloud.parts)
        parts = []
        for view in cloud.views:
            # Those of the same end and, at the road, of the same place.
            before = [
                other
                for other in (other for cloud in earlier for other in cloud.views if other.end == view.end)
                if view.end != ROAD
                or np.linalg.norm(view.sensor + view.origin - other.sensor - other.origin) < SAME_PLACE_M
            ]
            found = (road if view.end == ROAD else self.vehicle).detect(view, before)
            found = refine_boxes(found, view) if method.refines else found
            found = replace(found, seen_by=seen_from(view.end, len(found)))
            parts.append(SeenBoxes.of(found, view.sensor.astype(np.float64) + view.origin))
        out = reduce(lambda a, b: fuse_boxes(a, b, method), parts).boxes
        return out.take(np.argsort(-out.score, kind="stable"))


def create_for_ends(log: Log, config: Config, given: LidarDetector | None = None) -> LidarDetector:
    """Make the detector in LiDAR sweeps of a log, one for each end where these are searched apart.

    `given`: takes the place of the one that the settings name.

    Raises `ConfigError`, `MissingExtra`: see `create_lidar_detector`.
    """
    name, level = config.detect.in_sweeps, fusion_level(log, config)[0]
    vehicle = given or create_lidar_detector(name, log, config.lidar)
    if level is None or (level is FusionLevel.POINTS and name == LABELS):
        return vehicle
    if level is FusionLevel.POINTS:
        return EndsDetector(vehicle, None, None)
    chosen = config.cooperation.road_detector
    road_name = detector_by_mounting(log, name) if chosen == AUTO else chosen
    road = vehicle if road_name == name else create_lidar_detector(road_name, log, config.lidar)
    return EndsDetector(vehicle, road, METHODS[config.cooperation.matching])


def detector_by_mounting(log: Log, name: str) -> str:
    """Return the shipped detector that fits how the road's LiDARs look down; a detector of the user's own is for both ends."""
    if name not in (VEHICLE_NETWORK, ROADSIDE_NETWORK):
        return name
    return network_for(lidar for lidar in log.lidars.values() if end_of(lidar) == ROAD)
