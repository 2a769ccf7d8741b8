"""The cameras that a scene describes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S, Camera, rotation_from_rpy, transform
from log2sim.synth.scene import CameraSpec, Scene


def camera_of(spec: CameraSpec) -> Camera:
    """Make the pinhole camera that a scene describes; pixel centers are whole numbers."""
    width, height = spec.size_px
    focal = width / 2 / np.tan(np.deg2rad(spec.fov_deg) / 2)
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    forward_T_cam = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])
    rotation = rotation_from_rpy(0.0, -np.deg2rad(spec.pitch_deg), np.deg2rad(spec.yaw_deg)) @ forward_T_cam
    return Camera(spec.name, width, height, K, spec.mount, transform(rotation, np.array(spec.position_m)))


def frame_stamps(spec: CameraSpec, scene: Scene) -> NDArray[np.int64]:
    """Stamps (F,) of a camera's frames, absolute ns, all within the log."""
    first = int(np.ceil(-spec.offset_s * spec.rate_hz - 1e-9))
    last = int(np.floor((scene.duration_s - spec.offset_s) * spec.rate_hz + 1e-9))
    t = np.arange(first, last + 1) / spec.rate_hz + spec.offset_s
    return scene.start_ns + np.rint(t * NS_PER_S).astype(np.int64)
