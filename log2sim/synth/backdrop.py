"""The static parts of a scene: the ground and facades."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, box_corners_bev
from log2sim.synth.grain import grain
from log2sim.synth.ground import Ground
from log2sim.synth.light import light_of
from log2sim.synth.markings import GroundPlan
from log2sim.synth.polytope_caster import Terrain
from log2sim.synth.scene import Scene
from log2sim.synth.scene_places import Building

FACADE_M_PER_PX = 0.04
FACADE_LEVELS = 6
FLOOR_M, BAY_M = 3.1, 2.7
GRAIN = 0.5  # of plaster relative to asphalt


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
    color : (int, int, int)
        RGB.
    seed : tuple of int
        Of its windows and stains.
    """

    foot_m: Array
    along: Array
    outward: Array
    length_m: float
    height_m: float
    color: tuple[int, int, int]
    seed: tuple[int, ...]

    @cached_property
    def texture(self) -> tuple[NDArray[np.uint8], ...]:
        """Images (H, W, 3), sRGB as BGR, the first row at the ground, in pixels of `FACADE_M_PER_PX`, then ever twice as large."""
        return _pyramid(_facade(self.length_m, self.height_m, self.color, self.seed))


class Backdrop:
    """The ground and the facades of a scene, painted when and where they are looked at."""

    def __init__(self, scene: Scene, seed: int) -> None:
        self.terrain: Terrain | None = None  # level
        self.ground = Ground(GroundPlan.of(scene), seed)
        self.buildings = tuple(_walls(building, (seed, 5, k)) for k, building in enumerate(scene.building))
        sun = light_of(scene.environment).sun
        thrown = [_shadow(building, sun) for building in scene.building if building.shadow]
        self.shadows: tuple[Array, ...] = (*(_hull(np.array(s.outline)) for s in scene.shadow), *thrown)


def _shadow(building: Building, sun: tuple[float, float, float]) -> Array:
    """Outline (P, 2) of the shadow of a building."""
    length, width, height = building.size_m
    corners = box_corners_bev(np.array(building.center), length, width, np.deg2rad(building.yaw_deg))[0]
    top = corners - np.divide(sun[:2], sun[2]) * height
    return _hull(np.concatenate([corners, top]))


def _hull(points: Array) -> Array:
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], np.float64)


def _walls(building: Building, seed: tuple[int, ...]) -> tuple[Wall, ...]:
    """Make the four sides of a building."""
    length, width, height = building.size_m
    corners = box_corners_bev(np.array(building.center), length, width, np.deg2rad(building.yaw_deg))[0]
    out = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        span = float(np.linalg.norm(b - a))
        along = (b - a) / span
        out.append(Wall(a, along, np.array([along[1], -along[0]]), span, height, building.color, (*seed, k)))
    return tuple(out)


def _facade(length_m: float, height_m: float, color: Sequence[int], seed: tuple[int, ...]) -> NDArray[np.uint8]:
    """Paint a facade (H, W, 3), sRGB, its first row at the ground: a plinth, floors of windows, a cornice."""
    rng = np.random.default_rng(seed)
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
    shade = 1 + (grain(seed[0], 0, (0, int(rng.integers(1024))), (h, w)) - 1) * np.float32(GRAIN)
    return np.clip(image * shade[..., None], 0, 255).astype(np.uint8)


def _pyramid(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], ...]:
    """Halve an image again and again: copies, each half as large as the one before."""
    levels = [image]
    while len(levels) < FACADE_LEVELS and min(levels[-1].shape[:2]) >= 8:
        levels.append(np.asarray(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8))
    return tuple(levels)
