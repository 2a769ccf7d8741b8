"""Projection into images whose lines are exposed one after the other while the camera moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry.camera import Camera, project
from log2sim.geometry.transforms import Array

# Poses during the readout; between them image coordinates are interpolated. A camera that turns at 1 rad/s with 2000 px focal
# length and 0.1 s of readout moves its image by 12 px between two of them, which interpolation follows to less than 0.1 px.
KNOTS = 17
ITERATIONS = 3


def line_time_s(camera: Camera, uv_px: Array) -> Array:
    """Compute when the lines of pixels (N, 2) are exposed, s (N,), relative to the middle of the image; 0 for a global shutter.

    Pixels outside the image take the time of its border, those of NaN that of the middle.
    """
    shutter = camera.rolling_shutter
    if shutter is None:
        return np.zeros(len(uv_px))
    along, size_px = (1, camera.height_px) if shutter.direction in ("down", "up") else (0, camera.width_px)
    share = np.nan_to_num(np.clip(uv_px[:, along] / size_px, 0.0, 1.0) - 0.5)
    sign = 1.0 if shutter.direction in ("down", "right") else -1.0
    return np.asarray(sign * shutter.readout_s * share)


def project_moving(
    camera: Camera, points: NDArray[np.floating[Any]], cam_T_points: Callable[[Array], Array]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Project points (N, 3), m, through a camera that moves while its image is read.

    Parameters
    ----------
    camera : Camera
    points : (N, 3), m
        In a frame in which they stand still.
    cam_T_points : callable
        Transforms (K, 4, 4) from that frame to the camera at times (K,), s, relative to the middle of the image.

    Returns
    -------
    uv_px : (N, 2) float64
        NaN where `project` gives NaN.
    depth_m : (N,) float64
        Along the optical axis at the time of the point's line.
    valid : (N,) bool
        In front of the camera and inside the image.

    Notes
    -----
    The line in which a point appears depends on the pose at the time of that line: a fixed point, found by iteration from the
    pose of the middle. It converges while the image of a point moves by less than the readout does.
    """
    shutter = camera.rolling_shutter
    if shutter is None or shutter.readout_s <= 0:
        local = _moved(points, cam_T_points(np.zeros(1))[0])
        uv, valid = project(camera, local)
        return uv, local[:, 2], valid
    times = np.linspace(-0.5, 0.5, KNOTS) * shutter.readout_s
    transforms = cam_T_points(times)
    uv = project(camera, _moved(points, transforms[KNOTS // 2]))[0]
    depth = np.zeros(len(points))
    for _ in range(ITERATIONS):
        place = (line_time_s(camera, uv) / shutter.readout_s + 0.5) * (KNOTS - 1)
        uv, depth = _project_between(camera, points, transforms, place)
    with np.errstate(invalid="ignore"):
        valid = np.all((uv >= 0) & (uv < [camera.width_px, camera.height_px]), axis=1)
    return uv, depth, valid


def _project_between(
    camera: Camera, points: NDArray[np.floating[Any]], transforms: Array, place: Array
) -> tuple[Array, Array]:
    """Interpolate the projections (N, 2) and depths (N,) of the two transforms around each place (N,) among them."""
    before = np.minimum(place.astype(np.int64), KNOTS - 2)
    weight = place - before
    uv, depth = np.zeros((len(points), 2)), np.zeros(len(points))
    for k in np.unique(before):
        rows = before == k
        for knot, share in ((k, 1 - weight[rows]), (k + 1, weight[rows])):
            local = _moved(points[rows], transforms[knot])
            uv[rows] += share[:, None] * project(camera, local)[0]
            depth[rows] += share * local[:, 2]
    return uv, depth


def _moved(points: NDArray[np.floating[Any]], dst_T_src: Array) -> Array:
    return np.asarray(points @ dst_T_src[:3, :3].T + dst_T_src[:3, 3])
