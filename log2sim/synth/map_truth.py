"""The exact map features of a scene: what is painted, where roads end, and the lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry import LineString, Point
from shapely.geometry.base import BaseGeometry

from log2sim.datatypes import MapFeatures, MapLane, Marking, RoadBorder
from log2sim.geometry import Array
from log2sim.synth.markings import (
    GroundPlan,
    RoadLine,
    Stroke,
    arrow_outline,
    crosswalk_stripes,
    parallel,
    road_lines,
    stretch,
)
from log2sim.synth.scene import Scene
from log2sim.synth.scene_places import Road, Zebra

MIN_PIECE_M = 0.05  # of a line; less is what rounding leaves
CIRCLE_SEGMENTS = 64  # a quarter of a circle; 1 mm off on one of 4 m
DIGITS = 9  # whole nanometers: exact enough, and the file stays small
TURNS = "lanes that turn in junctions are not listed"

Interval = tuple[float, float]


def map_features_of(scene: Scene) -> MapFeatures:
    """Say what is painted on the ground of a scene, where its roads end, and which lanes they have.

    Notes
    -----
    A line is cut where another road, a crosswalk or a stretch without markings interrupts it; a piece goes from where its
    paint begins to where it ends. Worn lines are whole, removed ones are left out. A lane lies between the lines that are
    painted, else between the ends of its road; it is cut where another road crosses it.
    """
    plan = GroundPlan.of(scene)
    markings: list[Marking] = []
    borders: list[RoadBorder] = []
    lanes: list[MapLane] = []
    for k, road in enumerate(plan.roads):
        lines = road_lines(road, keeps_right=plan.keeps_right)
        own = [_pieces_of(line, area_of(plan.interruptions(k)), f"line_{k}_{n}") for n, line in enumerate(lines)]
        markings += [piece for pieces in own for piece in pieces]
        crossed = area_of([Stroke(np.array(r.line), r.width_m) for n, r in enumerate(plan.roads) if n != k])
        sides = _borders(road, crossed, k)
        borders += [piece for pieces in sides for piece in pieces]
        lanes += _Lanes.of(road, k, plan.keeps_right, tuple(zip(lines, own)), sides).cut(crossed)
    markings += [_crosswalk(zebra, k) for k, zebra in enumerate(plan.zebras)]
    for k, stop in enumerate(plan.stop_lines):
        markings.append(
            Marking(f"stop_line_{k}", "stop_line", _on_ground(np.array(stop.line)), stop.width_m, stop.color)
        )
    for k, arrow in enumerate(plan.arrows):
        outline = arrow_outline(arrow)
        turn = np.deg2rad(arrow.yaw_deg)
        across = outline @ np.array([-np.sin(turn), np.cos(turn)])
        markings.append(Marking(f"arrow_{k}", "other", _on_ground(outline), float(np.ptp(across)), "white"))
    return MapFeatures(tuple(markings), tuple(borders), tuple(lanes), (TURNS,) if len(plan.roads) > 1 else ())


def area_of(strokes: Sequence[Stroke]) -> BaseGeometry:
    """Area of strokes as they are painted: square ends, round joints."""
    parts = []
    for stroke in strokes:
        for a, b in zip(stroke.line, stroke.line[1:]):
            if not np.array_equal(a, b):
                parts.append(LineString([a, b]).buffer(stroke.width_m / 2, cap_style="flat"))
        parts += [Point(p).buffer(stroke.width_m / 2, quad_segs=CIRCLE_SEGMENTS) for p in stroke.line[1:-1]]
    return shapely.union_all(parts)


def _left_over(line: Array, area: BaseGeometry) -> list[Interval]:
    """Parts of a line (P, 2) outside an area, as distances along it in ascending order."""
    whole = LineString(line)
    return _along(whole, whole.difference(area))


def _along(whole: LineString, part: BaseGeometry) -> list[Interval]:
    pieces = [p for p in shapely.get_parts(part) if p.geom_type == "LineString" and p.length >= MIN_PIECE_M]
    ends = [[float(whole.project(Point(p.coords[n]))) for n in (0, -1)] for p in pieces]
    # Pieces that meet at a point of the line are one.
    out: list[Interval] = []
    for begin, end in sorted((min(e), max(e)) for e in ends):
        if out and begin - out[-1][1] < 10**-DIGITS:
            out[-1] = (out[-1][0], end)
        else:
            out.append((begin, end))
    return out


def _pieces_of(line: RoadLine, gaps: BaseGeometry, name: str) -> list[Marking]:
    """Cut a line where it is interrupted."""
    whole = LineString(line.line)
    painted = [_along(whole, LineString(dash).difference(gaps)) for dash in line.dashes if len(dash) > 1]
    dashes = [interval for intervals in painted for interval in intervals]
    out: list[Marking] = []
    for begin, end in _left_over(line.line, gaps):
        inside = [(a, b) for a, b in dashes if a >= begin - MIN_PIECE_M and b <= end + MIN_PIECE_M]
        if inside:
            points = stretch(line.line, min(a for a, _ in inside), max(b for _, b in inside))
            out.append(Marking(f"{name}_{len(out)}", line.kind, _on_ground(points), line.width_m, line.color))
    return out


def _borders(road: Road, crossed: BaseGeometry, k: int) -> tuple[list[RoadBorder], list[RoadBorder]]:
    """List the ends of the road at its right and its left, as its line runs."""
    kind = "curb" if road.sidewalk_m > 0 else "edge"
    sides = []
    for name, side in (("right", -1), ("left", 1)):
        line = parallel(np.array(road.line), side * road.width_m / 2)
        pieces = [stretch(line, *interval) for interval in _left_over(line, crossed)]
        sides.append([RoadBorder(f"border_{k}_{name}_{n}", kind, _on_ground(p)) for n, p in enumerate(pieces)])
    return sides[0], sides[1]


def _crosswalk(zebra: Zebra, k: int) -> Marking:
    stripes = crosswalk_stripes(zebra)
    whole = LineString(np.array(zebra.line))
    begin = whole.project(Point(stripes[0].line[0]))
    end = whole.project(Point(stripes[-1].line[-1]))
    middle = stretch(np.array(zebra.line), begin, end)
    outline = np.concatenate([parallel(middle, -zebra.width_m / 2), parallel(middle, zebra.width_m / 2)[::-1]])
    return Marking(f"crosswalk_{k}", "crosswalk", _on_ground(outline), zebra.width_m, "white")


@dataclass(frozen=True, eq=False)
class _Lanes:
    """The lanes of a road from its right to its left, as its line runs.

    Attributes
    ----------
    road : Road
    number : int
    first_forward, last_forward : int
        Which lanes lead along the line.
    at_m : (L + 1,) float64
        How far to the left of the road's line their boundaries lie.
    sides : tuple of lists
        Markings, or borders, of each boundary for the lane at its right and the one at its left.
    """

    road: Road
    number: int
    first_forward: int
    last_forward: int
    at_m: Array
    sides: tuple[tuple[list[Marking] | list[RoadBorder], list[Marking] | list[RoadBorder]], ...]

    @classmethod
    def of(
        cls,
        road: Road,
        number: int,
        keeps_right: bool,
        lines: Sequence[tuple[RoadLine, list[Marking]]],
        borders: tuple[list[RoadBorder], list[RoadBorder]],
    ) -> _Lanes:
        """Find what lies at the boundaries."""
        back = road.backward_lanes
        first = 0 if keeps_right else back
        at = (np.arange(road.lanes + 1) / road.lanes - 0.5) * road.width_m
        sides: list[tuple[list[Marking] | list[RoadBorder], list[Marking] | list[RoadBorder]]] = []
        for boundary in range(road.lanes + 1):
            own = [(line, pieces) for line, pieces in lines if line.boundary == boundary]
            if own:
                offsets = [_offset(road, line) for line, _ in own]
                at[boundary] = np.mean(offsets)
                # Of a double line each lane has the one that is nearer.
                sides.append((own[int(np.argmin(offsets))][1], own[int(np.argmax(offsets))][1]))
            else:
                border = borders[0] if boundary == 0 else borders[1] if boundary == road.lanes else []
                sides.append((border, border))
        return cls(road, number, first, first + road.lanes - back - 1, at, tuple(sides))

    def cut(self, crossed: BaseGeometry) -> list[MapLane]:
        """List the lanes in the directions in which they are driven, cut where other roads cross."""
        parts = [self._parts(lane, crossed) for lane in range(self.road.lanes)]
        out = []
        for lane, pieces in enumerate(parts):
            for n, piece in enumerate(pieces):
                right, left = (parts[k][n] if self._alike(parts, lane, k) else None for k in (lane - 1, lane + 1))
                forward = self._forward(lane)
                beside = {"right": right, "left": left} if forward else {"right": left, "left": right}
                numbers = {"right": lane - 1 if forward else lane + 1, "left": lane + 1 if forward else lane - 1}
                same = {
                    side: other.id
                    for side, other in beside.items()
                    if other is not None and self._forward(numbers[side]) == forward
                }
                opposite = [o.id for side, o in beside.items() if o is not None and side not in same]
                out.append(
                    replace(
                        piece,
                        left_lane=same.get("left"),
                        right_lane=same.get("right"),
                        opposite=opposite[0] if opposite else None,
                    )
                )
        return out

    def _alike(self, parts: list[list[MapLane]], lane: int, other: int) -> bool:
        return 0 <= other < len(parts) and len(parts[other]) == len(parts[lane])

    def _forward(self, lane: int) -> bool:
        return self.first_forward <= lane <= self.last_forward

    def _parts(self, lane: int, crossed: BaseGeometry) -> list[MapLane]:
        """Cut a lane at other roads; the parts on them belong to junctions. In the order of the road's line."""
        middle = parallel(np.array(self.road.line), float(self.at_m[lane : lane + 2].mean()))
        whole = LineString(middle)
        free = [(interval, False) for interval in _along(whole, whole.difference(crossed))]
        parts = sorted([*free, *((interval, True) for interval in _along(whole, whole.intersection(crossed)))])
        names = [f"lane_{self.number}_{lane}_{n}" for n in range(len(parts))]
        forward = self._forward(lane)
        out = []
        for n, ((begin, end), inside) in enumerate(parts):
            points = stretch(middle, begin, end)
            before, after = names[max(n - 1, 0) : n], names[n + 1 : n + 2]
            right = None if inside else _beside(points, self.sides[lane][1])
            left = None if inside else _beside(points, self.sides[lane + 1][0])
            out.append(
                MapLane(
                    id=names[n],
                    points_m=_on_ground(points if forward else points[::-1]),
                    width_m=np.full(len(points), float(np.diff(self.at_m)[lane])),
                    left=left if forward else right,
                    right=right if forward else left,
                    predecessors=tuple(before if forward else after),
                    successors=tuple(after if forward else before),
                    junction=f"junction_{self.number}_{n}" if inside else None,
                )
            )
        return out


def _offset(road: Road, line: RoadLine) -> float:
    """How far a line lies to the left of its road's line, m."""
    a, b = np.array(road.line[:2])
    ahead = (b - a) / np.linalg.norm(b - a)
    return float((line.line[0] - a) @ [-ahead[1], ahead[0]])


def _beside(points: Array, pieces: Sequence[Marking | RoadBorder]) -> str | None:
    """Find which piece runs along most of a lane, None without one."""
    lane = LineString(points)

    def shared_m(piece: Marking | RoadBorder) -> float:
        ends = [lane.project(Point(p)) for p in piece.points_m[[0, -1], :2]]
        return float(abs(ends[1] - ends[0]))

    best = max(pieces, key=shared_m, default=None)
    return best.id if best is not None and shared_m(best) > 0 else None


def _on_ground(points: Array) -> Array:
    return np.column_stack([np.round(points, DIGITS), np.zeros(len(points))])
