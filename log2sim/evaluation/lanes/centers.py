"""Lanes against true ones, and against the true paths of those who drive in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, MapLane, Scenario
from log2sim.evaluation.lanes.area import STEP_M, Area, sampled
from log2sim.evaluation.lanes.lines import share, weighted_quantile
from log2sim.geometry import Array, wrap_angle

MATCH_M = 0.5
CENTER_REACH_M = 1.5
"""About half a lane: a found center line farther from all true ones belongs to none."""
MAX_TURN_RAD = np.deg2rad(45.0)
MIN_SPEED_MPS = 0.5
"""Who is slower may stand beside the lanes."""


def lane_figures(found: Sequence[MapLane], true: Sequence[MapLane], area: Area) -> dict[str, Any]:
    """Compare center lines, in their direction and outside of junctions, whose lanes a truth need not list."""
    ours = [lane for lane in found if lane.junction is None]
    theirs = [lane for lane in true if lane.junction is None]
    # In junctions a found lane may be any; what lies on a true junction lane counts neither way.
    crossed = shapely.union_all([_band(lane) for lane in true if lane.junction is not None])
    away, weight = _distances(ours, true, area.counts)
    at_junction = _inside(crossed, ours, area.counts)
    away, weight = away[~at_junction], weight[~at_junction]
    missed, true_weight = _distances(theirs, found, area.expects)
    near = away <= CENTER_REACH_M
    return {
        "true_m": float(true_weight.sum()),
        "found_m": float(weight.sum()),
        "precision": share(weight, away <= MATCH_M),
        "recall": share(true_weight, missed <= MATCH_M),
        "center_median_m": weighted_quantile(away[near], weight[near], 0.5),
        "center_p95_m": weighted_quantile(away[near], weight[near], 0.95),
    }


def path_figures(found: Sequence[MapLane], truth: Scenario, area: Area) -> dict[str, Any]:
    """Share of the true paths of vehicles, the ego among them, that lies in a lane of their direction."""
    inside_m, all_m = 0.0, 0.0
    for agent in truth.agents:
        w = agent.waypoints
        if agent.static or GROUP_OF.get(agent.category) != "vehicle" or len(w) < 2:
            continue
        seen = np.ones(len(w), dtype=bool) if w.visible is None else w.visible
        used = (np.abs(w.speed_mps) >= MIN_SPEED_MPS) & (w.observed & seen)
        xy = np.column_stack([w.x_m, w.y_m])
        step = np.linalg.norm(np.gradient(xy, axis=0), axis=1)
        used &= area.expects(xy)
        distance, limit = _to_lanes(xy[used], np.asarray(w.yaw_rad)[used], found)
        inside_m += float(step[used][distance <= limit].sum())
        all_m += float(step[used].sum())
    return {"path_m": all_m, "inside": inside_m / all_m if all_m > 0 else None}


def _samples(lanes: Sequence[MapLane], counts: Any) -> tuple[Array, Array, Array]:
    parts = [sampled(lane.points_m) for lane in lanes]
    xy = np.concatenate([np.zeros((0, 2)), *(p[0] for p in parts)])
    heading = np.concatenate([np.zeros(0), *(p[1] for p in parts)])
    weight = np.repeat([p[2] for p in parts], [len(p[0]) for p in parts])
    kept = counts(xy)
    return xy[kept], heading[kept], weight[kept]


def _distances(lanes: Sequence[MapLane], others: Sequence[MapLane], counts: Any) -> tuple[Array, Array]:
    """Distances (S,) of points of lanes to the nearest other lane of their direction, and the length (S,) of each."""
    xy, heading, weight = _samples(lanes, counts)
    distance, _ = _to_lanes(xy, heading, others)
    return distance, weight


def _inside(area: Any, lanes: Sequence[MapLane], counts: Any) -> NDArray[np.bool_]:
    xy, _, _ = _samples(lanes, counts)
    return np.asarray(shapely.contains_xy(area, xy[:, 0], xy[:, 1]), dtype=bool)


def _band(lane: MapLane) -> Any:
    return shapely.LineString(lane.points_m[:, :2]).buffer(float(np.mean(lane.width_m)) / 2, cap_style="flat")


def _to_lanes(xy: Array, heading: Array, lanes: Sequence[MapLane]) -> tuple[Array, Array]:
    """Distance (S,) of points with headings to the nearest lane that leads so, and half its width (S,)."""
    best, half = np.full(len(xy), np.inf), np.zeros(len(xy))
    points = shapely.points(xy) if len(xy) else np.zeros(0, dtype=object)
    for lane in lanes:
        center = lane.points_m[:, :2]
        steps = np.linalg.norm(np.diff(center, axis=0), axis=1)
        center = center[np.append(True, steps > 0)]
        if len(center) < 2 or len(xy) == 0:
            continue
        line = shapely.LineString(center)
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(center, axis=0), axis=1))])
        at = shapely.line_locate_point(line, points)
        piece = np.clip(np.searchsorted(s, at, side="right") - 1, 0, len(s) - 2)
        along = np.diff(center, axis=0)[piece]
        turn = np.abs(wrap_angle(heading - np.arctan2(along[:, 1], along[:, 0])))
        distance = np.where(turn <= MAX_TURN_RAD, shapely.distance(line, points), np.inf)
        nearer = distance < best
        best[nearer] = distance[nearer]
        width = lane.width_m[np.append(True, steps > 0)]
        half[nearer] = np.interp(at[nearer], s, width) / 2 + STEP_M / 2
    return best, half
