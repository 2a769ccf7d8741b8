"""Correspondences of all cameras of a rig in one table, and their errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.rig import Rig, RigState, rotation_of

# Parameters of feet: one that all cameras share, then of each camera the height of feet above the road, m, and its rotation.
SHARED, OF_CAMERA = 1, 4


@dataclass(frozen=True, eq=False)
class RigRows:
    """Correspondences of all cameras of a rig, sorted by tick.

    Attributes
    ----------
    camera : (N,) int64
        Number of the camera within the rig.
    ray : (N, 2) float64
        Normalized image coordinates.
    xy : (N, 2) float64
        Ground positions, m, rig frame.
    tick : (N,) int64
        Tick of the log.
    focal_px : (N,) float64
        Of the cameras.
    sigma_px, sigma_m : (N,) float64
        Standard deviations of pixels and of ground positions.
    """

    camera: NDArray[np.int64]
    ray: Array
    xy: Array
    tick: NDArray[np.int64]
    focal_px: Array
    sigma_px: Array
    sigma_m: Array

    @classmethod
    def of(cls, rig: Rig, found: Mapping[str, Correspondences], sigma_px: float, sigma_m: float) -> RigRows:
        """Join the correspondences of the cameras; rows that are not finite are left out."""
        parts = []
        for k, (name, member) in enumerate(rig.cameras.items()):
            rows = found.get(name) or Correspondences.join([])
            rows = rows.take(np.isfinite(np.column_stack([rows.uv, rows.xy_ego])).all(axis=1))
            K, one = member.camera.K, np.ones(len(rows))
            ray = (rows.uv - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
            focal = float(np.sqrt(K[0, 0] * K[1, 1])) * one
            xy = rows.xy_ego - rig.origin_m[:2]
            parts.append(cls(k * one.astype(np.int64), ray, xy, rows.tick, focal, sigma_px * one, sigma_m * one))
        return cls.join(parts)

    @classmethod
    def join(cls, parts: list[RigRows]) -> RigRows:
        """Concatenate several tables."""
        out = cls(*(np.concatenate(column) for column in zip(*(vars(part).values() for part in parts))))
        return out.take(np.argsort(out.tick, kind="stable"))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.camera)

    def take(self, index: Any) -> RigRows:
        """Select rows by integers or a mask."""
        return RigRows(*(column[index] for column in vars(self).values()))


def heights_of(rig: Rig, rows: RigRows) -> tuple[Array, Array]:
    """Compute how high the rays of rows pass over their ground positions, by the calibration: (N,) m, and sigmas (N,) m."""
    members = list(rig.cameras.values())
    rotation = np.array([m.cam_T_rig[:3, :3].T for m in members])[rows.camera]
    place = np.array([-m.cam_T_rig[:3, :3].T @ m.cam_T_rig[:3, 3] for m in members])[rows.camera]
    direction = np.einsum("nij,nj->ni", rotation, np.column_stack([rows.ray, np.ones(len(rows))]))
    level = (direction[:, :2] ** 2).sum(axis=1)
    reach = ((rows.xy - place[:, :2]) * direction[:, :2]).sum(axis=1) / level
    height = place[:, 2] + reach * direction[:, 2]
    # A pixel turns the ray, and a ground position that is farther is passed lower.
    by_pixel = reach * np.sqrt(level + direction[:, 2] ** 2 * (1 + direction[:, 2] ** 2 / level)) / rows.focal_px
    sigma = np.hypot(by_pixel * rows.sigma_px, direction[:, 2] / np.sqrt(level) * rows.sigma_m)
    return height, np.where(reach > 0, sigma, np.inf)


@dataclass(frozen=True, eq=False)
class FootErrors:
    """Errors of the feet of boxes with the state of a rig, linearized.

    Attributes
    ----------
    squared : (N,) float64
        Squared whitened errors; infinite behind the camera.
    error : (N, 2) float64
        Whitened errors.
    slope : (N, 2, 5) float64
        Their derivatives by `below_px` and by `lift_m` and rotation of the row's camera.
    pixels : (N,) float64
        Distances in the image, px.
    """

    squared: Array
    error: Array
    slope: Array
    pixels: Array


def linearize_feet(rig: Rig, rows: RigRows, state: RigState, planes: Array | None = None) -> FootErrors:
    """Linearize the errors of feet; `planes` (N, 3) replaces the plane of the state, as each tick has its own."""
    members = list(rig.cameras.values())
    turns = rotation_of(np.array([state.feet[n] for n in rig.cameras]))
    turns = turns @ rotation_of(np.array([state.mount[n] for n in rig.cameras]))
    poses = turns @ np.array([m.cam_T_rig[:3] for m in members])
    flat = np.concatenate([poses[:, :, :2], poses[:, :, 3:]], axis=2)[rows.camera]
    up = poses[rows.camera, :, 2]
    lift = np.array([state.lift_m[name] for name in rig.cameras])[rows.camera]
    plane = (state.plane if planes is None else planes) + np.column_stack([0 * lift, 0 * lift, lift])
    matrices = flat + up[:, :, None] * plane[:, None, :]
    point = np.einsum("nij,nj->ni", matrices, np.column_stack([rows.xy, np.ones(len(rows))]))
    front = point[:, 2] > 0
    scale = rows.focal_px / np.where(front, point[:, 2], 1.0)
    ray = point[:, :2] * (scale / rows.focal_px)[:, None]
    # Derivatives of the pixel by the point in the camera, and by the ground position, px a meter.
    by_point = np.zeros((len(rows), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = scale
    by_point[:, :, 2] = -ray * scale[:, None]
    by_xy = by_point @ matrices[:, :, :2]
    slope = np.zeros((len(rows), 2, SHARED + OF_CAMERA))
    slope[:, 1, 0] = -1.0
    slope[:, :, 1] = np.einsum("nij,nj->ni", by_point, up)
    slope[:, :, 2:] = -by_point @ _cross(point)
    error = (ray - rows.ray) * rows.focal_px[:, None] - [0.0, state.below_px]
    pixels = np.where(front, np.hypot(*error.T), np.inf)
    covariance = (rows.sigma_m**2)[:, None, None] * by_xy @ by_xy.swapaxes(1, 2)
    covariance[:, [0, 1], [0, 1]] += (rows.sigma_px**2)[:, None]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    error, slope = (whiten @ error[:, :, None])[:, :, 0], whiten @ slope
    squared = np.where(front, (error**2).sum(axis=1), np.inf)
    return FootErrors(squared, error, slope, pixels)


def _cross(v: Array) -> Array:
    """Build the matrices (N, 3, 3) of cross products with vectors (N, 3)."""
    (x, y, z), zero = v.T, np.zeros(len(v))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
