"""Bird's-eye views of one tick or of many by inverse perspective mapping, without the heights of the ground.

Where several cameras or ticks see the same cell, the one that resolves the ground finest weighs most, seams are feathered
and exposures are balanced. Only the ground is mapped rightly: objects above it lean away from the camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import ConfigError
from log2sim.files.documents import refuse_existing, replaced
from log2sim.geometry import Array, inverse
from log2sim.perception.frames import RecordReader
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.observe_tick import base_pose
from log2sim.perception.seams import roads_at
from log2sim.perception.sync import Schedule
from log2sim.road.ground_map import Raster
from log2sim.road.pictures import GroundView, Image, project_cells, sample_colors, signed_inverse, visible_window

__all__ = ["BirdsEyeView", "GroundView", "Mosaic", "render_birdseye", "write_image"]


@dataclass(frozen=True, eq=False)
class BirdsEyeView:
    """North-up raster of the ground.

    Attributes
    ----------
    image_bgr : (R, C, 3) uint8
        Row 0 is the northernmost.
    alpha : (R, C) uint8
        0 where no camera saw the ground.
    extent_m : (float, float, float, float)
        x0, x1, y0, y1 of the outer edges, m.
    resolution_m : float
        Edge of a cell, m.
    frame : str
        "map" or "ego".
    """

    image_bgr: Image
    alpha: Image
    extent_m: tuple[float, float, float, float]
    resolution_m: float
    frame: str = "map"

    @property
    def coverage(self) -> NDArray[np.bool_]:
        """Mask (R, C) of the cells that a camera saw."""
        return self.alpha > 0


def render_birdseye(
    views: Sequence[GroundView],
    *,
    extent_m: tuple[float, float, float, float],
    resolution_m: float = 0.05,
    coarsest_m: float = 0.6,
    frame: str = "map",
) -> BirdsEyeView:
    """Render the views of one tick; `Mosaic` does the same over many ticks.

    Parameters
    ----------
    extent_m : x0, x1, y0, y1
    resolution_m : edge of a cell, > 0.
    coarsest_m : ground longer than this under one pixel is left out, > 0.
    """
    mosaic = Mosaic(extent_m=extent_m, resolution_m=resolution_m, coarsest_m=coarsest_m, frame=frame)
    mosaic.add(views)
    return mosaic.image()


class Mosaic:
    """Accumulator of views, tick after tick, into one bird's-eye view.

    Notes
    -----
    Colors are averaged with the square of the image's resolution on the ground as weight, so the nearest view of a cell
    decides its color and far views only fill the rest. Gains that balance exposures follow Brown and Lowe (2007), section
    6, relative to what the mosaic already holds.
    """

    def __init__(
        self,
        *,
        extent_m: tuple[float, float, float, float],
        resolution_m: float = 0.05,
        coarsest_m: float = 0.6,
        frame: str = "map",
    ) -> None:
        raster = Raster.covering(extent_m, resolution_m)
        (rows, columns), self.extent_m = raster.shape, raster.extent_m
        self.resolution_m = resolution_m
        self.coarsest_m = coarsest_m
        self.frame = frame
        self._sum = np.zeros((rows, columns, 3), dtype=np.float32)
        self._weight = np.zeros((rows, columns), dtype=np.float32)
        self._opacity = np.zeros((rows, columns), dtype=np.float32)

    def add(self, views: Sequence[GroundView]) -> None:
        """Add the views of one tick."""
        layers = [layer for layer in (self._warp(view) for view in views) if layer is not None]
        for layer, gain in zip(layers, self._gains(layers)):
            place = (layer.rows, layer.columns)
            self._sum[place] += layer.color * (gain.astype(np.float32) * layer.weight[..., None])
            self._weight[place] += layer.weight
            np.maximum(self._opacity[place], layer.opacity, out=self._opacity[place])

    def image(self) -> BirdsEyeView:
        """Compose the image of all views so far."""
        seen = self._weight > 0
        color = np.divide(self._sum, self._weight[..., None], out=np.zeros_like(self._sum), where=seen[..., None])
        image = np.clip(np.rint(color), 0, 255).astype(np.uint8)
        alpha = np.where(seen, np.maximum(np.rint(255 * self._opacity), 1), 0).astype(np.uint8)
        return BirdsEyeView(image, alpha, self.extent_m, self.resolution_m, self.frame)

    def _warp(self, view: GroundView) -> _Layer | None:
        """Warp one view onto the part of the raster that it sees."""
        x0, _, _, y1 = self.extent_m
        d = self.resolution_m
        ground_H_cell = np.array([[d, 0, x0 + d / 2], [0, -d, y1 - d / 2], [0, 0, 1]])
        image_H_cell = signed_inverse(view) @ ground_H_cell
        window = visible_window(view, image_H_cell, self._weight.shape, self.coarsest_m / d)
        if window is None:
            return None
        rows, columns = window
        uv, scale, opacity = project_cells(
            view,
            image_H_cell,
            np.arange(rows.start, rows.stop),
            np.arange(columns.start, columns.stop),
            self.coarsest_m / d,
        )
        if not np.any(opacity > 0):
            return None
        weight = opacity * scale**4 * np.float32(view.weight)
        return _Layer(rows, columns, sample_colors(view.image_bgr, uv, scale), weight, opacity)

    def _gains(self, layers: list[_Layer]) -> Array:
        """Compute the gains (L, 3) of layers and color channels that balance exposures where layers overlap."""
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


def write_image(view: BirdsEyeView, path: Path | str, *, overwrite: bool = False) -> None:
    """Write a bird's-eye view as PNG with alpha channel, or as JPEG on white, whole or not at all."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".jpg", ".jpeg"):
        raise ConfigError(f"{path}: a bird's-eye view is written as .png, .jpg or .jpeg, not '{path.suffix}'")
    refuse_existing(path, overwrite=overwrite)
    if suffix == ".png":
        image = np.dstack([view.image_bgr, view.alpha])
    else:
        alpha = view.alpha[..., None] / 255.0
        image = np.rint(view.image_bgr * alpha + 255 * (1 - alpha)).astype(np.uint8)
    with replaced(path) as temporary:
        done, data = cv2.imencode(suffix, image)
        if not done:
            raise ConfigError(f"{path}: OpenCV cannot encode an image of {image.shape[1]} x {image.shape[0]} px")
        temporary.write_bytes(data.tobytes())


