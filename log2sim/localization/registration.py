"""Registration of a sweep with a map of Gaussians, and how well it is constrained.

Voxelized GICP (Koide et al., ICRA 2021) as the library small_gicp implements it.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from log2sim.errors import MissingExtra
from log2sim.geometry import Array, inverse

VOXEL_M = 0.5
MAP_VOXEL_M = 1.0
NEIGHBORS = 10
MAX_ITERATIONS = 30
MIN_POINTS = 100
# Share of the points that fall onto known surfaces: typical sweeps of a drive have 0.7 or more with their map; half of that is
# left where a sweep shows another place.
MIN_OVERLAP = 0.35
# Surfaces are given a variance of 1e-3 along their normals by the library, and of 1 across them: a point on a surface square to
# a direction adds 1 / (2 * 1e-3) of information about it, any other 1 / 2, so that a direction that nothing holds has a
# constraint of 0.001. Noise of the normals raises that: simulated tunnels have 0.001 to 0.015, streets 0.006 to 0.1. Where it is
# low, the fit is repeated from a start farther along that direction than a voxel; it is held if the fit comes back.
INFORMATION_OF_POINT = 500.0
MIN_CONSTRAINT, DOUBTFUL_CONSTRAINT = 0.002, 0.03
PROBE_M = 1.5 * MAP_VOXEL_M
MIN_RETURN = 0.5


@dataclass(frozen=True, eq=False)
class Fit:
    """A registered sweep.

    Attributes
    ----------
    pose : (4, 4) float64
        Of the ego in the frame of the map.
    overlap : float
        Share of the sweep's points that fall onto known surfaces.
    residual : float
        Mean squared Mahalanobis distance of these points, without unit.
    constraint : float
        Share of points, as if all were square to it, that hold the weakest direction of translation.
    weakest : (3,) float64
        That direction, in the frame of the map.
    covariance : (6, 6) float64
        Of rotation vector and translation, rad and m; the inverse of the information matrix, hence optimistic.
    """

    pose: Array
    overlap: float
    residual: float
    constraint: float
    weakest: Array
    covariance: Array


def load_small_gicp() -> ModuleType:
    """Import the library for registration.

    Raises
    ------
    MissingExtra
        Where it is not installed.
    """
    try:
        import small_gicp
    except ImportError:
        raise MissingExtra("LiDAR odometry", "odometry") from None
    module: ModuleType = small_gicp
    return module


def is_installed() -> bool:
    """Return whether the library for registration is installed."""
    try:
        load_small_gicp()
    except MissingExtra:
        return False
    return True


class SurfaceMap:
    """Surfaces of the sweeps so far, as one Gaussian in each voxel."""

    def __init__(self) -> None:
        self._library = load_small_gicp()
        self._voxels = self._library.GaussianVoxelMap(MAP_VOXEL_M)

    def surfaces_of(self, xyz_m: Array) -> Any:
        """Thin out points (N, 3) and estimate their surfaces; None for fewer than `MIN_POINTS` of them."""
        if len(xyz_m) < MIN_POINTS:
            return None
        surfaces, _ = self._library.preprocess_points(xyz_m, VOXEL_M, NEIGHBORS, 1)
        return surfaces if surfaces.size() >= MIN_POINTS else None

    def insert(self, surfaces: Any, pose: Array) -> None:
        """Add surfaces of the ego's frame at a pose (4, 4); those without points for 100 sweeps are removed."""
        self._voxels.insert(surfaces, pose)

    def fit(self, surfaces: Any, guess: Array) -> Fit:
        """Register surfaces from a guessed pose (4, 4)."""
        found = self._library.align(self._voxels, surfaces, guess, max_iterations=MAX_ITERATIONS)
        count = max(int(found.num_inliers), 1)
        pose, information = np.array(found.T_target_source), np.array(found.H)
        constraint, weakest = weakest_direction(information, count)
        return Fit(
            pose,
            found.num_inliers / surfaces.size(),
            2 * float(found.error) / count,
            constraint,
            pose[:3, :3] @ weakest,
            np.linalg.pinv(information),
        )

    def holds(self, surfaces: Any, fit: Fit) -> bool:
        """Return whether a fit holds every direction of motion, by fitting again from a start shifted along the weakest one."""
        if not MIN_CONSTRAINT <= fit.constraint < DOUBTFUL_CONSTRAINT:
            return fit.constraint >= DOUBTFUL_CONSTRAINT
        shift = np.zeros((4, 4))
        shift[:3, 3] = PROBE_M * fit.weakest
        again = self._library.align(self._voxels, surfaces, fit.pose + shift, max_iterations=MAX_ITERATIONS)
        stayed_m = float((np.array(again.T_target_source) - fit.pose)[:3, 3] @ fit.weakest)
        return abs(stayed_m) < (1 - MIN_RETURN) * PROBE_M


def weakest_direction(information: Array, points: int) -> tuple[float, Array]:
    """Find the direction of translation that a registration holds least: its constraint and unit vector (3,), ego frame.

    Parameters
    ----------
    information : (6, 6) float64
        Of rotation and translation, in this order.
    points : int

    Notes
    -----
    The least eigenvalue of the information about translation alone, with rotation free (Zhang, Kaess, Singh, ICRA 2016, look at
    the same eigenvalues).
    """
    rotation, both, translation = information[:3, :3], information[:3, 3:], information[3:, 3:]
    alone = translation - both.T @ np.linalg.pinv(rotation) @ both
    values, vectors = np.linalg.eigh((alone + alone.T) / 2)
    return float(values[0]) / points / INFORMATION_OF_POINT, vectors[:, 0]


def motion_between(first: Array, second: Array) -> Array:
    """Compute the pose (4, 4) of the second in the frame of the first."""
    return np.asarray(inverse(first) @ second)
