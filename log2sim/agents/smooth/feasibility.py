"""Limits of road vehicles' motion and a check for them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

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
# A limit counts as broken where the motion is beyond it by as many of its own standard deviations.
SIGNIFICANT_SIGMAS = 2.0

PHRASES = {
    "acceleration": "accelerates at {:.0f} m/s2",
    "lateral_acceleration": "accelerates sideways at {:.0f} m/s2",
    "curvature": "turns on a circle of {:.1f} m",
    "jerk": "jerks at {:.0f} m/s3",
}


@dataclass(frozen=True)
class BrokenLimit:
    """A limit that a motion breaks.

    Attributes
    ----------
    name : str
        A key of `PHRASES`.
    worst : float
        Farthest beyond the limit, in its unit.
    worst_s : float, s
        When.
    start_s, end_s : float, s
        First and last time at which it is broken.
    """

    name: str
    worst: float
    worst_s: float
    start_s: float
    end_s: float


def broken_limits(
    t_s: Array,
    acceleration_mps2: Array,
    yaw_rad: Array,
    curvature_1pm: Array,
    sigma: Mapping[str, Array] | None = None,
) -> tuple[BrokenLimit, ...]:
    """Find the limits that a motion breaks anywhere.

    Parameters
    ----------
    t_s : (T,) float64, s
    acceleration_mps2 : (T, 2) float64, m/s2
    yaw_rad : (T,) float64, rad
    curvature_1pm : (T,) float64, 1/m
    sigma : mapping of str to (T,) float64, optional
        Standard deviations of the limited quantities by the names of the limits; 0 where none is given.
    """
    lateral = acceleration_mps2[:, 1] * np.cos(yaw_rad) - acceleration_mps2[:, 0] * np.sin(yaw_rad)
    jerk = np.hypot(*np.diff(acceleration_mps2, axis=0).T) / np.diff(t_s)
    limited = {
        "acceleration": (np.hypot(*acceleration_mps2.T), MAX_ACCELERATION_MPS2),
        "lateral_acceleration": (np.abs(lateral), MAX_LATERAL_MPS2),
        "curvature": (np.abs(curvature_1pm), MAX_CURVATURE_1PM),
        "jerk": (jerk, MAX_JERK_MPS3),
    }
    found = []
    for name, (values, limit) in limited.items():
        margin = SIGNIFICANT_SIGMAS * (sigma or {}).get(name, np.zeros(len(values)))
        broken = np.flatnonzero(values - margin > limit)
        if len(broken):
            worst = int(broken[np.argmax(values[broken])])
            # A difference of two waypoints holds for both of them.
            last = int(broken[-1]) + len(t_s) - len(values)
            times = (float(t_s[k]) for k in (worst, int(broken[0]), last))
            found.append(BrokenLimit(name, float(values[worst]), *times))
    return tuple(found)


def limit_doubts(broken: Iterable[BrokenLimit]) -> tuple[Doubt, ...]:
    """Make doubts of the limits that a motion breaks."""
    doubts = []
    for limit in broken:
        value = 1.0 / limit.worst if limit.name == "curvature" else limit.worst
        reason = f"{PHRASES[limit.name].format(value)} at {limit.worst_s:.1f} s"
        doubts.append(Doubt(limit.name, reason, limit.start_s, limit.end_s))
    return tuple(doubts)
