"""Where paint lies on the ground: the lines of roads, the stripes of crosswalks, stop lines and arrows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from log2sim.geometry import Array
from log2sim.synth.scene import Scene
from log2sim.synth.scene_places import Arrow, PaintColor, Road, StopLine, Zebra

DASH_M = (3.0, 3.0)  # length and gap, as in towns (RMS-1, 1993: 3 m and 6 m; many narrower ones)
LINE_M = 0.14
DOUBLE_GAP_M = 0.12  # between the two lines of a double one (RMS-1: as wide as a line)
STRIPE_M = (0.5, 0.5)  # of crosswalks
ROAD_MARGIN_M, ZEBRA_MARGIN_M = 4.0, 1.6  # by which what interrupts markings is wider than roads and crosswalks
# Shares of the length of an arrow, as the straight and the bent arrow of 5 m (RMS-1) have them.
SHAFT_WIDTH, HEAD_WIDTH, HEAD_LENGTH = 0.03, 0.12, 0.4
BEND_AT, BEND_REACH, BEND_HEAD = 0.55, 0.2, 0.3


@dataclass(frozen=True)
class GroundPlan:
    """What is painted on a meadow.

    Attributes
    ----------
    roads, zebras, stop_lines, arrows : sequence
    keeps_right : bool
        Whether vehicles drive on the right.
    """

    roads: Sequence[Road] = ()
    zebras: Sequence[Zebra] = ()
    stop_lines: Sequence[StopLine] = ()
    arrows: Sequence[Arrow] = ()
    keeps_right: bool = True

    @classmethod
    def of(cls, scene: Scene) -> GroundPlan:
        """Take it from a scene."""
        return cls(scene.road, scene.zebra, scene.stop_line, scene.arrow, scene.traffic == "right")

    def interruptions(self, road: int) -> list[Stroke]:
        """List where a road has no markings: where others cross it, at crosswalks, and where they are missing."""
        own = self.roads[road]
        others = [Stroke(np.array(r.line), r.width_m + ROAD_MARGIN_M) for k, r in enumerate(self.roads) if k != road]
        crosswalks = [Stroke(np.array(z.line), z.width_m + ZEBRA_MARGIN_M) for z in self.zebras]
        bare = [stretch(np.array(own.line), *ends) for ends in own.missing_m]
        return others + crosswalks + [Stroke(line, own.width_m + ROAD_MARGIN_M) for line in bare if len(line) > 1]


@dataclass(frozen=True, eq=False)
class Stroke:
    """A line with a width.

    Attributes
    ----------
    line : (P, 2) float64, m
    width_m : float
    """

    line: Array
    width_m: float

    def wider(self, by_m: float) -> Stroke:
        """Add to the width."""
        return Stroke(self.line, self.width_m + by_m)


@dataclass(frozen=True, eq=False)
class RoadLine:
    """A line that is painted along a road, before anything interrupts it.

    Attributes
    ----------
    kind : "solid" or "dashed"
    line : (P, 2) float64, m
        Its middle.
    width_m : float
    color : "white" or "yellow"
    dashes : tuple of (Q, 2) float64, m
        What is painted of it.
    boundary : int
        Boundary of lanes that it marks: 0 at the right of the road as its line runs, up to its number of lanes at the left.
    """

    kind: Literal["solid", "dashed"]
    line: Array
    width_m: float
    color: PaintColor
    dashes: tuple[Array, ...]
    boundary: int

    @property
    def strokes(self) -> list[Stroke]:
        """What is painted of it."""
        return [Stroke(piece, self.width_m) for piece in self.dashes]


def road_lines(road: Road, keeps_right: bool = True) -> list[RoadLine]:
    """List the lines between lanes, then those along both sides."""
    middle = np.array(road.line)
    out: list[RoadLine] = []
    forward = road.lanes - road.backward_lanes
    # Seen along the line, the lanes that lead along it are at the right where traffic keeps right.
    center = forward if keeps_right else road.backward_lanes
    for k in range(1, road.lanes):
        at_center = k == center and road.center_marking is not None
        kind = road.center_marking if at_center else road.marking
        color = road.center_color if k == center and road.center_color is not None else road.color
        offset = (k / road.lanes - 0.5) * road.width_m
        if kind == "double":
            aside = (LINE_M + DOUBLE_GAP_M) / 2
            out += [_line(road, middle, "solid", (offset + a, LINE_M, k), color) for a in (-aside, aside)]
        elif kind == "solid" or kind == "dashed":
            out.append(_line(road, middle, kind, (offset, LINE_M, k), color))
    if road.side_marking != "none":
        side = road.width_m / 2 - road.side_inset_m
        for offset, k in ((-side, 0), (side, road.lanes)):
            out.append(_line(road, middle, road.side_marking, (offset, road.side_line_m, k), road.color))
    return out


def old_lines(road: Road) -> list[Stroke]:
    """List what is left of removed lines between lanes."""
    middle = np.array(road.line)
    offsets = [(k / road.lanes - 0.5) * road.width_m + old for old in road.old_m for k in range(1, road.lanes)]
    lines = [_line(road, middle, "dashed", (offset, LINE_M, 0), "white") for offset in offsets]
    return [stroke for line in lines for stroke in line.strokes]


def _line(
    road: Road,
    middle: Array,
    kind: Literal["solid", "dashed"],
    where: tuple[float, float, int],
    color: PaintColor,
) -> RoadLine:
    """Lay a line at an offset to the left, of a width, that marks a boundary."""
    offset, width_m, boundary = where
    line = parallel(middle, offset) if offset != 0 else middle
    dashes: Sequence[Array] = [line]
    if kind == "dashed":
        dashes = dashes_of_pieces(line, *DASH_M) if road.dash_m is None else dashes_along(line, *road.dash_m)
    return RoadLine(kind, line, width_m, color, tuple(dashes), boundary)


def crosswalk_stripes(zebra: Zebra) -> list[Stroke]:
    """List the stripes of a crosswalk."""
    return [Stroke(dash, zebra.width_m) for dash in dashes_of_pieces(np.array(zebra.line), *STRIPE_M)]


def arrow_outline(arrow: Arrow) -> Array:
    """Outline (P, 2), m, counter-clockwise."""
    shaft, head = SHAFT_WIDTH / 2, HEAD_WIDTH / 2
    if arrow.shape == "straight":
        neck = 0.5 - HEAD_LENGTH
        right = [(-0.5, -shaft), (neck, -shaft), (neck, -head), (0.5, 0.0)]
        outline = np.array(right + [(x, -y) for x, y in right[-2::-1]])
    else:
        tip, neck, half = BEND_REACH + BEND_HEAD, BEND_REACH, BEND_HEAD / 2
        x = BEND_AT
        outline = np.array([
            (0, -shaft), (x + 2 * shaft, -shaft), (x + 2 * shaft, neck), (x + shaft + half, neck), (x + shaft, tip),
            (x + shaft - half, neck), (x, neck), (x, shaft), (0, shaft),
        ]) - [0.5, 0.0]  # fmt: skip
    if arrow.shape == "right":
        outline = (outline * [1, -1])[::-1]
    c, s = np.cos(np.deg2rad(arrow.yaw_deg)), np.sin(np.deg2rad(arrow.yaw_deg))
    return np.asarray(outline * arrow.length_m @ np.array([[c, s], [-s, c]]) + arrow.position)


def dashes_of_pieces(line: Array, on_m: float, off_m: float) -> list[Array]:
    """Divide each straight piece of a line (P, 2) into dashes, beginning with half a gap."""
    out = []
    for a, b in pairwise(line):
        length = float(np.linalg.norm(b - a))
        if length > 0:
            begins = np.arange(off_m / 2, length, on_m + off_m) / length
            out += [np.array([a + (b - a) * f, a + (b - a) * min(f + on_m / length, 1.0)]) for f in begins]
    return out


def dashes_along(line: Array, on_m: float, off_m: float) -> list[Array]:
    """Divide a line (P, 2) into dashes, beginning with half a gap."""
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    return [stretch(line, begin, begin + on_m) for begin in np.arange(off_m / 2, length, on_m + off_m)]


def stretch(line: Array, begin_m: float, end_m: float) -> Array:
    """Cut a stretch (Q, 2) out of a line (P, 2) by distances along it; fewer than two points where it has none."""
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    begin, end = max(begin_m, 0.0), min(end_m, float(s[-1]))
    if end <= begin:
        return np.zeros((0, 2))
    at = np.concatenate([[begin], s[(s > begin) & (s < end)], [end]])
    return np.column_stack([np.interp(at, s, line[:, k]) for k in range(2)])


def parallel(line: Array, left_m: float) -> Array:
    """Shift a line (P, 2) to its left."""
    d = np.gradient(line, axis=0)
    return np.asarray(line + left_m * np.stack([-d[:, 1], d[:, 0]], 1) / np.linalg.norm(d, axis=1, keepdims=True))
