"""Figures of estimated poses for the report."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.documents import rounded
from log2sim.geometry import Array
from log2sim.localization.camera_motion import CameraPath
from log2sim.localization.odometry import Odometry


def odometry_figures(found: Odometry) -> dict[str, Any]:
    """Collect the figures of an odometry for the report."""
    return {
        "lidar": found.lidar,
        "sweeps": found.sweeps,
        "poses": len(found.t_ns),
        "predicted": int(found.predicted.sum()),
        "degenerate": int(found.degenerate.sum()),
        "problems": found.problems,
        "path_m": rounded(found.path_m, 3),
        "overlap_median": _median(found.overlap),
        "residual_median": _median(found.residual),
        "constraint_median": _median(found.constraint),
    }


def camera_figures(found: CameraPath) -> dict[str, Any]:
    """Collect the figures of camera motion for the report."""
    steps = np.diff(found.start_T_ego[:, :3, 3], axis=0)
    return {
        "camera": found.camera,
        "frames": found.frames,
        "poses": len(found.t_ns),
        "predicted": int(found.predicted.sum()),
        "path_m": rounded(float(np.linalg.norm(steps, axis=1).sum()), 3),
        "points_on_road_median": found.on_road,
    }


def _median(values: Array) -> float | None:
    """Return the median of what is known, rounded."""
    known = values[np.isfinite(values)]
    return rounded(float(np.median(known)), 4) if len(known) else None
