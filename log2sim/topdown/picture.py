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

from log2sim.camera import distort
from log2sim.errors import ConfigError
from log2sim.files import refuse_existing, replaced
from log2sim.geometry import Array, inverse
from log2sim.types import Camera

MAX_CELLS = 36_000_000
"""Cells a picture may have; at 28 bytes a cell while it is built this is 1 GB."""

_LEVELS = 4
"""Halvings of an image kept to average pixels where many fall into one cell."""

Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class GroundView:
    """One camera frame and where its pixels lie on the ground.

    Attributes
    ----------
    image_bgr : (H, W, 3) uint8
    ground_H_image : (3, 3) float64
        Ground xy in m of an undistorted pixel, in the frame of the picture.
    camera : Camera or None
        Needed only to distort: without it the image counts as undistorted.
    weight : float
        Trust relative to other views, > 0.
    exclude_px : (M, 4) float64 or None
        Image boxes u0, v0, u1, v1 that show obstacles, which would smear over the road behind them; left out.
    signed : bool
        Whether the third row of `ground_H_image` is known to be positive on pixels that see the ground, as
        `ground_homography` has it. Otherwise the middle of the bottom row is taken to see the ground.
    """

    image_bgr: Image
    ground_H_image: Array
    camera: Camera | None = None
    weight: float = 1.0
    exclude_px: Array | None = None
    signed: bool = False

    @classmethod
    def from_pose(
        cls, image_bgr: Image, camera: Camera, map_T_cam: Array, ground_z_m: float = 0.0, **options: Any
    ) -> GroundView:
        """A view of a camera with pose (4, 4) onto the plane z = `ground_z_m` of the frame that the pose is in."""
        return cls(image_bgr, ground_homography(camera, map_T_cam, ground_z_m), camera, signed=True, **options)


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


def ground_homography(camera: Camera, map_T_cam: Array, ground_z_m: float = 0.0) -> Array:
    """Ground xy (m) of undistorted pixels as `ground_H_image` (3, 3), for the plane z = `ground_z_m`.

    Its third row is positive on pixels below the horizon.

    Raises
    ------
    ValueError
        When the camera lies in the plane, which it then sees edge-on.
    """
    if abs(map_T_cam[2, 3] - ground_z_m) < 1e-3:
        raise ValueError(
            f"camera '{camera.name}' lies in the ground plane z = {ground_z_m:g} m and cannot look onto it"
        )
    cam_T_map = inverse(np.asarray(map_T_cam, dtype=np.float64))
    r, t = cam_T_map[:3, :3], cam_T_map[:3, 3]
    image_H_ground = camera.K @ np.column_stack([r[:, 0], r[:, 1], r[:, 2] * ground_z_m + t])
    return np.asarray(np.linalg.inv(image_H_ground), dtype=np.float64)


