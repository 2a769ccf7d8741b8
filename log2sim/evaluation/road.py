"""Markings, borders, lanes, colors and traffic lights against the truth."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from shapely.geometry.base import BaseGeometry

from log2sim.datatypes import COLOR_NAMES, GROUP_OF, Agent, MapFeatures, MapLane, Marking, RoadBorder, Scenario
from log2sim.errors import ScenarioError
from log2sim.files.arrays import Columns
from log2sim.geometry import Array, weighted_quantile, wrap_angle

WITHIN_M, CLOSE_M = 40.0, 20.0  # of the ego's path
STEP_M = 0.1  # between points at which lines are compared
MAX_SAMPLES = 2_000_000
MAX_CELLS = 10_000_000
PATH_TOLERANCE_M = 0.05  # to which the ego's path is simplified before its surroundings are taken


@dataclass(frozen=True, eq=False)
class Area:
    """Where map features count."""

    near: BaseGeometry | None  # surroundings of the ego's path; None without an ego, where all counts
    close: BaseGeometry | None  # its nearer part
    seen: BaseGeometry | None  # ground that a sensor saw; None where the truth does not tell
    path_m: float  # length of the ego's path, m; 0 without an ego

    @classmethod
    def of(cls, scenario: Scenario, truth: Scenario, shift_m: Array) -> Area:
        """Take it from a truth that was moved into the scenario's map by `shift_m` (3,).

        Raises `ScenarioError` when the truth names cells in a way that cannot be read.
        """
        ego = truth.ego or scenario.ego
        seen = seen_ground(truth, shift_m)
        if ego is None:
            return cls(None, None, seen, 0.0)
        w = ego.waypoints
        path = shapely.LineString(np.column_stack([w.x_m, w.y_m])) if len(w) > 1 else shapely.Point(w.x_m[0], w.y_m[0])
        near, close = (path.simplify(PATH_TOLERANCE_M).buffer(reach) for reach in (WITHIN_M, CLOSE_M))
        shapely.prepare([near, close])
        return cls(near, close, seen, float(path.length))

    def counts(self, xy_m: Array) -> NDArray[np.bool_]:
        """Whether what is found at points (N, 2) counts: near the path."""
        return _within(self.near, xy_m)

    def expects(self, xy_m: Array) -> NDArray[np.bool_]:
        """Whether what is true at points (N, 2) should be found: near the path, where a sensor saw the ground."""
        return _within(self.near, xy_m) & _within(self.seen, xy_m)


def _within(area: BaseGeometry | None, xy_m: Array) -> NDArray[np.bool_]:
    if area is None:
        return np.ones(len(xy_m), dtype=bool)
    return np.asarray(shapely.contains_xy(area, xy_m[:, 0], xy_m[:, 1]), dtype=bool)


def seen_ground(truth: Scenario, shift_m: Array) -> BaseGeometry | None:
    """Return the ground that sensors saw, as the provenance of a synthetic truth lists it, moved by `shift_m`; None without."""
    stated = truth.provenance.get("seen_ground")
    if stated is None:
        return None
    try:
        cell_m, runs = float(stated["cell_m"]), np.array(stated["runs"], dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError, KeyError) as error:
        raise ScenarioError(f"provenance.seen_ground: {error!r}, expected cell_m and runs of three numbers") from None
    if not (np.isfinite(runs).all() and 0 < cell_m < 100 and len(runs) <= MAX_CELLS and (runs[:, 2] > 0).all()):
        raise ScenarioError("provenance.seen_ground: expected positive numbers of cells of at most 100 m")
    low = runs[:, :2] * cell_m + shift_m[:2]
    boxes = shapely.box(low[:, 0], low[:, 1], low[:, 0] + runs[:, 2] * cell_m, low[:, 1] + cell_m)
    seen = shapely.union_all(boxes)
    shapely.prepare(seen)
    return seen


def sampled(points_m: Array) -> tuple[Array, Array, float]:
    """Sample a line (N, 2 or 3) at steps of at most `STEP_M`: places (S, 2), headings (S,), and the length that each stands for, m.

    Raises `ScenarioError` when it is too long to be a line on a road.
    """
    xy = np.asarray(points_m, dtype=np.float64)[:, :2]
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    if s[-1] == 0:
        return np.zeros((0, 2)), np.zeros(0), 0.0
    if s[-1] > MAX_SAMPLES * STEP_M:
        raise ScenarioError(f"a line of {s[-1]:g} m is too long to be compared")
    count = int(np.ceil(s[-1] / STEP_M))
    at = (np.arange(count) + 0.5) * s[-1] / count
    piece = np.clip(np.searchsorted(s, at, side="right") - 1, 0, len(steps) - 1)
    along = np.diff(xy, axis=0)[piece]
    middle = xy[piece] + along * ((at - s[piece]) / np.where(steps[piece] > 0, steps[piece], 1.0))[:, None]
    return middle, np.arctan2(along[:, 1], along[:, 0]), float(s[-1] / count)


MATCH_M = 0.3
# Found points farther from every true line than this, a third of a lane, belong to none and have no lateral error.
LATERAL_REACH_M = 1.0
Line = Marking | RoadBorder
Counts = Callable[[Array], NDArray[np.bool_]]  # which of places (N, 2) count


@dataclass(frozen=True, eq=False)
class RoadSamples(Columns):
    """Points of lines, S in all."""

    xy_m: Array  # (S, 2)
    length_m: Array  # (S,) that each stands for
    line: NDArray[np.int64]  # (S,) index of its line
    heading_rad: Array  # (S,)

    @classmethod
    def of(cls, lines: Sequence[Line | MapLane], counts: Counts) -> RoadSamples:
        """Sample lines; places that do not count are left out."""
        parts = [sampled(line.points_m) for line in lines]
        each = [len(xy) for xy, _, _ in parts]
        xy = np.concatenate([np.zeros((0, 2)), *(xy for xy, _, _ in parts)])
        length, line = np.repeat([length for _, _, length in parts], each), np.repeat(np.arange(len(lines)), each)
        heading = np.concatenate([np.zeros(0), *(heading for _, heading, _ in parts)])
        return cls(xy, length, line, heading).take(counts(xy))


def nearest_road(samples: RoadSamples, lines: Sequence[Line]) -> tuple[NDArray[np.int64], Array]:
    """Find the nearest line (S,) of each sample and its distance (S,) in m; -1 and infinite without lines."""
    index, distance = np.full(len(samples.line), -1), np.full(len(samples.line), np.inf)
    geometries = [shapely.LineString(line.points_m[:, :2]) for line in lines]
    if len(geometries) == 0 or len(index) == 0:
        return index, distance
    (rows, found), away = shapely.STRtree(geometries).query_nearest(
        shapely.points(samples.xy_m), all_matches=False, return_distance=True
    )
    index[rows], distance[rows] = found, away
    return index, distance


def line_figures(found: Sequence[Line], true: Sequence[Line], area: Area) -> dict[str, Any]:
    """Compare found lines with true ones.

    `precision` is the share of found length within `MATCH_M` of a true line, `recall` the share of true length
    within that of a found one, where a sensor saw the ground; `recall_20_m` the same within 20 m of the path. The
    lateral errors are distances of found points to the nearest true line within `LATERAL_REACH_M`. None where there is
    nothing to compute a figure from.
    """
    ours, theirs = RoadSamples.of(found, area.counts), RoadSamples.of(true, area.expects)
    nearest_true, away = nearest_road(ours, true)
    _, missed_by = nearest_road(theirs, found)
    right = away <= MATCH_M
    found_m, true_m = float(ours.length_m.sum()), float(theirs.length_m.sum())
    false_m = float(ours.length_m[~right].sum())
    close = _within(area.close, theirs.xy_m)
    # Shares of the matched length whose kind, and whose color where both sides state one, is right.
    matched, agreement = ours.take(right), {}
    for name in ("kind", "color"):
        lines = [(found[i], true[k]) for i, k in zip(matched.line, nearest_true[right])]
        pairs = [(getattr(a, name, None), getattr(b, name, None)) for a, b in lines]
        stated = np.array([None not in pair for pair in pairs], dtype=bool)
        same = np.array([a == b for a, b in pairs], dtype=bool)
        agreement[f"{name}_accuracy"] = share(matched.length_m[stated], same[stated])
    beside = away <= LATERAL_REACH_M
    return {
        "true_m": true_m, "found_m": found_m, "precision": share(ours.length_m, right),
        "recall": share(theirs.length_m, missed_by <= MATCH_M),
        "recall_20_m": share(theirs.length_m[close], missed_by[close] <= MATCH_M),
        "lateral_median_m": _quantile(away[beside], ours.length_m[beside], 0.5),
        "lateral_p95_m": _quantile(away[beside], ours.length_m[beside], 0.95),
        "false_m_per_100_m": None if area.path_m < 1 else 100 * false_m / area.path_m, **agreement,
    }  # fmt: skip


def share(weight: Array, chosen: NDArray[np.bool_]) -> float | None:
    """Share of the weights (N,) that is chosen (N,), None where they are all zero."""
    total = float(weight.sum())
    return float(weight[chosen].sum()) / total if total > 0 else None


def _quantile(values: Array, weight: Array, share: float) -> float | None:
    return weighted_quantile(values, weight, share) if weight.sum() > 0 else None


STOP_LINE_REACH_M = 0.5
# What two of a kind share at least to be the same: of the length of the longer stop line, of the union of outlines.
MIN_STOP_LINE_SHARE, MIN_OVERLAP, MIN_ARROW_OVERLAP = 0.5, 0.5, 0.2


def shape_figures(found: Sequence[Marking], true: Sequence[Marking], area: Area) -> dict[str, Any]:
    """Count by kind how many are true, and how many are found or false; `partly_seen` ones count neither way."""

    def geometry(marking: Marking) -> BaseGeometry:
        xy = marking.points_m[:, :2]
        line = marking.kind == "stop_line" or len(xy) < 3
        return shapely.LineString(xy) if line else shapely.make_valid(shapely.Polygon(xy))

    def mostly(inside: Counts, shape: BaseGeometry) -> bool:  # whether at least half of the corners lie within
        corners: Array = shapely.get_coordinates(shape)
        return bool(len(corners)) and bool(inside(corners).mean() >= 0.5)

    out = {}
    for name, kind in (("stop_lines", "stop_line"), ("crosswalks", "crosswalk"), ("others", "other")):
        ours = [geometry(m) for m in found if m.kind == kind]
        theirs = [geometry(m) for m in true if m.kind == kind]
        same = np.array([[_alike(kind, a, b) for b in theirs] for a in ours]).reshape(len(ours), len(theirs))
        rows, columns = linear_sum_assignment(-same)
        matched = same[rows, columns] > 0
        seen = np.array([mostly(area.expects, g) for g in theirs], dtype=bool)
        near = np.array([mostly(area.counts, g) for g in ours], dtype=bool)
        right = np.isin(np.arange(len(ours)), rows[matched])
        hit = np.isin(np.arange(len(theirs)), columns[matched])
        out[name] = {
            "true": int(seen.sum()),
            "found": int((hit & seen).sum()),
            "false": int((near & ~right).sum()),
            "partly_seen": int((~seen).sum()),
        }
    return out


def _alike(kind: str, a: BaseGeometry, b: BaseGeometry) -> float:
    """How much two of a kind are the same, 0 where they are not."""
    if kind == "stop_line":
        shared = min(p.intersection(q.buffer(STOP_LINE_REACH_M)).length for p, q in ((a, b), (b, a)))
        part = shared / max(a.length, b.length) if max(a.length, b.length) > 0 else 0.0
        return float(part) if part >= MIN_STOP_LINE_SHARE else 0.0
    union = a.union(b).area
    overlap = a.intersection(b).area / union if union > 0 else 0.0
    return float(overlap) if overlap >= (MIN_OVERLAP if kind == "crosswalk" else MIN_ARROW_OVERLAP) else 0.0


CENTER_MATCH_M = 0.5
CENTER_REACH_M = 1.5  # about half a lane: a found center line farther from all true ones belongs to none
MAX_TURN_RAD = np.deg2rad(45.0)
MIN_SPEED_MPS = 0.5  # who is slower may stand beside the lanes


def lane_figures(found: Sequence[MapLane], true: Sequence[MapLane], area: Area) -> dict[str, Any]:
    """Compare center lines, in their direction and outside of junctions, whose lanes a truth need not list."""
    ours = [lane for lane in found if lane.junction is None]
    theirs = [lane for lane in true if lane.junction is None]
    # In junctions a found lane may be any; what lies on a true junction lane counts neither way.
    junctions = [lane for lane in true if lane.junction is not None]
    middles = [shapely.LineString(lane.points_m[:, :2]) for lane in junctions]
    half_m = [float(np.mean(lane.width_m)) / 2 for lane in junctions]
    crossed = shapely.union_all([line.buffer(half, cap_style="flat") for line, half in zip(middles, half_m)])
    found_at, true_at = RoadSamples.of(ours, area.counts), RoadSamples.of(theirs, area.expects)
    found_at = found_at.take(~np.asarray(shapely.contains_xy(crossed, *found_at.xy_m.T), dtype=bool))
    away, _ = _to_lanes(found_at.xy_m, found_at.heading_rad, true)
    missed, _ = _to_lanes(true_at.xy_m, true_at.heading_rad, found)
    weight, true_weight, near = found_at.length_m, true_at.length_m, away <= CENTER_REACH_M
    return {
        "true_m": float(true_weight.sum()),
        "found_m": float(weight.sum()),
        "precision": share(weight, away <= CENTER_MATCH_M),
        "recall": share(true_weight, missed <= CENTER_MATCH_M),
        "center_median_m": _quantile(away[near], weight[near], 0.5),
        "center_p95_m": _quantile(away[near], weight[near], 0.95),
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


def color_figures(true: Sequence[Agent], found: Mapping[str, Agent]) -> dict[str, Any] | None:
    """Compare the colors of vehicles that were found with the true ones.

    `found`: the agent that each true one is matched with most often, by the true one's id. `accuracy` is the
    share of right names among vehicles with a color whose true color has a name of the fixed list; `ciede2000_median`
    the difference of the RGB values (Sharma et al., 2005; about 2 is just noticeable). None where the truth has no
    colors.
    """
    colored = [a for a in true if a.color is not None and GROUP_OF.get(a.category) == "vehicle"]
    if not colored:
        return None
    from skimage.color import deltaE_ciede2000, rgb2lab

    confused: Counter[str] = Counter()
    distance, named, right, with_color = [], 0, 0, 0
    matched = [(agent.color, found[agent.id].color) for agent in colored if agent.id in found]
    for true_color, color in matched:
        if color is None or true_color is None:
            continue
        with_color += 1
        lab = (rgb2lab(np.array(c["rgb"], dtype=np.float64)[None, None] / 255) for c in (color, true_color))
        distance.append(float(deltaE_ciede2000(*lab)[0, 0]))
        if true_color["name"] in COLOR_NAMES:
            named += 1
            right += color["name"] == true_color["name"]
            if color["name"] != true_color["name"]:
                confused[f"{true_color['name']} as {color['name']}"] += 1
    return {
        "vehicles": len(matched), "with_color": with_color, "named": named, "right": right,
        "accuracy": right / named if named else None,
        "ciede2000_median": float(np.median(distance)) if distance else None,
        "confused": dict(sorted(confused.items())),
    }  # fmt: skip


MAX_DISTANCE_M = 3.0  # between a found and a true signal head; those of one approach stand farther apart
STEP_S = 0.05


def signal_figures(scenario: Scenario, truth: Scenario) -> dict[str, Any] | None:
    """Compare the traffic lights of a scenario with those of its truth; None where none are true.

    `state_right` is the share of the time at which a found signal states something in which it is right, `state_known` the
    share of time in which it states something.
    """
    if not truth.signals:
        return None
    found, true = scenario.signals, truth.aligned_to(scenario).signals
    ours, theirs = (np.array([s.position_m for s in side]).reshape(-1, 3) for side in (found, true))
    away = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(away, 2 * MAX_DISTANCE_M))
    pairs = [(i, k) for i, k in zip(rows, columns) if away[i, k] <= MAX_DISTANCE_M]
    t_s = np.arange(0.0, scenario.duration_s + 1e-9, STEP_S)
    known, right = [], []
    for i, k in pairs:
        states, actual = found[i].at(t_s), true[k].at(t_s)
        stated, judged = states != "unknown", actual != "unknown"
        known.append((stated & judged).sum() / max(int(judged.sum()), 1))
        right += (states == actual)[stated & judged].tolist()
    return {
        "true": len(true),
        "found": len(pairs),
        "false": len(found) - len(pairs),
        "position_median_m": float(np.median([away[p] for p in pairs])) if pairs else None,
        "state_known": float(np.mean(known)) if known else None,
        "state_right": float(np.mean(right)) if right else None,
    }


def map_figures(scenario: Scenario, truth: Scenario) -> dict[str, Any] | None:
    """Compare the map features of a scenario with those of its truth, wherever its map lies; None without either.

    Raises `ScenarioError` when a line is too long, or the truth says in a way that cannot be read which ground sensors
    saw.
    """
    if scenario.map_features is None or truth.map_features is None:
        return None
    moved = truth.aligned_to(scenario)
    ours, theirs = scenario.map_features, moved.map_features or MapFeatures()
    area = Area.of(scenario, moved, truth.shift_to(scenario))
    our_lines, true_lines = ([m for m in side.markings if m.is_lane_line] for side in (ours, theirs))
    return {
        "within_m": WITHIN_M if area.near is not None else None,
        "where_seen": area.seen is not None,
        "lane_lines": line_figures(our_lines, true_lines, area),
        "borders": line_figures(ours.borders, theirs.borders, area),
        **shape_figures(ours.markings, theirs.markings, area),
        "lanes": {**lane_figures(ours.lanes, theirs.lanes, area), **path_figures(ours.lanes, moved, area)},
    }


def road_verdict(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Say in a line each how well the road, colors and traffic lights are found; nothing where there are none."""
    out = []
    figures = result.get("map_features")
    if figures is not None:
        named = (("lane lines", figures["lane_lines"]), ("borders", figures["borders"]), ("lanes", figures["lanes"]))
        parts = [
            f"{name} {whole_percent(f['recall'])} found"
            + f", {whole_percent(f['precision'])} right" * bool(f["found_m"])
            for name, f in named
            if f["true_m"]
        ]
        shapes = _shape_texts(figures)
        out += [("road", "; ".join([*parts, *shapes]))] if parts or shapes else []
    colors, signals = result.get("colors"), result.get("signals")
    if colors is not None and colors["vehicles"]:
        right = f"{colors['right']} of {colors['named']} right"
        out.append(("colors", f"{right}, {colors['with_color']} of {colors['vehicles']} vehicles have one"))
    if signals is not None:
        right = f", state right {whole_percent(signals['state_right'])} of the time" if signals["found"] else ""
        out.append(("signals", f"{signals['found']} of {signals['true']} found, {signals['false']} false{right}"))
    return out


