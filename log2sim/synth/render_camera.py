"""A camera at one time: its rays in the map and the projection of polygons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, apply, inverse

NEAR_M = 0.2  # of the near plane


@dataclass(frozen=True, eq=False)
class RenderCamera:
    """A camera at one time.

    Attributes
    ----------
    K : (3, 3) float64, px
    width_px : int
    height_px : int
    map_T_cam : (4, 4) float64
    """

    K: Array
    width_px: int
    height_px: int
    map_T_cam: Array

    @classmethod
    def of(cls, camera: Camera, map_T_cam: Array) -> RenderCamera:
        """Take a camera without its distortion."""
        return cls(camera.K, camera.width_px, camera.height_px, map_T_cam)

    def enlarged(self, scale: int) -> RenderCamera:
        """Divide each pixel into several; whole numbers are pixel centers, before and after."""
        K = self.K * scale
        K[:2, 2] += (scale - 1) / 2
        K[2, 2] = 1.0
        return RenderCamera(K, self.width_px * scale, self.height_px * scale, self.map_T_cam)

    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Rays with depth 1 in the map, as sums of a part by column (W, 3) and a part by row (H, 3)."""
        u = (np.arange(self.width_px) - self.K[0, 2]) / self.K[0, 0]
        v = (np.arange(self.height_px) - self.K[1, 2]) / self.K[1, 1]
        R = self.map_T_cam[:3, :3]
        return np.outer(u, R[:, 0]).astype(np.float32), (np.outer(v, R[:, 1]) + R[:, 2]).astype(np.float32)

    def rise(self) -> NDArray[np.float32]:
        """Height gained by rays of depth 1: (H, W), or (H, 1) where all of a row rise alike."""
        by_column, by_row = self.rays()
        if np.ptp(by_column[:, 2]) < 1e-6:
            by_column = by_column[:1]
        up: NDArray[np.float32] = by_row[:, None, 2] + by_column[None, :, 2]
        return up

    def taller(self, factor: int) -> RenderCamera:
        """Divide each row into several."""
        K = self.K.copy()
        K[1] *= factor
        K[1, 2] += (factor - 1) / 2
        return RenderCamera(K, self.width_px, self.height_px * factor, self.map_T_cam)

    def directions(self, u: NDArray[Any], v: NDArray[Any]) -> Array:
        """Rays (N, 3) of depth 1 in the map through points of the image."""
        rays = np.column_stack([(u - self.K[0, 2]) / self.K[0, 0], (v - self.K[1, 2]) / self.K[1, 1], np.ones(len(u))])
        return np.asarray(rays @ self.map_T_cam[:3, :3].T)

    def ground_depth(self, u: NDArray[Any], v: NDArray[Any], far_m: float) -> Array:
        """Depth (N,) at which rays through points of the image meet z = 0, at most `far_m`."""
        fall = np.maximum(-self.directions(u, v)[:, 2], 1e-9)
        return np.asarray(np.minimum(self.map_T_cam[2, 3] / fall, far_m))

    def image_H_plane(self, origin: Array, first: Array, second: Array) -> Array:
        """Homography (3, 3) from coordinates along two directions (3,) in the map, from `origin` (3,) relative to the camera."""
        return np.asarray(self.K @ self.map_T_cam[:3, :3].T @ np.column_stack([first, second, origin]))

    def polygon(self, points_map: Array) -> NDArray[np.int32]:
        """Project a convex polygon (P, 3), clipped at the near plane, to sixteenths of a pixel (Q, 2); may be empty."""
        p = apply(inverse(self.map_T_cam), points_map)
        out = []
        for a, b in zip(p, np.roll(p, -1, axis=0)):
            if a[2] >= NEAR_M:
                out.append(a)
            if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
                out.append(a + (b - a) * (NEAR_M - a[2]) / (b[2] - a[2]))
        if len(out) < 3:
            return np.zeros((0, 2), np.int32)
        q = np.array(out)
        uv = q[:, :2] / q[:, 2:] * [self.K[0, 0], self.K[1, 1]] + self.K[:2, 2]
        return np.asarray(np.rint(np.clip(uv, -1e5, 1e5) * 16).astype(np.int32))
