"""The fused top-down picture: every camera's view of the road laid onto one raster of the map or ego frame.

A camera sees the road through a homography, so a cell of the raster finds its color at one place of each image. Where
several cameras or ticks see the same cell, the one that resolves the ground finest weighs most, seams are feathered and
exposures balanced. Only the ground is right: whatever stands on it leans away from the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.documents import refuse_existing, replaced
from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.visualization.birdseye.ground_view import (
    GroundView,
    Image,
    look_up,
    sample,
    seen_window,
    shown_mask,
    signed_inverse,
)

__all__ = ["GroundView", "Mosaic", "TopdownPicture", "render_topdown", "write_picture"]

MAX_CELLS = 36_000_000
"""Cells a picture may have; at 28 bytes a cell while it is built this is 1 GB."""


@dataclass(frozen=True, eq=False)
class TopdownPicture:
    """A north-up raster: `image_bgr` (R, C, 3) uint8, `alpha` (R, C) uint8, 0 where no camera saw the ground.

    `extent_m` is x0, x1, y0, y1 of the outer edges, row 0 lies at y1; `frame` is "map" or "ego".
    """

    image_bgr: Image
    alpha: Image
    extent_m: tuple[float, float, float, float]
    resolution_m: float
    frame: str = "map"

    @property
    def coverage(self) -> NDArray[np.bool_]:
        """Cells (R, C) that a camera saw."""
        return self.alpha > 0


def render_topdown(
    views: Sequence[GroundView],
    *,
    extent_m: tuple[float, float, float, float],
    resolution_m: float = 0.05,
    coarsest_m: float = 0.6,
    frame: str = "map",
) -> TopdownPicture:
    """Lay the views of one tick onto one raster; `Mosaic` does the same over many ticks.

    Parameters
    ----------
    extent_m : x0, x1, y0, y1
    resolution_m : edge of a cell, > 0.
    coarsest_m : ground longer than this under one pixel is left out, > 0.
    """
    mosaic = Mosaic(extent_m=extent_m, resolution_m=resolution_m, coarsest_m=coarsest_m, frame=frame)
    mosaic.add(views)
    return mosaic.picture()


class Mosaic:
    """Accumulates views, tick after tick, into one picture of the road.

    Notes
    -----
    Colors are averaged with the square of the image's resolution on the ground as weight, so the nearest look at a cell
    decides its color and far looks only fill what is left. Gains that level exposure follow Brown and Lowe (2007),
    section 6, anchored in what the mosaic already holds.
    """

    def __init__(
        self,
        *,
        extent_m: tuple[float, float, float, float],
        resolution_m: float = 0.05,
        coarsest_m: float = 0.6,
        frame: str = "map",
    ) -> None:
        rows, columns = _raster_shape(extent_m, resolution_m)
        x0, y1 = extent_m[0], extent_m[3]
        self.extent_m = (x0, x0 + columns * resolution_m, y1 - rows * resolution_m, y1)
        self.resolution_m = resolution_m
        self.coarsest_m = coarsest_m
        self.frame = frame
        self._sum = np.zeros((rows, columns, 3), dtype=np.float32)
        self._weight = np.zeros((rows, columns), dtype=np.float32)
        self._opacity = np.zeros((rows, columns), dtype=np.float32)

    def add(self, views: Sequence[GroundView]) -> None:
        """Lay the views of one tick over what is there."""
        layers = [layer for layer in (self._warp(view) for view in views) if layer is not None]
        for layer, gain in zip(layers, self._gains(layers)):
            place = (layer.rows, layer.columns)
            self._sum[place] += layer.color * (gain.astype(np.float32) * layer.weight[..., None])
            self._weight[place] += layer.weight
            np.maximum(self._opacity[place], layer.opacity, out=self._opacity[place])

    def picture(self) -> TopdownPicture:
        """The picture so far."""
        seen = self._weight > 0
        color = np.divide(self._sum, self._weight[..., None], out=np.zeros_like(self._sum), where=seen[..., None])
        image = np.clip(np.rint(color), 0, 255).astype(np.uint8)
        alpha = np.where(seen, np.maximum(np.rint(255 * self._opacity), 1), 0).astype(np.uint8)
        return TopdownPicture(image, alpha, self.extent_m, self.resolution_m, self.frame)

    def _warp(self, view: GroundView) -> _Layer | None:
        """Colors and weights of one view over the part of the raster that it sees."""
        x0, _, _, y1 = self.extent_m
        d = self.resolution_m
        ground_H_cell = np.array([[d, 0, x0 + d / 2], [0, -d, y1 - d / 2], [0, 0, 1]])
        image_H_cell = signed_inverse(view) @ ground_H_cell
        height, width = view.image_bgr.shape[:2]
        window = seen_window(view, image_H_cell, self._weight.shape, self.coarsest_m / d)
        if window is None:
            return None
        rows, columns = window
        uv, scale, opacity = look_up(
            view,
            image_H_cell,
            np.arange(rows.start, rows.stop),
            np.arange(columns.start, columns.stop),
            self.coarsest_m / d,
        )
        if not np.any(opacity > 0):
            return None
        if view.exclude_px is not None and len(view.exclude_px):
            shown = cv2.remap(shown_mask(view.exclude_px, height, width), *uv, cv2.INTER_LINEAR)
            opacity = opacity * (shown.astype(np.float32) / np.float32(255))
        weight = opacity * scale**4 * np.float32(view.weight)
        return _Layer(rows, columns, sample(view.image_bgr, uv, scale), weight, opacity)

    def _gains(self, layers: list[_Layer]) -> Array:
        """Gains (L, 3), one a layer and color channel, that level the colors where layers overlap."""
        anchor = _Layer(
            slice(0, self._weight.shape[0]),
            slice(0, self._weight.shape[1]),
            self._sum,
            self._weight,
            self._opacity,
            True,
        )
        everything = [*layers, anchor]
        count = len(layers)
        normal, right = np.eye(count) * 0.05, np.zeros((count, 3))
        for i in range(count):
            for j in range(i + 1, count + 1):
                ratio = _log_ratio(everything[i], everything[j])
                if ratio is None:
                    continue
                normal[i, i] += 1
                right[i] -= ratio
                if j < count:
                    normal[j, j] += 1
                    normal[i, j] -= 1
                    normal[j, i] -= 1
                    right[j] += ratio
        return np.exp(np.clip(np.linalg.solve(normal, right), -0.7, 0.7)) if count else right


def write_picture(picture: TopdownPicture, path: Path | str, *, overwrite: bool = False) -> None:
    """Write a picture as PNG with its coverage as alpha channel, or as JPEG on white, whole or not at all."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".jpg", ".jpeg"):
        raise ConfigError(f"{path}: a top-down picture is written as .png, .jpg or .jpeg, not '{path.suffix}'")
    refuse_existing(path, overwrite=overwrite)
    if suffix == ".png":
        image = np.dstack([picture.image_bgr, picture.alpha])
    else:
        alpha = picture.alpha[..., None] / 255.0
        image = np.rint(picture.image_bgr * alpha + 255 * (1 - alpha)).astype(np.uint8)
    with replaced(path) as temporary:
        done, data = cv2.imencode(suffix, image)
        if not done:
            raise ConfigError(f"{path}: OpenCV cannot encode a picture of {image.shape[1]} x {image.shape[0]} px")
        temporary.write_bytes(data.tobytes())


