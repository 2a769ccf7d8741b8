"""The static parts of a scene: ground with roads and markings, facades."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, box_corners_bev
from log2sim.synth.scene import Building, Scene

GROUND_M_PER_PX = 0.04
MAX_GROUND_PX = 6000
MARGIN_M = 12.0
FACADE_M_PER_PX = 0.04
GAMMA = 2.2
MARKING, ASPHALT, PAVING, MEADOW = (214, 216, 216), (92, 91, 90), (150, 155, 158), (128, 142, 138)
FLOOR_M, BAY_M = 3.1, 2.7


@dataclass(frozen=True, eq=False)
class Wall:
    """One side of a building.

    Attributes
    ----------
    foot_m : (2,) float64, m
        One end of its foot.
    along : (2,) float64
        Unit direction from there along the foot.
    outward : (2,) float64
        Unit normal.
    length_m : float
    height_m : float
    texture : (H, W, 3) uint8
        sRGB, its first row at the ground.
    """

    foot_m: Array
    along: Array
    outward: Array
    length_m: float
    height_m: float
    texture: NDArray[np.uint8]


class Backdrop:
    """The ground and the facades of a scene, painted when first asked for."""

    def __init__(self, scene: Scene, seed: int) -> None:
        self._scene, self._seed = scene, seed
        points = [p for road in scene.road for p in road.line] + [w[:2] for w in scene.ego.waypoints]
        self.corner_m = np.array(points).min(0) - MARGIN_M
        self._extent_m = np.array(points).max(0) + MARGIN_M - self.corner_m

    @cached_property
    def walls(self) -> tuple[Wall, ...]:
        """The sides of all buildings."""
        rng = np.random.default_rng([self._seed, 5])
        return tuple(wall for building in self._scene.building for wall in _walls(building, rng))

    @cached_property
    def ground(self) -> tuple[NDArray[np.uint8], ...]:
        """The ground from above as a pyramid, each level half as large; the first pixel lies at `corner_m`."""
        shape = np.minimum(np.ceil(self._extent_m / GROUND_M_PER_PX).astype(int), MAX_GROUND_PX)
        rng = np.random.default_rng([self._seed, 3])
        levels = [_paint_ground(self._scene, self.corner_m, (int(shape[1]), int(shape[0])), rng)]
        while min(levels[-1].shape[:2]) > 64 and len(levels) < 6:
            levels.append(
                np.asarray(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
            )
        return tuple(levels)


def _paint_ground(scene: Scene, low: Array, shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Paint the ground from above (H, W, 3), sRGB: columns go east, rows go north."""
    image = np.empty((*shape, 3), np.uint8)
    image[:] = MEADOW
    sidewalk, asphalt, white = (np.zeros(shape, np.uint8) for _ in range(3))
    roads = [(np.array(r.line), r) for r in scene.road]
    for line, road in roads:
        _stroke(sidewalk, line, low, road.width_m + 2 * road.sidewalk_m)
        _stroke(asphalt, line, low, road.width_m)
    for i, (line, road) in enumerate(roads):
        crossing = np.zeros(shape, np.uint8)
        for j, (other, r) in enumerate(roads):
            if i != j:
                _stroke(crossing, other, low, r.width_m + 4.0)
        for zebra in scene.zebra:
            _stroke(crossing, np.array(zebra.line), low, zebra.width_m + 1.6)
        marks = np.zeros(shape, np.uint8)
        if road.marking != "none":
            for a, b in _dashes(line, 3.0, 3.0) if road.marking == "dashed" else pairwise(line):
                _stroke(marks, np.array([a, b]), low, 0.14)
        for side in (-1, 1):
            _stroke(marks, _parallel(line, side * (road.width_m / 2 - 0.2)), low, 0.1)
        white[(marks > 0) & (crossing == 0)] = 255
    for zebra in scene.zebra:
        for a, b in _dashes(np.array(zebra.line), 0.5, 0.5):
            _stroke(white, np.array([a, b]), low, zebra.width_m)
    rows, columns = np.indices(shape, dtype=np.float32)
    image[sidewalk > 0] = PAVING
    joint = ((rows % 25 < 1) | (columns % 25 < 1)) & (sidewalk > 0)
    image[joint] = np.array(PAVING) * 0.86
    curb = cv2.dilate(asphalt, np.ones((7, 7), np.uint8)) > 0
    image[curb & (sidewalk > 0)] = (172, 176, 178)
    image[asphalt > 0] = ASPHALT
    image[white > 0] = MARKING
    return _weathered(image, rng, 0.015)


