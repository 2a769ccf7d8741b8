"""Stop lines, crosswalks, arrows and letters against true ones, each as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from shapely.geometry.base import BaseGeometry

from log2sim.datatypes import Marking
from log2sim.evaluation.lanes.area import Area
from log2sim.geometry import Array

STOP_LINE_REACH_M = 0.5
MIN_STOP_LINE_SHARE, MIN_OVERLAP, MIN_ARROW_OVERLAP = 0.5, 0.5, 0.2
"""What two of a kind share at least to be the same: of the length of the longer stop line, of the union of outlines."""


def shape_figures(found: Sequence[Marking], true: Sequence[Marking], area: Area) -> dict[str, Any]:
    """Count by kind how many are true, and how many are found or false; `partly_seen` ones count neither way."""
    out = {}
    for name, kind in (("stop_lines", "stop_line"), ("crosswalks", "crosswalk"), ("others", "other")):
        ours = [_geometry(m) for m in found if m.kind == kind]
        theirs = [_geometry(m) for m in true if m.kind == kind]
        same = np.array([[_alike(kind, a, b) for b in theirs] for a in ours]).reshape(len(ours), len(theirs))
        rows, columns = linear_sum_assignment(-same)
        matched = same[rows, columns] > 0
        seen = np.array([_mostly(area.expects, g) for g in theirs], dtype=bool)
        near = np.array([_mostly(area.counts, g) for g in ours], dtype=bool)
        right = np.zeros(len(ours), dtype=bool)
        right[rows[matched]] = True
        hit = np.zeros(len(theirs), dtype=bool)
        hit[columns[matched]] = True
        out[name] = {
            "true": int(seen.sum()),
            "found": int((hit & seen).sum()),
            "false": int((near & ~right).sum()),
            "partly_seen": int((~seen).sum()),
        }
    return out


def _geometry(marking: Marking) -> BaseGeometry:
    xy = marking.points_m[:, :2]
    if marking.kind == "stop_line" or len(xy) < 3:
        return shapely.LineString(xy)
    return shapely.make_valid(shapely.Polygon(xy))


def _alike(kind: str, a: BaseGeometry, b: BaseGeometry) -> float:
    """How much two of a kind are the same, 0 where they are not."""
    if kind == "stop_line":
        shared = min(
            a.intersection(b.buffer(STOP_LINE_REACH_M)).length, b.intersection(a.buffer(STOP_LINE_REACH_M)).length
        )
        part = shared / max(a.length, b.length) if max(a.length, b.length) > 0 else 0.0
        return float(part) if part >= MIN_STOP_LINE_SHARE else 0.0
    union = a.union(b).area
    overlap = a.intersection(b).area / union if union > 0 else 0.0
    return float(overlap) if overlap >= (MIN_OVERLAP if kind == "crosswalk" else MIN_ARROW_OVERLAP) else 0.0


def _mostly(inside: Any, geometry: BaseGeometry) -> bool:
    """Whether at least half of the corners lie within."""
    corners: Array = shapely.get_coordinates(geometry)
    marks: NDArray[np.bool_] = inside(corners)
    return bool(marks.mean() >= 0.5) if len(corners) else False
