"""The log that encoders write, and what they share."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from worlds import tiny_log

from log2sim.datatypes import Labels, Log
from log2sim.geometry import NS_PER_S, Array, wrap_angle

HEADING_RAD = np.deg2rad(40.0)
START_XY_M = (30.0, -20.0)
SPEED_MPS = 6.0
RED = [215, 15, 15]


def _placed(*rows: tuple[float, float, float], pose: bool = False) -> list[list[float]]:
    """Turn rows x, y and speed, or heading in degrees, of the ego's start into those of the map."""
    c, s = np.cos(HEADING_RAD), np.sin(HEADING_RAD)
    turn = np.rad2deg(HEADING_RAD) if pose else 0.0
    return [[START_XY_M[0] + c * x - s * y, START_XY_M[1] + s * x + c * y, last + turn] for x, y, last in rows]


@cache
def world_log() -> Log:
    """The log of `make_world` without changes, made once."""
    return make_world()


def make_world(**changes: Any) -> Log:
    """An ego that turns left at 6 m/s, a moving and a parked red car, a pedestrian; one camera, a LiDAR that turns clockwise.

    The LiDAR faces forward, and the camera takes its frame, in the middle between the stamps of two sweeps, which are the ends
    of their turns. Records are made once. Labels are at the frames of the camera.
    """
    agents = [
        {"id": "car", "category": "car", "size_m": [4.4, 1.8, 1.5], "color": RED,
         "waypoints": _placed((15.0, 3.4, 4.0), (40.0, 3.4, 4.0))},
        {"id": "parked", "category": "car", "size_m": [4.2, 1.7, 1.6], "color": RED,
         "pose": _placed((14.0, -4.0, 10.0), pose=True)[0]},
        {"id": "walker", "category": "pedestrian", "waypoints": _placed((17.0, 1.0, 1.4), (17.0, -6.0, 1.4))},
    ]  # fmt: skip
    table: dict[str, Any] = {
        "agents": agents,
        "name": "world",
        "duration_s": 1.0,
        "ego": {"waypoints": _placed((0.0, 0.0, SPEED_MPS), (5.0, 0.2, SPEED_MPS), (10.0, 1.2, SPEED_MPS)), "poses": "poses"},
        "road": [{"line": [row[:2] for row in _placed((-20.0, 0.0, 0.0), (60.0, 0.0, 0.0))], "width_m": 12.0}],
        "camera": [{"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [480, 300], "offset_s": 0.05}],
        "lidar": [
            {
                "name": "top",
                "position_m": [0.75, 0.0, 2.125],
                "channels": 24,
                "elevation_deg": [-20.0, 2.0],
                "azimuth_step_deg": 1.0,
                "range_m": 60.0,
            }
        ],
    }  # fmt: skip
    return tiny_log(noise_m=0.0, **{**table, **changes})[0]


def labels_at(labels: Labels, t_ns: NDArray[np.int64] | int, track: str) -> tuple[Array, Array, Array]:
    """Interpolate the box of a track at stamps (N,): centers (N, 3), size (3,), yaws (N,); straight on beyond the labels."""
    rows = np.flatnonzero(labels.track_id == track)
    rows = rows[np.argsort(labels.t_ns[rows], kind="stable")]
    t0 = int(labels.t_ns[rows[0]])
    known = (labels.t_ns[rows] - t0) / NS_PER_S
    asked = (np.atleast_1d(t_ns) - t0) / NS_PER_S
    k = np.clip(np.searchsorted(known, asked) - 1, 0, max(len(rows) - 2, 0))
    after = np.minimum(k + 1, len(rows) - 1)
    share = np.divide(asked - known[k], known[after] - known[k], out=np.zeros_like(asked), where=after > k)
    a, b = rows[k], rows[after]
    center = labels.center_m[a] + share[:, None] * (labels.center_m[b] - labels.center_m[a])
    yaw = wrap_angle(labels.yaw_rad[a] + share * wrap_angle(labels.yaw_rad[b] - labels.yaw_rad[a]))
    return center, labels.size_m[rows[0]], yaw