@dataclass(frozen=True, eq=False)
class _Layer:
    """Colors of one view on a window of the raster; with `weighted` they are still to be divided by `weight`."""

    rows: slice
    columns: slice
    color: NDArray[Any]
    weight: NDArray[np.float32]
    opacity: NDArray[np.float32]
    weighted: bool = False


def _log_ratio(a: _Layer, b: _Layer, step: int = 4, fewest: int = 100) -> Array | None:
    """Compute the logarithm (3,) of the ratio of mean colors on cells that both layers see well; None if too few."""
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
    return np.asarray(np.log(np.maximum(means[0], 1.0) / np.maximum(means[1], 1.0)))


# A pixel of a camera on a car shows about half a meter of road along the line of sight at this distance.
REACH_M = 25.0
CELL_M = 0.05


def fuse_tick(
    log: Log,
    schedule: Schedule,
    homographies: Mapping[str, CameraHomography],
    tick: int,
    reader: RecordReader,
    *,
    reach_m: float = REACH_M,
    cell_m: float = CELL_M,
) -> BirdsEyeView:
    """Draw the pictures of a tick on the road around the cameras, with gains that balance their exposures.

    Cameras without a frame at the tick, without a homography, or with a picture that cannot be read are left out. The picture
    is in the ground frame: that of the ego at the stamp of the tick, or that of the map for cameras at the road.
    """
    map_T_base = base_pose(log, int(schedule.t_ns[tick]))
    views, places = [], []
    for name, road in roads_at(log, schedule, homographies, tick).items():
        index = int(schedule.frames[name][tick])
        image = reader.get(name, index)
        if image is not None:
            views.append(GroundView(image, road, log.cameras[name], signed=True))
            pose = log.map_T_sensor(name, int(log.streams[name].t_ns[index]))[0][0]
            places.append((inverse(map_T_base) @ pose)[:2, 3])
    x, y = np.mean(places, axis=0).tolist() if places else (0.0, 0.0)
    extent = (x - reach_m, x + reach_m, y - reach_m, y + reach_m)
    return render_birdseye(views, extent_m=extent, resolution_m=cell_m, frame="ego" if log.ego is not None else "map")
