"""Waypoints: the columns of a trajectory as files hold them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class Waypoints:
    """A trajectory of the box center as columns, map frame.

    Attributes
    ----------
    t_s : (T,) float64, s
        Strictly increasing times since the scenario's start.
    x_m, y_m, z_m : (T,) float64, m
        Box center.
    yaw_rad : (T,) float64
    speed_mps : (T,) float64, m/s
        Along the heading, negative when reversing.
    observed : (T,) bool
        False where a gap was filled.
    sigma_xy_m : (T,) float64, m
        One standard deviation of the position.
    visible : (T,) bool or None
        Whether the sensors could see the agent; only in truth.
    """

    t_s: Array
    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    observed: NDArray[np.bool_]
    sigma_xy_m: Array
    visible: NDArray[np.bool_] | None = None

    FLOATS = ("t_s", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "sigma_xy_m")

    def __post_init__(self) -> None:
        """Check that all columns have one length; `ValueError` names the one that has another."""
        for key in (*self.FLOATS, "observed", "visible"):
            column = getattr(self, key)
            if column is not None and len(column) != len(self.t_s):
                raise ValueError(f"waypoints: {key} has {len(column)} values, t_s has {len(self.t_s)}")

    def __len__(self) -> int:
        """Return the number of waypoints."""
        return len(self.t_s)

    def problem(self) -> str | None:
        """Describe the first defect: no waypoint, a value that is not finite, times that do not increase; None without."""
        if len(self) == 0:
            return "has no waypoints, expected at least one"
        for key in self.FLOATS:
            finite = np.isfinite(getattr(self, key))
            if not finite.all():
                return f"waypoints.{key} is not finite at index {int(np.argmin(finite))}"
        late = np.diff(self.t_s) <= 0
        if late.any():
            k = int(np.argmax(late)) + 1
            return f"waypoints.t_s does not increase at index {k} ({self.t_s[k]:g} s)"
        return None
