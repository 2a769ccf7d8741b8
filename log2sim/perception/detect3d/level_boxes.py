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

    def strength(self, info: NetworkInfo) -> Array:
        """Compute the part (M,) of the score's logit that does not depend on points and range."""
        weights = self._weights(info)
        return np.asarray(weights[0] + weights[1] * self.heat + weights[2] * self.quality)

    def score(self, info: NetworkInfo, points: NDArray[np.int64], range_m: Array) -> Array:
        """Compute the probability (M,) that each box is right, with its number of points and its range (M,), m."""
        weights = self._weights(info)
        return sigmoid(self.strength(info) + weights[3] * np.log1p(points) + weights[4] * range_m / 10.0)

    def _weights(self, info: NetworkInfo) -> Array:
        """Take the calibration (5, M) of each box's group."""
        return np.array([info.calibration[group] for group in info.groups])[self.group].T


@dataclass(frozen=True, eq=False)
class MapCells:
    """Values of the maps at K cells.

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
        return cls(middle, maps.reshape(len(maps), -1)[:, flat].astype(np.float64))


def boxes_of_cells(cells: MapCells, group: NDArray[np.intp], info: NetworkInfo) -> LevelBoxes:
    """Decode the box that each cell (K,) regresses for its group (K,); boxes that are not finite are left out."""
    channels, values = info.channels, cells.values
    box = values[channels.box]
    offset = np.clip(box[:2].T, -MAX_OFFSET_M, MAX_OFFSET_M)
    height = np.clip(box[2:3].T, MIN_CENTER_HEIGHT_M, MAX_CENTER_HEIGHT_M)
    size = np.exp(np.clip(box[3:6].T, np.log(MIN_SIDE_M), np.log(MAX_SIDE_M)))
    yaw, heading_score = headings(values[channels.axis], values[channels.direction])
    heat = values[channels.heat][group, np.arange(len(group))]
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
