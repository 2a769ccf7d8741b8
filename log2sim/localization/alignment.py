"""The frame of estimated poses: fitted to given poses, or level on the ground under the first sweep."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Array, PoseTrack, nearest_rotation, rotation_from_rpy, transform

# The ground is searched this near to the ego, and this far above and below where it is expected.
GROUND_REACH_M, GROUND_MARGIN_M = 15.0, 0.6
MIN_GROUND_POINTS = 200
GROUND_ROUNDS, GROUND_TOLERANCE_M = 10, 0.05
# Roads are not tilted more against the car on them.
MAX_TILT_RAD = np.deg2rad(15.0)


def fit_to_given(estimated: PoseTrack, given: PoseTrack) -> Array | None:
    """Fit the frame of estimated poses to given ones: `map_T_odom` (4, 4); None where no given pose is at their stamps.

    Notes
    -----
    The rotation is the mean of the differences between the attitudes (chordal mean; Hartley et al., IJCV 2013, section 5.3),
    the translation that between the positions. Attitudes of GNSS with an IMU hold the vertical, and the direction where the
    path is short; positions alone would leave the roll about a straight path open.
    """
    map_T_ego, known = given.at(estimated.t_ns)
    if not known.any():
        return None
    target, source = map_T_ego[known], estimated.map_T_ego[known]
    rotation = nearest_rotation(np.einsum("nij,nkj->ik", target[:, :3, :3], source[:, :3, :3]))
    shift = target[:, :3, 3].mean(axis=0) - rotation @ source[:, :3, 3].mean(axis=0)
    return transform(rotation, shift)


def level_on_ground(xyz_m: Array, ground_z_m: float) -> Array | None:
    """Fit the ground around the ego: the pose (4, 4) of the ego in a frame with this ground level at `ground_z_m`.

    Parameters
    ----------
    xyz_m : (N, 3) float64, m
        One sweep in the ego's frame.
    ground_z_m : float
        Expected height of the road in the ego's frame, m.

    Returns
    -------
    level_T_ego : (4, 4) float64, or None
        None where there are too few points on a ground. The origin keeps its place above the ground, and the x axis its direction.

    Notes
    -----
    A slope that is the same all around is taken for level: a LiDAR alone does not measure the vertical.
    """
    away = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    points = xyz_m[(away < GROUND_REACH_M) & (np.abs(xyz_m[:, 2] - ground_z_m) < GROUND_MARGIN_M)]
    if len(points) < MIN_GROUND_POINTS:
        return None
    terms, weight = np.column_stack([np.ones(len(points)), points[:, :2]]), np.ones(len(points))
    plane: Array = np.zeros(3)
    for _ in range(GROUND_ROUNDS):
        weighted = terms * weight[:, None]
        plane = np.asarray(np.linalg.lstsq(weighted.T @ terms, weighted.T @ points[:, 2], rcond=None)[0])
        weight = 1 / (1 + ((points[:, 2] - terms @ plane) / GROUND_TOLERANCE_M) ** 2) ** 2
    pitch, roll = np.arctan(plane[1] / np.sqrt(1 + plane[2] ** 2)), -np.arctan(plane[2])
    if max(abs(pitch), abs(roll)) > MAX_TILT_RAD:
        return None
    rotation = rotation_from_rpy(roll, pitch, 0.0)
    height_m = float(plane[0] / np.sqrt(1 + plane[1] ** 2 + plane[2] ** 2))
    return transform(rotation, np.array([0.0, 0.0, ground_z_m - height_m]))