def _weathered(image: NDArray[np.uint8], rng: np.random.Generator, grain: float) -> NDArray[np.uint8]:
    """Grain, stains and patches of many sizes."""
    h, w = image.shape[:2]
    shade = rng.standard_normal((h, w), dtype=np.float32) * np.float32(grain)
    for size, share in ((6, 0.8), (40, 1.3), (200, 1.7)):
        coarse = rng.normal(0, share * grain, (h // size + 2, w // size + 2)).astype(np.float32)
        shade += cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)
    return np.clip(image * (1 + shade[..., None]), 0, 255).astype(np.uint8)


def _stroke(mask: NDArray[np.uint8], line: Array, low: Array, width_m: float) -> None:
    """Draw a line with square ends and a true width."""
    for a, b in pairwise(line):
        d = b - a
        across = np.array([-d[1], d[0]]) / np.linalg.norm(d) * width_m / 2
        corners = (np.array([a + across, b + across, b - across, a - across]) - low) / GROUND_M_PER_PX
        cv2.fillConvexPoly(mask, np.rint(corners * 16).astype(np.int32), 255, cv2.LINE_8, 4)
    for p in line[1:-1]:
        center = np.rint((p - low) / GROUND_M_PER_PX).astype(int)
        cv2.circle(mask, center.tolist(), round(width_m / 2 / GROUND_M_PER_PX), 255, -1)


def _dashes(line: Array, on_m: float, off_m: float) -> list[tuple[Array, Array]]:
    out = []
    for a, b in pairwise(line):
        length = float(np.linalg.norm(b - a))
        begins = np.arange(off_m / 2, length, on_m + off_m) / length
        out += [(a + (b - a) * f, a + (b - a) * min(f + on_m / length, 1.0)) for f in begins]
    return out


def _parallel(line: Array, left_m: float) -> Array:
    d = np.gradient(line, axis=0)
    return np.asarray(line + left_m * np.stack([-d[:, 1], d[:, 0]], 1) / np.linalg.norm(d, axis=1, keepdims=True))


def _walls(building: Building, rng: np.random.Generator) -> list[Wall]:
    length, width, height = building.size_m
    corners = box_corners_bev(np.array(building.center), length, width, np.deg2rad(building.yaw_deg))[0]
    out = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        span = float(np.linalg.norm(b - a))
        along = (b - a) / span
        out.append(
            Wall(a, along, np.array([along[1], -along[0]]), span, height, _facade(span, height, building.color, rng))
        )
    return out


def _facade(length_m: float, height_m: float, color: Sequence[int], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Paint a facade (H, W, 3), sRGB, its first row at the ground: a plinth, floors of windows, a cornice."""
    px = 1 / FACADE_M_PER_PX
    h, w = max(8, round(height_m * px)), max(8, round(length_m * px))
    image = np.empty((h, w, 3), np.uint8)
    image[:] = color[::-1]
    image[: round(0.8 * px)] = np.array(color[::-1]) * 0.78
    image[-round(0.35 * px) :] = np.minimum(np.array(color[::-1]) * 1.1, 255)
    bays, floors = int((length_m - 0.8) // BAY_M), int((height_m - 1.0) // FLOOR_M)
    start = (length_m - bays * BAY_M) / 2
    for floor in range(floors):
        for bay in range(bays):
            x, z = start + bay * BAY_M + 0.75, 1.1 + floor * FLOOR_M
            frame = [round(v * px) for v in (z - 0.08, z + 1.63, x - 0.08, x + 1.28)]
            image[frame[0] : frame[1], frame[2] : frame[3]] = np.minimum(np.array(color[::-1]) * 1.12, 255)
            pane = [round(v * px) for v in (z, z + 1.55, x, x + 1.2)]
            light = rng.uniform(0.75, 1.15)
            ramp = np.linspace(0.85, 1.15, pane[1] - pane[0])[:, None, None] * light
            image[pane[0] : pane[1], pane[2] : pane[3]] = np.clip(ramp * np.array((112, 100, 88)), 0, 255)
            middle = (pane[2] + pane[3]) // 2
            image[pane[0] : pane[1], middle - 1 : middle + 1] = np.minimum(np.array(color[::-1]) * 1.05, 255)
    return _weathered(image, rng, 0.007)


def linear_table() -> NDArray[np.float32]:
    """Linear light of the 256 sRGB values."""
    return ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)
