"""Whether a sensor moves, by the poses of a log that may be noisy."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S

# Positions of a standing ego scatter, drift by centimeters a second, and its yaw by GNSS alone is any; only net motion over
# a second tells that it drives.
WINDOW_S = 1.0
MIN_DRIVEN_M = 1.0


def sensor_drives(log: Log, name: str, since_ns: int, t_ns: int) -> bool:
    """Return whether a sensor has moved by a meter within a second, or since an earlier stamp; False where no pose is known."""
    sensor = log.cameras.get(name) or log.lidars[name]
    if sensor.mount == "map" or log.ego is None:
        return False
    before_ns = max(min(since_ns, t_ns - round(WINDOW_S * NS_PER_S)), int(log.ego.t_ns[0]))
    poses, known = log.map_T_sensor(name, np.array([before_ns, t_ns]))
    return bool(known.all()) and float(np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3])) >= MIN_DRIVEN_M
