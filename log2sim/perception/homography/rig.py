"""A rig of cameras over one ground plane: its cameras by calibration, and what is fitted on top of it.

All cameras of a rig see the same ground, and one detector finds their boxes. So the plane of the ground relative to the rig
and the systematic error of the boxes' feet are parameters of the rig; a camera has a rotation of its mount of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array, Camera, inverse

# Ground ahead of a camera at which the errors of its homography are predicted.
PROBE_M = 20.0


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera of a rig, by its calibration.

    Attributes
    ----------
    camera : Camera
    cam_T_rig : (4, 4) float64
        The rig frame is the ground frame of the correspondences with its origin on the ground below the cameras' mean.
    """

    camera: Camera
    cam_T_rig: Array


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras that see one ground plane.

    Attributes
    ----------
    cameras : mapping of str to RigCamera
    origin_m : (3,) float64
        Origin of the rig frame in the ground frame of the correspondences.
    """

    cameras: Mapping[str, RigCamera]
    origin_m: Array

    @classmethod
    def of(cls, cameras: Mapping[str, Camera], ground_z_m: float) -> Rig:
        """Make the rig of cameras whose mounts are poses in one frame, in which the ground is at `ground_z_m`."""
        places = np.array([c.mount_T_cam[:3, 3] for c in cameras.values()])
        origin = np.array([*places[:, :2].mean(axis=0), ground_z_m])
        members = {}
        for name, camera in cameras.items():
            rig_T_cam = np.array(camera.mount_T_cam, dtype=np.float64)
            rig_T_cam[:3, 3] -= origin
            members[name] = RigCamera(camera, inverse(rig_T_cam))
        return cls(members, origin)


@dataclass(frozen=True, eq=False)
class RigState:
    """What is fitted on top of the calibration of a rig.

    Attributes
    ----------
    plane : (3,) float64
        Height of the ground in the rig frame: its slopes along x and along y, and its height at the origin, m.
    below_px : float
        How far below the lower edge of its box an obstacle touches the ground.
    lift_m : mapping of str to float
        Height above the road at which the feet of boxes in a camera seem to lie: boxes end at the tires, which stand behind the
        nearest side of a vehicle, by more where a camera sees its ends than where it sees its sides.
    mount : mapping of str to (3,) float64
        Rotation of each camera against its calibration, rad, camera frame.
    feet : mapping of str to (3,) float64
        Rotation that the feet of boxes in a camera ask for beyond that of the mount, rad.
    """

    plane: Array
    below_px: float
    lift_m: Mapping[str, float]
    mount: Mapping[str, Array]
    feet: Mapping[str, Array]

    @classmethod
    def calibrated(cls, rig: Rig, plane: Array | None = None) -> RigState:
        """Make the state of a rig that is as its calibration says, over flat ground or a `plane` (3,)."""
        none = {name: np.zeros(3) for name in rig.cameras}
        return cls(np.zeros(3) if plane is None else plane, 0.0, dict.fromkeys(rig.cameras, 0.0), none, dict(none))


def rotation_of(vector: Array) -> Array:
    """Compute the rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad (Rodrigues)."""
    v = np.asarray(vector, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    cross = np.zeros((*v.shape[:-1], 3, 3))
    cross[..., 2, 1], cross[..., 0, 2], cross[..., 1, 0] = x, y, z
    cross -= np.swapaxes(cross, -1, -2)
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + np.sinc(angle / 2 / np.pi) ** 2 / 2 * cross @ cross)


def cam_of_ground(member: RigCamera, plane: Array, turn: Array) -> Array:
    """Compute the matrices (..., 3, 3) from ground positions (x, y, 1), rig frame, to points in a camera.

    Parameters
    ----------
    member : RigCamera
    plane : (..., 3) float64
    turn : (3, 3) float64
        Rotation of the camera against its calibration.
    """
    r, t = turn @ member.cam_T_rig[:3, :3], turn @ member.cam_T_rig[:3, 3]
    rise = r[:, 2, None] * np.asarray(plane)[..., None, :]
    return np.asarray(np.column_stack([r[:, :2], t]) + rise)


def road_homography(rig: Rig, state: RigState, name: str, plane: Array | None = None) -> Array:
    """Compute `ground_H_image` (..., 3, 3) of the road itself, px and m, in the ground frame of the correspondences.

    `plane` (..., 3) replaces that of the state, as that of a tick does.
    """
    member = rig.cameras[name]
    turn = rotation_of(state.mount[name])
    return _to_ground(rig, member, cam_of_ground(member, state.plane if plane is None else plane, turn))


def foot_homography(rig: Rig, state: RigState, name: str, plane: Array | None = None) -> Array:
    """Compute `ground_H_image` (..., 3, 3) from the feet of boxes to the nearest sides of obstacles, like `road_homography`."""
    member = rig.cameras[name]
    turn = rotation_of(state.feet[name]) @ rotation_of(state.mount[name])
    lifted = (state.plane if plane is None else plane) + [0.0, 0.0, state.lift_m[name]]
    below = np.eye(3)
    below[1, 2] = state.below_px
    return scaled(_to_ground(rig, member, cam_of_ground(member, lifted, turn)) @ below)


def foot_sigma_m(rig: Rig, state: RigState, name: str, covariance: Array) -> float:
    """Predict the standard deviation, m, of ground positions `PROBE_M` ahead of a camera; NaN where it does not see so far.

    `covariance` (5, 5) is that of `below_px`, and of `lift_m` and the rotation `feet` of the camera.
    """
    member = rig.cameras[name]
    axis = member.cam_T_rig[2, :3]
    place = inverse(member.cam_T_rig)[:2, 3]
    if not np.hypot(*axis[:2]) > 0:
        return float("nan")
    at = place + PROBE_M * axis[:2] / np.hypot(*axis[:2])
    turn = rotation_of(state.feet[name]) @ rotation_of(state.mount[name])
    matrix = cam_of_ground(member, state.plane, turn)
    point = matrix @ [*at, 1.0]
    if not point[2] > 0:
        return float("nan")
    by_point = np.array([[1.0, 0.0, -point[0] / point[2]], [0.0, 1.0, -point[1] / point[2]]]) / point[2]
    by_parameter = np.zeros((2, 5))
    by_parameter[1, 0] = -1.0 / member.camera.K[1, 1]
    by_parameter[:, 1] = by_point @ (turn @ member.cam_T_rig[:3, 2])
    by_parameter[:, 2:] = by_point @ np.cross(np.eye(3), point).T
    on_ground = np.linalg.solve(by_point @ matrix[:, :2], by_parameter)
    return float(np.sqrt(np.linalg.eigvalsh(on_ground @ covariance @ on_ground.T)[-1]))


def _to_ground(rig: Rig, member: RigCamera, cam_H_ground: Array) -> Array:
    back = np.eye(3)
    back[:2, 2] = rig.origin_m[:2]
    return scaled(back @ np.linalg.inv(member.camera.K @ cam_H_ground))


def scaled(h: Array) -> Array:
    """Scale homographies (..., 3, 3) so that their third rows are unit vectors."""
    return np.asarray(h / np.linalg.norm(h[..., 2, :], axis=-1)[..., None, None])
