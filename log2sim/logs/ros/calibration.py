"""Cameras from CameraInfo messages (http://docs.ros.org/en/api/sensor_msgs/html/msg/CameraInfo.html)."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.geometry import Array, Camera, Mount, inverse, transform
from log2sim.logs.ros.containers import printable
from log2sim.logs.ros.settings import Intrinsics

BROWN, FISHEYE = ("plumb_bob", "rational_polynomial", "radtan", ""), ("equidistant", "fisheye", "kannala_brandt4")
ROTATION_TOLERANCE = 1e-3


class CalibrationProblem(ValueError):
    """A CameraInfo that gives no camera; the text is the reason."""


def camera_from_intrinsics(name: str, given: Intrinsics, mount: Mount, mount_T_cam: Array) -> Camera:
    """Build a camera from the settings."""
    K = np.array([[given.fx_px, 0.0, given.cx_px], [0.0, given.fy_px, given.cy_px], [0.0, 0.0, 1.0]])
    size = given.width_px, given.height_px
    return Camera(name, *size, K, mount, mount_T_cam, given.distortion_model, given.distortion)


def camera_from_info(
    name: str, info: Any, pose: tuple[Mount, Array], *, rectified: bool, stereo: bool = False
) -> Camera:
    """Build a camera from a CameraInfo.

    Parameters
    ----------
    name : str
    info : sensor_msgs/CameraInfo
    pose : (mount, (4, 4) float64)
        Where the frame of the images is: mount_T_cam.
    rectified : bool
        Whether the images are rectified: then P is theirs, their axes are turned by R, and there is no distortion.
    stereo : bool
        Whether another camera has the same frame, as the second of a stereo pair has in ROS: then the last column of P holds
        its position in it.

    Raises
    ------
    CalibrationProblem
        When the camera is not calibrated, or its lens model is none of those that `Camera` has.
    """
    mount, mount_T_cam = pose
    model, distortion = "none", tuple[float, ...]()
    K, P = _matrix(info, "K", (3, 3)), _matrix(info, "P", (3, 4))
    if rectified and P[0, 0] > 0 and P[1, 1] > 0 and np.isfinite(P).all():
        rotation = _matrix(info, "R", (3, 3))
        if not np.abs(rotation @ rotation.T - np.eye(3)).max() <= ROTATION_TOLERANCE:
            rotation = np.eye(3)
        mount_T_cam = mount_T_cam @ inverse(transform(rotation, np.zeros(3)))
        if stereo:
            mount_T_cam = mount_T_cam @ inverse(transform(np.eye(3), _offset(P)))
        K = P[:, :3]
    elif not rectified:
        model, distortion = _lens(info)
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(K).all()):
        raise CalibrationProblem(f"its focal lengths are {K[0, 0]:g} and {K[1, 1]:g} px: the camera is not calibrated")
    K, (width, height) = _reduced(info, K)
    if not (width > 0 and height > 0):
        raise CalibrationProblem(f"its size is {width}x{height} px")
    return Camera(name, width, height, K, mount, mount_T_cam, model, distortion)


def _offset(P: Array) -> Array:
    """Position (3,) of the second camera of a stereo pair in the frame of both: P = K [I | t]."""
    K = np.triu(P[:, :3])
    K[2, 2] = 1.0
    return np.asarray(np.linalg.solve(K, P[:, 3]))


def _lens(info: Any) -> tuple[str, tuple[float, ...]]:
    values = np.asarray(_field(info, "D"), dtype=np.float64).ravel()
    kind = printable(info.distortion_model).strip().lower()
    if not values.any():
        return "none", ()
    if not np.isfinite(values).all():
        raise CalibrationProblem("its distortion is not finite")
    limit = 8 if kind in BROWN else 4
    if kind not in BROWN + FISHEYE or values[limit:].any():
        raise CalibrationProblem(
            f"its distortion model '{kind}' with {len(values)} values is not read; known: {', '.join((*BROWN[:2], FISHEYE[0]))}"
        )
    values = values[:limit]
    if kind in FISHEYE:
        return "fisheye", tuple(np.append(values, np.zeros(4 - len(values))).tolist())
    length = next(n for n in (4, 5, 8) if n >= len(values))
    return "brown", tuple(np.append(values, np.zeros(length - len(values))).tolist())


def _reduced(info: Any, K: Array) -> tuple[Array, tuple[int, int]]:
    """Camera matrix and size of the images, which may be a region of the sensor, binned; both are given for the whole."""
    binning = np.array([max(1, int(info.binning_x)), max(1, int(info.binning_y))])
    roi = info.roi
    size = np.array([int(info.width), int(info.height)])
    if roi.width and roi.height:
        size = np.array([int(roi.width), int(roi.height)])
    K = K.copy()
    K[:2, 2] -= [int(roi.x_offset), int(roi.y_offset)]
    K[:2] /= binning[:, None]
    width, height = (size // binning).tolist()
    return K, (width, height)


def _field(info: Any, name: str) -> Any:
    """Return D, K, R or P, which ROS 2 writes in lower case."""
    return getattr(info, name, None) if hasattr(info, name) else getattr(info, name.lower())


def _matrix(info: Any, name: str, shape: tuple[int, int]) -> Array:
    values = np.asarray(_field(info, name), dtype=np.float64)
    if values.size != shape[0] * shape[1]:
        raise CalibrationProblem(f"{name} has {values.size} values, expected {shape[0] * shape[1]}")
    return values.reshape(shape)