def map_lines(result: Mapping[str, Any]) -> list[str]:
    """Format the figures of map features, colors and traffic lights in detail; nothing where there are none."""
    out = []
    figures = result.get("map_features")
    if figures is not None:
        kinds = figures["lane_lines"]["kind_accuracy"]
        right = "" if kinds is None else f", kind right {whole_percent(kinds)}"
        out += [
            f"lane lines: {_line_text(figures['lane_lines'])}{right}",
            f"borders:    {_line_text(figures['borders'])}",
        ]
        shapes = _shape_texts(figures)
        out += [f"markings:   {', '.join(shapes)}"] if shapes else []
        lanes = figures["lanes"]
        out.append(
            f"lanes:      precision {cell(lanes['precision'], 2)}, recall {cell(lanes['recall'], 2)}, center off by "
            f"{_meters(lanes['center_median_m'])} (median), {whole_percent(lanes['inside'])} of true paths inside"
        )
    colors, signals = result.get("colors"), result.get("signals")
    if colors is not None:
        out.append(
            f"colors:     {colors['right']} of {colors['named']} names right, {colors['with_color']} of "
            f"{colors['vehicles']} vehicles have one, CIEDE2000 {cell(colors['ciede2000_median'], 1)} (median)"
        )
    if signals is not None:
        out.append(
            f"signals:    {signals['found']} of {signals['true']} found, {signals['false']} false, off by "
            f"{_meters(signals['position_median_m'])} (median), state right {whole_percent(signals['state_right'])} of the time"
        )
    lines = [part for line in out for part in textwrap.wrap(line, 100, subsequent_indent=" " * 12)]
    return ["", *lines] if lines else []


