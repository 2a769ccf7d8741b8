"""Pictures warped onto the ground as it is, cell by cell: where each cell appears, how finely, and whether it is in view."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S, Array, Camera, inverse, project, project_moving
from log2sim.mapping.raster import Raster
from log2sim.mapping.surface import Surface, upsample

# Cells longer than this under one pixel are left out: four times the width of a lane marking.
COARSEST_M = 0.6
# Opacity rises from the image border inwards over this share of the width, which feathers seams.
FEATHER_SHARE = 0.04
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
    """Where the cells of a map that are in view appear in a picture, N cells.

    Attributes
    ----------
    rows, columns : (N,) int64
        Of the cells in the map.
    u, v : (N,) float32, px
    scale : (N,) float32
        Pixels along a cell's edge, geometric mean of both directions.
    opacity : (N,) float32
        In (0, 1].
    depth_m : (N,) float32, m
        Along the optical axis.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    scale: NDArray[np.float32]
    opacity: NDArray[np.float32]
    depth_m: NDArray[np.float32]

    def take(self, kept: NDArray[np.bool_]) -> Warp:
        """Choose cells by a mask (N,)."""
        return Warp(*(getattr(self, f.name)[kept] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class View:
    """A picture's camera at the time of the picture.

    Attributes
    ----------
    log : Log
    camera : Camera
    t_ns : int
    map_T_cam : (4, 4) float64
    """

    log: Log
    camera: Camera
    t_ns: int
    map_T_cam: Array

    def project(self, points: Array) -> tuple[Array, Array]:
        """Project points (N, 3), m, map frame: pixels (N, 2), NaN behind the camera, and depths (N,), m.

        Lines that are read one after the other see the ground from where the camera is then.
        """
        if self.camera.rolling_shutter is None or self.camera.mount == "map":
            cam_T_map = inverse(self.map_T_cam)
            local = points @ cam_T_map[:3, :3].T + cam_T_map[:3, 3]
            return project(self.camera, local)[0], local[:, 2]
        uv, depth, _ = project_moving(self.camera, points, self._cam_T_map)
        return uv, depth

    def _cam_T_map(self, t_s: Array) -> Array:
        poses, known = self.log.map_T_sensor(self.camera.name, self.t_ns + np.round(t_s * NS_PER_S).astype(np.int64))
        return inverse(np.where(known[:, None, None], poses, self.map_T_cam))


def warp_onto(view: View, surface: Surface, z0_m: float, raster: Raster) -> Warp | None:
    """Find the cells of a raster in a picture; None where it shows none.

    Parameters
    ----------
    view : View
    surface : Surface
        With the north-west corner of the raster and cells a whole number of times as long.
    z0_m : float
        Height of reference of the surface, m.
    raster : Raster
    """
    window = _window(view, surface, z0_m)
    if window is None:
        return None
    rows, columns = window
    every = [np.arange(k.start, k.stop) for k in window]
    uv, depth, usable = _project_nodes(view, surface, z0_m, every[0], every[1])
    factor = round(surface.raster.resolution_m / raster.resolution_m)
    scale, opacity = _quality(view.camera, uv, usable, factor, raster.resolution_m)
    if not opacity.any():
        return None
    shape = (
        min(rows.stop * factor, raster.shape[0]) - rows.start * factor,
        min(columns.stop * factor, raster.shape[1]) - columns.start * factor,
    )
    fine_opacity = upsample(opacity, factor, shape)
    row, column = np.nonzero(fine_opacity > MIN_OPACITY)
    nodes = np.where(np.isfinite(uv), uv, -1e4).astype(np.float32)
    u, v, fine_scale, fine_depth = (
        upsample(np.ascontiguousarray(layer, np.float32), factor, shape)[row, column]
        for layer in (nodes[..., 0], nodes[..., 1], scale, depth)
    )
    place = (row + rows.start * factor, column + columns.start * factor)
    return Warp(*place, u, v, fine_scale, fine_opacity[row, column], fine_depth)


def reach_of(camera: Camera, height_m: float) -> float:
    """Return how far from the camera a pixel is as long on the ground as `COARSEST_M`, m."""
    return min(float(np.sqrt(COARSEST_M * camera.K[1, 1] * max(height_m, 0.5))), MAX_REACH_M)


def _window(view: View, surface: Surface, z0_m: float) -> tuple[slice, slice] | None:
    """Rows and columns of the surface around all cells in view."""
    raster, place = surface.raster, view.map_T_cam[:3, 3]
    (row,), (column,) = raster.cells_of(place[None, :2])
    r, c = (int(np.clip(round(at), 0, n - 1)) for at, n in zip((row, column), raster.shape))
    height_m = float(place[2] - z0_m - surface.z_m[r, c])
    reach = int(reach_of(view.camera, height_m) / raster.resolution_m)
    low = [max(round(at) - reach, 0) for at in (row, column)]
    high = [min(round(at) + reach + 1, n) for at, n in zip((row, column), raster.shape)]
    if low[0] >= high[0] or low[1] >= high[1]:
        return None
    nodes = [np.unique(np.append(np.arange(a, b, PROBE_STEP), b - 1)) for a, b in zip(low, high)]
    _, _, usable = _project_nodes(view, surface, z0_m, nodes[0], nodes[1])
    if not usable.any():
        return None
    found = [nodes[axis][usable.any(axis=1 - axis)] for axis in (0, 1)]
    spans = [
        slice(max(int(k[0]) - PROBE_STEP, a), min(int(k[-1]) + PROBE_STEP, b)) for k, a, b in zip(found, low, high)
    ]
    return spans[0], spans[1]


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
    camera: Camera, uv: Array, usable: NDArray[np.bool_], factor: int, cell_m: float
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
        opacity = np.minimum(edge / (FEATHER_SHARE * camera.width_px), (finest * COARSEST_M / cell_m - 1) / 0.5)
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
    nearest = np.full(height * width, NOTHING_M, np.float32)
    cell = (row[inside] * width + column[inside]).astype(np.int64)
    np.minimum.at(nearest, cell, depth[inside].astype(np.float32))
    # Between two rings of points there is the same object.
    image = np.asarray(cv2.erode(nearest.reshape(height, width), np.ones((3, 1), np.uint8)), np.float32)
    shown = sample_nearest(image, warp, DEPTH_SHRINK, np.float32(NOTHING_M))
    return np.asarray(warp.depth_m > shown * (1 + MIN_HIDDEN_BY) + MIN_HIDDEN_BY_M)


def sample_nearest(image: NDArray[Pixel], warp: Warp, shrink: int, outside: Pixel) -> NDArray[Pixel]:
    """Look up in an image, `shrink` times smaller than the picture, what cells (N,) of a warp show."""
    column, row = (np.rint(a / shrink - np.float32(0.5)).astype(np.int32) for a in (warp.u, warp.v))
    height, width = image.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen = image.ravel().take(np.where(inside, row * width + column, 0))
    return np.where(inside, seen, outside).astype(image.dtype)