@dataclass(frozen=True, eq=False)
class _Layer:
    rows: slice
    columns: slice
    color: NDArray[Any]
    weight: NDArray[np.float32]
    opacity: NDArray[np.float32]
    weighted: bool = False
    """Whether `color` is a sum that is still to be divided by `weight`."""


def _raster_shape(extent_m: tuple[float, float, float, float], resolution_m: float) -> tuple[int, int]:
    x0, x1, y0, y1 = extent_m
    if not (np.all(np.isfinite(extent_m)) and x1 > x0 and y1 > y0 and resolution_m > 0):
        raise ConfigError(f"top-down picture: extent {extent_m} at {resolution_m} m a cell has no area")
    rows, columns = round(np.ceil((y1 - y0) / resolution_m - 1e-6)), round(np.ceil((x1 - x0) / resolution_m - 1e-6))
    if rows * columns > MAX_CELLS or max(rows, columns) >= 32767:
        raise ConfigError(
            f"top-down picture: {columns} x {rows} cells, more than the {MAX_CELLS} allowed (32766 an edge); "
            f"choose a resolution coarser than {resolution_m:g} m or a smaller extent"
        )
    return rows, columns


def _log_ratio(a: _Layer, b: _Layer, step: int = 4, fewest: int = 100) -> Array | None:
    """Log of a's mean color over b's (3,) on cells that both see well; None when these are too few."""
    r0, r1 = max(a.rows.start, b.rows.start), min(a.rows.stop, b.rows.stop)
    c0, c1 = max(a.columns.start, b.columns.start), min(a.columns.stop, b.columns.stop)
    if r0 >= r1 or c0 >= c1:
        return None
    part = []
    for layer in (a, b):
        place = (
            slice(r0 - layer.rows.start, r1 - layer.rows.start, step),
            slice(c0 - layer.columns.start, c1 - layer.columns.start, step),
        )
        part.append((layer.color[place], layer.weight[place], layer.opacity[place], layer.weighted))
    both = (part[0][2] > 0.5) & (part[1][2] > 0.5)
    if np.count_nonzero(both) < fewest:
        return None
    means = []
    for color, weight, _, weighted in part:
        values = color[both].astype(np.float64)
        means.append((values / weight[both][:, None] if weighted else values).mean(axis=0))
    return np.log(np.maximum(means[0], 1.0) / np.maximum(means[1], 1.0))
