"""Pairs of agents that overlap in the scenario itself, so that the scenario cannot be a reference for keeping clear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.simulation.metrics.box_tracks import BoxTracks
from log2sim.simulation.metrics.collisions import contacts
from log2sim.simulation.reactive.path_table import TIME_STEP_S, PathTable

DEEP_OVERLAP_M = 0.5  # larger than the errors of boxes
CHUNK = 200


def deep_overlaps(paths: PathTable, size_m: Array, static: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pairs (A, A) whose boxes come to overlap by more than `DEEP_OVERLAP_M`, not from the start.

    Pairs that overlap from the start are one object detected twice, or a load and its carrier: no reason to brake.
    """
    count = len(size_m)
    deep, together = np.zeros((2, count, count), dtype=bool)
    stays = static & (paths.begin_s == paths.end_s)
    moving = ~static
    if not moving.any():
        return deep
    begin_s = np.where(stays, -np.inf, paths.begin_s)
    end_s = np.where(stays, np.inf, paths.end_s)
    t_s = np.arange(paths.begin_s[moving].min(), paths.end_s[moving].max() + TIME_STEP_S, TIME_STEP_S)
    size = np.maximum(size_m - [DEEP_OVERLAP_M, DEEP_OVERLAP_M, 0.0], 0.1)
    everybody = np.arange(count)
    for part in np.split(t_s, range(CHUNK, len(t_s), CHUNK)):
        pose = paths.at(everybody, part[:, None])
        there = (begin_s <= part[:, None]) & (part[:, None] <= end_s)
        x, y, z, yaw, speed = (np.where(there, c, np.nan) for c in pose[:5])
        found = contacts(BoxTracks(x, y, z, yaw, speed, size), moving)
        a, b = found.a, found.b
        deep[a, b] = True
        at_once = part[found.first_row.astype(np.intp)] <= np.maximum(begin_s[a], begin_s[b]) + TIME_STEP_S
        together[a[at_once], b[at_once]] = True
    into = deep & ~together
    return into | into.T
