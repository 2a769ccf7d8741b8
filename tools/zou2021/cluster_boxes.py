"""Boxes around the points of clusters of votes, as Zou et al. (2021) make them; their sizes are those of what was hit.

How the paper turns its boxes is not said. Here a box is the smallest around the points, its front where the cells' headings are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Boxes3D
from log2sim.perception.detect3d.boxes import (
    MapCells,
    bandwidths_m,
    categories_of,
    category_logits,
    cluster,
    foreground,
    headings,
)
from log2sim.perception.detect3d.network import Network, grid_window, level_points, rasterize, viewpoints_xy
from log2sim.perception.lidar.cloud import Cloud

# Points on the ground around an object belong to its cells, too.
MIN_HEIGHT_M = 0.15
MIN_SIDE_M = 0.3
MIN_POINTS = 2


@dataclass(frozen=True, eq=False)
class ClusterBoxDetector:
    """LiDAR detector whose boxes stand around the points of clusters.

    Attributes
    ----------
    name : str
    network : Network
    range_m : float
        Largest distance from the sensor along x and y, m.
    min_score : float
        Least mean probability of a cluster's class.
    """

    name: str
    network: Network
    range_m: float
    min_score: float

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        """Detect road users in one cloud; `earlier` has no effect."""
        info = self.network.info
        xyz, index = level_points(cloud, self.range_m)
        if not len(xyz):
            return Boxes3D.empty()
        low, shape = grid_window(xyz, cell_m=info.cell_m, range_m=self.range_m, center=viewpoints_xy(cloud)[0])
        grid = rasterize(xyz, cell_m=info.cell_m, low=low, shape=shape)
        maps = self.network.run(grid)
        flat, probability = foreground(maps, grid, info)
        if not len(flat):
            return Boxes3D.empty()
        cells = MapCells.at(maps, flat, info, low)
        label = cluster(
            cells.middle_m + cells.values[info.channels.vote].T, probability.argmax(axis=0), bandwidths_m(info)
        )
        rows = self._rows(cells, probability, label)
        # Clusters of points: by the cell of each.
        of_cell = np.full(maps.shape[1] * maps.shape[2], -1)
        of_cell[flat] = label
        place = ((xyz[:, :2] - low) / (info.cell_m * info.stride)).astype(np.intp)
        inside = np.flatnonzero(
            (place >= 0).all(axis=1) & (place < maps.shape[1:]).all(axis=1) & (xyz[:, 2] > MIN_HEIGHT_M)
        )
        of_point = of_cell[place[inside, 0] * maps.shape[2] + place[inside, 1]]
        return self._boxes(rows, [inside[of_point == k] for k in range(len(rows[0]))], xyz, index, cloud)

    def _rows(self, cells: MapCells, probability: NDArray[np.float64], label: NDArray[np.intp]):
        """Return yaw, heading score, category and score of each cluster, averaged over its cells."""
        info, count = self.network.info, int(label.max()) + 1
        size = np.bincount(label, minlength=count)

        def average(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.stack([np.bincount(label, row, count) / size for row in values])

        best = probability.argmax(axis=0)
        support = np.stack([np.bincount(label, p * (best == k), count) for k, p in enumerate(probability)])
        group, mean = support.argmax(axis=0), average(probability)
        channels = info.channels
        yaw, heading_score = headings(average(cells.values[channels.axis]), average(cells.values[channels.direction]))
        logits = {name: average(v) for name, v in category_logits(cells.values, info).items()}
        return yaw, heading_score, categories_of(logits, group, info), mean[group, np.arange(count)]

    def _boxes(self, rows, points: list[NDArray[np.intp]], xyz: NDArray[np.float32], index, cloud: Cloud) -> Boxes3D:
        """Stand a box around the points of each cluster, from the ground to the highest."""
        yaw, heading_score, category, score = rows
        kept = [k for k in np.argsort(-score) if len(points[k]) >= MIN_POINTS and score[k] >= self.min_score]
        center, size, t_ns = np.zeros((len(kept), 3)), np.zeros((len(kept), 3)), np.zeros(len(kept), np.int64)
        turned = np.array(yaw)
        for row, k in enumerate(kept):
            p = xyz[points[k]].astype(np.float64)
            turned[k] = axis_of(p[:, :2], yaw[k])
            c, s = np.cos(turned[k]), np.sin(turned[k])
            along = p[:, :2] @ np.array([[c, -s], [s, c]])
            low, high = along.min(axis=0), along.max(axis=0)
            size[row] = *np.maximum(high - low, MIN_SIDE_M), max(p[:, 2].max(), MIN_SIDE_M)
            ground = np.median(cloud.xyz[index[points[k]], 2] - cloud.height[index[points[k]]])
            center[row] = *(np.array([[c, -s], [s, c]]) @ (low + high) / 2), size[row, 2] / 2 + ground
            t_ns[row] = cloud.stamp_ns + round(float(cloud.t_s[index[points[k]]].mean()) * 1e9)
        n = np.array([len(points[k]) for k in kept], np.int64)
        return Boxes3D(
            t_ns, center + cloud.origin, size, turned[kept], heading_score[kept], category[kept], score[kept], n
        )


def axis_of(xy: NDArray[np.float64], yaw: float) -> float:
    """Return the heading along the longer side of the smallest rectangle around points (N, 2), on the side of `yaw`."""
    import cv2

    middle = xy.mean(axis=0)
    corners = cv2.boxPoints(cv2.minAreaRect((xy - middle).astype(np.float32))).astype(np.float64)
    sides = corners[1:3] - corners[:2]
    x, y = sides[np.argmax(np.hypot(*sides.T))]
    forward = np.sign(x * np.cos(yaw) + y * np.sin(yaw)) or 1.0
    return float(np.arctan2(forward * y, forward * x))
