"""Ground as both ends see it: heights between the rings of the vehicle's LiDAR show how high and how tilted a unit is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from log2sim.cooperation.pose_fit import FEW_PIECES, MAD_TO_SIGMA, MIN_SCALE_M, Evidence
from log2sim.cooperation.structure import VehicleView, thin
from log2sim.geometry import Array
from log2sim.perception.lidar.ground import ON_GROUND_M, Ground, estimate_ground

# Where the vehicle has no ground point so near, its surface is a guess; measured in synthetic streets it errs by 5 cm up to here.
MAX_GAP_M = 1.5
BIAS_M = 0.03
VOXEL_M = 0.5
# For slopes of the surface.
STEP_M = 0.5
CAUCHY = 2.0
# Of upright things: above curbs and the errors of a surface on slopes.
MIN_HEIGHT_M = 0.7
# Of the lowest points around a pole, those of the ground.
GROUND_RADIUS_M, GROUND_SHARE = 20.0, 0.1
# Of a pole that sees no ground.
USUAL_BELOW_M = 4.0


@dataclass(frozen=True, eq=False)
class CommonGround:
    """Ground around a unit.

    Attributes
    ----------
    surface : Ground
        By the vehicle, in the frame of the site.
    known : cKDTree
        Of the places (x, y) of the vehicle's ground points.
    road_m : (N, 3) float64, m
        Ground points of the unit, thinned out.
    """

    surface: Ground
    known: cKDTree
    road_m: Array


def ground_below(road_m: Array) -> float:
    """Estimate the height of the ground at a pole, m, in the frame of the site, from the unit's points (N, 3)."""
    near = road_m[np.hypot(road_m[:, 0], road_m[:, 1]) < GROUND_RADIUS_M, 2]
    return float(np.quantile(near, GROUND_SHARE)) if len(near) else -USUAL_BELOW_M


def upright_points(road_m: Array) -> Array:
    """Choose the points (n, 3) of a unit, m, that are above the ground as it sees it itself."""
    if len(road_m) == 0:
        return road_m
    surface = estimate_ground(road_m, np.zeros(2), ground_below(road_m))
    return road_m[road_m[:, 2] - surface.at(road_m[:, :2]) > MIN_HEIGHT_M]


def common_ground(view: VehicleView, road_m: Array) -> CommonGround | None:
    """Find the ground among points of both ends; None where one of them sees none."""
    below = ground_below(road_m)
    surface, own = (estimate_ground(xyz, np.zeros(2), below) for xyz in (view.xyz_m, road_m))
    seen = view.xyz_m[np.abs(view.xyz_m[:, 2] - surface.at(view.xyz_m[:, :2])) < ON_GROUND_M]
    ground = thin(road_m[np.abs(road_m[:, 2] - own.at(road_m[:, :2])) < ON_GROUND_M], VOXEL_M)
    if len(seen) == 0 or len(ground) == 0:
        return None
    return CommonGround(surface, cKDTree(thin(seen, VOXEL_M)[:, :2]), ground)


def match_ground(ground: CommonGround, correction: Array, within_m: float) -> Evidence | None:
    """Compare heights of the unit's ground points, corrected by a transform (4, 4), with the vehicle's surface."""
    at = ground.road_m @ correction[:3, :3].T + correction[:3, 3]
    away = ground.known.query(at[:, :2], distance_upper_bound=MAX_GAP_M)[0]
    residual = at[:, 2] - ground.surface.at(at[:, :2])
    kept = np.isfinite(away) & (np.abs(residual) < within_m)
    at, residual = at[kept], residual[kept]
    if len(at) < FEW_PIECES:
        return None
    step = STEP_M * np.eye(2)
    slope = [(ground.surface.at(at[:, :2] + d) - ground.surface.at(at[:, :2] - d)) / (2 * STEP_M) for d in step]
    normals = np.stack([-slope[0], -slope[1], np.ones(len(at))], axis=1)
    scale = max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), MIN_SCALE_M)
    share = 1.0 / (1.0 + (residual / (CAUCHY * scale)) ** 2)
    weight = share / (scale**2 + float(share.sum()) * BIAS_M**2)
    # Slopes show height and tilt alone: what they say about the plane is the noise of the surface.
    jacobian = np.zeros((len(at), 7))
    jacobian[:, 2] = 1.0
    jacobian[:, 3:5] = np.cross(at, normals)[:, :2]
    return Evidence((jacobian * weight[:, None]).T @ jacobian, (jacobian * weight[:, None]).T @ residual)
