"""The ground from above: roads, markings and crosswalks, worn and stained, painted in tiles where a camera looks.

Tile (i, j) of level k is a square of `TILE_PX` pixels of `GROUND_M_PER_PX` * 2**k m; its first column begins at
x = i * its length, its first row at y = j * its length: columns go east, rows go north. Painted tiles are kept, at most
`MAX_TILES` of them, so a road may have any length.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.scene import Arrow, PaintColor, Road, Scene, StopLine, Zebra

NOISE_PX = 1024  # after which the noise repeats
SIGMA = 0.015  # standard deviation of the finest grain
PATCHES = ((8, 0.8), (32, 1.3), (256, 1.7))  # sizes in pixels and their strengths relative to the grain's


def grain(seed: int, level: int, first: tuple[int, int], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Factors of brightness around 1 for a part of an endless surface, from row and column `first` of a level on."""
    return _window(_noise(seed, level), first, shape)


def _window(image: NDArray[np.float32], first: tuple[int, int], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Part of an image that repeats for ever."""
    rows, columns = ((f + np.arange(n)) % len(image) for f, n in zip(first, shape))
    return image.take(rows, axis=0).take(columns, axis=1)


def _halved(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.float32)


def _add_patches(
    out: NDArray[np.float32], patches: Sequence[tuple[int, float]], sigma: float, rng: np.random.Generator
) -> None:
    """Add noise of several sizes in pixels and strengths relative to `sigma`."""
    for size, strength in patches:
        count = NOISE_PX // size
        coarse = np.pad(rng.normal(0, strength * sigma, (count, count)).astype(np.float32), 2, mode="wrap")
        wide = cv2.resize(coarse, None, fx=size, fy=size, interpolation=cv2.INTER_CUBIC)
        out += wide[2 * size : -2 * size, 2 * size : -2 * size]


@lru_cache(maxsize=16)
def _noise(seed: int, level: int) -> NDArray[np.float32]:
    if level:
        return _halved(_noise(seed, level - 1))
    rng = np.random.default_rng([seed, 3])
    shade = rng.standard_normal((NOISE_PX, NOISE_PX), dtype=np.float32) * np.float32(SIGMA)
    _add_patches(shade, PATCHES, SIGMA, rng)
    return np.asarray(1 + shade, np.float32)


# Sizes in pixels of 4 cm and strengths: chips of paint, the width of a tire, and stretches on which it brakes.
WEAR_PATCHES = ((2, 0.6), (8, 1.0), (64, 0.9))


@lru_cache(maxsize=24)
def _paint_left(seed: int, level: int, worn: float) -> NDArray[np.float32]:
    """Share of paint that is left in each pixel of an endless surface of which the share `worn` has none."""
    if level:
        return _halved(_paint_left(seed, level - 1, worn))
    return (_depth(seed) >= worn).astype(np.float32)


@lru_cache(maxsize=2)
def _depth(seed: int) -> NDArray[np.float32]:
    """Share of the surface (NOISE_PX, NOISE_PX) that wears off before each pixel does."""
    noise = np.zeros((NOISE_PX, NOISE_PX), np.float32)
    _add_patches(noise, WEAR_PATCHES, 1.0, np.random.default_rng([seed, 6]))
    rank = np.empty(noise.size, np.float32)
    rank[np.argsort(noise, axis=None, kind="stable")] = np.arange(noise.size, dtype=np.float32) / noise.size
    return rank.reshape(noise.shape)


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
    """What is painted on a meadow."""

    roads: Sequence[Road] = ()
    zebras: Sequence[Zebra] = ()
    stop_lines: Sequence[StopLine] = ()
    arrows: Sequence[Arrow] = ()
    keeps_right: bool = True  # whether vehicles drive on the right

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
    """A line with a width."""

    line: Array  # (P, 2), m
    width_m: float


@dataclass(frozen=True, eq=False)
class RoadLine:
    """A line that is painted along a road, before anything interrupts it."""

    kind: Literal["solid", "dashed"]
    line: Array  # (P, 2), m: its middle
    width_m: float
    color: PaintColor
    dashes: tuple[Array, ...]  # tuple of (Q, 2) float64, m: what is painted of it
    boundary: int  # of lanes, 0 at the right of the road as its line runs, its number of lanes at the left

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


def _line(
    road: Road, middle: Array, kind: Literal["solid", "dashed"], where: tuple[float, float, int], color: PaintColor
) -> RoadLine:
    """Lay a line at an offset to the left, of a width, that marks a boundary."""
    offset, width_m, boundary = where
    line = parallel(middle, offset) if offset != 0 else middle
    dashes: Sequence[Array] = [line]
    if kind == "dashed":
        dashes = dashes_of_pieces(line, *DASH_M)
        if road.dash_m is not None:  # along the whole line, beginning with half a gap
            (on_m, off_m), length = road.dash_m, float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
            dashes = [stretch(line, begin, begin + on_m) for begin in np.arange(off_m / 2, length, on_m + off_m)]
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


Mask = NDArray[np.uint8]
Share = NDArray[np.uint8] | NDArray[np.float32]
Color = tuple[int, int, int]
Surface = Mapping[str, float]  # values by meadow, sidewalk, curb, asphalt and paint
_Paint = tuple[PaintColor, float, float]

GROUND_M_PER_PX = 0.04
TILE_PX = 256
MAX_TILES = 320  # 63 MB
LEVELS = 7
MARKING, ASPHALT, PAVING = (214, 216, 216), (92, 91, 90), (150, 155, 158)
CURB, MEADOW = (172, 176, 178), (128, 142, 138)
# Yellow as traffic yellow (RAL 1023) in sRGB, BGR.
PAINT: dict[str, Color] = {"white": MARKING, "yellow": (38, 176, 236)}
OLD_STRENGTH, OLD_WORN = 0.4, 0.35  # of removed lines: what grinding leaves is dimmer and in pieces
CURB_M = 0.12
SLAB_PX, JOINT_SHADE = 25, 0.86  # paving slabs of 1 m with joints of one fine pixel
MAX_CIRCLE_PX = 2e4  # from a tile to the center of a circle that is drawn
SUBPIXELS = 2  # masks are drawn so much finer than tiles


class Ground:
    """The ground of a scene, painted when and where it is looked at; the seed is that of grain, stains and wear."""

    def __init__(self, plan: GroundPlan, seed: int) -> None:
        self._seed = seed
        roads = plan.roads
        asphalt = [Stroke(np.array(r.line), r.width_m) for r in roads]
        curbs = [2 * CURB_M if r.sidewalk_m > 0 else 0.0 for r in roads]
        self._sidewalks = _Strokes([Stroke(s.line, s.width_m + 2 * r.sidewalk_m) for s, r in zip(asphalt, roads)])
        self._curbs = _Strokes([Stroke(s.line, s.width_m + more) for s, more in zip(asphalt, curbs)])
        self._asphalt = _Strokes(asphalt)
        self._layers = _layers(plan)
        self.tile = lru_cache(maxsize=MAX_TILES)(self._paint)  # by level, i and j

    def mosaic(self, level: int, low: tuple[int, int], needed: NDArray[np.bool_], beside: Color) -> Mask:
        """Join tiles of a level, from i and j `low` on, that are needed (rows, columns); all others have one color."""
        rows, columns = needed.shape
        out = np.empty((rows * TILE_PX, columns * TILE_PX, 3), np.uint8)
        out[:] = beside
        for row, column in np.argwhere(needed).tolist():
            tile = self.tile(level, low[0] + column, low[1] + row)
            out[row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX] = tile
        return out

    def _paint(self, level: int, i: int, j: int) -> Mask:
        """Paint a tile (TILE_PX, TILE_PX, 3), sRGB as BGR."""
        canvas = _Canvas(level, i, j)
        planes = np.empty((3, TILE_PX, TILE_PX), np.float32)
        planes[:] = np.reshape(MEADOW, (3, 1, 1))
        sidewalk = canvas.drawn(self._sidewalks)
        if sidewalk is not None:
            # Slabs are darker by the share of joints in a pixel.
            count = TILE_PX * 2**level  # of fine pixels along a side
            fine = [np.arange(first * count, (first + 1) * count) % SLAB_PX == 0 for first in (j, i)]
            joints = [np.asarray(f.reshape(TILE_PX, -1).mean(1), np.float32) for f in fine]
            plain = np.outer(1 - joints[0], 1 - joints[1])
            _blend(planes, PAVING, sidewalk, np.asarray(1 - (1 - JOINT_SHADE) * (1 - plain), np.float32))
            _blend(planes, CURB, canvas.drawn(self._curbs))
        asphalt = canvas.drawn(self._asphalt)
        _blend(planes, ASPHALT, asphalt)
        if asphalt is not None:
            for layer in self._layers:
                _blend(planes, PAINT[layer.color], self._covered(layer, canvas, (level, i, j)))
        planes *= grain(self._seed, level, (j * TILE_PX, i * TILE_PX), (TILE_PX, TILE_PX))
        np.clip(planes, 0, 255, out=planes)
        return np.asarray(cv2.merge(list(planes.astype(np.uint8))), np.uint8)

    def shade(self, level: int, i: int, j: int, values: Surface) -> NDArray[np.float32]:
        """Return a tile (TILE_PX, TILE_PX) of a value that each surface has, fresh paint among them, without grain."""
        where, canvas = (level, i, j), _Canvas(level, i, j)
        plane = np.full((1, TILE_PX, TILE_PX), values["meadow"], np.float32)
        for name, strokes in (("sidewalk", self._sidewalks), ("curb", self._curbs), ("asphalt", self._asphalt)):
            _blend(plane, (values[name],), canvas.drawn(strokes))
        for layer in self._layers:
            _blend(plane, (values["paint"],), self._covered(layer, canvas, where))
        return np.asarray(plane[0])

    def _covered(self, layer: _Layer, canvas: _Canvas, where: tuple[int, int, int]) -> Share | None:
        """Share of each pixel (TILE_PX, TILE_PX) from 0 to 255 that has paint of a layer; None where nothing has."""
        drawn = canvas.drawn(layer.free)
        for outline in layer.outlines:
            drawn = _most(drawn, canvas.filled(outline))
        for marks, crossing in layer.along:
            lines = canvas.drawn(marks)
            if lines is not None:
                gap = canvas.drawn(crossing)
                drawn = _most(drawn, lines if gap is None else np.asarray(cv2.subtract(lines, gap), np.uint8))
        if drawn is None or (layer.worn <= 0 and layer.strength >= 1):
            return drawn
        level, i, j = where
        left = _window(_paint_left(self._seed, level, layer.worn), (j * TILE_PX, i * TILE_PX), (TILE_PX, TILE_PX))
        return np.asarray(drawn * (left * np.float32(layer.strength)))


@dataclass(frozen=True, eq=False)
class _Layer:
    """Paint of one color that is worn alike."""

    color: PaintColor
    worn: float  # share that is missing
    strength: float  # from 0 for what cannot be seen to 1 for fresh paint
    free: _Strokes  # what nothing interrupts
    along: tuple[tuple[_Strokes, _Strokes], ...]  # lines along roads, and what interrupts them
    outlines: tuple[Array, ...]  # tuple of (P, 2) float64, m


def _most(a: Mask | None, b: Mask | None) -> Mask | None:
    return b if a is None else a if b is None else np.maximum(a, b)


def _layers(plan: GroundPlan) -> tuple[_Layer, ...]:
    """Sort what is painted by its color and wear; removed lines lie below all others."""
    free: dict[_Paint, list[Stroke]] = {}
    outlines: dict[_Paint, list[Array]] = {}
    along: dict[_Paint, list[tuple[_Strokes, _Strokes]]] = {}
    for zebra in plan.zebras:
        free.setdefault(("white", zebra.worn, 1.0), []).extend(crosswalk_stripes(zebra))
    for stop in plan.stop_lines:
        free.setdefault((stop.color, stop.worn, 1.0), []).append(Stroke(np.array(stop.line), stop.width_m))
    for arrow in plan.arrows:
        outlines.setdefault(("white", arrow.worn, 1.0), []).append(arrow_outline(arrow))
    for k, road in enumerate(plan.roads):
        strokes: dict[_Paint, list[Stroke]] = {}
        if road.old_m:  # what is left of removed lines between lanes
            offsets = [(n / road.lanes - 0.5) * road.width_m + old for old in road.old_m for n in range(1, road.lanes)]
            old = [_line(road, np.array(road.line), "dashed", (offset, LINE_M, 0), "white") for offset in offsets]
            strokes["white", OLD_WORN, OLD_STRENGTH] = [stroke for line in old for stroke in line.strokes]
        for line in road_lines(road, keeps_right=plan.keeps_right):
            strokes.setdefault((line.color, road.worn, 1.0), []).extend(line.strokes)
        gaps = _Strokes(plan.interruptions(k))
        for paint, some in strokes.items():
            along.setdefault(paint, []).append((_Strokes(some), gaps))
    kinds = sorted({*free, *outlines, *along}, key=lambda paint: (paint[2], *paint))
    return tuple(
        _Layer(*kind, _Strokes(free.get(kind, ())), tuple(along.get(kind, ())), tuple(outlines.get(kind, ())))
        for kind in kinds
    )


class _Strokes:
    """Strokes that are drawn together, as pieces of straight lines that are found by where they are."""

    def __init__(self, strokes: Sequence[Stroke]) -> None:
        lines = [s.line for s in strokes if len(s.line) > 1]
        counts = [len(line) - 1 for line in lines]
        self._begin = np.concatenate([np.zeros((0, 2)), *(line[:-1] for line in lines)])
        self._end = np.concatenate([np.zeros((0, 2)), *(line[1:] for line in lines)])
        self._width = np.repeat([s.width_m for s in strokes if len(s.line) > 1], counts)
        # Where a piece continues another one, a disk fills the gap between their square ends.
        self._joined = np.concatenate([np.zeros(0, bool), *(np.arange(n) > 0 for n in counts)])

    def within(self, low: Array, high: Array) -> Iterator[tuple[Array, Array, float, bool]]:
        """Yield begin, end, width and whether it continues another one, of pieces that may reach between two corners (2,)."""
        half = self._width[:, None] / 2
        near = np.maximum(self._begin, self._end) + half >= low
        near &= np.minimum(self._begin, self._end) - half <= high
        for k in np.flatnonzero(near[:, 0] & near[:, 1]):
            yield self._begin[k], self._end[k], float(self._width[k]), bool(self._joined[k])


class _Canvas:
    """Draws strokes on masks of one tile."""

    def __init__(self, level: int, i: int, j: int) -> None:
        step = GROUND_M_PER_PX * 2**level
        self._low, self._step = np.array([i, j]) * TILE_PX * step, step / SUBPIXELS
        self._high = self._low + TILE_PX * step

    def drawn(self, strokes: _Strokes) -> Mask | None:
        """Share of each pixel (TILE_PX, TILE_PX) from 0 to 255 that is covered; None where nothing is."""
        pieces = list(strokes.within(self._low - self._step, self._high + self._step))
        if not pieces:
            return None
        mask = np.zeros((TILE_PX * SUBPIXELS,) * 2, np.uint8)
        for begin, end, width, joined in pieces:
            self._draw(mask, begin, end, width, joined=joined)
        share = np.asarray(cv2.resize(mask, (TILE_PX, TILE_PX), interpolation=cv2.INTER_AREA), np.uint8)
        return share if cv2.countNonZero(share) else None

    def filled(self, outline: Array) -> Mask | None:
        """Share of each pixel (TILE_PX, TILE_PX) from 0 to 255 within an outline (P, 2); None where it does not reach."""
        if np.any(outline.max(0) < self._low) or np.any(outline.min(0) > self._high):
            return None
        mask = np.zeros((TILE_PX * SUBPIXELS,) * 2, np.uint8)
        corners = np.rint(((outline - self._low) / self._step - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(mask, [corners], 255, cv2.LINE_8, 4)
        return np.asarray(cv2.resize(mask, (TILE_PX, TILE_PX), interpolation=cv2.INTER_AREA), np.uint8)

    def _draw(self, mask: Mask, begin: Array, end: Array, width_m: float, *, joined: bool) -> None:
        """Draw a piece with square ends; one that is thinner than a pixel is fainter instead."""
        shade = round(255 * min(1.0, width_m / self._step))
        # OpenCV also draws the outline of a polygon, half a pixel to each side.
        half = max(width_m / self._step - 1.0, 0.0) / 2
        (ax, ay), (bx, by) = (((p - self._low) / self._step - 0.5).tolist() for p in (begin, end))
        length = float(np.hypot(bx - ax, by - ay))
        if length == 0:
            return
        x, y = (ay - by) / length * half, (bx - ax) / length * half
        corners = np.array([(ax + x, ay + y), (bx + x, by + y), (bx - x, by - y), (ax - x, ay - y)])
        cv2.fillConvexPoly(mask, np.rint(np.clip(corners, -1e6, 1e6) * 16).astype(np.int32), shade, cv2.LINE_8, 4)
        if joined and half > 1 and max(abs(ax), abs(ay)) < MAX_CIRCLE_PX:
            cv2.circle(mask, (round(ax * 16), round(ay * 16)), round(half * 16), shade, -1, 8, 4)


def _blend(
    planes: NDArray[np.float32], color: Sequence[float], share: Share | None, shade: NDArray[np.float32] | None = None
) -> None:
    """Paint a color (C,) over an image (C, H, W) where a mask (H, W) covers it, in part where the mask does."""
    if share is None:
        return
    part = share * np.float32(1 / 255)
    planes *= 1 - part
    if shade is not None:
        part *= shade
    for plane, value in zip(planes, color):
        plane += part * np.float32(value)
