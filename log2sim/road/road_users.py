"""Where road users hide the ground: their boxes at any time, on the ground and in pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Log, Scenario
from log2sim.geometry import NS_PER_S, Array, Camera, box_corners, box_corners_bev, distort, inverse, outline
from log2sim.road.ground_map import Raster

# Boxes end at the body: mirrors and loads stick out, and the ground beside a vehicle lies in its contact shadow.
MARGIN_M = 0.3
# A true box lies within twice its sigma of the estimated one in 95 of 100 cases.
SIGMAS = 2.0
MAX_SIGMA_M = 1.0
# Masks of pictures have one pixel for this many along an edge.
MASK_SHRINK = 4
# Farther away no picture shows the ground finely enough to be mapped.
REACH_M = 120.0
# Corners of a polygon in a mask, px; OpenCV draws what is within.
MAX_CORNER_PX = 1e4


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of road users with their margins, map frame, one row each."""

    center_m: Array  # `center_m`, `size_m`: (M, 3)
    size_m: Array
    yaw_rad: Array  # (M,)


class RoadUsers:
    """The agents of a scenario at chosen times.

    `log`: whose ego hides the ground too. `t_ns`: (T,) int64: all times that will be asked for.
    """

    def __init__(self, log: Log, scenario: Scenario, t_ns: NDArray[np.int64]) -> None:
        self._t_ns = np.unique(np.asarray(t_ns, dtype=np.int64))
        self._agents = [agent for agent in scenario.others if len(agent.waypoints)]
        t_s = (self._t_ns - scenario.t0_ns) / NS_PER_S
        rows = [_rows_of(agent, t_s) for agent in self._agents]
        self._rows = np.stack(rows, axis=1) if rows else np.zeros((len(t_s), 0, 7))
        self._ego = np.full((len(self._t_ns), 7), np.nan)
        if log.ego is not None:
            map_T_ego, known = log.ego.at(self._t_ns)
            yaw = np.arctan2(map_T_ego[:, 1, 0], map_T_ego[:, 0, 0])
            size = np.broadcast_to(np.asarray(log.ego_vehicle.size_m) + 2 * MARGIN_M, (len(yaw), 3))
            self._ego[known] = np.column_stack([log.ego_centers(map_T_ego), size, yaw])[known]

    def inputs(self) -> list[Any]:
        """Return all boxes at all times, and who never moves."""
        return [self._t_ns, self._rows, [agent.static for agent in self._agents], self._ego]

    def at(self, t_ns: int) -> Boxes:
        """Return the boxes of the agents that are there at one of the times, without the ego's."""
        rows = self._rows[int(np.searchsorted(self._t_ns, t_ns))]
        return _boxes_of(rows[np.isfinite(rows).all(axis=1)])

    def ego_at(self, t_ns: int) -> Boxes:
        """Return the box of the ego at one of the times; none where its pose is not known."""
        rows = self._ego[int(np.searchsorted(self._t_ns, t_ns))][None]
        return _boxes_of(rows[np.isfinite(rows).all(axis=1)])

    def standing(self) -> Boxes:
        """Return the boxes of the agents that never move."""
        rows = [np.zeros((0, 7)), *(self._rows[:, k] for k, agent in enumerate(self._agents) if agent.static)]
        return _boxes_of(np.concatenate([own[np.isfinite(own).all(axis=1)][:1] for own in rows]))


def _rows_of(agent: Agent, t_s: Array) -> Array:
    """Rows (T, 7) of an agent's box at times: center, size with margins, yaw; NaN where it is not there."""
    w = agent.waypoints
    sigma = np.nan_to_num(np.interp(t_s, w.t_s, w.sigma_xy_m), nan=0.0)
    margin = MARGIN_M + SIGMAS * np.clip(sigma, 0, MAX_SIGMA_M)
    if agent.static:
        k = len(w) // 2
        place = np.broadcast_to([w.x_m[k], w.y_m[k], w.z_m[k], w.yaw_rad[k]], (len(t_s), 4))
    else:
        states = agent.at(t_s)
        place = np.stack([states.x_m, states.y_m, states.z_m, states.yaw_rad], axis=1)
    size = np.asarray(agent.size_m) + 2 * margin[:, None] * [1, 1, 0] + [0, 0, MARGIN_M]
    return np.column_stack([place[:, :3], size, place[:, 3]])


def _boxes_of(rows: Array) -> Boxes:
    return Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6])


def draw_footprints(
    boxes: Sequence[Boxes], raster: Raster, corner: tuple[int, int] = (0, 0), shape: tuple[int, int] | None = None
) -> NDArray[np.uint8]:
    """Mask of the cells under boxes, 1 there: of all cells (R, C), or of a part of a shape from the row and column of its corner on."""
    mask = np.zeros(shape or raster.shape, dtype=np.uint8)
    for some in boxes:
        corners = box_corners_bev(some.center_m[:, :2], some.size_m[:, 0], some.size_m[:, 1], some.yaw_rad)
        rows, columns = raster.cells_of(corners.reshape(-1, 2))
        for polygon in np.rint(np.stack([columns, rows], axis=1)).astype(np.int32).reshape(-1, 4, 2) - corner[::-1]:
            if np.all(polygon.max(axis=0) >= 0) and np.all(polygon.min(axis=0) < mask.shape[::-1]):
                cv2.fillConvexPoly(mask, polygon, 1)
    return mask


def covered(boxes: Sequence[Boxes], raster: Raster, cell: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which cells (N,), counted row by row, are under boxes; takes the time of the part that they are in, however large the raster."""
    if not len(cell):
        return np.zeros(0, dtype=bool)
    rows, columns = np.divmod(cell, raster.shape[1])
    corner = (int(rows.min()), int(columns.min()))
    shape = (int(rows.max()) - corner[0] + 1, int(columns.max()) - corner[1] + 1)
    mask = draw_footprints(boxes, raster, corner, shape)
    return np.asarray(mask.ravel().take((rows - corner[0]) * shape[1] + columns - corner[1]) > 0)


def draw_outlines(boxes: Boxes, camera: Camera, map_T_cam: Array) -> NDArray[np.uint8]:
    """Mask of a picture, `MASK_SHRINK` times smaller, that is 1 where it shows the boxes instead of the ground."""
    mask = np.zeros((-(-camera.height_px // MASK_SHRINK), -(-camera.width_px // MASK_SHRINK)), dtype=np.uint8)
    near = np.hypot(*(boxes.center_m[:, :2] - map_T_cam[:2, 3]).T) < REACH_M
    corners = box_corners(boxes.center_m[near], boxes.size_m[near], boxes.yaw_rad[near])
    cam_T_map = inverse(map_T_cam)
    for box in corners @ cam_T_map[:3, :3].T + cam_T_map[:3, 3]:
        rays = outline(box)
        if len(rays) < 3:
            continue
        uv = (distort(camera, rays) @ camera.K[:2, :2].T + camera.K[:2, 2]) / MASK_SHRINK
        uv = np.clip(uv[np.isfinite(uv).all(axis=1)], -MAX_CORNER_PX, MAX_CORNER_PX)
        if len(uv) >= 3:
            hull = cv2.convexHull(uv.astype(np.float32))
            cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), 1)
    return mask
