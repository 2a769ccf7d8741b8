"""A map of the ground that is too large to be drawn at once: its parts, and what they show as one.

Memory and the number of records a map takes are bounded, so that a map of a long way would be coarse and of few records. Parts overlap, so that each line is seen with what is around it; of what a part shows counts what lies in its core, and lines that
go on across the edge of a core are joined there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise, product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely import LineString, box

from log2sim.datatypes import Log, MapFeatures, Marking, RoadBorder, Scenario
from log2sim.errors import LogError
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.lidar.cloud import cloud_origin
from log2sim.road.ground_map import Extent
from log2sim.road.markings import MIN_LINE_M

# Of this long only few ground pixels and points are finer than lane markings.
MARGIN_M = 40.0
# A roadside sensor 6 m above the road has a pixel of 0.5 m length at this distance, with 1500 px of focal length.
ROADSIDE_MARGIN_M = 70.0
# Cells along an edge of a part, overlap included: with 44 bytes a cell it takes 640 MB while it is filled.
PART_CELLS = 3800
# Gaps of dashed lines are 13 m at most, dashes 3 m at least: around a core each line is seen with its next dash.
OVERLAP_M = 20.0
# Two parts see the same line: what ends so near to each other in both, in about the same direction, goes on.
JOIN_M, JOIN_COS = 0.5, float(np.cos(np.deg2rad(15)))


@dataclass(frozen=True)
class Part:
    """A part of a map: what is drawn, and the core of it whose features count."""

    area_m: Extent
    core_m: Extent


def path_of(log: Log, scenario: Scenario) -> Array:
    """Places (K, 3), m, on the ground that the ego passed, about every half meter; none without known poses."""
    if log.ego is None:
        return np.zeros((0, 3))
    end_ns = scenario.t0_ns + round(scenario.duration_s * NS_PER_S)
    t_ns = log.ego.t_ns[(log.ego.t_ns >= scenario.t0_ns) & (log.ego.t_ns <= end_ns)]
    t_ns = t_ns if len(t_ns) else np.array([scenario.t0_ns], dtype=np.int64)
    map_T_ego, known = log.ego.at(t_ns)
    ground = map_T_ego[known] @ np.array([0.0, 0.0, log.ground_z_ego_m, 1.0])
    if not len(ground):
        return np.zeros((0, 3))
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ground[:, :3], axis=0), axis=1))])
    at = np.linspace(0, gone[-1], max(int(gone[-1] / 0.5), 1) + 1)
    return np.column_stack([np.interp(at, gone, ground[:, k]) for k in range(3)])


def roadside_of(log: Log, scenario: Scenario) -> Array:
    """Places (K, 3), m, of the sensors that are fixed in the map, on the ground where there is no ego."""
    fixed = [name for name, camera in log.cameras.items() if camera.mount == "map"]
    fixed += [name for name, lidar in log.lidars.items() if lidar.mount == "map"]
    places = np.array([log.map_T_sensor(name, scenario.t0_ns)[0][0, :3, 3] for name in fixed]).reshape(-1, 3)
    if log.ego is None:
        places[:, 2] = cloud_origin(log, scenario.t0_ns)[1]
    return places


def whole_map(log: Log, scenario: Scenario) -> Extent:
    """Return what a map of all that a log shows covers; raises `LogError` when no pose is known."""
    extent = _extent_around(_places(log, scenario), None)
    if extent is None:
        raise LogError("no pose of any sensor is known, so pictures and sweeps have no place in a map of the ground")
    return extent


def _places(log: Log, scenario: Scenario) -> list[tuple[Array, float]]:
    """Places (K, 3), m, of sensors, and how far around them, m, the ground is mapped."""
    return [(path_of(log, scenario), MARGIN_M), (roadside_of(log, scenario), ROADSIDE_MARGIN_M)]


def _extent_around(places: list[tuple[Array, float]], core_m: Extent | None) -> Extent | None:
    """Extent of what is mapped from the places that see anything of a core, or from all; None where there are none.

    In whole meters, so that maps of one log lie on the same cells whichever part of it they show.
    """
    corners = []
    for xyz, margin in places:
        near = xyz if core_m is None else xyz[is_within(xyz, core_m, margin)]
        corners += [near[:, :2] - margin, near[:, :2] + margin]
    xy = np.concatenate(corners)
    if not len(xy):
        return None
    (x0, y0), (x1, y1) = np.floor(xy.min(axis=0)), np.ceil(xy.max(axis=0))
    return float(x0), float(x1), float(y0), float(y1)


def is_within(places: Array, extent_m: Extent, margin_m: float = 0.0) -> NDArray[np.bool_]:
    """Mark the places (K, 2 or 3) that are in an extent, or this near to it; its upper edges are not in it."""
    x0, x1, y0, y1 = extent_m
    x, y = places[:, 0], places[:, 1]
    return (x >= x0 - margin_m) & (x < x1 + margin_m) & (y >= y0 - margin_m) & (y < y1 + margin_m)


def parts_of(log: Log, scenario: Scenario, cell_m: float) -> list[Part]:
    """Part the map of a log in cells of this size; one part where that suffices.

    Raises `LogError` when no pose is known.
    """
    whole = whole_map(log, scenario)
    if (whole[1] - whole[0]) * (whole[3] - whole[2]) <= (PART_CELLS * cell_m) ** 2:
        return [Part(whole, whole)]
    edge_m = max(PART_CELLS * cell_m - 2 * OVERLAP_M, 2 * OVERLAP_M)
    columns, rows = (
        np.round(np.linspace(low, high, int(np.ceil((high - low) / edge_m)) + 1)).tolist()
        for low, high in (whole[:2], whole[2:])
    )
    parts, places = [], _places(log, scenario)
    for (x0, x1), (y0, y1) in product(pairwise(columns), pairwise(rows)):
        core = (x0, x1, y0, y1)
        around = _extent_around(places, core)
        if around is not None:
            west, south = (max(around[k], core[k] - OVERLAP_M) for k in (0, 2))
            east, north = (min(around[k], core[k] + OVERLAP_M) for k in (1, 3))
            parts.append(Part((west, east, south, north), core))
    return [part for part in parts if part.area_m[0] < part.area_m[1] and part.area_m[2] < part.area_m[3]]


Line = Marking | RoadBorder


def join_parts(parts: Sequence[Part], found: Sequence[MapFeatures]) -> MapFeatures:
    """Return what all parts of a map show, each in its core; notes that hold for all of them, and all where they show nothing."""
    if len(parts) == 1:
        return found[0]
    markings: list[Marking] = []
    lines: list[tuple[int, Line]] = []
    for number, (part, features) in enumerate(zip(parts, found)):
        lane_lines: list[Line] = [m for m in features.markings if m.is_lane_line]
        for line in (*lane_lines, *features.borders):
            lines += [(number, stretch) for stretch in _cut(line, part.core_m)]
        others = [m for m in features.markings if not m.is_lane_line]
        markings += [m for m in others if is_within(m.points_m.mean(axis=0)[None], part.core_m)[0]]
    joined = _join(lines)
    markings += [line for line in joined if isinstance(line, Marking)]
    borders = [line for line in joined if isinstance(line, RoadBorder)]
    notes = dict.fromkeys(chain(*(features.notes for features in found)))
    notes = {note: None for note in notes if not lines or all(note in features.notes for features in found)}
    return MapFeatures(
        tuple(replace(m, id=f"marking-{k + 1}") for k, m in enumerate(sorted(markings, key=lambda m: -m.confidence))),
        tuple(replace(b, id=f"border-{k + 1}") for k, b in enumerate(sorted(borders, key=lambda b: -b.confidence))),
        notes=tuple(notes),
    )


def _cut(line: Line, core_m: Extent) -> list[Line]:
    """Return the stretches of a line within a core."""
    x0, x1, y0, y1 = core_m
    inside = LineString(line.points_m).intersection(box(x0, y0, x1, y1))
    stretches = [np.array(one.coords) for one in getattr(inside, "geoms", [inside]) if one.geom_type == "LineString"]
    return [replace(line, points_m=points_m) for points_m in stretches if len(points_m) > 1]


def _join(lines: list[tuple[int, Line]]) -> list[Line]:
    """Join lines of different parts where they go on in each other, the nearest ends first; leave out what stays too short."""
    if not lines:
        return []
    ends = np.array([line.points_m[[0, -1], :2] for _, line in lines]).reshape(-1, 2)
    inner = np.array([line.points_m[[1, -2], :2] for _, line in lines]).reshape(-1, 2)
    outward = ends - inner
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    pairs = cKDTree(ends).query_pairs(JOIN_M, output_type="ndarray")
    apart = np.linalg.norm(ends[pairs[:, 0]] - ends[pairs[:, 1]], axis=1)
    other = dict[int, int]()  # the end that an end goes on in
    for a, b in pairs[np.argsort(apart, kind="stable")].tolist():
        (part, line), (other_part, other_line) = lines[a // 2], lines[b // 2]
        alike = part != other_part and type(line) is type(other_line) and line.kind == other_line.kind
        if alike and a not in other and b not in other and float(outward[a] @ outward[b]) < -JOIN_COS:
            other |= {a: b, b: a}
    left, out = set(range(len(lines))), list[Line]()
    # From an end that nothing goes on in; what is left then are rings.
    for start in sorted(range(len(ends)), key=lambda end: end in other):
        run, end = list[tuple[Line, bool]](), start if start // 2 in left else None
        while end is not None:
            left.remove(end // 2)
            run.append((lines[end // 2][1], end % 2 == 1))
            following = other.get(end ^ 1)
            end = following if following is not None and following // 2 in left else None
        if run:
            out.append(_one_of(run))
    return [line for line in out if _length_m(line) >= MIN_LINE_M]


def _one_of(run: list[tuple[Line, bool]]) -> Line:
    """Make one line of stretches in their order, each with whether it is passed backwards: by what most of it is like."""
    length = np.array([max(_length_m(line), 1e-6) for line, _ in run])
    longest = run[int(np.argmax(length))][0]
    points_m = np.zeros((0, 3))
    for line, backward in run:
        stretch = line.points_m[::-1] if backward else line.points_m
        middle = (points_m[-1:] + stretch[:1]) / 2 if len(points_m) else stretch[:1]
        points_m = np.concatenate([points_m[:-1], middle, stretch[1:]])
    changed: dict[str, object] = {
        "points_m": points_m,
        "sources": tuple(dict.fromkeys(chain(*(line.sources for line, _ in run)))),
    }
    names = ("confidence", "width_m") if isinstance(longest, Marking) else ("confidence",)
    changed |= {name: float(np.average([getattr(line, name) for line, _ in run], weights=length)) for name in names}
    return replace(longest, **changed)  # type: ignore[arg-type]


def _length_m(line: Line) -> float:
    return float(np.linalg.norm(np.diff(line.points_m[:, :2], axis=0), axis=1).sum())
