"""Names the markings and borders at the edges of lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from log2sim.datatypes import MapLane, Marking, RoadBorder
from log2sim.geometry import wrap_angle
from log2sim.lanes.graph.polyline import Polyline
from log2sim.lanes.graph.strips import PARALLEL_RAD, list_road_lines

NEAR_M = 0.7
"""A line this near to the edge of a lane is its edge: vehicles, and so lanes along their paths, keep half a meter off the middle."""

MIN_SHARE = 0.5
"""Of a lane's length that a line has to accompany."""


def name_lines(lanes: Sequence[MapLane], markings: Sequence[Marking], borders: Sequence[RoadBorder]) -> list[MapLane]:
    """Return lanes outside of junctions with the lines at their edges, where none are named; lanes side by side share one."""
    items = list_road_lines(markings, borders)
    lines = [Polyline.through(item.points_m) for item in items]
    names = [item.id for item in items]
    return [lane if lane.junction is not None else _named(lane, lines, names) for lane in lanes]


def _named(lane: MapLane, lines: Sequence[Polyline], names: Sequence[str]) -> MapLane:
    own = Polyline(lane.points_m)
    s = np.linspace(0.0, own.length_m, max(int(np.ceil(own.length_m)), 4) + 1)
    points, heading = own.at(s)[:, :2], own.heading_at(s)
    half = np.interp(s, own.s_m, lane.width_m) / 2
    best: dict[str, tuple[float, str | None]] = {}
    low, high = own.bounds_m
    for line, name in zip(lines, names):
        if np.any(line.bounds_m[0] - half.max() - NEAR_M > high) or np.any(
            line.bounds_m[1] + half.max() + NEAR_M < low
        ):
            continue
        for turned in (0.0, np.pi):
            at = line.project(points, heading + turned)
            aside = -at.aside_m if turned == 0.0 else at.aside_m
            along = at.inside & (np.abs(wrap_angle(at.turn_rad)) <= PARALLEL_RAD)
            for side, sign in (("left", 1), ("right", -1)):
                near = along & (np.abs(sign * aside - half) <= NEAR_M)
                if near.mean() >= MIN_SHARE and near.mean() > best.get(side, (0.0, None))[0]:
                    best[side] = (float(near.mean()), name)
    left, right = (best.get(side, (0.0, None))[1] for side in ("left", "right"))
    return replace(lane, left=lane.left or left, right=lane.right or right)
