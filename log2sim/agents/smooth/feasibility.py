"""Limits of road vehicles' motion and a check for them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from log2sim.datatypes import Doubt
from log2sim.geometry import Array

# Beyond these a vehicle's motion is infeasible for Waymax (Gulino et al., 2023).
MAX_ACCELERATION_MPS2 = 10.4
MAX_CURVATURE_1PM = 0.3
# Tires on dry asphalt hold about 0.9 g laterally.
MAX_LATERAL_MPS2 = 8.8
# Brakes need some 0.2 s to build up their full deceleration.
MAX_JERK_MPS3 = 50.0


def broken_limits(t_s: Array, acceleration_mps2: Array, yaw_rad: Array, curvature_1pm: Array) -> tuple[str, ...]:
    """Name the limits that a motion breaks anywhere.

    Parameters
    ----------
    t_s : (T,) float64, s
    acceleration_mps2 : (T, 2) float64, m/s2
    yaw_rad : (T,) float64, rad
    curvature_1pm : (T,) float64, 1/m
    """
    lateral = acceleration_mps2[:, 1] * np.cos(yaw_rad) - acceleration_mps2[:, 0] * np.sin(yaw_rad)
    jerk = np.hypot(*np.diff(acceleration_mps2, axis=0).T) / np.diff(t_s)
    worst = {
        "acceleration": (np.hypot(*acceleration_mps2.T), MAX_ACCELERATION_MPS2),
        "lateral_acceleration": (np.abs(lateral), MAX_LATERAL_MPS2),
        "curvature": (np.abs(curvature_1pm), MAX_CURVATURE_1PM),
        "jerk": (jerk, MAX_JERK_MPS3),
    }
    return tuple(name for name, (values, limit) in worst.items() if values.max(initial=0.0) > limit)


def limit_doubts(names: Iterable[str]) -> tuple[Doubt, ...]:
    """Make doubts of the limits that a motion breaks, by their names from `broken_limits`."""
    return tuple(Doubt(name, f"no vehicle has its {name.replace('_', ' ')}") for name in names)
