"""The ground from above: roads, markings and crosswalks, painted in tiles where a camera looks, fine ones near and coarse ones far.

Tile (i, j) of level k is a square of `TILE_PX` pixels of `GROUND_M_PER_PX` * 2**k m; its first column begins at
x = i * its length, its first row at y = j * its length: columns go east, rows go north. Painted tiles are kept, at most
`MAX_TILES` of them, so a road may have any length.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.grain import grain
from log2sim.synth.scene import Road, Zebra

GROUND_M_PER_PX = 0.04
TILE_PX = 256
MAX_TILES = 320  # 63 MB
LEVELS = 7
MARKING, ASPHALT, PAVING, CURB, MEADOW = (
    (214, 216, 216),
    (92, 91, 90),
    (150, 155, 158),
    (172, 176, 178),
    (128, 142, 138),
)
CURB_M = 0.12
SLAB_PX, JOINT_SHADE = 25, 0.86  # paving slabs of 1 m with joints of one fine pixel
MAX_CIRCLE_PX = 2e4  # from a tile to the center of a circle that is drawn
SUBPIXELS = 2  # masks are drawn so much finer than tiles

Mask = NDArray[np.uint8]
Color = tuple[int, int, int]


class Ground:
    """The ground of a scene, painted when and where it is looked at.

    Parameters
    ----------
    roads, zebras
        What is painted on a meadow.
    seed
        Of grain and stains.
    """

    def __init__(self, roads: Sequence[Road], zebras: Sequence[Zebra], seed: int) -> None:
        self._seed = seed
        lines = [np.array(r.line) for r in roads]
        asphalt = [Stroke(line, r.width_m) for line, r in zip(lines, roads)]
        crosswalks = [Stroke(np.array(z.line), z.width_m) for z in zebras]
        curbs = [2 * CURB_M if r.sidewalk_m > 0 else 0.0 for r in roads]
        self._sidewalks = _Strokes([Stroke(s.line, s.width_m + 2 * r.sidewalk_m) for s, r in zip(asphalt, roads)])
        self._curbs = _Strokes([Stroke(s.line, s.width_m + more) for s, more in zip(asphalt, curbs)])
        self._asphalt = _Strokes(asphalt)
        self._marks = [_Strokes(_markings(line, r)) for line, r in zip(lines, roads)]
        self._crossing = [
            _Strokes([s.wider(4.0) for s in asphalt if s is not own] + [c.wider(1.6) for c in crosswalks])
            for own in asphalt
        ]
        self._stripes = _Strokes([Stroke(dash, c.width_m) for c in crosswalks for dash in _dashes(c.line, 0.5, 0.5)])
        self._tiles: OrderedDict[tuple[int, int, int], Mask] = OrderedDict()

    def tile(self, level: int, i: int, j: int) -> Mask:
        """Return a tile (TILE_PX, TILE_PX, 3), sRGB as BGR."""
        where = (level, i, j)
        if where in self._tiles:
            self._tiles.move_to_end(where)
            return self._tiles[where]
        image = self._paint(level, i, j)
        self._tiles[where] = image
        if len(self._tiles) > MAX_TILES:
            self._tiles.popitem(last=False)
        return image

    def _paint(self, level: int, i: int, j: int) -> Mask:
        step = GROUND_M_PER_PX * 2**level
        canvas = _Canvas(np.array([i, j]) * TILE_PX * step, step)
        planes = np.empty((3, TILE_PX, TILE_PX), np.float32)
        planes[:] = np.reshape(MEADOW, (3, 1, 1))
        sidewalk = canvas.drawn(self._sidewalks)
        if sidewalk is not None:
            _blend(planes, PAVING, sidewalk, _joints(level, i, j))
            _blend(planes, CURB, canvas.drawn(self._curbs))
        asphalt = canvas.drawn(self._asphalt)
        _blend(planes, ASPHALT, asphalt)
        if asphalt is not None:
            _blend(planes, MARKING, self._white(canvas))
        planes *= grain(self._seed, level, (j * TILE_PX, i * TILE_PX), (TILE_PX, TILE_PX))
        np.clip(planes, 0, 255, out=planes)
        return np.asarray(cv2.merge(list(planes.astype(np.uint8))), np.uint8)

    def _white(self, canvas: _Canvas) -> Mask | None:
        """Draw markings, which end where another road or a crosswalk begins, and the stripes of crosswalks."""
        white = canvas.drawn(self._stripes)
        for marks, crossing in zip(self._marks, self._crossing):
            drawn = canvas.drawn(marks)
            if drawn is None:
                continue
            gap = canvas.drawn(crossing)
            if gap is not None:
                drawn = np.asarray(cv2.subtract(drawn, gap), np.uint8)
            white = drawn if white is None else np.maximum(white, drawn)
        return white


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
    """Draws strokes on masks of one tile, which begins at `low_m` (2,) and has pixels of `step_m`."""

    def __init__(self, low_m: Array, step_m: float) -> None:
        self._low, self._step = low_m, step_m / SUBPIXELS
        self._high = low_m + TILE_PX * step_m

    def drawn(self, strokes: _Strokes) -> Mask | None:
        """Share of each pixel (TILE_PX, TILE_PX) from 0 to 255 that is covered; None where nothing is."""
        mask: Mask | None = None
        for begin, end, width, joined in strokes.within(self._low - self._step, self._high + self._step):
            if mask is None:
                mask = np.zeros((TILE_PX * SUBPIXELS,) * 2, np.uint8)
            self._draw(mask, begin, end, width, joined=joined)
        if mask is None:
            return None
        share = np.asarray(cv2.resize(mask, (TILE_PX, TILE_PX), interpolation=cv2.INTER_AREA), np.uint8)
        return share if cv2.countNonZero(share) else None

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
    planes: NDArray[np.float32], color: Color, share: Mask | None, shade: NDArray[np.float32] | None = None
) -> None:
    """Paint a color over an image (3, H, W) where a mask (H, W) covers it, in part where the mask does."""
    if share is None:
        return
    part = share * np.float32(1 / 255)
    planes *= 1 - part
    if shade is not None:
        part *= shade
    for plane, value in zip(planes, color):
        plane += part * np.float32(value)


def _markings(line: Array, road: Road) -> list[Stroke]:
    """List the line in the middle and those along both sides."""
    pieces: list[Array] = []
    if road.marking != "none":
        for k in range(1, road.lanes):
            border = _parallel(line, (k / road.lanes - 0.5) * road.width_m) if 2 * k != road.lanes else line
            pieces += _dashes(border, 3.0, 3.0) if road.marking == "dashed" else [border]
    sides = [Stroke(_parallel(line, side * (road.width_m / 2 - 0.2)), 0.1) for side in (-1, 1)]
    return [Stroke(piece, 0.14) for piece in pieces] + sides


def _dashes(line: Array, on_m: float, off_m: float) -> list[Array]:
    out = []
    for a, b in pairwise(line):
        length = float(np.linalg.norm(b - a))
        if length > 0:
            begins = np.arange(off_m / 2, length, on_m + off_m) / length
            out += [np.array([a + (b - a) * f, a + (b - a) * min(f + on_m / length, 1.0)]) for f in begins]
    return out


def _parallel(line: Array, left_m: float) -> Array:
    d = np.gradient(line, axis=0)
    return np.asarray(line + left_m * np.stack([-d[:, 1], d[:, 0]], 1) / np.linalg.norm(d, axis=1, keepdims=True))


def _joints(level: int, i: int, j: int) -> NDArray[np.float32]:
    """Brightness (TILE_PX, TILE_PX) of paving: darker by the share of joints in a pixel."""
    factor = 2**level

    def covered(first: int) -> NDArray[np.float32]:
        fine = (np.arange(TILE_PX * factor) + first * TILE_PX * factor) % SLAB_PX == 0
        return np.asarray(fine.reshape(TILE_PX, factor).mean(1), np.float32)

    plain = np.outer(1 - covered(j), 1 - covered(i))
    return np.asarray(1 - (1 - JOINT_SHADE) * (1 - plain), np.float32)
