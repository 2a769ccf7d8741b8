"""Suppression of boxes that stand where a stronger one stands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# Road users do not share ground; estimates of neighbors overlap by a little where sizes and headings are off.
MAX_IOU = 0.2
# A person inside a car, or a rider counted as a person too: most of the smaller box is on the larger one's ground.
MAX_OVERLAP_OF_SMALLER = 0.5
# Slender boxes of one object that cross share little area. Objects of one group keep half a width between their centers.
MIN_DISTANCE_WIDTHS = 0.5
# One rectangle of a pair is made smaller by this, so that no edges lie on each other: more than rounding, less than
# anything measured.
SHRUNK_M = 1e-6


@dataclass(frozen=True, eq=False)
class Rectangles:
    """Oriented rectangles in the ground plane.

    Attributes
    ----------
    xy_m : (M, 2) float64
        Centers.
    size_m : (M, 2) float64
        Length, width.
    yaw_rad : (M,) float64
    """

    xy_m: Array
    size_m: Array
    yaw_rad: Array

    def take(self, index: NDArray[Any]) -> Rectangles:
        """Take the rectangles at `index`, integers or a mask."""
        return Rectangles(self.xy_m[index], self.size_m[index], self.yaw_rad[index])


def suppress(boxes: Rectangles, score: Array, group: NDArray[np.intp], *, across: bool = True) -> NDArray[np.intp]:
    """Choose the boxes that no stronger chosen one excludes.

    Parameters
    ----------
    boxes : M Rectangles
    score : (M,) float64
    group : (M,) int
        Boxes of one group exclude each other by IoU and by the distance of their centers, others by the part of the
        smaller one that they share.
    across : bool
        Whether boxes of different groups exclude each other at all.

    Returns
    -------
    (K,) int
        Indices of the chosen boxes, best score first; ties by place, so that the order of the input does not matter.
    """
    order = np.lexsort((boxes.xy_m[:, 1], boxes.xy_m[:, 0], -score))
    first, second = excluding_pairs(boxes.take(order), group[order], across=across)
    kept = np.ones(len(order), dtype=bool)
    for i, j in zip(first.tolist(), second.tolist(), strict=True):  # ordered by the stronger box
        if kept[i]:
            kept[j] = False
    return np.asarray(order[kept], dtype=np.intp)


def excluding_pairs(
    boxes: Rectangles, group: NDArray[np.intp], *, across: bool = True
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find the pairs i < j of boxes that exclude each other, ordered by i; the boxes are ordered by score."""
    from scipy.spatial import cKDTree

    reach = np.hypot(*boxes.size_m.T) / 2
    if len(reach) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    pairs = cKDTree(boxes.xy_m).query_pairs(2 * reach.max(), output_type="ndarray")
    i, j = pairs.min(axis=1), pairs.max(axis=1)
    away = np.hypot(*(boxes.xy_m.take(i, axis=0) - boxes.xy_m.take(j, axis=0)).T)
    same = group.take(i) == group.take(j)
    near = np.flatnonzero((away < reach.take(i) + reach.take(j)) & (same | across))
    i, j, away, same = i.take(near), j.take(near), away.take(near), same.take(near)
    excluded = same & (away < MIN_DISTANCE_WIDTHS * (boxes.size_m[i, 1] + boxes.size_m[j, 1]) / 2)
    # Areas are asked for last: most pairs are decided by now.
    left = np.flatnonzero(~excluded)
    shared = shared_area(boxes.take(i[left]), boxes.take(j[left]))
    area = boxes.size_m.prod(axis=1)
    area_i, area_j = area[i[left]], area[j[left]]
    excluded[left] = np.where(
        same[left],
        shared > MAX_IOU * (area_i + area_j - shared),
        shared > MAX_OVERLAP_OF_SMALLER * np.minimum(area_i, area_j),
    )
    i, j = i[excluded], j[excluded]
    order = np.lexsort((j, i))
    return i[order], j[order]


def shared_area(a: Rectangles, b: Rectangles) -> Array:
    """Compute the area (P,), m^2, that rectangles share in pairs.

    Notes
    -----
    The boundary of the shared area consists of the parts of each rectangle's edges inside the other one; by Green's
    theorem the cross products of their ends add up to twice the area. A tenth of the time of `geometry.overlap_area`,
    and exact to `SHRUNK_M` times the circumference.
    """
    b = Rectangles(b.xy_m - a.xy_m, np.maximum(b.size_m - SHRUNK_M, 0.0), b.yaw_rad)
    a = Rectangles(np.zeros_like(a.xy_m), a.size_m, a.yaw_rad)
    twice = _edges_inside(a, b) + _edges_inside(b, a)
    return np.asarray(np.maximum(twice / 2, 0.0))


def _edges_inside(own: Rectangles, other: Rectangles) -> Array:
    """Add up the cross products (P,) of the ends of each rectangle's edges inside another one."""
    c, s = np.cos(own.yaw_rad), np.sin(own.yaw_rad)
    along = np.stack([c, s], axis=1) * (own.size_m[:, :1] / 2)
    across = np.stack([-s, c], axis=1) * (own.size_m[:, 1:2] / 2)
    corners = own.xy_m[:, None] + np.stack([along + across, across - along, -along - across, along - across], axis=1)
    step = np.roll(corners, -1, axis=1) - corners
    # Start and direction of the edges (P, 4, 2) along the axes of the other rectangle.
    c, s = np.cos(other.yaw_rad), np.sin(other.yaw_rad)
    axes = np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=2)
    start, turned = (corners - other.xy_m[:, None]) @ axes, step @ axes
    half = other.size_m[:, None] / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (-half - start) / turned, (half - start) / turned
    parallel = turned == 0
    inside = np.abs(start) < half
    enter = np.where(parallel, np.where(inside, -np.inf, np.inf), np.minimum(*ends)).max(axis=2)
    leave = np.where(parallel, np.where(inside, np.inf, -np.inf), np.maximum(*ends)).min(axis=2)
    enter, leave = np.maximum(enter, 0.0), np.minimum(leave, 1.0)
    length = np.maximum(leave - enter, 0.0)
    # The cross product of two points of one edge is that of its corner and its step, times the share of the edge.
    cross = corners[..., 0] * step[..., 1] - corners[..., 1] * step[..., 0]
    return np.asarray((cross * length).sum(axis=1))
