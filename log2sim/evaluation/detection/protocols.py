"""What counts and which found box is which true one, by protocol."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import CATEGORIES
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.geometry import Array, rectangle_iou, upright_box_iou

Measure = Literal["iou_3d", "iou_bev", "center_m"]
FLAT = [0, 1, 3, 4, 6]  # x, y, length, width, yaw
MAX_PAIRS_AT_ONCE = 2_000_000  # limits memory to some 100 MB


@dataclass(frozen=True)
class Criterion:
    """When a found and a true box match."""

    # IoU of the boxes, IoU of their outlines on the ground, or horizontal distance of their centers.
    measure: Measure
    limit: float  # IoU above which, or distance in m below which, boxes match

    def __post_init__(self) -> None:
        """Check the limit."""
        if self.measure not in ("iou_3d", "iou_bev", "center_m"):
            raise ValueError(f"measure is '{self.measure}', expected iou_3d, iou_bev or center_m")
        if not (self.limit > 0 if self.measure == "center_m" else 0 <= self.limit < 1):
            expected = "above 0 m" if self.measure == "center_m" else "from 0 to below 1"
            raise ValueError(f"limit of {self.measure} is {self.limit:g}, expected {expected}")

    def __str__(self) -> str:
        """Name the criterion, such as "IoU 3D > 0.7" or "center < 1 m"."""
        if self.measure == "center_m":
            return f"center < {self.limit:g} m"
        return f"IoU {'3D' if self.measure == 'iou_3d' else 'BEV'} > {self.limit:g}"


@dataclass(frozen=True, eq=False)
class BoxPairs:
    """Pairs of found and true boxes that may match."""

    # found, truth: (P,) rows of both tables.
    found: NDArray[np.int64]
    truth: NDArray[np.int64]
    value: Array  # (P,) IoU or distance


@dataclass(frozen=True, eq=False)
class Matches:
    """The true box of each found one."""

    truth: NDArray[np.int64]  # (M,) row of the true box; -1 without
    value: Array  # (M,) IoU or distance of the match, NaN without
    right: NDArray[np.bool_]  # (M,) found boxes that match a counted true box
    false: NDArray[np.bool_]  # (M,) found boxes that match nothing; ignored ones are neither right nor false
    truths: int  # number of counted true boxes

    def excusing(self, rows: NDArray[np.bool_]) -> Matches:
        """Return matches in which the boxes of a mask (M,) are not false where they match nothing."""
        return replace(self, false=self.false & ~rows)


def match_detections(found: SceneBoxes, truth: SceneBoxes, criterion: Criterion) -> Matches:
    """Match found and true boxes of all scenes one to one, best score first.

    `found`, `truth`: of one class: categories are not compared.
    """
    return assign_boxes(found, truth, candidate_pairs(found, truth, criterion), criterion)


def assign_boxes(found: SceneBoxes, truth: SceneBoxes, pairs: BoxPairs, criterion: Criterion) -> Matches:
    """Choose among candidate pairs, which do not depend on what is ignored; see `match_detections`.

    A found box takes the best true box that is free, a counted one before an ignored one. Ignored found boxes come last. So
    the matches of the boxes above a score do not depend on those below. This is the order of PASCAL VOC and nuScenes; KITTI
    lets true boxes choose, which gives the same counts wherever a found box can match one true box only, as above an IoU of
    one half. Found boxes beyond the first on one true box are false, ignored true boxes included, as in KITTI.
    """
    i, j, value = pairs.found, pairs.truth, pairs.value
    closeness = -value if criterion.measure == "center_m" else value
    order = np.lexsort((j, -closeness, truth.ignored[j], i, -found.score[i], found.ignored[i]))
    partner, of_pair = np.full(len(found), -1, dtype=np.int64), np.full(len(found), np.nan)
    taken = np.zeros(len(truth), dtype=bool)
    for a, b, v in zip(i[order].tolist(), j[order].tolist(), value[order].tolist(), strict=True):
        if partner[a] < 0 and not taken[b]:
            partner[a], of_pair[a], taken[b] = b, v, True
    matched = partner >= 0
    to_counted = matched.copy()
    to_counted[matched] = ~truth.ignored[partner[matched]]
    counted = int(np.count_nonzero(~truth.ignored))
    return Matches(partner, of_pair, to_counted & ~found.ignored, ~matched & ~found.ignored, counted)


def candidate_pairs(found: SceneBoxes, truth: SceneBoxes, criterion: Criterion) -> BoxPairs:
    """List the pairs of boxes of one scene that meet a criterion."""
    rows_i, rows_j, values = [], [], []
    for i, j in _pairs_in_scenes(found.scene, truth.scene):
        a, b = found.box[i], truth.box[j]
        distance = np.hypot(a[:, 0] - b[:, 0], a[:, 1] - b[:, 1])
        if criterion.measure == "center_m":
            near, value = distance < criterion.limit, distance
        else:
            reach = (np.hypot(a[:, 3], a[:, 4]) + np.hypot(b[:, 3], b[:, 4])) / 2
            gate = distance < reach
            i, j, a, b = i[gate], j[gate], a[gate], b[gate]
            value = upright_box_iou(a, b) if criterion.measure == "iou_3d" else rectangle_iou(a[:, FLAT], b[:, FLAT])
            near = value > criterion.limit
        rows_i.append(i[near])
        rows_j.append(j[near])
        values.append(value[near])
    if not values:
        return BoxPairs(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))
    return BoxPairs(np.concatenate(rows_i), np.concatenate(rows_j), np.concatenate(values))


def _pairs_in_scenes(
    scene_a: NDArray[np.int64], scene_b: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield all pairs of rows with one scene, in parts of about `MAX_PAIRS_AT_ONCE`."""
    order = np.argsort(scene_b, kind="stable")
    begin = np.searchsorted(scene_b[order], scene_a)
    count = np.searchsorted(scene_b[order], scene_a, side="right") - begin
    part = np.cumsum(count) // MAX_PAIRS_AT_ONCE
    for k in np.unique(part):
        rows = np.flatnonzero((part == k) & (count > 0))
        if not len(rows):
            continue
        n = count[rows]
        within = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
        yield np.repeat(rows, n).astype(np.int64), order[np.repeat(begin[rows], n) + within].astype(np.int64)


