"""Waypoints: the columns of a trajectory as files hold them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.numerals import short_repr


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
    sigma_yaw_rad, sigma_speed_mps : (T,) float64 or None
        One standard deviation of heading and speed, for each waypoint; None where unknown. Half a turn is no part of
        `sigma_yaw_rad`: whether front and back may be swapped is a doubt of the agent.
    visible : (T,) bool or None
        Whether the sensors could see the agent; only in truth.
    lidar_points : (T,) float64 or None
        LiDAR points in the agent's box, of all LiDARs together; only in truth.
    """

    __repr__ = short_repr

    t_s: Array
    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    observed: NDArray[np.bool_]
    sigma_xy_m: Array
    sigma_yaw_rad: Array | None = None
    sigma_speed_mps: Array | None = None
    visible: NDArray[np.bool_] | None = None
    lidar_points: Array | None = None

    FLOATS = ("t_s", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "sigma_xy_m")
    OPTIONAL_FLOATS = ("sigma_yaw_rad", "sigma_speed_mps")

    def __post_init__(self) -> None:
        """Check that all columns have one length; `ValueError` names the one that has another."""
        for key, column in self.columns().items():
            if len(column) != len(self.t_s):
                raise ValueError(f"waypoints: {key} has {len(column)} values, t_s has {len(self.t_s)}")

    def __len__(self) -> int:
        """Return the number of waypoints."""
        return len(self.t_s)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the columns that there are, by name."""
        names = (*self.FLOATS, "observed", *self.OPTIONAL_FLOATS, "visible", "lidar_points")
        return {key: getattr(self, key) for key in names if getattr(self, key) is not None}

    def take(self, index: Any) -> Self:
        """Take the waypoints at `index`, integers in rising order, a slice or a mask."""
        return type(self)(**{key: column[index] for key, column in self.columns().items()})

    def problem(self) -> str | None:
        """Describe the first defect: no waypoint, a value that is not finite, times that do not increase; None without."""
        if len(self) == 0:
            return "has no waypoints, expected at least one"
        for key, column in self.columns().items():
            finite = np.isfinite(column)
            if not finite.all():
                return f"waypoints.{key} is not finite at index {int(np.argmin(finite))}"
        late = np.diff(self.t_s) <= 0
        if late.any():
            k = int(np.argmax(late)) + 1
            return f"waypoints.t_s does not increase at index {k} ({self.t_s[k]:g} s)"
        return None
