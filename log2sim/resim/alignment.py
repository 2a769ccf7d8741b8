"""Where an agent was for its points to lie on each other: trajectories are decimeters off, and its surfaces would be as thick.

Point-to-plane ICP (Chen & Medioni, 1992) of what each sweep shows of it against what the sweeps before it did, with weights
of Geman and McClure.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.datatypes import Agent
from log2sim.geometry import Array
from log2sim.resim.rays import Floats
from log2sim.resim.surfels import Surfels

MIN_POINTS, MOST_POINTS = 20, 400  # that decide; more decide no better
SPACING_M = 0.08  # of the points that later sweeps are compared with
SCALES_M = (0.3, 0.15, 0.1, 0.06, 0.06)  # of residuals, from how far trajectories are off to how thick surfaces are
# Of corrections, for what points do not tell, such as a place along a flat side: how far trajectories are off.
SIGMA = np.array([0.2, 0.2, np.deg2rad(3.0)])
SAME_PLACE_M = 0.02  # an agent this near to where it was in the source is there


@dataclass(eq=False)
class Alignment:
    """Poses x, y, m, and yaw, rad, of the surfaces of a rigid agent in its frame, by time."""

    agent: Agent
    t_s: Array = field(default_factory=lambda: np.zeros(0))  # (K,), increasing
    pose: Array = field(default_factory=lambda: np.zeros((0, 3)))
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))  # of the surfaces, and their normals
    normal: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def fit(self, t_s: float, points: Array, normal: Array, own: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return points (N, 3) in the agent's frame, and their normals, where they lie on those of other times; keep those of its `own`."""
        k = int(np.searchsorted(self.t_s, t_s))
        back = inverted(self.pose[min(k, len(self.t_s) - 1)]) if len(self.t_s) else np.zeros(3)
        rows = np.flatnonzero(own & normal.any(axis=1))
        rows = rows[:: max(1, len(rows) // MOST_POINTS)]
        if len(rows) >= MIN_POINTS:
            if len(self.points):
                back = self._fitted(back, points[rows], normal[rows])
            self.t_s, self.pose = np.insert(self.t_s, k, t_s), np.insert(self.pose, k, inverted(back), axis=0)
            at, axes = moved(points[rows], back), moved(normal[rows], back * [0, 0, 1])
            if len(self.points):
                new = np.isinf(cKDTree(self.points).query(at, distance_upper_bound=SPACING_M)[0])
                at, axes = at[new], axes[new]
            self.points, self.normal = np.concatenate([self.points, at]), np.concatenate([self.normal, axes])
        return moved(points, back), moved(normal, back * [0, 0, 1])

    def _fitted(self, back: Array, points: Array, normal: Array) -> Array:
        tree = cKDTree(self.points)
        for scale in SCALES_M:
            at = moved(points, back)
            distance, near = tree.query(at, distance_upper_bound=3 * scale)
            met = np.flatnonzero(np.isfinite(distance))
            axis = self.normal[near[met]]
            met = met[(axis * moved(normal[met], back * [0, 0, 1])).sum(axis=1) > 0.7]
            axis, x, y = self.normal[near[met]], at[met, 0], at[met, 1]
            off = ((self.points[near[met]] - at[met]) * axis).sum(axis=1)
            weight = 1 / (scale * (1 + (off / scale) ** 2)) ** 2
            columns = np.column_stack([axis[:, :2], axis[:, 1] * x - axis[:, 0] * y])
            square = columns.T @ (columns * weight[:, None]) + np.diag(1 / SIGMA**2)
            step = np.linalg.solve(square, columns.T @ (weight * off) - back / SIGMA**2)
            back = np.append(moved(np.append(back[:2], 0)[None], step)[0, :2], back[2] + step[2])
        return back

    def centered(self, surfels: Surfels) -> Surfels:
        """Return the surfaces where they were in the mean, so that they are there in the box of an agent that is elsewhere now."""
        if not len(self.t_s):
            return surfels
        mean = self.pose.mean(axis=0)
        x, y, _ = inverted(mean)
        place = moved(np.tile([x, y, 0.0], (len(self.pose), 1)), self.pose)
        self.pose = place + (self.pose - mean) * [0, 0, 1]
        center, normal = moved(surfels.center_m, mean), moved(surfels.normal, mean * [0, 0, 1])
        return replace(surfels, center_m=center.astype(np.float32), normal=normal.astype(np.float32))

    def at(self, t_s: Array, x_m: Array, y_m: Array) -> Array:
        """Return poses (T, 3) at times (T,); 0 where the agent, at x and y (T,), is elsewhere than in the source."""
        if not len(self.t_s):
            return np.zeros((len(t_s), 3))
        was = self.agent.trajectory.at(t_s)
        same = np.hypot(was.x_m - x_m, was.y_m - y_m) < SAME_PLACE_M
        return np.column_stack([np.interp(t_s, self.t_s, column) for column in self.pose.T]) * same[:, None]


def moved(points: Floats | Array, pose: Array) -> Array:
    """Turn points (N, 3) by the yaw of a pose (3,), or of one each (N, 3), then move them."""
    x, y, yaw = np.moveaxis(pose, -1, 0)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack(
        [c * points[:, 0] - s * points[:, 1] + x, s * points[:, 0] + c * points[:, 1] + y, points[:, 2]]
    )


def inverted(pose: Array) -> Array:
    """Return the inverse of a pose (3,)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2]])
