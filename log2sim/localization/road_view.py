"""The road before a camera from above, and points followed from image to image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, apply, inverse, project

MIN_CORNER = 1e-4
# Followed forward and back, a point ends where it began.
MAX_RETURN_PX = 0.7
# The road is seen from above over this rectangle before the camera; one pixel of the image is 0.1 m at 12 m with f = 700 px and
# a height of 1.5 m, and the rectangle has so many of its own pixels a meter.
MIN_ROAD_M, MAX_ROAD_M, ROAD_SIDE_M, ROAD_PX_PER_M = 3.0, 16.0, 6.0, 20.0
ROAD_POINTS, ROAD_WINDOW_PX, ROAD_SPACING_PX = 400, 15, 4
# Few levels: parts of the rectangle outside the image are constant and bias the coarse ones to no motion; motions are found within half a meter of a
# guess, and guesses are this far apart where the last motion does not help.
ROAD_LEVELS, GUESS_STEP_M = 2, 0.8
MIN_SHOWN_SHARE = 0.2


class RoadView:
    """The road before a camera, seen from above.

    Attributes
    ----------
    map_uv : (H, W, 2) float32
        Pixels of the image to look at, for each pixel of the view.
    shown : (H, W) uint8
        1 where the image shows the road, away from its border.
    """

    def __init__(self, camera: Camera, height_m: float, scale: float) -> None:
        ego_T_cam = camera.mount_T_cam
        ahead = ego_T_cam[:2, 2] / np.linalg.norm(ego_T_cam[:2, 2])
        self.axes = np.stack([-ahead, [ahead[1], -ahead[0]]])  # of rows, downward, and of columns, to the right
        self.corner = ego_T_cam[:2, 3] + ahead * MAX_ROAD_M - self.axes[1] * ROAD_SIDE_M
        rows, columns = ((np.array([MAX_ROAD_M - MIN_ROAD_M, 2 * ROAD_SIDE_M])) * ROAD_PX_PER_M).astype(int)
        j, i = np.meshgrid(np.arange(columns), np.arange(rows))
        xy = self.in_ego(np.column_stack([j.ravel(), i.ravel()]).astype(np.float64))
        points = np.column_stack([xy, np.full(len(xy), ego_T_cam[2, 3] - height_m)])
        uv, valid = project(camera, apply(inverse(ego_T_cam), points))
        valid &= (uv >= 0).all(axis=1) & (uv[:, 0] < camera.width_px) & (uv[:, 1] < camera.height_px)
        uv = np.where(valid[:, None], (uv + 0.5) * scale - 0.5, -1.0).astype(np.float32)
        self.map_uv = uv.reshape(rows, columns, 2)
        margin = np.ones((ROAD_WINDOW_PX, ROAD_WINDOW_PX), dtype=np.uint8)
        self.shown = _eroded(valid.reshape(rows, columns).astype(np.uint8), margin)

    def in_ego(self, px: Array) -> Array:
        """Convert pixels (N, 2), column and row, to positions (N, 2), m, ego frame."""
        return np.asarray(self.corner + (px[:, 1:] * self.axes[0] + px[:, :1] * self.axes[1]) / ROAD_PX_PER_M)

    def view(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Look at the road of an image from above."""
        import cv2

        return np.asarray(cv2.remap(image, self.map_uv[..., 0], self.map_uv[..., 1], cv2.INTER_LINEAR), dtype=np.uint8)

    def followed(self, first: NDArray[np.uint8], second: NDArray[np.uint8], guess_m: Array) -> tuple[Array, Array]:
        """Follow the texture of the road from one view to the next: positions (N, 2), m, in the ego's frame at both."""
        import cv2

        if self.shown.mean() < MIN_SHOWN_SHARE:
            return np.zeros((0, 2)), np.zeros((0, 2))
        start = cv2.goodFeaturesToTrack(first, ROAD_POINTS, MIN_CORNER, ROAD_SPACING_PX, mask=self.shown)
        rows, columns = -self.axes @ guess_m * ROAD_PX_PER_M
        begin, end = follow_points(
            first, second, start, FollowSettings(ROAD_WINDOW_PX, ROAD_LEVELS, (float(columns), float(rows)))
        )
        inside = np.clip(np.round(end).astype(int), 0, np.array(self.shown.shape)[::-1] - 1)
        good = self.shown[inside[:, 1], inside[:, 0]] > 0
        return self.in_ego(begin[good]), self.in_ego(end[good])


def _eroded(mask: NDArray[np.uint8], kernel: NDArray[np.uint8]) -> NDArray[np.uint8]:
    import cv2

    return np.asarray(cv2.erode(mask, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0), dtype=np.uint8)


@dataclass(frozen=True)
class FollowSettings:
    """How points are followed.

    Attributes
    ----------
    window_px : int
        Side of the patch around a point.
    levels : int
        Halvings of the image in which motion is searched first.
    guess_px : (2,) tuple of float
        Expected motion.
    """

    window_px: int
    levels: int
    guess_px: tuple[float, float] = (0.0, 0.0)


def follow_points(first: Any, second: Any, start: Any, settings: FollowSettings) -> tuple[Array, Array]:
    """Follow points (N, 1, 2), or None, to the next image and back: pixels (M, 2) of those that return."""
    import cv2

    if start is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    shift, levels = np.array(settings.guess_px, dtype=np.float32), settings.levels
    window, flags = (settings.window_px, settings.window_px), cv2.OPTFLOW_USE_INITIAL_FLOW
    ahead, found, _ = cv2.calcOpticalFlowPyrLK(
        first, second, start, start + shift, winSize=window, maxLevel=levels, flags=flags
    )
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        second, first, ahead, np.asarray(ahead) - shift, winSize=window, maxLevel=levels, flags=flags
    )
    returned = np.linalg.norm((np.asarray(back) - start)[:, 0], axis=1) < MAX_RETURN_PX
    good = (np.asarray(found)[:, 0] == 1) & (np.asarray(found_back)[:, 0] == 1) & returned
    return np.asarray(start[good, 0], dtype=np.float64), np.asarray(np.asarray(ahead)[good, 0], dtype=np.float64)
