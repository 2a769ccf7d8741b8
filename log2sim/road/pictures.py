"""Pictures warped onto the ground, their colors on a raster, and what hides it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.geometry import Array, Camera, inverse, project, project_moving
from log2sim.perception.lidar.projection import poses_around
from log2sim.road.ground_map import Raster
from log2sim.road.surface import Surface, upsample

# Levels of the image pyramid above the image itself, to average pixels where many fall into one cell.
PYRAMID_LEVELS = 4
# Opacity rises from the image border inwards over this share of the width, which feathers seams.
FEATHER_SHARE = 0.04
SAMPLES_A_ROW = 1024

Image = NDArray[np.uint8]


def sample_at(
    image: Image, u: NDArray[np.float32], v: NDArray[np.float32], scale: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Sample colors (N, 3) at pixels (N,), from higher levels of an image pyramid where a cell's edge is several pixels (N,) long."""
    level = np.clip(np.rint(np.log2(np.maximum(scale, 1e-6))), 0, PYRAMID_LEVELS).astype(np.int8)
    out = np.zeros((len(level), 3), dtype=np.uint8)
    highest = int(level.max(initial=0))
    for k in range(highest + 1):
        chosen = np.flatnonzero(level == k)
        if len(chosen):
            # In rows, since OpenCV takes no longer ones.
            rows = -(-len(chosen) // SAMPLES_A_ROW), SAMPLES_A_ROW
            at = [np.resize(a[chosen] * np.float32(0.5**k), rows) for a in (u, v)]
            seen = cv2.remap(image, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            out[chosen] = seen.reshape(-1, 3)[: len(chosen)]
        if k < highest:
            image = np.asarray(cv2.pyrDown(image), dtype=np.uint8)
    return out


# Cells longer than this under one pixel are left out: four times the width of a lane marking.
COARSEST_M = 0.6
MIN_OPACITY = 0.01
MAX_REACH_M = 100.0
# Cells of the surface between those that are projected first, to find the part of the map that is in view.
PROBE_STEP = 8
# Pixels of the picture for one of the depths of what hides the ground: about as far apart as neighboring rings of a LiDAR.
DEPTH_SHRINK = 24
# Ground hides nothing of itself, though its depth at the edge of such a pixel is another than in its middle.
MIN_HIDDEN_BY, MIN_HIDDEN_BY_M = 0.08, 0.5
NOTHING_M = 1e6
Pixel = TypeVar("Pixel", np.uint8, np.float32)


@dataclass(frozen=True, eq=False)
class Warp:
    """Where the cells of a map that are in view appear in a picture, N cells."""

    cell: NDArray[np.int64]  # (N,): number of the cell in the map, row by row
    u: NDArray[np.float32]  # `u`, `v`: (N,), px
    v: NDArray[np.float32]
    scale: NDArray[np.float32]  # (N,): pixels along a cell's edge, geometric mean of both directions
    opacity: NDArray[np.float32]  # (N,): in (0, 1]
    depth_m: NDArray[np.float32]  # (N,): along the optical axis

    def take(self, kept: NDArray[np.bool_]) -> Warp:
        """Choose cells by a mask (N,)."""
        chosen = np.flatnonzero(kept)
        return Warp(*(getattr(self, f.name).take(chosen) for f in fields(self)))


@dataclass(frozen=True, eq=False)
class View:
    """A picture's camera at the time of the picture."""

    camera: Camera
    map_T_cam: Array  # (4, 4)
    t_ns: int = 0
    log: Log | None = None  # where the camera is while its lines are read, one after the other

    def project(self, points: Array) -> tuple[Array, Array]:
        """Project points (N, 3), m, map frame: pixels (N, 2), NaN behind the camera, and depths (N,), m."""
        if self.log is None or self.camera.rolling_shutter is None or self.camera.mount == "map":
            cam_T_map = inverse(self.map_T_cam)
            local = points @ cam_T_map[:3, :3].T + cam_T_map[:3, 3]
            return project(self.camera, local)[0], local[:, 2]
        uv, depth, _ = project_moving(self.camera, points, poses_around(self.log, self.camera.name, self.t_ns))
        return uv, depth


def warp_onto(view: View, surface: Surface, z0_m: float, raster: Raster, coarsest_m: float = COARSEST_M) -> Warp | None:
    """Find the cells of a raster in a picture; None where it shows none.

    `surface`: with the north-west corner of the raster and cells a whole number of times as long. `z0_m`: height of
    reference of the surface, m. `coarsest_m`: ground longer than this under one pixel is left out, m.
    """
    window = _window(view, surface, z0_m, coarsest_m)
    if window is None:
        return None
    every = [np.arange(k.start, k.stop) for k in window]
    uv, depth, usable = _project_nodes(view, surface, z0_m, every[0], every[1])
    factor = round(surface.raster.resolution_m / raster.resolution_m)
    scale, opacity = _quality(view.camera, uv, usable, factor, coarsest_m / raster.resolution_m)
    if not opacity.any():
        return None
    row, column = (k.start * factor for k in window)
    shape = min(window[0].stop * factor, raster.shape[0]) - row, min(window[1].stop * factor, raster.shape[1]) - column
    fine_opacity = upsample(opacity, factor, shape)
    seen = np.flatnonzero(fine_opacity > MIN_OPACITY)
    nodes = np.where(np.isfinite(uv), uv, -1e4).astype(np.float32)
    u, v, fine_scale, fine_depth = (
        upsample(np.ascontiguousarray(layer, np.float32), factor, shape).ravel().take(seen)
        for layer in (nodes[..., 0], nodes[..., 1], scale, depth)
    )
    cell = seen // shape[1] * raster.shape[1] + seen % shape[1] + row * raster.shape[1] + column
    return Warp(cell, u, v, fine_scale, fine_opacity.ravel().take(seen), fine_depth)


def _window(view: View, surface: Surface, z0_m: float, coarsest_m: float) -> tuple[slice, slice] | None:
    """Rows and columns of the surface around all cells in view."""
    raster, place = surface.raster, view.map_T_cam[:3, 3]
    (row,), (column,) = raster.cells_of(place[None, :2])
    r, c = (int(np.clip(round(at), 0, n - 1)) for at, n in zip((row, column), raster.shape))
    height_m = float(place[2] - z0_m - surface.z_m[r, c])
    # As far from the camera a pixel is that long on the ground.
    reach_m = min(float(np.sqrt(coarsest_m * view.camera.K[1, 1] * max(height_m, 0.5))), MAX_REACH_M)
    reach = int(reach_m / raster.resolution_m)
    low = [max(round(at) - reach, 0) for at in (row, column)]
    high = [min(round(at) + reach + 1, n) for at, n in zip((row, column), raster.shape)]
    if low[0] >= high[0] or low[1] >= high[1]:
        return None
    nodes = [np.unique(np.append(np.arange(a, b, PROBE_STEP), b - 1)) for a, b in zip(low, high)]
    _, _, usable = _project_nodes(view, surface, z0_m, nodes[0], nodes[1])
    if not usable.any():
        return None
    found = [nodes[axis][usable.any(axis=1 - axis)][[0, -1]].tolist() for axis in (0, 1)]
    rows, columns = (
        slice(max(first - PROBE_STEP, a), min(last + PROBE_STEP, b)) for (first, last), a, b in zip(found, low, high)
    )
    return rows, columns


def _project_nodes(
    view: View, surface: Surface, z0_m: float, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Project cells of the surface: pixels (r, c, 2), depths (r, c), m, and whether they are in the picture (r, c)."""
    xy = surface.raster.xy_of(rows[:, None], columns[None, :])
    z = surface.z_m[np.ix_(rows, columns)] + z0_m
    uv, depth = view.project(np.concatenate([xy, z[..., None]], axis=2).reshape(-1, 3))
    camera = view.camera
    with np.errstate(invalid="ignore"):
        inside = np.all((uv >= 0) & (uv <= [camera.width_px - 1, camera.height_px - 1]), axis=1)
    return uv.reshape(*z.shape, 2), depth.reshape(z.shape), inside.reshape(z.shape)


def _quality(
    camera: Camera, uv: Array, usable: NDArray[np.bool_], factor: int, coarsest_cells: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pixels along the edge of a fine cell, and opacity, of nodes (r, c)."""
    if min(usable.shape) < 2:
        return np.zeros(usable.shape, np.float32), np.zeros(usable.shape, np.float32)
    with np.errstate(invalid="ignore"):
        # Over a few cells, so that what is left of noise in the heights makes no holes.
        along, across = (cv2.blur(np.gradient(uv, axis=axis) / factor, (5, 5)) for axis in (0, 1))
        area = np.abs(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0])
        norm = (along**2 + across**2).sum(axis=2)
        largest = np.sqrt((norm + np.sqrt(np.maximum(norm**2 - 4 * area**2, 0))) / 2)
        finest = np.divide(area, largest, out=np.zeros_like(area), where=largest > 0)
        edge = np.minimum(uv, np.array([camera.width_px - 1, camera.height_px - 1]) - uv).min(axis=2)
        opacity = np.minimum(edge / (FEATHER_SHARE * camera.width_px), (finest * coarsest_cells - 1) / 0.5)
    known = cv2.erode((usable & np.isfinite(area)).astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    opacity = np.where(known, np.clip(opacity, 0, 1), 0)
    return np.where(known, np.sqrt(area), 0).astype(np.float32), opacity.astype(np.float32)


def find_hidden(view: View, warp: Warp, hiding: Array) -> NDArray[np.bool_]:
    """Mark the cells (N,) of a warp that are behind points (H, 3), m, map frame, of what stands on the ground."""
    uv, depth = view.project(hiding)
    width, height = (-(-n // DEPTH_SHRINK) for n in (view.camera.width_px, view.camera.height_px))
    with np.errstate(invalid="ignore"):
        column, row = np.floor(uv / DEPTH_SHRINK).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    nearest = np.full(height * width, NOTHING_M)  # in double precision `ufunc.at` takes a twentieth of the time
    np.minimum.at(nearest, (row[inside] * width + column[inside]).astype(np.int64), depth[inside])
    # Between two rings of points there is the same object.
    near = nearest.reshape(height, width).astype(np.float32)
    image = np.asarray(cv2.erode(near, np.ones((3, 1), np.uint8)), np.float32)
    shown = sample_nearest(image, warp, DEPTH_SHRINK, np.float32(NOTHING_M))
    return np.asarray(warp.depth_m > shown * (1 + MIN_HIDDEN_BY) + MIN_HIDDEN_BY_M)


def sample_nearest(image: NDArray[Pixel], warp: Warp, shrink: int, outside: Pixel) -> NDArray[Pixel]:
    """Look up in an image, `shrink` times smaller than the picture, what cells (N,) of a warp show."""
    column, row = (np.rint(a / shrink - np.float32(0.5)).astype(np.int32) for a in (warp.u, warp.v))
    height, width = image.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen = image.ravel().take(np.where(inside, row * width + column, 0))
    return np.where(inside, seen, outside).astype(image.dtype)


# Cells between those that are compared for the exposure.
STEP = 4
MIN_COMMON_CELLS = 100
# What an overlap tells of an exposure counts as much as that it is usual, as in Brown and Lowe: noise of 10 levels of 100 against a
# tenth. Counted whole, what is brighter far away than near, as wet roads are, would make each picture brighter than the last.
OVERLAP_SHARE = 0.5
# An exposure may differ from what is mapped so far by at most one stop.
MAX_LOG_GAIN = 0.7
# Finer pixels do not show more of a cell, but they are those of the nearest view.
MAX_SCALE = 4.0
# Darker values, of 255, say little about the exposure, and brighter ones are clipped.
DARKEST, BRIGHTEST = 10.0, 245.0
MIN_COMMON_OPACITY = 0.5


class ColorRaster:
    """Accumulate pictures that were warped onto a raster.

    Weights are the fourth power of the pixels along a cell's edge, so that the nearest view decides and far ones only fill the
    rest. The gain of a picture is between 1 and the median ratio of its colors to those mapped so far, after Brown and Lowe (2007),
    section 6, but one picture after the other; without an overlap it is that of the last picture of its camera.
    """

    def __init__(self, raster: Raster) -> None:
        self.raster = raster
        self._sum = np.zeros((*raster.shape, 3), dtype=np.float32)
        self._weight = np.zeros(raster.shape, dtype=np.float32)
        self._opacity = np.zeros(raster.shape, dtype=np.uint8)
        self.gains: dict[str, list[Array]] = {}

    def add(self, camera: str, image: Image, warp: Warp) -> None:
        """Add a picture of a camera, as far as a warp shows it."""
        color = sample_at(image, warp.u, warp.v, warp.scale).astype(np.float32)
        weight = warp.opacity * np.minimum(warp.scale, MAX_SCALE) ** 4
        gain = self._gain(camera, color, weight, warp)
        color *= weight[:, None] * gain.astype(np.float32)
        # Each cell is there once.
        self._sum.reshape(-1, 3)[warp.cell] += color
        self._weight.reshape(-1)[warp.cell] += weight
        opacity = self._opacity.reshape(-1)
        opacity[warp.cell] = np.maximum(opacity.take(warp.cell), np.rint(255 * warp.opacity).astype(np.uint8))

    def image(self) -> tuple[Image, Image]:
        """Return colors (R, C, 3) and opacity (R, C)."""
        seen = self._weight > 0
        color = np.empty((*self.raster.shape, 3), dtype=np.uint8)
        for k in range(3):  # by channel, so that no second array of floats is made of all
            mean = np.divide(self._sum[..., k], self._weight, out=np.zeros_like(self._weight), where=seen)
            color[..., k] = np.clip(np.rint(mean), 0, 255)
        return color, np.where(seen, np.maximum(self._opacity, 1), 0).astype(np.uint8)

    def _gain(self, camera: str, color: NDArray[np.float32], weight: NDArray[np.float32], warp: Warp) -> Array:
        """Gains (3,) of a picture's channels that fit it to what is mapped so far."""
        cell, width = warp.cell, self.raster.shape[1]
        some = np.flatnonzero((warp.opacity > MIN_COMMON_OPACITY) & (weight > 0))
        some = some[(cell[some] // width % STEP == 0) & (cell[some] % width % STEP == 0)]
        some = some[self._opacity.reshape(-1)[cell[some]] > 255 * MIN_COMMON_OPACITY]
        some = some[np.all((color[some] > DARKEST) & (color[some] < BRIGHTEST), axis=1)]
        last = self.gains.setdefault(camera, [])
        if len(some) < MIN_COMMON_CELLS:
            gain = last[-1] if last else np.ones(3)
        else:
            mapped = self._sum.reshape(-1, 3)[cell[some]] / self._weight.reshape(-1)[cell[some], None]
            ratio = mapped / color[some]
            log_ratio = np.log(np.maximum(np.median(ratio, axis=0), 1e-3))
            gain = np.exp(np.clip(OVERLAP_SHARE * log_ratio, -MAX_LOG_GAIN, MAX_LOG_GAIN))
        last.append(np.asarray(gain, dtype=np.float64))
        return last[-1]


# Rows of pictures whose median is taken at a time, which bounds the memory.
ROWS_AT_A_TIME = 64


def median_picture(images: Sequence[Image], users: Sequence[NDArray[np.uint8]]) -> tuple[Image, NDArray[np.uint8]]:
    """Return the median of pictures (H, W, 3), and the mask (h, w) that is 1 where more than half of theirs show road users."""
    out = np.empty_like(images[0])
    for k in range(0, len(out), ROWS_AT_A_TIME):
        rows = slice(k, k + ROWS_AT_A_TIME)
        out[rows] = np.median([image[rows] for image in images], axis=0).astype(np.uint8)
    often = 2 * np.sum(users, axis=0, dtype=np.int64) > len(users)
    return out, np.asarray(often, dtype=np.uint8)
