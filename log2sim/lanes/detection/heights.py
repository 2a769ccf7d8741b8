"""Heights of points on the ground."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Array
from log2sim.mapping.ground_map import GroundMap

AROUND_M = 0.25


def at_height(ground: GroundMap, xy: Array) -> Array:
    """Put points (N, 2) on the ground: (N, 3), m. Where the height is unknown it is that of the nearest point, or 0."""
    reach = max(1, round(AROUND_M / ground.resolution_m))
    rows = ((ground.extent_m[3] - xy[:, 1]) / ground.resolution_m).astype(int)
    columns = ((xy[:, 0] - ground.extent_m[0]) / ground.resolution_m).astype(int)
    z = np.full(len(xy), np.nan)
    for k, (r, c) in enumerate(zip(rows, columns)):
        part = ground.height_m[max(r - reach, 0) : max(r + reach + 1, 0), max(c - reach, 0) : max(c + reach + 1, 0)]
        known = part[np.isfinite(part)]
        if known.size:
            z[k] = np.median(known)
    known = np.isfinite(z)
    if not known.any():
        everywhere = ground.height_m[::20, ::20]
        level = float(np.nanmedian(everywhere)) if np.isfinite(everywhere).any() else 0.0
        return np.column_stack([xy, np.full(len(xy), level)])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    return np.column_stack([xy, np.interp(s, s[known], z[known])])
