"""Strips of road between two lines that run side by side: lanes as markings and borders show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Marking, RoadBorder
from log2sim.geometry import Array, Polyline, wrap_angle

# Stations at which the distance to the next line is taken.
STEP_M = 1.0
# Of a lane: from the narrowest of roadworks (2.2 m) to the widest of ramps.
MIN_WIDTH_M, MAX_WIDTH_M = 2.2, 5.0
# Lines nearer than this belong together: double lines, a curb beside an edge line.
SAME_LINE_M = 1.0
# Edges of a lane differ less in heading, also where it widens.
PARALLEL_RAD = float(np.deg2rad(8.0))
# Shorter strips are between arrows, letters and pieces of crosswalks: a dash and its gap are 9 m (RMS 1993) to 12 m long.
MIN_LENGTH_M = 8.0
# Between two pieces of a strip whose lines are worn: the longest gap between dashes of motorways (12 m) and some more.
MAX_GAP_M = 15.0
# How far the second piece may lie aside of where the first leads, and how much wider it may be: less than any next lane.
MAX_ASIDE_M, MAX_WIDENING_M = 0.5, 0.8
# What may be the edge of a lane.
RoadLine = Marking | RoadBorder


@dataclass(frozen=True, eq=False)
class LaneStrip:
    """A strip between two lines; its direction is that of one of them."""

    line: Polyline  # its middle
    width_m: Array  # `width_m`, `width_s_m`: (K,): widths and their stations
    width_s_m: Array
    left: str  # `left`, `right`: ids of the lines beside it; of the longest if there are several
    right: str
    confidence: float  # that both lines are there
    directed: float = 0.5  # probability that it leads the way of its line

    def reversed(self) -> LaneStrip:
        """Return the strip in the other direction."""
        s = self.line.length_m - self.width_s_m[::-1]
        line = Polyline(self.line.points_m[::-1])
        return replace(self, line=line, width_m=self.width_m[::-1], width_s_m=s, left=self.right, right=self.left)


def list_road_lines(markings: Sequence[Marking], borders: Sequence[RoadBorder]) -> list[RoadLine]:
    """Return the lane lines and borders."""
    items: list[RoadLine] = [marking for marking in markings if marking.is_lane_line]
    items.extend(borders)
    return [item for item in items if len(item.points_m) > 1 and np.ptp(item.points_m[:, :2], axis=0).max() > 0]


def find_strips(markings: Sequence[Marking], borders: Sequence[RoadBorder]) -> list[LaneStrip]:
    """Return the strips between lane lines and borders, from one end of the lines to the other."""
    items = list_road_lines(markings, borders)
    lines = [Polyline.through(item.points_m) for item in items]
    sides = [_Sides.of(line, k, lines) for k, line in enumerate(lines)]
    found = []
    for i, item in enumerate(items):
        back = Polyline(lines[i].points_m[::-1])
        for line, own in ((lines[i], sides[i]), (back, _Sides.of(back, i, lines))):
            for j in {int(v) for v in own.left[own.left >= 0]}:
                left, theirs = items[j], sides[j]
                # Stretches of rows at which each line is the nearest of the other.
                rows = np.flatnonzero(own.left == j)
                gap = line.at(own.s_m[rows])[:, None, :2] - lines[j].at(theirs.s_m)[None, :, :2]
                across = np.hypot(gap[..., 0], gap[..., 1]).argmin(axis=1)
                rows = rows[(theirs.left[across] == i) | (theirs.right[across] == i)]
                for run in np.split(rows, np.flatnonzero(np.diff(rows) > 2) + 1):
                    if len(run) < 2 or own.s_m[run[-1]] - own.s_m[run[0]] < STEP_M:
                        continue
                    s, width = own.s_m[run], own.left_m[run]
                    middle = Polyline.through(line.offset(s, width / 2))
                    at = (s - s[0]) / (s[-1] - s[0]) * middle.length_m
                    found.append(LaneStrip(middle, width, at, left.id, item.id, left.confidence * item.confidence))
    return [strip for strip in _chained(_once(found)) if strip.line.length_m >= MIN_LENGTH_M]


@dataclass(frozen=True, eq=False)
class _Sides:
    """Stations of a line, and for each the nearest lines to its left and right, -1 for none, with their distances."""

    s_m: Array
    left: NDArray[np.intp]
    right: NDArray[np.intp]
    left_m: Array

    @classmethod
    def of(cls, line: Polyline, k: int, lines: Sequence[Polyline]) -> _Sides:
        """Look to both sides of a line, which is `lines[k]` or its reverse."""
        s = np.linspace(0.0, line.length_m, max(int(np.ceil(line.length_m / STEP_M)), 1) + 1)
        points, heading = line.at(s)[:, :2], line.heading_at(s)
        nearest = {sign: np.full(len(s), np.inf) for sign in (1, -1)}
        which = {sign: np.full(len(s), -1) for sign in (1, -1)}
        for j, other in enumerate(lines):
            if j == k or not line.is_near(other, MAX_WIDTH_M):
                continue
            for turned in (0.0, np.pi):
                at = other.project(points, heading + turned)
                aside = -at.aside_m if turned == 0.0 else at.aside_m
                there = (at.s_m >= -STEP_M / 2) & (at.s_m <= other.length_m + STEP_M / 2)
                good = there & (np.abs(at.turn_rad) <= PARALLEL_RAD)
                for sign in (1, -1):
                    near = good & (sign * aside >= SAME_LINE_M) & (sign * aside < nearest[sign])
                    nearest[sign] = np.where(near, sign * aside, nearest[sign])
                    which[sign] = np.where(near, j, which[sign])
        for sign in (1, -1):
            which[sign][(nearest[sign] < MIN_WIDTH_M) | (nearest[sign] > MAX_WIDTH_M)] = -1
        return cls(s, which[1], which[-1], nearest[1])


def _once(strips: Sequence[LaneStrip]) -> list[LaneStrip]:
    """Drop strips that another, longer one holds: lines that lead opposite ways see the same one from both sides."""
    kept: list[LaneStrip] = []
    for strip in sorted(strips, key=lambda one: -one.line.length_m):
        middle = strip.line.at(np.linspace(0.0, strip.line.length_m, 9))
        heading = strip.line.heading_at(np.linspace(0.0, strip.line.length_m, 9))
        held = np.zeros(9, dtype=bool)
        for other in kept:
            for turned in (0.0, np.pi):
                at = other.line.project(middle[:, :2], heading + turned)
                held |= at.inside & (np.abs(at.aside_m) < MIN_WIDTH_M / 2) & (np.abs(at.turn_rad) < np.pi / 2)
        if held.mean() < 0.5:
            kept.append(strip)
    return kept


def _chained(strips: list[LaneStrip]) -> list[LaneStrip]:
    """Join strips that follow each other."""
    while True:
        both = [(strip, strip.reversed()) for strip in strips]
        gaps = [
            (gap, i, j, flip)
            for i, one in enumerate(both)
            for j, two in enumerate(both)
            if i != j
            for flip in ((False, False), (True, False), (False, True))
            if (gap := _gap(one[flip[0]], two[flip[1]])) is not None
        ]
        if not gaps:
            return strips
        _, i, j, flip = min(gaps)
        joined = _join(both[i][flip[0]], both[j][flip[1]])
        strips = [strip for k, strip in enumerate(strips) if k not in (i, j)] + [joined]


def _gap(one: LaneStrip, two: LaneStrip) -> float | None:
    """Return the gap between the end of one strip and the start of another that continues it, else None."""
    (x, y, _), (u, v, _) = one.line.points_m[-1], two.line.points_m[0]
    if abs(u - x) > MAX_GAP_M or abs(v - y) > MAX_GAP_M:
        return None
    heading = one.line.heading_rad[-1]
    c, s = np.cos(heading), np.sin(heading)
    along, aside = (u - x) * c + (v - y) * s, (v - y) * c - (u - x) * s
    bend = float(wrap_angle(two.line.heading_rad[0] - heading))
    fits = -STEP_M <= along <= MAX_GAP_M and abs(aside - along * bend / 2) <= MAX_ASIDE_M and abs(bend) <= PARALLEL_RAD
    return float(along) if fits and abs(one.width_m[-1] - two.width_m[0]) <= MAX_WIDENING_M else None


def _join(one: LaneStrip, two: LaneStrip) -> LaneStrip:
    heading = one.line.heading_rad[-1]
    ahead = (two.line.points_m[:, :2] - one.line.points_m[-1, :2]) @ [np.cos(heading), np.sin(heading)]
    rest = two.line.points_m[int(np.argmax(ahead > 0.1)) :]
    line = Polyline.through(np.concatenate([one.line.points_m, rest]))
    longer = max(one, two, key=lambda strip: strip.line.length_m)
    shift = line.length_m - two.line.length_m
    known = two.width_s_m + shift > one.line.length_m
    s = np.concatenate([one.width_s_m, two.width_s_m[known] + shift])
    width = np.concatenate([one.width_m, two.width_m[known]])
    share = one.line.length_m / (one.line.length_m + two.line.length_m)
    confidence = share * one.confidence + (1 - share) * two.confidence
    return LaneStrip(line, width, s, longer.left, longer.right, confidence)
