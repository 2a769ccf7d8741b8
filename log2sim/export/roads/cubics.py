"""Cubics along a road, as OpenDRIVE has them for heights, offsets and widths."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Array

LEVEL_M = 5.0
"""Length over which heights are averaged against their noise."""

EXACT_M = 0.002
"""How far widths between stations may be from what is written."""


def elevation_profile(stations: Array, ground_m: Array, length_m: float) -> Array:
    """Fit cubics (K, 5) s, a, b, c, d through heights (N,) at the ends and their means every `LEVEL_M`, without overshoot.

    Before and after the stations the slope at the ends continues.
    """
    block = np.floor((stations - stations[0]) / LEVEL_M).astype(int)
    _, first, counts = np.unique(block, return_index=True, return_counts=True)
    s, z = (np.add.reduceat(v, first) / counts for v in (stations, ground_m))
    inner = (s > stations[0] + LEVEL_M / 4) & (s < stations[-1] - LEVEL_M / 4)
    s = np.concatenate([stations[:1], s[inner], stations[-1:]])
    z = np.concatenate([ground_m[:1], z[inner], ground_m[-1:]])
    grade = np.diff(z) / np.diff(s)
    z = np.concatenate([[z[0] - grade[0] * s[0]], z, [z[-1] + grade[-1] * (length_m - s[-1])]])
    return cubics_through(np.concatenate([[0.0], s, [length_m]]), z)


def cubics_through(stations: Array, values: Array) -> Array:
    """Return cubics (K, 5) s, a, b, c, d from station 0 on through values (N,) at stations (N,), without overshoot."""
    from scipy.interpolate import PchipInterpolator

    s, v = stations, np.asarray(values, dtype=np.float64)
    if s[0] > 1e-6:
        s, v = np.concatenate([[0.0], s]), np.concatenate([v[:1], v])
    apart = np.concatenate([np.diff(s) > 1e-6, [True]])
    s, v = s[apart], v[apart]
    if np.ptp(v) < EXACT_M / 10:
        return np.array([[0.0, v[0], 0.0, 0.0, 0.0]])
    d, c, b, a = PchipInterpolator(s, v).c
    return _merged_cubics(np.column_stack([s[:-1], a, b, c, d]))


def _merged_cubics(rows: Array) -> Array:
    """Drop cubics (K, 5) that only continue the one before, which checkers call redundant."""
    kept = [rows[0]]
    for row in rows[1:]:
        s, a, b, c, d = kept[-1]
        h = row[0] - s
        goes_on = [a + h * (b + h * (c + h * d)), b + h * (2 * c + 3 * h * d), c + 3 * h * d, d]
        if np.abs(row[1:] - goes_on).max() > 2e-6:
            kept.append(row)
    return np.array(kept)