def render_topdown(
    views: Sequence[GroundView],
    *,
    extent_m: tuple[float, float, float, float],
    resolution_m: float = 0.05,
    coarsest_m: float = 0.4,
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
        coarsest_m: float = 0.4,
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
        image_H_cell = _signed_inverse(view) @ ground_H_cell
        height, width = view.image_bgr.shape[:2]
        window = _seen_window(view, image_H_cell, self._weight.shape, self.coarsest_m / d)
        if window is None:
            return None
        rows, columns = window
        uv, scale, opacity = _look_up(
            view,
            image_H_cell,
            np.arange(rows.start, rows.stop),
            np.arange(columns.start, columns.stop),
            self.coarsest_m / d,
        )
        if not np.any(opacity > 0):
            return None
        if view.exclude_px is not None and len(view.exclude_px):
            shown = cv2.remap(_shown_mask(view.exclude_px, height, width), *uv, cv2.INTER_LINEAR)
            opacity = opacity * (shown.astype(np.float32) / 255)
        weight = opacity * scale**4 * np.float32(view.weight)
        return _Layer(rows, columns, _sample(view.image_bgr, uv, scale), weight, opacity)

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


def _signed_inverse(view: GroundView) -> Array:
    """`image_H_ground` (3, 3) scaled so that its third row is positive on ground in front of the camera."""
    height, width = view.image_bgr.shape[:2]
    image_H_ground = np.linalg.inv(view.ground_H_image)
    below = view.ground_H_image[2] @ np.array([width / 2, height - 1, 1.0])
    return -image_H_ground if not view.signed and below < 0 else image_H_ground


def _look_up(
    view: GroundView, image_H_cell: Array, rows: NDArray[Any], columns: NDArray[Any], coarsest_cells: float
) -> tuple[tuple[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32], NDArray[np.float32]]:
    """Where cells lie in the image: (u, v), pixels a cell edge, and opacity in [0, 1] (0 outside the image)."""
    h = image_H_cell
    x, y = columns[None, :].astype(np.float64), rows[:, None].astype(np.float64)
    un, vn, w = ((h[k, 0] * x + (h[k, 1] * y + h[k, 2])).astype(np.float32) for k in range(3))
    front = w > np.float32(1e-9 * np.abs(h[2]).max())
    inverse_w = np.divide(1, w, out=np.zeros_like(w), where=front)
    u, v = un * inverse_w, vn * inverse_w
    # Far outside the image nothing is needed, and squares would overflow there.
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
        u, v = _distorted(view.camera, u, v, front)
    edge = np.minimum(np.minimum(u, width - 1 - u), np.minimum(v, height - 1 - v)) / (0.04 * width)
    fine = (finest_px * np.float32(coarsest_cells) - 1) / 0.5
    opacity = np.where(front, np.clip(np.minimum(edge, fine), 0, 1), 0).astype(np.float32)
    return (u.astype(np.float32), v.astype(np.float32)), np.sqrt(area).astype(np.float32), opacity


def _distorted(camera: Camera, u: Array, v: Array, front: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Distort pixels; those that a pinhole of three times the view would not see stay outside the image."""
    uv = np.stack([u[front], v[front]], axis=1).astype(np.float64)
    xy = (uv - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    half_view = 1.5 * np.array([camera.width_px / camera.K[0, 0], camera.height_px / camera.K[1, 1]])
    seen = np.all(np.abs(xy) <= half_view, axis=1)
    bent = distort(camera, np.where(seen[:, None], xy, 0.0)) @ camera.K[:2, :2].T + camera.K[:2, 2]
    out = np.full((2, *u.shape), -1e6)
    out[:, front] = np.where(seen[:, None], bent, -1e6).T
    return out[0], out[1]


def _seen_window(
    view: GroundView, image_H_cell: Array, shape: tuple[int, ...], coarsest_cells: float, step: int = 8
) -> tuple[slice, slice] | None:
    """Rows and columns around all cells that the view sees, found on every `step`-th cell."""
    rows, columns = np.arange(0, shape[0] + step, step), np.arange(0, shape[1] + step, step)
    seen = _look_up(view, image_H_cell, rows, columns, coarsest_cells)[2] > 0
    if not seen.any():
        return None
    r, c = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    return (
        slice(max(int(rows[r[0]]) - step, 0), min(int(rows[r[-1]]) + step, shape[0])),
        slice(max(int(columns[c[0]]) - step, 0), min(int(columns[c[-1]]) + step, shape[1])),
    )


def _sample(image: Image, uv: tuple[NDArray[np.float32], NDArray[np.float32]], scale: NDArray[np.float32]) -> Image:
    """Colors at pixels, taken from halved images where a cell holds several pixels."""
    level = np.clip(np.rint(np.log2(np.maximum(scale, 1e-6))), 0, _LEVELS).astype(np.int8)
    out = np.zeros((*level.shape, 3), dtype=np.uint8)
    for k in range(_LEVELS + 1):
        chosen = level == k
        if chosen.any():
            factor = np.float32(0.5**k)
            seen = cv2.remap(image, uv[0] * factor, uv[1] * factor, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            out[chosen] = seen[chosen]
        image = cv2.pyrDown(image)
    return out


def _shown_mask(box_px: Array, height: int, width: int) -> Image:
    """255 where no obstacle stands, with soft borders."""
    mask = np.full((height, width), 255, dtype=np.uint8)
    bounds = np.nan_to_num(np.asarray(box_px, dtype=np.float64), nan=0.0)
    for u0, v0, u1, v1 in np.clip(np.rint(bounds), 0, [width, height, width, height]).astype(int):
        mask[v0:v1, u0:u1] = 0
    return np.asarray(cv2.blur(mask, (9, 9)))


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
