"""What no road vehicle does: the limits that a smoothed motion breaks."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Array

# Waymax (Gulino et al., 2023) calls a vehicle's motion infeasible beyond the first two.
MAX_ACCELERATION_MPS2 = 10.4
MAX_CURVATURE_1PM = 0.3
# Tires on dry asphalt hold about 0.9 g sideways.
MAX_LATERAL_MPS2 = 8.8
# Brakes need some 0.2 s to build up their full deceleration.
MAX_JERK_MPS3 = 50.0


def broken_limits(t_s: Array, acceleration_mps2: Array, yaw_rad: Array, curvature_1pm: Array) -> tuple[str, ...]:
    """Names of the limits that a motion with columns (T,), accelerations (T, 2), breaks anywhere."""
    lateral = acceleration_mps2[:, 1] * np.cos(yaw_rad) - acceleration_mps2[:, 0] * np.sin(yaw_rad)
    jerk = np.hypot(*np.diff(acceleration_mps2, axis=0).T) / np.diff(t_s)
    worst = {
        "acceleration": (np.hypot(*acceleration_mps2.T), MAX_ACCELERATION_MPS2),
        "lateral_acceleration": (np.abs(lateral), MAX_LATERAL_MPS2),
        "curvature": (np.abs(curvature_1pm), MAX_CURVATURE_1PM),
        "jerk": (jerk, MAX_JERK_MPS3),
    }
    return tuple(name for name, (values, limit) in worst.items() if values.max(initial=0.0) > limit)
