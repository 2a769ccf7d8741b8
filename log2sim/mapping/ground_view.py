"""Inverse perspective mapping: pixels of the cells of a ground raster, their resolution in the image, and their colors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, distort, fold_radius, ground_homography

# Levels of the image pyramid above the image itself, to average pixels where many fall into one cell.
PYRAMID_LEVELS = 4
# Opacity rises from the image border inwards over this share of the width, which feathers seams.
FEATHER_SHARE = 0.04
SAMPLES_A_ROW = 1024

Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class GroundView:
    """Camera frame with the homography from its pixels to the ground.

    Attributes
    ----------
    image_bgr : (H, W, 3) uint8
    ground_H_image : (3, 3) float64
        Undistorted pixels to ground positions, m, in the frame of the bird's-eye view.
    camera : Camera or None
        Needed only to distort: without it the image counts as undistorted.
    weight : float
        Trust relative to other views, > 0.
    signed : bool
        Whether the third row of `ground_H_image` is known to be positive below the horizon, as `ground_homography` has
        it. Otherwise the middle of the lowest image row is assumed to see the ground.
    """

    image_bgr: Image
    ground_H_image: Array
    camera: Camera | None = None
    weight: float = 1.0
    signed: bool = False

    @classmethod
    def from_pose(
        cls, image_bgr: Image, camera: Camera, map_T_cam: Array, ground_z_m: float = 0.0, **options: Any
    ) -> GroundView:
        """Make the view of a camera with pose (4, 4) onto the plane z = `ground_z_m` of the frame of the pose."""
        return cls(image_bgr, ground_homography(camera, map_T_cam, ground_z_m), camera, signed=True, **options)


def signed_inverse(view: GroundView) -> Array:
    """Invert the homography to `image_H_ground` (3, 3), with a third row that is positive in front of the camera."""
    height, width = view.image_bgr.shape[:2]
    image_H_ground: Array = np.linalg.inv(view.ground_H_image).astype(np.float64)
    below = view.ground_H_image[2] @ np.array([width / 2, height - 1, 1.0])
    return -image_H_ground if not view.signed and below < 0 else image_H_ground


def project_cells(
    view: GroundView, image_H_cell: Array, rows: NDArray[Any], columns: NDArray[Any], coarsest_cells: float
) -> tuple[tuple[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32], NDArray[np.float32]]:
    """Project the cells of `rows` and `columns` of a raster into the image.

    Parameters
    ----------
    view : GroundView
    image_H_cell : (3, 3) float64
        Column and row of a cell to undistorted pixels.
    rows, columns : (R,), (C,) int
    coarsest_cells : float
        Cells longer than this under one pixel are left out.

    Returns
    -------
    uv : pair of (R, C) float32
        Pixels of the cell centers.
    scale : (R, C) float32
        Pixels along a cell's edge, geometric mean of the two directions.
    opacity : (R, C) float32
        In [0, 1], 0 outside the image.
    """
    h = image_H_cell
    x, y = columns[None, :].astype(np.float64), rows[:, None].astype(np.float64)
    un, vn, w = ((h[k, 0] * x + (h[k, 1] * y + h[k, 2])).astype(np.float32) for k in range(3))
    front = w > np.float32(1e-9 * np.abs(h[2]).max())
    inverse_w = np.divide(1, w, out=np.zeros_like(w), where=front)
    u, v = un * inverse_w, vn * inverse_w
    # Squares would overflow far outside the image, where nothing is needed.
    height, width = view.image_bgr.shape[:2]
    front &= (np.abs(u) < 4 * width) & (np.abs(v) < 4 * height)
    u, v, inverse_w = (np.where(front, a, 0) for a in (u, v, inverse_w))
    ju, jv = (h[0, 0] - u * h[2, 0], h[0, 1] - u * h[2, 1]), (h[1, 0] - v * h[2, 0], h[1, 1] - v * h[2, 1])
    norm = sum(np.square(j, dtype=np.float32) for j in (*ju, *jv)) * inverse_w**2
    area = np.abs(np.float32(np.linalg.det(h))) * inverse_w**3
    # Singular values a >= b of the Jacobian: a b = area, a^2 + b^2 = norm; b is the coarse direction.
    largest = np.sqrt((norm + np.sqrt(np.maximum(norm**2 - 4 * area**2, 0))) / 2)
    finest_px = np.divide(area, largest, out=np.zeros_like(area), where=largest > 0)
    if view.camera is not None and view.camera.distortion_model != "none" and any(view.camera.distortion):
        u, v = _distort_pixels(view.camera, u, v, front)
    edge = np.minimum(np.minimum(u, width - 1 - u), np.minimum(v, height - 1 - v)) / (FEATHER_SHARE * width)
    fine = (finest_px * np.float32(coarsest_cells) - 1) / 0.5
    opacity = np.where(front, np.clip(np.minimum(edge, fine), 0, 1), 0).astype(np.float32)
    return (u.astype(np.float32), v.astype(np.float32)), np.sqrt(area).astype(np.float32), opacity


def _distort_pixels(camera: Camera, u: Array, v: Array, front: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Apply the lens distortion to pixels; those beyond the radius where the model folds back lie outside the image."""
    uv = np.stack([u[front], v[front]], axis=1).astype(np.float64)
    xy = (uv - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    seen = np.hypot(xy[:, 0], xy[:, 1]) < fold_radius(camera)
    distorted = distort(camera, np.where(seen[:, None], xy, 0.0)) @ camera.K[:2, :2].T + camera.K[:2, 2]
    out = np.full((2, *u.shape), -1e6)
    out[:, front] = np.where(seen[:, None], distorted, -1e6).T
    return out[0], out[1]


def visible_window(
    view: GroundView, image_H_cell: Array, shape: tuple[int, ...], coarsest_cells: float, step: int = 8
) -> tuple[slice, slice] | None:
    """Find the rows and columns around all cells inside the view, on every `step`-th cell; None if there are none."""
    rows, columns = np.arange(0, shape[0] + step, step), np.arange(0, shape[1] + step, step)
    seen = project_cells(view, image_H_cell, rows, columns, coarsest_cells)[2] > 0
    if not seen.any():
        return None
    r, c = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    return (
        slice(max(int(rows[r[0]]) - step, 0), min(int(rows[r[-1]]) + step, shape[0])),
        slice(max(int(columns[c[0]]) - step, 0), min(int(columns[c[-1]]) + step, shape[1])),
    )


def sample_colors(
    image: Image,
    uv: tuple[NDArray[np.float32], NDArray[np.float32]],
    scale: NDArray[np.float32],
    wanted: NDArray[np.bool_] | None = None,
) -> Image:
    """Sample colors at pixels, from higher levels of an image pyramid where a cell holds several pixels.

    Parameters
    ----------
    image : (H, W, 3) uint8
    uv : pair of (R, C) float32
    scale : (R, C) float32
        Pixels along a cell's edge.
    wanted : (R, C) bool, optional
        The others stay black.
    """
    chosen = np.ones(scale.shape, bool) if wanted is None else wanted
    out = np.zeros((*scale.shape, 3), dtype=np.uint8)
    out[chosen] = sample_at(image, uv[0][chosen], uv[1][chosen], scale[chosen])
    return out


def sample_at(
    image: Image, u: NDArray[np.float32], v: NDArray[np.float32], scale: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Sample colors (N, 3) at pixels (N,) as `sample_colors` does."""
    level = np.clip(np.rint(np.log2(np.maximum(scale, 1e-6))), 0, PYRAMID_LEVELS).astype(np.int8)
    out = np.zeros((len(level), 3), dtype=np.uint8)
    highest = int(level.max(initial=0))
    for k in range(highest + 1):
        chosen = np.flatnonzero(level == k)
        if len(chosen):
            out[chosen] = _sample(image, u[chosen] * np.float32(0.5**k), v[chosen] * np.float32(0.5**k))
        if k < highest:
            image = np.asarray(cv2.pyrDown(image), dtype=np.uint8)
    return out


def _sample(image: Image, u: NDArray[np.float32], v: NDArray[np.float32]) -> Image:
    """Interpolate colors (N, 3) at pixels (N,); they are put into rows, since OpenCV takes no longer ones."""
    rows = -(-len(u) // SAMPLES_A_ROW)
    at = [np.resize(a, (rows, SAMPLES_A_ROW)) for a in (u, v)]
    seen = cv2.remap(image, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(seen, dtype=np.uint8).reshape(-1, 3)[: len(u)]
