"""At which ticks a camera that was searched for objects shows an agent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.plausibility.box_table import BoxTable
from log2sim.agents.plausibility.recording import Recording
from log2sim.geometry import Array, Camera, apply, inverse, project

# Smaller objects are "small" in COCO (Lin et al., ECCV 2014), where detectors find less than half of them.
MIN_HEIGHT_PX = 32.0
# Share of the width of an image at either side in which an object is cut off.
BORDER_SHARE = 0.05
# From a camera farther from the LiDAR other things hide an object than from the LiDAR.
MAX_BASELINE_M = 3.0


def shown_in_images(boxes: BoxTable, recording: Recording) -> NDArray[np.bool_]:
    """Mark (A, T) where a searched camera next to the LiDAR has an agent well inside its image, large enough to be detected."""
    shown = np.zeros(boxes.present.shape, dtype=bool)
    log, schedule = recording.log, recording.schedule
    for name, frames in schedule.frames.items():
        camera, ticks = log.cameras[name], np.flatnonzero((frames >= 0) & boxes.present.any(axis=0))
        poses, known = log.map_T_sensor(name, log.streams[name].t_ns[frames[ticks]])
        for tick, map_T_cam in zip(ticks[known].tolist(), poses[known]):
            cloud, rows = recording.clouds[tick], np.flatnonzero(boxes.present[:, tick])
            if cloud is None or np.linalg.norm(map_T_cam[:3, 3] - cloud.origin - cloud.sensor) > MAX_BASELINE_M:
                continue
            shown[rows, tick] |= _shown(camera, map_T_cam, boxes.center_m[rows, tick], boxes.size_m[rows, 2])
    return shown


def _shown(camera: Camera, map_T_cam: Array, center_m: Array, height_m: Array) -> NDArray[np.bool_]:
    """Mark the boxes (M,) with these centers (M, 3) and heights (M,) that an image shows."""
    in_cam = apply(inverse(map_T_cam), center_m)
    uv, inside = project(camera, in_cam)
    border = BORDER_SHARE * camera.width_px
    inside &= np.abs(np.nan_to_num(uv[:, 0]) - camera.width_px / 2) < camera.width_px / 2 - border
    return np.asarray(inside & (camera.K[1, 1] * height_m >= MIN_HEIGHT_PX * in_cam[:, 2]))
