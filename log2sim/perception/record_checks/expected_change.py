"""How much a picture of a standing scene changes when its camera moves."""

from __future__ import annotations

import cv2
import numpy as np

from log2sim.geometry import Array, Camera
from log2sim.perception.record_checks.thumbnails import Thumbnail, quantile_of_change

# What is not ground is assumed as far away as this, so that no more motion is expected than there is at least; houses and
# trees along a road are nearer.
FAR_M = 50.0
MIN_DEPTH_M = 0.1


def expect_change(
    picture: Thumbnail, camera: Camera, map_T_before: Array, map_T_after: Array, ground_z_m: float
) -> float:
    """Return by how many gray levels a picture changes where nothing but its camera moves: the 95 % quantile over the cells.

    Parameters
    ----------
    picture : (h, w) float32
        The earlier picture.
    camera : Camera
        Its lens distortion is left out; it changes where things are in a picture, not how far they move.
    map_T_before, map_T_after : (4, 4) float64
        Poses of the camera.
    ground_z_m : float
        Height of flat ground in the map.

    Notes
    -----
    Every cell of the later picture is followed to the ground or to `FAR_M`, and from there to the earlier picture. A picture
    without texture, as in fog, is expected not to change.
    """
    height, width = picture.shape
    K = np.diag([width / camera.width_px, height / camera.height_px, 1.0]) @ camera.K
    v, u = np.mgrid[0.5:height, 0.5:width]
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ (map_T_after[:3, :3] @ np.linalg.inv(K)).T
    above_m = map_T_after[2, 3] - ground_z_m
    far = FAR_M / np.linalg.norm(rays, axis=1)
    down = rays[:, 2] * far < -above_m
    reach = np.where(down, np.divide(-above_m, rays[:, 2], out=far.copy(), where=down), far)
    points = rays * reach[:, None] + (map_T_after[:3, 3] - map_T_before[:3, 3])
    seen = points @ (K @ map_T_before[:3, :3].T).T
    front = seen[:, 2] > MIN_DEPTH_M
    at = np.full((len(points), 2), -10.0)
    np.divide(seen[:, :2], seen[:, 2:], out=at, where=front[:, None])
    inside = ((at >= 0) & (at <= [width, height])).all(axis=1)
    flow = (at - 0.5).astype(np.float32).reshape(height, width, 2)
    moved = cv2.remap(picture, flow[..., 0], flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return quantile_of_change(np.abs(moved - picture).ravel()[inside])
