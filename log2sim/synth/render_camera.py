"""A camera at one time: its rays in the map and the projection of polygons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, apply, inverse

NEAR_M = 0.2  # of the near plane


@dataclass(frozen=True, eq=False)
class RenderCamera:
    """A camera at one time, enlarged for oversampling.

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
    def of(cls, camera: Camera, map_T_cam: Array, scale: int) -> RenderCamera:
        """Enlarge a camera; whole numbers are pixel centers, before and after."""
        K = camera.K * scale
        K[:2, 2] += (scale - 1) / 2
        K[2, 2] = 1.0
        return cls(K, camera.width_px * scale, camera.height_px * scale, map_T_cam)

    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Rays with depth 1 in the map, as sums of a part by column (W, 3) and a part by row (H, 3)."""
        u = (np.arange(self.width_px) - self.K[0, 2]) / self.K[0, 0]
        v = (np.arange(self.height_px) - self.K[1, 2]) / self.K[1, 1]
        R = self.map_T_cam[:3, :3]
        return np.outer(u, R[:, 0]).astype(np.float32), (np.outer(v, R[:, 1]) + R[:, 2]).astype(np.float32)

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