def _shape_texts(figures: Mapping[str, Any]) -> list[str]:
    """Say of each kind of marking with a shape, where there are any, how many are found."""
    out = []
    for key, name in (("stop_lines", "stop lines"), ("crosswalks", "crosswalks"), ("others", "other markings")):
        counts = figures[key]
        false = f" (+{counts['false']} false)" if counts["false"] else ""
        if counts["true"] or counts["false"]:
            out.append(f"{counts['found']} of {counts['true']}{false} {name}")
    return out


def _line_text(figures: Mapping[str, Any]) -> str:
    return (
        f"precision {cell(figures['precision'], 2)}, recall {cell(figures['recall'], 2)} "
        f"({cell(figures['recall_20_m'], 2)} within 20 m), off by {_meters(figures['lateral_median_m'])} (median) {_meters(figures['lateral_p95_m'])} (p95), "
        f"{cell(figures['false_m_per_100_m'], 1)} m false per 100 m"
    )


def cell(value: float | None, digits: int, scale: float = 1) -> str:
    """Format a figure with some decimals; "-" for None."""
    return "-" if value is None else f"{scale * value:.{digits}f}"


def _meters(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} m"


def whole_percent(share: float | None) -> str:
    """Format a share as a whole number of percent; "-" for None."""
    return "-" if share is None else f"{100 * share:.0f} %"
