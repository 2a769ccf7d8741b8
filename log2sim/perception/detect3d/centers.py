"""Boxes from the maps of a network: one for every peak of the map of centers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.detect3d.level_boxes import LevelBoxes, boxes_of_cells, cells_around
from log2sim.perception.detect3d.network import NetworkInfo

# Fainter peaks are so hardly ever objects that average precision is the same without them.
MIN_HEAT = 0.1
# More than the road users that one sensor sees.
MAX_PEAKS = 300


def decode_centers(maps: NDArray[np.float32], info: NetworkInfo, low: Array) -> LevelBoxes:
    """Decode the boxes at the peaks of the heat, strongest first, not yet scored nor suppressed.

    Parameters
    ----------
    maps : (C, h, w) float32
        Output of the network.
    low : (2,) float64, m
        Lower corner of the maps.

    Notes
    -----
    Zhou, Wang and Kraehenbuehl (2019), "Objects as Points": a cell of the greatest heat among its eight neighbors is an
    object's center. Networks are taught an object's box in the cells around its center too; the mean over those that mean
    the same object errs less than the box of a single cell.
    """
    group, flat = peaks(maps[info.channels.heat])
    cells = cells_around(maps, flat, group, info, low)
    heat = maps.reshape(len(maps), -1)[info.channels.heat][group, flat].astype(np.float64)
    return boxes_of_cells(cells, group, heat, info)


def peaks(heat: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find cells that no neighbor exceeds in maps of logits (G, h, w).

    Returns
    -------
    group, flat : (K,) int
        Map and flat index in it, greatest logit first.
    """
    import cv2

    least = np.float32(np.log(MIN_HEAT / (1 - MIN_HEAT)))
    kernel = np.ones((3, 3), np.uint8)
    groups, cells = [], []
    for k, logits in enumerate(heat):
        flat = np.flatnonzero((logits >= least) & (logits >= cv2.dilate(logits, kernel)))
        groups.append(np.full(len(flat), k, dtype=np.intp))
        cells.append(flat)
    group, flat = np.concatenate(groups), np.concatenate(cells)
    order = np.argsort(-heat.reshape(len(heat), -1)[group, flat], kind="stable")[:MAX_PEAKS]
    return group[order], flat[order]
