"""Ground that is not level in a picture: rays against the terrain, colors from the tiles of the ground."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.synth.ground import GROUND_M_PER_PX, LEVELS, MEADOW, TILE_PX, Ground
from log2sim.synth.light import Light
from log2sim.synth.polytope_caster import Terrain
from log2sim.synth.render_camera import RenderCamera
from log2sim.synth.scenery import FAR_M, MIN_FALL, Image, Texture, linear

NEWTON_STEPS = 3
MAX_ERROR_M = 0.05  # of the terrain's height where a ray meets it
MAX_MOSAIC_TILES = 24  # along a side: 113 MB at most
REACH_M = 250.0  # beyond which the ground is as level as it is under the camera
Flags = NDArray[np.bool_]


def draw_terrain(
    view: RenderCamera, ground: Ground, terrain: Terrain, light: Light, color: Image, depth: Image
) -> None:
    """Draw the ground below the horizon."""
    by_column, by_row = view.rays()
    fall = -(by_row[:, None, 2] + by_column[None, :, 2])
    rows = np.flatnonzero((fall > MIN_FALL).any(1))
    if len(rows) == 0:
        return
    band = slice(int(rows[0]), int(rows[-1]) + 1)
    dx = by_row[band, None, 0] + by_column[None, :, 0]
    dy = by_row[band, None, 1] + by_column[None, :, 1]
    eye = view.map_T_cam[:3, 3].astype(np.float32)
    under = terrain.height(eye[:1], eye[1:2]) + terrain.relief(eye[:1], eye[1:2])
    level = np.maximum(eye[2] - under[0], np.float32(0.1)) / np.maximum(fall[band], np.float32(1e-6))
    level = np.minimum(level, np.float32(FAR_M))
    away, met = _distances(terrain, eye, (dx, dy, -fall[band]), np.minimum(level, np.float32(REACH_M)))
    away = np.where(met, away, level)
    seen = met | (fall[band] > MIN_FALL)
    x, y = eye[0] + away * dx, eye[1] + away * dy
    lit = linear(_sampled(ground, view, x, y, away, seen), light.on_ground())
    color[band][seen], depth[band][seen] = lit[seen], away[seen]


def _distances(
    terrain: Terrain, eye: NDArray[np.float32], ray: tuple[Image, Image, Image], start: Image
) -> tuple[Image, Flags]:
    """Depth (H, W) at which rays meet the terrain by Newton's method, and whether they do."""
    dx, dy, dz = (np.ravel(r) for r in ray)
    t = start.ravel().copy()
    for _ in range(NEWTON_STEPS):
        x, y = eye[0] + t * dx, eye[1] + t * dy
        sx, sy = terrain.slope(x, y)
        slope = dz - sx * dx - sy * dy
        error = eye[2] + t * dz - terrain.height(x, y)
        t -= error / np.minimum(slope, np.float32(-1e-3))
        np.clip(t, 0.1, 2 * REACH_M, out=t)
    x, y = eye[0] + t * dx, eye[1] + t * dy
    met = np.abs(eye[2] + t * dz - terrain.height(x, y)) < MAX_ERROR_M
    sx, sy = terrain.slope(x, y)
    t += terrain.relief(x, y) / np.minimum(dz - sx * dx - sy * dy, np.float32(-0.02))
    return t.reshape(start.shape), met.reshape(start.shape) & (t.reshape(start.shape) < REACH_M)


def _sampled(ground: Ground, view: RenderCamera, x: Image, y: Image, away: Image, seen: Flags) -> Texture:
    """Colors (H, W, 3) of positions, for each row from the level of tiles whose resolution fits."""
    middle = np.median(away, axis=1)
    slanted = np.sqrt(np.maximum(middle / max(float(view.map_T_cam[2, 3]), 0.5), 1.0))
    footprint = middle / view.K[0, 0] * slanted
    level = np.clip(np.log2(np.maximum(footprint / GROUND_M_PER_PX, 1.0)), 0, LEVELS - 1).astype(int)
    out = np.empty((*x.shape, 3), np.uint8)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(level)) + 1, [len(level)]])
    for first, last in pairwise(edges):
        part = slice(int(first), int(last))
        out[part] = sampled_ground(ground, int(level[first]), x[part], y[part], seen[part])
    return out


def sampled_ground(ground: Ground, level: int, x: Image, y: Image, seen: Flags) -> Texture:
    """Colors (H, W, 3) of positions (H, W) from tiles of a level, or of a coarser one where they would be too many."""
    if not seen.any():
        return np.zeros((*x.shape, 3), np.uint8)
    # On a slope, rays of one row meet the ground near by and far away: coarser tiles, so that all of them fit into memory.
    extent = max(float(np.ptp(x[seen])), float(np.ptp(y[seen])))
    while level < LEVELS - 1 and extent > MAX_MOSAIC_TILES * TILE_PX * GROUND_M_PER_PX * 2**level:
        level += 1
    step = np.float32(GROUND_M_PER_PX * 2**level)
    side = step * np.float32(TILE_PX)
    i, j = (np.floor(v[seen] / side).astype(np.int64) for v in (x, y))
    low = (int(i.min()), int(j.min()))
    shape = (int(j.max()) - low[1] + 1, int(i.max()) - low[0] + 1)
    touched = np.zeros(shape, bool)
    touched[j - low[1], i - low[0]] = True
    mosaic = np.empty((shape[0] * TILE_PX, shape[1] * TILE_PX, 3), np.uint8)
    mosaic[:] = MEADOW
    for row, column in zip(*np.nonzero(touched)):
        tile = ground.tile(level, low[0] + int(column), low[1] + int(row))
        mosaic[row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX] = tile
    u, v = (
        (x - np.float32(low[0]) * side) / step - np.float32(0.5),
        (y - np.float32(low[1]) * side) / step - np.float32(0.5),
    )
    return np.asarray(cv2.remap(mosaic, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
