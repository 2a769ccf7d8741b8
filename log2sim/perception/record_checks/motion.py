"""How a sensor moves, by the poses of a log that may be noisy."""

from __future__ import annotations

from typing import Literal

import numpy as np

from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S

Motion = Literal["drives", "stands", "unclear"]

# Positions of a standing ego scatter, drift by centimeters a second, and its yaw by GNSS alone is any; only net motion over
# a second tells that it drives. What brakes to a stop has been this near to its place for a second only after it stands.
WINDOW_S = 1.0
MIN_DRIVEN_M = 1.0
MAX_STANDING_M = 0.05


def motion_of(log: Log, name: str, since_ns: int, t_ns: int) -> Motion:
    """Return whether a sensor has moved by a meter, or by no more than poses scatter, within a second or since an earlier stamp."""
    sensor = log.cameras.get(name) or log.lidars[name]
    if sensor.mount == "map":
        return "stands"
    if log.ego is None:
        return "unclear"
    wanted_ns = min(since_ns, t_ns - round(WINDOW_S * NS_PER_S))
    before_ns = max(wanted_ns, int(log.ego.t_ns[0]))
    poses, known = log.map_T_sensor(name, np.array([before_ns, t_ns]))
    if not known.all():
        return "unclear"
    moved_m = float(np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3]))
    if moved_m >= MIN_DRIVEN_M:
        return "drives"
    return "stands" if moved_m < MAX_STANDING_M and before_ns == wanted_ns else "unclear"
