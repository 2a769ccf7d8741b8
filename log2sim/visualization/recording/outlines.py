"""Boxes of a scenario's agents in the pictures of a camera, as short lists of whole pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Log, Scenario
from log2sim.geometry import NS_PER_S, Array, Camera, apply, box_corners, box_lines, inverse, line_time_s, project
from log2sim.geometry.box_projection import EDGES, NEAR_M
from log2sim.perception.lidar.projection import View, project_boxes_in_view, view_of

MIN_SHARE = 1 / 200
"""Of the height of a picture: smaller boxes would be dots in it."""

STRAIGHT_SHARE = 1 / 640
"""Of the width of a picture, one pixel of the usual size: edges that a lens bends by less are drawn straight."""

CORNERS, SEGMENTS = 1, 0
"""Kinds of outlines: eight corners u, v in the order of `box_corners`, or segments u0, v0, u1, v1."""


class OutlineProjector:
    """Projects the agents of a scenario, but for the ego, into the frames of a log.

    Parameters
    ----------
    log : Log
        With the poses that the scenario was made with.
    scenario : Scenario

    Attributes
    ----------
    agents : tuple of Agent
        Outlines name them by their place among these.
    """

    def __init__(self, log: Log, scenario: Scenario) -> None:
        self.agents = scenario.others
        self._log, self._t0_ns = log, scenario.t0_ns
        self._size_m = np.array([a.size_m for a in self.agents], dtype=np.float64).reshape(-1, 3)

    def outlines(self, camera: str, t_ns: int) -> list[list[int]]:
        """Project the agents into the frame of a camera at a stamp, the farthest first.

        Returns
        -------
        list of [agent, kind, coordinates...]
            Whole pixels of the camera; see `CORNERS` and `SEGMENTS`. Empty where the pose of the camera is not known.
        """
        view = view_of(self._log, camera, t_ns)
        if view is None or not self.agents:
            return []
        center, yaw, present = _states(self.agents, (t_ns - self._t0_ns) / NS_PER_S)
        rows = np.flatnonzero(present)
        found = project_boxes_in_view(view, center[rows], self._size_m[rows], yaw[rows])
        height_px = found.box_px[:, 3] - found.box_px[:, 1]
        with np.errstate(invalid="ignore"):
            shown = np.flatnonzero(found.valid & (height_px >= MIN_SHARE * view.camera.height_px))
        out = []
        for i in shown[np.argsort(-found.range_m[shown], kind="stable")]:
            row = int(rows[i])
            corners = box_corners(center[row], self._size_m[row], yaw[row])[0]
            middle_px = found.box_px[i].reshape(2, 2).mean(axis=0)[None]
            kind, coordinates = outline_of(view.camera, apply(_cam_T_map(view, middle_px), corners))
            if len(coordinates):
                out.append([row, kind, *np.rint(coordinates).astype(np.int64).ravel().tolist()])
        return out


def outline_of(camera: Camera, corners_cam: Array) -> tuple[int, Array]:
    """Return the kind and the coordinates, px, of the outline of a box with corners (8, 3), m, cam frame.

    Corners where straight lines between them are right: all in front of the camera, and the lens bends no edge visibly.
    """
    if (corners_cam[:, 2] > NEAR_M).all():
        ends = corners_cam[np.array(EDGES)]
        uv = project(camera, np.concatenate([corners_cam, ends.mean(axis=1)]))[0]
        straight = uv[np.array(EDGES)].mean(axis=1)
        # Perspective moves the middle of an edge along it; what counts is its distance from the line.
        along = uv[np.array(EDGES)[:, 1]] - uv[np.array(EDGES)[:, 0]]
        off = uv[8:] - straight
        length = np.maximum(np.hypot(*along.T), 1e-9)
        bent = np.abs(along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0]) / length
        if np.isfinite(uv).all() and bent.max() <= STRAIGHT_SHARE * camera.width_px:
            return CORNERS, uv[:8]
    return SEGMENTS, box_lines(camera, corners_cam)


def _cam_T_map(view: View, middle_px: Array) -> Array:
    """Return the transform (4, 4) at the time of the line that shows the middle of a box."""
    if view.cam_T_map_at is None:
        return inverse(view.map_T_cam)
    return np.asarray(view.cam_T_map_at(line_time_s(view.camera, middle_px))[0])


def _states(agents: Sequence[Agent], t_s: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return centers (A, 3), m, yaws (A,) and whether each agent is present at a time."""
    center, yaw, present = np.full((len(agents), 3), np.nan), np.zeros(len(agents)), np.zeros(len(agents), dtype=bool)
    for k, agent in enumerate(agents):
        at = agent.at(float(agent.waypoints.t_s[0]) if agent.is_permanent else t_s)
        if at.valid[0]:
            center[k], yaw[k], present[k] = (at.x_m[0], at.y_m[0], at.z_m[0]), at.yaw_rad[0], True
    return center, yaw, present
