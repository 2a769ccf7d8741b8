"""Maps of roads as they come out of pictures and sweeps, drawn from above with their paint as truth.

Each is a square of `SIDE` cells. A road gives every cell its length along it and its offset to the left; lines, curbs, seams and
joints are bands of these. What mapped roads suffer from comes after: light, glare, seams between pictures, blur by range, shifts,
holes, rings of a LiDAR. Drawn in 0.1 s; nothing is rendered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.road.ground_map import GroundMap
from log2sim.road.surface import MIN_WEIGHT, SHARP_RANGE_M, SPREADS, USUAL

Layer = NDArray[np.float32]
SIDE, CELL_M = 320, 0.05
KINDS = ("nothing", "solid", "dashed", "stop_line", "crosswalk", "other")  # "other": arrows, letters, hatching
SOLID, DASHED, STOP, CROSSWALK, OTHER = range(1, len(KINDS))
UNKNOWN_DIRECTION = 255
# Lengths of dashes and gaps, m (RMS: 3/3, 3/6, 6/12, 1.5/1.5; MUTCD: 3/9, 0.6/1.2; UK: 2/4, 4/2; Japan: 8/12; cycle lanes: 1/1).
DASHES = ((3, 3), (3, 6), (6, 12), (1.5, 1.5), (3, 9), (0.6, 1.2), (2, 4), (4, 2), (8, 12), (1, 1), (6, 3), (1, 5))
WIDTHS_M = (0.1, 0.12, 0.12, 0.15, 0.15, 0.2, 0.25, 0.3)
WORN = (0.0, 0.0, 0.0, 0.05, 0.2, 0.2, 0.4, 0.6, 0.75)  # shares of paint that are gone
SHAPE = (SIDE, SIDE)


@dataclass(frozen=True, eq=False)
class Road:
    """A road over the cells (R, C): length along it and offset to the left, m, and its direction, rad."""

    s: Layer
    d: Layer
    heading: Layer


@dataclass(frozen=True)
class Style:
    """One paint: albedo, reflectance for a LiDAR relative to asphalt, and the share that is gone."""

    color: tuple[float, ...]
    reflects: float
    worn: float


def ramp(angle: float) -> Layer:
    """Meters (R, C) from the middle along a direction, rad."""
    rows, columns = np.mgrid[:SIDE, :SIDE].astype(np.float32) - np.float32((SIDE - 1) / 2)
    return (columns * np.float32(np.cos(angle)) - rows * np.float32(np.sin(angle))) * np.float32(CELL_M)


def band(d: Layer, at: float, width_m: float) -> Layer:
    """Share (R, C) of each cell within a band of offsets."""
    return np.clip((width_m / 2 - np.abs(d - np.float32(at))) / np.float32(CELL_M) + np.float32(0.5), 0, 1)


def between(d: Layer, one: float, other: float) -> Layer:
    """Share (R, C) of each cell between two offsets."""
    return band(d, (one + other) / 2, abs(other - one))


def shifted(image: Layer, x: float, y: float) -> Layer:
    """Move an image by cells; its edges go on."""
    by = np.array([[1, 0, x], [0, 1, y]])
    return np.asarray(cv2.warpAffine(image, by, SHAPE, borderMode=cv2.BORDER_REPLICATE), np.float32)


class Drawing:
    """A map that is drawn: a sheet of surfaces and paint, and what sensors make of it."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.wet, self.night = self.chance(0.2), self.chance(0.3)
        self.albedo = np.broadcast_to(self.gray(0.05, 0.3, 0.1), (*SHAPE, 3)).astype(np.float32)  # linear BGR
        self.reflects = np.full(SHAPE, 1.3, np.float32)  # of a LiDAR's light, relative to asphalt
        self.height = np.zeros(SHAPE, np.float32)
        self.kind, self.direction = np.zeros(SHAPE, np.uint8), np.full(SHAPE, UNKNOWN_DIRECTION, np.uint8)

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def u(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def log(self, low: float, high: float) -> float:
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def some(self, share: float, most: int) -> range:
        """Count up to `most` things, of which that share of maps has any."""
        return range(int(self.rng.integers(1, most + 1)) if self.chance(share) else 0)

    def gray(self, low: float, high: float, tint: float = 0.04) -> Layer:
        """Albedo (3,) with a little color."""
        return (self.log(low, high) * np.exp(self.rng.normal(0, tint, 3))).astype(np.float32)

    def noise(self, *sizes: float) -> Layer:
        """Noise (R, C) of unit variance made of patches of some sizes, in cells."""
        out = np.zeros(SHAPE, np.float32)
        for size in sizes:
            n = int(np.ceil(SIDE / size)) + 2
            coarse = self.rng.standard_normal((n, n), dtype=np.float32)
            out += cv2.resize(coarse, None, fx=size, fy=size, interpolation=cv2.INTER_CUBIC)[:SIDE, :SIDE]
        return out / np.float32(max(float(out.std()), 1e-6))

    def lay(self, share: Layer, albedo: Layer, reflects: float | Layer | None = None) -> None:
        """Blend a surface over the sheet where a mask (R, C) says."""
        self.albedo += share[..., None] * (albedo - self.albedo)
        if reflects is not None:
            self.reflects += share * (np.asarray(reflects, np.float32) - self.reflects)

    def road(self, angle: float | None = None) -> Road:
        """Draw a straight or bent road through the square."""
        theta, start = self.u(0, 2 * np.pi) if angle is None else angle, np.float32(self.u(20, 60))
        u, v = ramp(theta), ramp(theta + np.pi / 2) + np.float32(self.u(-8, 8))
        if self.chance(0.5):
            return Road(u + start, v, np.full_like(u, theta))
        # Around the center (0, radius) of its circle.
        side, radius = float(self.rng.choice([-1, 1])), np.float32(self.log(10, 400))
        turn = side * np.arctan2(u, radius - side * v)
        return Road(side * radius * turn + start, side * (radius - np.hypot(u, radius - side * v)), theta + turn)

    def surfaces(self, road: Road, edge: float) -> None:
        """Lay a road between offsets -edge and edge, curbs, and what is beside."""
        inside = between(road.d, -edge, edge)
        self.lay(inside, self.gray(0.16, 0.45) if self.chance(0.2) else self.gray(0.05, 0.2), self.u(0.8, 1.2))
        tracks = np.cos(road.d * np.float32(2 * np.pi / 1.75 / self.rng.integers(1, 3)))  # of wheels
        self.albedo *= (1 + np.float32(self.u(0, 0.12)) * tracks * inside)[..., None]
        for side in (1, -1):
            beside, kind = between(road.d, side * edge, side * (edge + 40)), self.u(0, 1)
            if kind < 0.55:  # a pavement behind a curb
                pavement, width, tile = self.gray(0.08, 0.4), self.u(0.1, 0.35), self.log(0.3, 2)
                self.lay(beside, pavement, self.u(0.7, 1.8))
                if self.chance(0.5):
                    joints = np.maximum(*(band(a % np.float32(tile), tile / 2, 0.02) for a in (road.s, road.d)))
                    self.lay(joints * beside * np.float32(self.u(0.2, 0.8)), pavement * 0.5)
                self.lay(band(road.d, side * (edge + width / 2), width), self.gray(0.1, 0.5), self.u(0.7, 2))
                if self.chance(0.5):  # a gutter
                    self.lay(band(road.d, side * (edge - 0.15), 0.3), self.gray(0.06, 0.35), self.u(0.8, 1.4))
                self.height += beside * np.float32(self.u(0, 0.15))
                if self.chance(0.4):
                    far = side * (edge + self.u(1.5, 4))
                    self.lay(between(road.d, far, far + side * 40), self.gray(0.04, 0.4, 0.15), self.u(0.7, 3))
            elif kind < 0.9:  # a verge
                ragged = 0.5 + 0.3 * self.noise(3, 12) if self.chance(0.5) else 0.5
                green = (cv2.blur(beside, (9, 9)) > ragged).astype(np.float32)
                rough = np.exp(np.float32(self.u(0.1, 0.5)) * self.noise(1.5, 5))[..., None]
                color = np.array([0.04, 0.11, 0.07], np.float32) * self.gray(0.6, 2, 0.2)
                self.lay(green, color * rough, np.float32(self.u(1, 4)) * rough[..., 0])
                self.height += green * np.float32(self.u(-0.1, 0.15))
        if self.chance(0.06):  # cobbles
            size = self.u(0.1, 0.25)
            gaps = np.maximum(*(band(a % np.float32(size), size / 2, 0.03) for a in (road.s, road.d)))
            self.albedo *= (1 - np.float32(self.u(0.2, 0.6)) * gaps * inside)[..., None]

    def wear(self, road: Road) -> None:
        """Add patches, seams, joints, cracks, rails, covers and what is left of removed lines."""
        for _ in self.some(0.6, 2):
            s, d = self.u(20, 70), self.u(-8, 8)
            part = between(road.s, s, s + self.u(0.6, 12)) * between(road.d, d, d + self.u(0.5, 4))
            self.lay(part, self.gray(0.04, 0.25), self.u(0.7, 1.4))
            if self.chance(0.4):
                self.lay(cv2.dilate(part, np.ones((3, 3))) - part, self.gray(0.02, 0.06), self.u(0.4, 1))
        for _ in self.some(0.75, 3):
            along = self.chance(0.6)
            at = band(road.d if along else road.s, self.u(-8, 8) if along else self.u(20, 70), self.u(0.02, 0.12))
            color = self.gray(0.02, 0.07) if self.chance(0.8) else self.gray(0.1, 0.3)
            self.lay(at * np.float32(self.u(0.3, 1)), color, self.u(0.5, 1.2))
        if self.chance(0.12):  # slabs of concrete
            sizes = (road.s, self.u(3, 6)), (road.d, self.u(3, 4.5))
            joints = [band(a % np.float32(n), n / 2, 0.03) for a, n in sizes]
            self.lay(np.maximum(*joints) * np.float32(0.8), self.gray(0.02, 0.08))
        for _ in self.some(0.3, 4):  # cracks, of which wet seals mirror the sky
            steps = self.rng.normal(0, 3, (40, 2)) + self.rng.normal(0, 6, 2)
            way, thick = np.cumsum(steps, axis=0) + self.rng.uniform(0, SIDE, 2), int(self.rng.integers(1, 4))
            mask = np.zeros(SHAPE, np.uint8)
            cv2.polylines(mask, [np.rint(way * 16).astype(np.int32)], False, 255, thick, cv2.LINE_AA, 4)
            color = self.gray(0.2, 0.5) if self.chance(0.15) else self.gray(0.015, 0.06)
            self.lay(mask.astype(np.float32) / 255, color, 0.6)
        if self.chance(0.06):  # rails of a tram
            middle, bright = self.u(-5, 5), self.gray(0.2, 0.8)
            for side in (-0.7175, 0.7175):
                self.lay(band(road.d, middle + side, 0.16), self.gray(0.03, 0.1), 0.7)
                self.lay(band(road.d, middle + side, 0.06), bright, self.u(0.3, 2))
        for _ in self.some(0.2, 2):  # covers of manholes
            cover = np.hypot(road.s - np.float32(self.u(20, 70)), road.d - np.float32(self.u(-8, 8))) < 0.3
            self.lay(cover.astype(np.float32), self.gray(0.03, 0.3), self.u(0.5, 2))
        for _ in self.some(0.25, 3):  # removed lines: ground off, or painted over, with flakes left
            at = band(road.d, self.u(-8, 8), self.u(0.1, 0.25)) * (self.dashes(road.s) if self.chance(0.5) else 1)
            self.albedo *= (1 + at * np.float32(self.log(0.6, 1.4) - 1))[..., None]
            flakes = (self.noise(2, 8) > self.u(0.3, 1.5)) * np.float32(self.u(0.1, 0.5))
            self.lay(at * flakes, self.gray(0.25, 0.5), 1.5)

    def dashes(self, s: Layer, pattern: tuple[float, float] | None = None) -> Layer:
        on, off = pattern or DASHES[int(self.rng.integers(len(DASHES)))]
        return between(s % np.float32(on + off), off / 2, off / 2 + on)

    def style(self) -> Style:
        """Draw a paint: white or yellow, new or gray, with or without beads."""
        white = self.u(0.25, 0.8) * np.exp(self.rng.normal(0, 0.03, 3))
        color = white * (0.15, 0.75, 1.1) if self.chance(0.2) else white
        reflects = np.exp(self.rng.normal(0.1, 0.2) if self.wet else self.rng.normal(1.0, 0.35))
        return Style(tuple(color), float(reflects), float(self.rng.choice(WORN)))

    def paint(self, share: Layer, style: Style, kind: int, heading: Layer) -> None:
        """Paint and note what was painted."""
        left = self.depth > np.quantile(self.depth[::4, ::4], style.worn) if style.worn else np.ones(SHAPE, bool)
        self.lay(share * left * np.float32(0.95), np.array(style.color, np.float32), style.reflects)
        on = share > 0.5
        self.kind[on], self.direction[on] = kind, np.rint(np.rad2deg(heading[on])).astype(np.int64) % 180

    def markings(self, road: Road, lines: Sequence[float], gap: Layer) -> None:
        """Paint a road's lines at some offsets, and what is across, but where `gap` (R, C) is 0."""
        usual, self.depth = self.style(), self.noise(1.5, 4, 25)
        width, pattern = float(self.rng.choice(WIDTHS_M)), DASHES[int(self.rng.integers(len(DASHES)))]
        for at in lines:
            style, edge = self.style() if self.chance(0.25) else usual, at in (lines[0], lines[-1])
            if self.chance(0.12):
                continue
            double = not edge and self.chance(0.15)
            aside, wide = self.u(0.1, 0.2), width * (1.5 if edge and self.chance(0.2) else 1)
            for middle in (at - aside, at + aside) if double else (at,):
                solid = self.chance(0.75 if edge else 0.25)
                share = band(road.d, middle, wide) * gap
                if not solid and self.chance(0.04):  # buttons, as Botts' dots
                    dots = np.hypot(road.s % np.float32(1.2) - np.float32(0.6), road.d - np.float32(middle)) < 0.05
                    self.lay(dots * gap, self.gray(0.3, 0.8), 3.0)
                    self.paint(share, Style(style.color, 1.0, 1.0), DASHED, road.heading)
                else:
                    share = share if solid else share * self.dashes(road.s, pattern)
                    self.paint(share, style, SOLID if solid else DASHED, road.heading)
        low, high, across = min(lines), max(lines), road.heading + np.float32(np.pi / 2)
        at = float(np.median(road.s)) + self.u(-8, 8)
        if self.chance(0.3):
            one, other = self.rng.choice(lines, 2, replace=False) if self.chance(0.7) else (low, high)
            share = band(road.s, at, self.u(0.25, 0.6)) * between(road.d, one, other)
            self.paint(share * gap, usual, STOP, across)
        if self.chance(0.25):
            at, period, length = at + self.u(1, 3), self.u(0.6, 1.3), self.u(1.8, 4.5)
            if self.chance(0.8):
                bars = band(road.d % np.float32(period), period / 2, self.u(0.4, 0.6) * period)
                share = bars * between(road.s, at, at + length) * between(road.d, low + 0.2, high - 0.2)
                self.paint(share * gap, usual, CROSSWALK, road.heading)
            else:
                edges = [band(road.s, k, self.u(0.15, 0.3)) for k in (at, at + length)]
                self.paint(np.maximum(*edges) * between(road.d, low, high) * gap, usual, CROSSWALK, across)
        for _ in self.some(0.3, 3):  # arrows and letters
            s, d, length, wide = at + self.u(-9, 5), self.u(low, high), self.u(1.5, 6), self.u(0.8, 2.2)
            u, v = (d - road.d) / wide * 80 + 40, (s + length - road.s) / length * 120
            share = cv2.remap(self.symbol(), u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
            self.paint(share.astype(np.float32) / 255 * gap, usual, OTHER, road.heading)
        if self.chance(0.06):  # hatching
            period, s, d = self.u(1, 3), at + self.u(-8, 2), self.u(low, high)
            slant = (road.d + road.s * np.float32(self.rng.choice([-1, 1]))) % np.float32(period)
            share = band(slant, period / 2, 0.4) * between(road.s, s, s + 8) * between(road.d, d, d + self.u(1, 3))
            self.paint(share * gap, usual, OTHER, road.heading)

    def symbol(self) -> NDArray[np.uint8]:
        """Draw an arrow or letters (120, 80), to be read from below."""
        out, bent = np.zeros((120, 80), np.uint8), int(self.rng.integers(-1, 2))
        if self.chance(0.4):
            word = "".join(self.rng.choice(list("ABEHLNOPSTX3057"), int(self.rng.integers(1, 4))))
            scale, thick = 78 / (20 * len(word)), int(self.rng.integers(5, 12))
            cv2.putText(out, word, (4, 100), cv2.FONT_HERSHEY_SIMPLEX, scale, 255, thick)
            return out
        cv2.rectangle(out, (37, 40), (43, 119), 255, -1)
        cv2.line(out, (40, 40), (40 + 16 * bent, 40), 255, 6)
        aside = [(40 + 38 * bent, 40), (40 + 14 * bent, 22), (40 + 14 * bent, 58)]
        cv2.fillPoly(out, [np.array(aside if bent else [(40, 0), (26, 45), (54, 45)])], 255)
        return out

    def light(self) -> Layer:
        """Light (R, C, 3) on the sheet: shadows of houses, posts, fences and trees, and lamps."""
        shade = np.zeros(SHAPE, np.uint8)
        for _ in self.some(0.35, 3):
            corners = self.rng.uniform(-0.3, 1.3, 2) * SIDE + self.rng.normal(0, SIDE * 0.3, (5, 2))
            cv2.fillPoly(shade, [cv2.convexHull(np.rint(corners).astype(np.int32))], 255)
        for _ in self.some(0.25, 3):  # thin ones, and sun between two houses
            ends = np.rint(self.rng.uniform(-0.2, 1.2, (2, 2)) * SIDE).astype(int).tolist()
            cv2.line(shade, *ends, int(self.rng.choice([0, 255])), int(self.rng.integers(1, 12)))
        if self.chance(0.15):
            shade[self.noise(6, 15, 40) > self.u(-0.5, 1)] = 255
        if self.chance(0.06):  # sun through a fence
            step = self.u(0.3, 1)
            bars = band(ramp(self.u(0, 2 * np.pi)) % np.float32(step), step / 2, step * self.u(0.3, 0.7)) > 0.5
            shade[bars & (self.noise(90) > -0.5)] = 255
        soft = cv2.GaussianBlur(shade.astype(np.float32) / 255, (0, 0), self.u(0.4, 4))[..., None]
        light = 1 + soft * (np.float32(self.u(0.1, 0.6)) * np.array([1.25, 1.08, 0.95], np.float32) - 1)
        return light * np.exp(np.float32(self.u(0.3, 1.2)) * self.noise(120))[..., None] if self.chance(0.15) else light

    def glare(self, toward: float) -> Layer:
        """Streaks (R, C) of lamps on wet ground and of upright things that pictures smear over it, about in one direction."""
        out = np.zeros(SHAPE, np.float32)
        for _ in self.some(0.6 if self.wet else 0.2, 5):
            angle, begin = toward + self.rng.normal(0, 0.12), self.rng.uniform(-0.2, 1.2, 2) * SIDE
            end = begin + self.u(1.5, 15) / CELL_M * np.array([np.cos(angle), -np.sin(angle)])
            mask, ends = np.zeros(SHAPE, np.float32), np.rint([begin, end]).astype(int).tolist()
            cv2.line(mask, *ends, self.u(0.1, 1), int(self.log(1.6, 33)))
            out = np.maximum(out, cv2.GaussianBlur(mask, (0, 0), self.log(0.6, 20)))
        return out * np.float32(self.log(0.05, 1.35))

    def pictures(self, road: Road) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Make colors (R, C, 3) of pictures side by side, each with its own gain, blur, shift and glare, and where they show it."""
        fine, coarse = np.float32(self.u(0.01, 0.12)), np.float32(self.u(0, 0.08))
        texture = np.exp(fine * self.noise(1) + coarse * self.noise(self.u(8, 60)))
        lit = self.albedo * self.light() * texture[..., None]
        exposure = self.log(0.4, 3.5) * (0.25 if self.night and self.chance(0.6) else 1)
        if self.wet:
            lit = lit * np.float32(self.u(0.5, 0.9)) + np.float32(self.u(0, 0.12))  # the sky mirrors
        ahead = float(road.heading.mean())
        drive = ahead if self.chance(0.7) else self.u(0, 2 * np.pi)
        view = ahead + self.rng.normal(0, 0.3) if self.chance(0.7) else self.u(0, np.pi)
        streaks = self.glare(drive if self.chance(0.7) else self.u(0, 2 * np.pi))
        lamp = np.float32(self.u(0, 0.25) if self.night or self.wet else 0) * ramp(drive + self.rng.normal(0, 0.2))
        count, feather = int(self.rng.choice([1, 1, 2, 3, 6])), int(self.rng.choice([1, 1, 7, 17]))
        # Six are one after the other, 2 m apart as a map takes them.
        seams = self.u(-8, -6) + 2.0 * np.arange(5) if count == 6 else np.sort(self.rng.uniform(-7, 7, count - 1))
        part = np.searchsorted(seams, ramp(drive))
        # On far ground pixels are long along the view.
        far, longer = self.u(0, 1) ** 2, 24.0 if self.chance(0.2) else 8.0
        haze = self.u(0, 0.3) if self.chance(0.2) else 0.0
        total, weight = np.zeros_like(lit), np.zeros(SHAPE, np.float32)
        for k in range(count):
            blur = far * self.u(0.5, 1.5)
            image = blurred(lit, view + self.rng.normal(0, 0.1), 0.4 + longer * blur, 0.4 + 2.2 * blur)
            image = shifted(image, *self.rng.normal(0, 0.7 if self.chance(0.8) else 2, 2))
            glare, lit_by = streaks, lamp
            if count == 6:  # headlights shine on the same part of each picture
                step = (2.0 * (k - 2.5) + self.rng.normal(0, 0.1)) / CELL_M
                glare, lit_by = (shifted(a, step * np.cos(drive), -step * np.sin(drive)) for a in (streaks, lamp))
            gain = np.float32(exposure * np.exp(self.rng.normal(0, 0.1))) * np.exp(lit_by)
            if self.chance(0.3):  # vignetting
                gain = gain * np.exp(np.float32(self.rng.normal(0, 0.1)) * ramp(view))
            image = image * gain[..., None] + glare[..., None] * np.float32(self.u(0.5, 1))
            own = cv2.blur((part == k).astype(np.float32), (feather, feather))
            total += (image * (1 - haze) + haze * 0.3) * own[..., None]
            weight += own
        image = 255 * np.clip(total / weight[..., None], 0, None) ** np.float32(1 / self.u(1.8, 2.4))
        grain = self.rng.standard_normal(image.shape, dtype=np.float32)
        sigma = np.float32(self.u(0.6, 6) * (1.8 if self.night else 1))
        image += cv2.GaussianBlur(grain, (0, 0), self.u(0.3, 1.2)) * sigma
        hole = np.zeros(SHAPE, bool)
        if self.chance(0.4):  # what no picture shows
            beyond = ramp(self.u(0, 2 * np.pi)) > self.u(0, 6)
            hole = self.noise(30, 90) > self.u(0.3, 2) if self.chance(0.4) else beyond
        color = np.where(hole[..., None], 0, np.clip(np.rint(image), 0, 255)).astype(np.uint8)
        return color, np.where(hole, 0, 255).astype(np.uint8)

    def sweeps(self, road: Road) -> Layer:
        """Make intensities (R, C) of sweeps along a way, NaN where none tells: rings that are dense near it and far apart elsewhere."""
        truth = cv2.GaussianBlur(shifted(self.reflects, *self.rng.normal(0, 1.2, 2)), (0, 0), self.log(0.5, 2.7))
        truth = truth * np.exp(np.float32(self.u(0, 0.12)) * self.noise(20, 80))
        way = float(road.heading.mean()) if self.chance(0.7) else self.u(0, 2 * np.pi)
        along, across = ramp(way) - np.float32(self.u(-30, 30)), ramp(way + np.pi / 2) - np.float32(self.u(-12, 12))
        sweeps, step, mount = int(self.rng.choice([1, 2, 4, 8, 14])), self.log(0.2, 2), np.float32(self.u(1.5, 2.5))
        rough = np.float32(self.u(0.03, 0.25))
        rings, shots = np.deg2rad(self.log(0.2, 2)), np.deg2rad(self.u(0.1, 0.4))
        gains = np.exp(self.rng.normal(0, self.u(0, 0.2), 512)).astype(np.float32)
        total, sums = np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.float32)
        for k in range(sweeps):
            away = np.hypot(along - np.float32(k * step), across) + np.float32(0.1)
            ring = np.arctan2(mount, away) / np.float32(rings)
            hit = (ring % 1) * np.float32(rings) * (np.square(away) / mount + mount) < CELL_M
            hit &= self.rng.random(SHAPE, dtype=np.float32) < CELL_M / (away * np.float32(shots))
            weight = hit / (1 + np.square(away / np.float32(SHARP_RANGE_M)))
            total += weight
            value = np.exp(rough * self.rng.standard_normal(SHAPE, dtype=np.float32))
            sums += weight * value * gains[ring.astype(np.int32) % 512]
        out = np.full(SHAPE, np.nan, np.float32)
        for spread in SPREADS:  # as `map_intensity` fills a map
            near, near_sums = (cv2.GaussianBlur(a, (0, 0), spread) for a in (total, sums * truth))
            free = np.isnan(out) & (near > MIN_WEIGHT / spread**2)
            out[free] = near_sums[free] / near[free]
        return np.minimum(out * np.float32(USUAL * np.exp(self.rng.normal(0, 0.1))), 1)


def blurred(image: Layer, angle: float, along: float, across: float) -> Layer:
    """Blur by a Gaussian with two sigmas, in cells."""
    reach = int(np.ceil(2.2 * max(along, across)))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float32)
    c, s = np.cos(angle), np.sin(angle)
    kernel = np.exp(-0.5 * (((x * c - y * s) / along) ** 2 + ((x * s + y * c) / across) ** 2))
    kernel = (kernel / kernel.sum()).astype(np.float32)
    return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE))


def draw_map(rng: np.random.Generator) -> tuple[GroundMap, NDArray[np.uint8], NDArray[np.uint8]]:
    """Draw a map, the kind of paint (R, C) of its cells, and its direction (R, C) in degrees."""
    it = Drawing(rng)
    road, lanes, width = it.road(), int(rng.choice([1, 2, 2, 3, 3, 4, 6])), it.u(2.5, 4.2)
    lines = [(k - lanes / 2) * width for k in range(lanes + 1)]
    edge = lines[-1] + 0.1 + float(rng.choice([0.0, 0.15, 0.3, 0.8, 2.0]))
    it.surfaces(road, edge)
    gap, crossing, half = np.ones(SHAPE, np.float32), None, it.u(2.5, 7)
    if it.chance(0.3):
        crossing = it.road(float(road.heading.mean()) + it.u(0.9, 2.2))
        inside = between(crossing.d, -half, half)
        it.lay(inside, it.gray(0.05, 0.2), it.u(0.8, 1.2))
        it.height *= 1 - inside
        gap = 1 - between(crossing.d, -half - it.u(0, 2), half + it.u(0, 2)) if it.chance(0.8) else gap
    it.wear(road)
    if it.chance(0.9):
        it.markings(road, lines, gap)
        if crossing is not None and it.chance(0.8):
            it.markings(crossing, [0.3 - half, 0.0, half - 0.3], 1 - between(road.d, -edge, edge))
    if it.chance(0.3):  # wear over the paint
        it.albedo *= (1 - np.float32(it.u(0, 0.4)) * (it.noise(6, 50) > 0.8))[..., None]
    color, alpha = it.pictures(road)
    intensity = it.sweeps(road)
    height = it.height + np.float32(it.u(0, 0.02)) * it.noise(4, 30) + np.float32(it.u(-0.02, 0.02)) * road.s
    if it.chance(0.3):
        intensity[it.noise(40, 100) > it.u(0.3, 2)] = np.nan
    if it.chance(0.3):  # a wall, of which the foot shines
        at, side = it.u(3, 14), float(rng.choice([-1, 1]))
        behind = between(road.d, side * at, side * 60) > 0.5
        foot = band(road.d, side * (at + 0.1), it.u(0.1, 0.4)) > 0.5
        alpha[behind], intensity[behind] = 0, np.nan
        intensity[foot] = np.minimum(np.float32(it.u(0.3, 1.5)) * np.exp(np.float32(0.3) * it.noise(3)), 1)[foot]
    for _ in it.some(0.3, 2):  # vehicles that leave holes
        s, d = float(road.s.mean()) + it.u(-9, 5), it.u(-9, 7)
        hole = between(road.s, s, s + it.u(2, 10)) * between(road.d, d, d + it.u(1.5, 2.6)) > 0.5
        alpha[hole], intensity[hole], height[hole] = 0, np.nan, np.nan
    sensors = it.u(0, 1)
    if sensors < 0.15:
        intensity[:], height[:] = np.nan, np.nan
    elif sensors < 0.27:
        alpha[:] = 0
    color[alpha == 0] = 0
    extent = (0.0, SIDE * CELL_M, 0.0, SIDE * CELL_M)
    ground = GroundMap(color, alpha, np.asarray(height, np.float32), intensity, CELL_M, extent)
    return ground, it.kind, it.direction
