"""The sky and the ground in a picture."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.ground import GROUND_M_PER_PX, LEVELS, TILE_PX, Ground
from log2sim.synth.light import Light
from log2sim.synth.render_camera import RenderCamera

FAR_M = 2000.0
ROWS_PER_PX = 2  # rows of the ground that are averaged for a pixel, because it is seen at a grazing angle
MIN_FALL = 1e-3  # of a ray of depth 1 that meets the ground
GAMMA = 2.2
_LINEAR = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)

Image = NDArray[np.float32]
Texture = NDArray[np.uint8]


def linear(image: Texture, light: NDArray[np.float32]) -> Image:
    """Light from surfaces of sRGB colors (H, W, 3) in light of a color (3,)."""
    out: Image = cv2.LUT(image, _LINEAR)  # type: ignore[assignment]
    out *= light
    return out


def draw_sky(view: RenderCamera, light: Light) -> tuple[Image, Image]:
    """Draw the sky: the image (H, W, 3) and its depth (H, W) in m."""
    up = view.rise()
    rise = np.clip(up / np.sqrt(1 + up * up) * 1.8, 0, 1)[..., None]
    horizon, zenith = np.array(light.horizon, np.float32), np.array(light.zenith, np.float32)
    color = np.empty((view.height_px, view.width_px, 3), np.float32)
    color[:] = horizon + (zenith - horizon) * rise
    return color, np.full(color.shape[:2], FAR_M, np.float32)


def draw_ground(view: RenderCamera, ground: Ground, light: Light, color: Image, depth: Image) -> None:
    """Draw the ground z = 0 below the horizon."""
    fall = -view.rise()
    rows = np.flatnonzero((fall > MIN_FALL).any(1))
    height = float(view.map_T_cam[2, 3])
    if len(rows) == 0 or height <= 0:
        return
    band = slice(int(rows[0]), int(rows[-1]) + 1)
    below = fall[band] > MIN_FALL
    away = np.divide(np.float32(height), fall[band], out=np.full(below.shape, FAR_M, np.float32), where=below)
    lit = linear(_ground_image(view, ground, band), light.on_ground())
    away, below = (np.broadcast_to(x, lit.shape[:2]) for x in (np.minimum(away, FAR_M), below))
    if below.all():
        color[band], depth[band] = lit, away
    else:
        color[band][below], depth[band][below] = lit[below], away[below]


def _ground_image(view: RenderCamera, ground: Ground, band: slice) -> Texture:
    """Warp the tiles of the ground into rows of the image, for each row from the level whose resolution fits."""
    fine = view.taller(ROWS_PER_PX)
    top = band.start * ROWS_PER_PX
    middle = fine.ground_depth(np.full(fine.height_px, fine.width_px / 2), np.arange(fine.height_px), FAR_M)
    slanted = np.sqrt(np.maximum(middle / (ROWS_PER_PX * fine.map_T_cam[2, 3]), 1.0))
    footprint = middle / fine.K[0, 0] * slanted
    level = np.clip(np.log2(np.maximum(footprint / GROUND_M_PER_PX, 1.0)), 0, LEVELS - 1).astype(int)
    level = level[top : band.stop * ROWS_PER_PX]
    out = np.empty((len(level), fine.width_px, 3), np.uint8)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(level)) + 1, [len(level)]])
    for first, last in pairwise(edges):
        out[first:last] = _warped(fine, ground, int(level[first]), slice(int(top + first), int(top + last)))
    size = (fine.width_px, band.stop - band.start)
    return np.asarray(cv2.resize(out, size, interpolation=cv2.INTER_AREA), np.uint8)


def _warped(fine: RenderCamera, ground: Ground, level: int, rows: slice) -> Texture:
    """Warp the tiles of one level into some rows."""
    step = GROUND_M_PER_PX * 2**level
    eye = fine.map_T_cam[:2, 3]
    corner_u = np.array([0, fine.width_px - 1, fine.width_px - 1, 0]) + np.array([-1, 1, 1, -1])
    corner_v = np.array([rows.start, rows.start, rows.stop, rows.stop]) + np.array([-1, -1, 1, 1])
    away = fine.ground_depth(corner_u, corner_v, FAR_M)[:, None]
    seen = (eye + fine.directions(corner_u, corner_v)[:, :2] * away) / (step * TILE_PX)
    low = np.floor(seen.min(0) - 0.02).astype(int)
    shape = np.floor(seen.max(0) + 0.02).astype(int) - low + 1  # columns and rows of tiles
    mosaic = np.zeros((shape[1] * TILE_PX, shape[0] * TILE_PX, 3), np.uint8)
    for j, i in zip(*np.nonzero(_touched(seen - low, shape))):
        tile = ground.tile(level, int(low[0] + i), int(low[1] + j))
        mosaic[j * TILE_PX : (j + 1) * TILE_PX, i * TILE_PX : (i + 1) * TILE_PX] = tile
    corner = low * TILE_PX * step + step / 2 - eye  # of the mosaic's first pixel, relative to the camera
    ground_H_mosaic = np.array([[step, 0, corner[0]], [0, step, corner[1]], [0, 0, 1]])
    shift = np.array([[1, 0, 0], [0, 1, -rows.start], [0, 0, 1.0]])
    homography = shift @ fine.image_H_plane(np.array([0, 0, -fine.map_T_cam[2, 3]]), *np.eye(3)[:2]) @ ground_H_mosaic
    size = (fine.width_px, rows.stop - rows.start)
    warped = cv2.warpPerspective(mosaic, homography, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.uint8)


def _touched(corners: Array, shape: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of a grid of unit squares, `shape` (2,) columns and rows, a convex polygon (P, 2) touches: (rows, columns)."""
    fineness = 8
    columns, rows = (int(n) * fineness for n in shape)
    mask = np.zeros((rows, columns), np.uint8)
    hull = cv2.convexHull(np.rint((corners * fineness - 0.5) * 16).astype(np.int32))
    cv2.fillConvexPoly(mask, hull, 1, cv2.LINE_8, 4)
    wider = np.asarray(cv2.dilate(mask, np.ones((3, 3), np.uint8)))
    return np.asarray(wider.reshape(rows // fineness, fineness, columns // fineness, fineness).any(axis=(1, 3)))