# True boxes with fewer points are ignored outside KITTI's difficulties: they show no extent (Waymo's level 1: over 5).
MIN_POINTS = 5


@dataclass(frozen=True)
class ObjectClass:
    """A class of a protocol."""

    name: str
    categories: tuple[str, ...]  # categories that make it up; they match freely among each other
    criteria: tuple[Criterion, ...]  # the first one decides in tables
    ignored_kinds: tuple[str, ...] = ()  # the log's own words of true boxes of these categories that are ignored


@dataclass(frozen=True)
class Protocol:
    """A way to evaluate."""

    name: str
    classes: tuple[ObjectClass, ...]
    of_camera: bool = False  # whether only boxes count that the reference camera shows, by KITTI's difficulties


@dataclass(frozen=True)
class Difficulty:
    """Limits of a true box; found boxes below the height are ignored."""

    name: str
    min_height_px: float
    max_occlusion: int
    max_truncation: float


# Geiger, Lenz, Urtasun (CVPR 2012), and the development kit of the object benchmark.
DIFFICULTIES = (Difficulty("easy", 40, 0, 0.15), Difficulty("moderate", 25, 1, 0.3), Difficulty("hard", 25, 2, 0.5))


def _ious(*limits: float) -> tuple[Criterion, ...]:
    return tuple(Criterion(measure, limit) for limit in limits for measure in ("iou_3d", "iou_bev"))


# nuScenes' distances; the table uses 1 m, about the IoU of 0.5 of a car shifted along its length.
CENTERS = tuple(Criterion("center_m", limit) for limit in (1.0, 0.5, 2.0, 4.0))
VEHICLES, PEOPLE, RIDERS = ("car", "truck", "bus"), ("pedestrian",), ("motorcycle", "cyclist")
PROTOCOLS: Mapping[str, Protocol] = {
    "kitti": Protocol(
        "kitti",
        (
            ObjectClass("car", ("car",), _ious(0.7, 0.5), ("Van",)),
            ObjectClass("pedestrian", PEOPLE, _ious(0.5, 0.25), ("Person_sitting", "Person")),
            ObjectClass("cyclist", ("cyclist",), _ious(0.5, 0.25)),
        ),
        of_camera=True,
    ),
    # Yu et al. (CVPR 2022), whose class "Car" is all vehicles and whose "Cyclist" includes motorcycles; and 0.3, which suits
    # small things that are seen from the roadside as well.
    "dair": Protocol(
        "dair",
        (
            ObjectClass("vehicle", VEHICLES, _ious(0.5)),
            ObjectClass("pedestrian", PEOPLE, _ious(0.25, 0.3)),
            ObjectClass("two_wheeler", RIDERS, _ious(0.25, 0.3)),
        ),
    ),
    "center": Protocol(
        "center",
        (
            ObjectClass("vehicle", VEHICLES, CENTERS),
            ObjectClass("pedestrian", PEOPLE, CENTERS),
            ObjectClass("two_wheeler", RIDERS, CENTERS),
            *(ObjectClass(name, (name,), CENTERS) for name in CATEGORIES if name in VEHICLES + RIDERS),
        ),
    ),
}
