"""Maps of the ground with markings painted on them, whose truth is exact."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.road.ground_map import GroundMap

ASPHALT, WHITE, GRASS = (92, 91, 90), (214, 216, 216), (60, 110, 80)
FINE = 4  # masks are drawn so much finer than cells


def line_of(function, begin: float, end: float, step: float = 0.25) -> Array:
    """Sample y = function(x) as points (N, 2)."""
    x = np.arange(begin, end + step / 2, step)
    return np.stack([x, np.broadcast_to(function(x), x.shape)], 1)


def dashes_of(line: Array, on_m: float, off_m: float, first_m: float = 0.0) -> list[Array]:
    """Cut dashes out of a line (N, 2)."""
    s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])

    def at(where):
        return np.stack([np.interp(where, s, line[:, k]) for k in range(2)], 1)

    begins = np.arange(first_m, s[-1], on_m + off_m)
    return [at(np.linspace(b, min(b + on_m, s[-1]), max(2, int(on_m / 0.25) + 1))) for b in begins if s[-1] - b > 0.2]


@dataclass
class Painter:
    """A map that is painted step by step; `ground` is what find_markings reads."""

    extent_m: tuple[float, float, float, float] = (0.0, 60.0, -15.0, 15.0)
    cell_m: float = 0.05
    base: tuple[int, int, int] = ASPHALT
    seed: int = 0
    color: NDArray[np.float32] = field(init=False)
    paint: NDArray[np.float32] = field(init=False)
    height: NDArray[np.float32] = field(init=False)

    def __post_init__(self) -> None:
        x0, x1, y0, y1 = self.extent_m
        shape = (round((y1 - y0) / self.cell_m), round((x1 - x0) / self.cell_m))
        self.rng = np.random.default_rng(self.seed)
        self.color = np.empty((*shape, 3), np.float32)
        self.color[:] = self.base
        self.paint = np.zeros(shape, np.float32)
        self.height = np.zeros(shape, np.float32)
        self.alpha = np.full(shape, 255, np.uint8)

    @property
    def xy(self) -> tuple[Array, Array]:
        """Positions (R, C) of the cells."""
        rows, columns = np.mgrid[: self.color.shape[0], : self.color.shape[1]]
        return self.extent_m[0] + (columns + 0.5) * self.cell_m, self.extent_m[3] - (rows + 0.5) * self.cell_m

    def cover(self, polygons: list[Array]) -> NDArray[np.float32]:
        """Share (R, C) of each cell that polygons cover."""
        mask = np.zeros(tuple(FINE * s for s in self.paint.shape), np.uint8)
        for polygon in polygons:
            u = (polygon[:, 0] - self.extent_m[0]) / self.cell_m * FINE - 0.5
            v = (self.extent_m[3] - polygon[:, 1]) / self.cell_m * FINE - 0.5
            cv2.fillPoly(mask, [np.rint(np.stack([u, v], 1) * 16).astype(np.int32)], 255, cv2.LINE_8, 4)
        return cv2.resize(mask, self.paint.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32) / 255

    def lay(self, share: NDArray[np.float32], color, *, reflects: float = 0.0) -> None:
        """Blend a color over the map."""
        self.color += share[..., None] * (np.array(color, np.float32) - self.color)
        self.paint += share * (reflects - self.paint)

    def lines(self, pieces: list[Array], width_m: float = 0.14, color=WHITE, *, worn: float = 0.0) -> None:
        """Paint lines; of worn paint that share is gone, in flakes of some centimeters to decimeters."""
        share = self.cover([outline_of(p, width_m) for p in pieces])
        if worn:
            noise = cv2.GaussianBlur(self.rng.normal(size=share.shape).astype(np.float32), (0, 0), 2.0)
            share = share * (noise > np.quantile(noise, worn))
        self.lay(share, color, reflects=1.0)

    def ground(
        self, *, grain: float = 0.05, lidar: bool = True, blur: float = 0.6, reflects: float = 0.4, noise: float = 0.04
    ) -> GroundMap:
        """Make the map: grain of the surface (share of brightness), blur in cells, LiDAR intensity of paint above the road, and its noise."""
        texture = cv2.GaussianBlur(self.rng.normal(size=self.paint.shape).astype(np.float32), (0, 0), 0.8)
        coarse = cv2.GaussianBlur(self.rng.normal(size=self.paint.shape).astype(np.float32), (0, 0), 6)
        shade = 1 + grain * texture / texture.std() + grain / 2 * coarse / coarse.std()
        image = cv2.GaussianBlur(self.color * shade[..., None], (0, 0), blur) if blur else self.color * shade[..., None]
        image = np.clip(image + self.rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)
        intensity = np.full(self.paint.shape, np.nan, np.float32)
        if lidar:
            value = 0.12 + reflects * self.paint + self.rng.normal(0, noise, self.paint.shape)
            hit = self.rng.random(self.paint.shape) < 0.3
            intensity = np.where(hit, np.clip(value, 0, 1), np.nan).astype(np.float32)
        return GroundMap(image, self.alpha, self.height, intensity, self.cell_m, self.extent_m)


def outline_of(line: Array, width_m: float) -> Array:
    """Outline (2 N, 2) of a line with a width."""
    d = np.gradient(line, axis=0) if len(line) > 2 else np.repeat(np.diff(line, axis=0), 2, axis=0)
    left = np.stack([-d[:, 1], d[:, 0]], 1) / np.linalg.norm(d, axis=1, keepdims=True) * width_m / 2
    return np.concatenate([line + left, (line - left)[::-1]])
