"""Points that were measured at different times, moved by a transform that changes over time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# Transforms are interpolated between knots this far apart, which errs by 3e-6 rad at 1 rad/s: 0.3 mm at 100 m.
KNOT_NS = 5_000_000
MAX_KNOTS = 4096

TransformAt = Callable[[NDArray[np.int64]], tuple[Array, NDArray[np.bool_]]]
"""Gives the transforms (K, 4, 4) at stamps (K,) and whether each is known."""


def move_points(xyz_m: NDArray[np.floating[Any]], t_ns: NDArray[np.int64], dst_T_src_at: TransformAt) -> Array | None:
    """Transform points (N, 3), m, each by the transform at its own stamp (N,).

    Returns
    -------
    (N, 3) float64, m, or None
        None where a transform is not known.
    """
    if len(xyz_m) == 0:
        return np.zeros((0, 3))
    first, span = int(t_ns.min()), int(t_ns.max() - t_ns.min())
    bins = min(-(-span // KNOT_NS), MAX_KNOTS)
    if bins == 0:
        dst_T_src, known = dst_T_src_at(np.array([first], dtype=np.int64))
        return _moved(np.asarray(xyz_m, dtype=np.float64), dst_T_src[0]) if known.all() else None
    knots = first + (np.arange(bins + 1) * span) // bins
    dst_T_src, known = dst_T_src_at(knots)
    if not known.all():
        return None
    place = (t_ns - first) * (bins / span)
    k = np.minimum(place.astype(np.int64), bins - 1)
    order = np.argsort(k, kind="stable")
    edges = np.searchsorted(k[order], np.arange(bins + 1))
    points, fraction = np.asarray(xyz_m, dtype=np.float64)[order], (place - k)[order, None]
    out = np.empty_like(points)
    for b in np.flatnonzero(np.diff(edges)).tolist():
        rows = slice(edges[b], edges[b + 1])
        begin = _moved(points[rows], dst_T_src[b])
        out[rows] = begin + fraction[rows] * (_moved(points[rows], dst_T_src[b + 1]) - begin)
    unsorted = np.empty_like(out)
    unsorted[order] = out
    return unsorted


def _moved(points: Array, dst_T_src: Array) -> Array:
    return np.asarray(points @ dst_T_src[:3, :3].T + dst_T_src[:3, 3])
