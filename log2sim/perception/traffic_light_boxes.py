"""Traffic lights in frames: cut out of the pictures, and their distances by the points on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.projection import View, project_points

# Lamps of a crop of this height are 10 px wide, which is enough to tell their colors; larger crops are scaled down.
MAX_CROP_PX = 40
# Around a box, as a share of its sides: boxes of detectors are off by so much, and lamps shine beyond their housing.
MARGIN = 0.1
MIN_SIDE_PX = 3
# Points of a housing lie in the middle of its box, and none behind the first ones; below this height above ground are vehicles.
MIDDLE, HOUSING_DEPTH_M, MIN_HEIGHT_M, MIN_POINTS = 0.7, 0.6, 1.5, 2
MAX_OVERLAP = 0.2  # of the smaller of two boxes; more have parts of one housing
# Of a log; 40 MB. Later ones are not kept.
MAX_CROPS = 20_000


@dataclass(frozen=True, eq=False)
class LightBox:
    """A traffic light in one frame."""

    camera: str
    t_ns: int  # stamp of the frame
    box_px: Array  # (4,): u0, v0, u1, v1
    score: float
    crop: NDArray[np.uint8]  # (h, w, 3): the picture there, BGR
    range_m: float = float("nan")  # distance of LiDAR points in the box from the camera, NaN without any


def crop_lights(camera: str, t_ns: int, image_bgr: NDArray[np.uint8], lights: Array) -> list[LightBox]:
    """Cut traffic lights (K, 5), boxes and scores, out of a frame.

    Those at its border are incomplete and left out, and of boxes within each other the weaker ones: housings hang side by side.
    """
    height, width = image_bgr.shape[:2]
    out: list[LightBox] = []
    for u0, v0, u1, v1, score in sorted(lights.tolist(), key=lambda row: -row[4]):
        box = np.array([u0, v0, u1, v1])
        inside = u0 > 1 and v0 > 1 and u1 < width - 1 and v1 < height - 1
        if not inside or min(u1 - u0, v1 - v0) < MIN_SIDE_PX:
            continue
        others = np.array([light.box_px for light in out]).reshape(-1, 4)
        common = np.clip(np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2]), 0, None).prod(axis=1)
        smaller = np.minimum((box[2:] - box[:2]).prod(), (others[:, 2:] - others[:, :2]).prod(axis=1))
        if (common / smaller > MAX_OVERLAP).any():
            continue
        du, dv = MARGIN * (u1 - u0), MARGIN * (v1 - v0)
        left, top, right, bottom = round(u0 - du), round(v0 - dv), round(u1 + du) + 1, round(v1 + dv) + 1
        crop = image_bgr[max(top, 0) : bottom, max(left, 0) : right]
        scale = min(1.0, MAX_CROP_PX / max(crop.shape[:2]))
        small = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else crop.copy()
        out.append(LightBox(camera, t_ns, box, score, np.asarray(small, np.uint8)))
    return out


def add_ranges(lights: Sequence[LightBox], view: View, cloud: Cloud) -> list[LightBox]:
    """Return the traffic lights of a frame with the distance of the points in the middle of each, if there are some of a housing."""
    if not lights:
        return []
    high = np.flatnonzero(cloud.height > MIN_HEIGHT_M)
    visible = project_points(view, cloud.origin, cloud.columns.take(high, axis=1))
    out = []
    for light in lights:
        middle, reach = (light.box_px[:2] + light.box_px[2:]) / 2, (light.box_px[2:] - light.box_px[:2]) * MIDDLE / 2
        inside = (np.abs(visible.u - middle[0]) <= reach[0]) & (np.abs(visible.v - middle[1]) <= reach[1])
        points = cloud.xyz[high[visible.index[inside]]] + cloud.origin - view.map_T_cam[:3, 3]
        away = np.linalg.norm(points, axis=1)
        front = away[away < away.min(initial=np.inf) + HOUSING_DEPTH_M]
        out.append(replace(light, range_m=float(np.median(front))) if len(front) >= MIN_POINTS else light)
    return out
