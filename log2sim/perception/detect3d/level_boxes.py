"""Boxes in the level frame of the network, whose z is the height above the ground, from the channels of its maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, wrap_angle
from log2sim.perception.detect3d.network import NetworkInfo
from log2sim.perception.detect3d.suppression import Rectangles

# Limits of what a network may say of a box: beyond them it is of no use, and exponentials overflow.
MIN_SIDE_M, MAX_SIDE_M = 0.1, 30.0
MAX_OFFSET_M = 15.0
MIN_CENTER_HEIGHT_M, MAX_CENTER_HEIGHT_M = -1.0, 5.0
MAX_LOGIT = 30.0
# Cells on each side of a center whose boxes are averaged: 0.5 m, within which boxes are taught for all but the slimmest.
AROUND_CELLS = 1
# Centers this part of a width apart may be of one object.
SAME_CENTER_WIDTHS = 0.5
# Cells whose heat is a smaller part of the center's are of the background, where no box is taught.
MIN_HEAT_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class LevelBoxes:
    """M boxes; x and y along the map's axes, z above the ground.

    Attributes
    ----------
    center_m, size_m : (M, 3) float64
    yaw_rad : (M,) float64
    heading_score : (M,) float64
        Probability in [0.5, 1] that front and back are not swapped.
    group : (M,) int
        Index into the network's groups.
    category : (M,) str
    heat, quality : (M,) float64
        Logits of the object being there, and of the expected IoU.
    """

    center_m: Array
    size_m: Array
    yaw_rad: Array
    heading_score: Array
    group: NDArray[np.intp]
    category: NDArray[np.str_]
    heat: Array
    quality: Array

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.group)

    def take(self, index: NDArray[Any]) -> LevelBoxes:
        """Take the boxes at `index`, integers or a mask."""
        return LevelBoxes(**{k: v[index] for k, v in vars(self).items()})

    @property
    def rectangles(self) -> Rectangles:
        """The boxes seen from above."""
        return Rectangles(self.center_m[:, :2], self.size_m[:, :2], self.yaw_rad)

    def terms(self, points: NDArray[Any], range_m: Array) -> Array:
        """Return what the score is computed from: (5, M), the terms of `NetworkInfo.calibration`.

        Parameters
        ----------
        points : (M,) int or float
            Number of points in each box.
        range_m : (M,) float64
            Distance of the centers from the sensor in the plane.
        """
        return np.stack([np.ones(len(self)), self.heat, self.quality, np.log1p(points), range_m / 10.0])

    def score(self, info: NetworkInfo, terms: Array) -> Array:
        """Compute the probability (M,) that each box is right from the first terms of the calibration, (up to 5, M)."""
        weights = np.array([info.calibration[group] for group in info.groups])[self.group, : len(terms)]
        return sigmoid((weights.T * terms).sum(axis=0))


@dataclass(frozen=True, eq=False)
class MapCells:
    """Values of the maps at K cells, or means of several cells each: all channels are such that means make sense.

    Attributes
    ----------
    middle_m : (K, 2) float64
        Middles of the cells.
    values : (C, K) float64
        All channels.
    """

    middle_m: Array
    values: Array

    @classmethod
    def at(cls, maps: NDArray[np.float32], flat: NDArray[np.intp], info: NetworkInfo, low: Array) -> MapCells:
        """Gather the cells at flat indices (K,) of maps (C, h, w) whose lower corner is at `low` (2,), m."""
        i, j = np.divmod(flat, maps.shape[2])
        middle = np.asarray(low) + (np.stack([i, j], axis=1) + 0.5) * (info.stride * info.cell_m)
        return cls(middle, maps.reshape(len(maps), -1).take(flat, axis=1).astype(np.float64))

    def means(self, weight: Array) -> MapCells:
        """Average cells that follow each other by weights (K, n), K n of them; NaN where none has a weight.

        Cells with a value that is not finite count for nothing.
        """
        rows = np.concatenate([self.middle_m.T, self.values])
        rows = rows.reshape(len(rows), *weight.shape)
        weight = np.where(np.isfinite(rows).all(axis=0), weight, 0.0)
        with np.errstate(invalid="ignore"):
            mean = np.einsum("rkn,kn->rk", np.where(weight > 0, rows, 0.0), weight) / weight.sum(axis=1)
        return MapCells(mean[:2].T, mean[2:])


def cells_around(
    maps: NDArray[np.float32], flat: NDArray[np.intp], group: NDArray[np.intp], info: NetworkInfo, low: Array
) -> MapCells:
    """Average the cells around each of some cells (K,) whose boxes are centered where that of the cell itself is.

    Cells are weighted by their heat for the group (K,). `maps`, `flat` and `low` are as for `MapCells.at`.
    """
    h, w = maps.shape[1:]
    step = np.arange(-AROUND_CELLS, AROUND_CELLS + 1)
    di, dj = (d.ravel() for d in np.meshgrid(step, step, indexing="ij"))
    i, j = flat[:, None] // w + di, flat[:, None] % w + dj
    inside = (i >= 0) & (i < h) & (j >= 0) & (j < w)
    cells = MapCells.at(maps, np.where(inside, i * w + j, 0).ravel(), info, low)
    own = slice(len(di) // 2, len(di) // 2 + 1)
    x, y, _, _, width, _ = cells.values[info.channels.box].reshape(6, *i.shape)
    with np.errstate(over="ignore", invalid="ignore"):
        x, y = (v + middle.reshape(i.shape) for v, middle in zip((x, y), cells.middle_m.T, strict=True))
        same = np.hypot(x - x[:, own], y - y[:, own]) < SAME_CENTER_WIDTHS * np.exp(width[:, own])
    heat = sigmoid(cells.values[info.channels.heat].reshape(len(info.groups), *i.shape)[group, np.arange(len(flat))])
    return cells.means(np.where(inside & same & (heat >= MIN_HEAT_SHARE * heat[:, own]), heat, 0.0))


def boxes_of_cells(cells: MapCells, group: NDArray[np.intp], heat: Array, info: NetworkInfo) -> LevelBoxes:
    """Decode the box that each cell (K,) regresses for its group (K,); boxes that are not finite are left out.

    Parameters
    ----------
    heat : (K,) float64
        Logit of the object being there.
    """
    channels, values = info.channels, cells.values
    box = values[channels.box]
    offset = np.clip(box[:2].T, -MAX_OFFSET_M, MAX_OFFSET_M)
    height = np.clip(box[2:3].T, MIN_CENTER_HEIGHT_M, MAX_CENTER_HEIGHT_M)
    size = np.exp(np.clip(box[3:6].T, np.log(MIN_SIDE_M), np.log(MAX_SIDE_M)))
    yaw, heading_score = headings(values[channels.axis], values[channels.direction])
    found = LevelBoxes(
        np.concatenate([cells.middle_m + offset, height], axis=1),
        size,
        yaw,
        heading_score,
        group,
        categories_of(category_logits(values, info), group, info),
        np.clip(heat, -MAX_LOGIT, MAX_LOGIT),
        np.clip(values[channels.quality], -MAX_LOGIT, MAX_LOGIT),
    )
    columns = [found.center_m.T, found.size_m.T, found.yaw_rad, found.heading_score, found.heat, found.quality]
    return found.take(np.flatnonzero(np.isfinite(np.vstack(columns)).all(axis=0)))


def headings(axis: Array, direction: Array) -> tuple[Array, Array]:
    """Compute yaw over the full circle from its axis and its direction.

    Parameters
    ----------
    axis : (2, K)
        Sine and cosine of twice the yaw, which do not tell front from back.
    direction : (2, K)
        Sine and cosine of the yaw, averaged over what the yaw may be: 2 p - 1 times the unit vector where the front is
        there with probability p.

    Returns
    -------
    yaw_rad : (K,) float64
    heading_score : (K,) float64
        Probability in [0.5, 1] that front and back are not swapped.
    """
    yaw = np.arctan2(axis[0], axis[1]) / 2
    along = direction[0] * np.sin(yaw) + direction[1] * np.cos(yaw)
    turned = np.asarray(wrap_angle(np.where(along < 0, yaw + np.pi, yaw)), dtype=np.float64)
    return turned, (1 + np.minimum(np.abs(along), 1.0)) / 2


def category_logits(values: Array, info: NetworkInfo) -> Mapping[str, Array]:
    """Take the logits (categories, K) of each group that has several categories out of values (C, K)."""
    return {group: values[place] for group, place in info.channels.category.items()}


def categories_of(logits: Mapping[str, Array], group: NDArray[np.intp], info: NetworkInfo) -> NDArray[np.str_]:
    """Choose the most probable category (K,) within the group (K,) of each box."""
    out = np.empty(len(group), dtype="<U16")
    for k, name in enumerate(info.groups):
        rows = np.flatnonzero(group == k)
        names = np.array(info.categories[name], dtype="<U16")
        out[rows] = names[logits[name][:, rows].argmax(axis=0)] if name in logits else names[0]
    return out


def sigmoid(logit: Array) -> Array:
    """Compute probabilities from logits."""
    return np.asarray(1 / (1 + np.exp(-np.clip(logit, -MAX_LOGIT, MAX_LOGIT))), dtype=np.float64)
