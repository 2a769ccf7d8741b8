"""What is known of how an object moves, and what smoothing its positions gives."""

from __future__ import annotations

from dataclasses import dataclass

from log2sim.agents.smooth.feasibility import MAX_CURVATURE_1PM
from log2sim.agents.smooth.heading import UNKNOWN_YAW_RAD
from log2sim.geometry import Array


@dataclass(frozen=True)
class MotionModel:
    """What is known of how an object moves.

    Attributes
    ----------
    jerk_density : float, optional
        Spectral density of the jerk in m2/s5; None to estimate it.
    holonomic : bool
        Whether it may move in any direction, as pedestrians do.
    heading_rad : float, optional
        Heading where the motion does not give one.
    heading_sigma_rad : float
        Its standard deviation.
    max_curvature_1pm : float, 1/m
        Of its way, unless it is holonomic.
    """

    jerk_density: float | None = None
    holonomic: bool = False
    heading_rad: float | None = None
    heading_sigma_rad: float = UNKNOWN_YAW_RAD
    max_curvature_1pm: float = MAX_CURVATURE_1PM

    @property
    def density_by_direction(self) -> bool:
        """Whether the jerk densities along and across the path are estimated separately."""
        return self.jerk_density is None and not self.holonomic


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A smoothed trajectory at the asked times and what was found out about the observations.

    Attributes
    ----------
    state : (T, 3, 2) float64
        Position in m, velocity in m/s, acceleration in m/s2.
    covariance : (T, 6, 6) float64
    yaw_rad, sigma_yaw_rad : (T,) float64
    residual_m : (n,) float64
        Distance of each observation from the trajectory.
    weight : (n,) float64
        Weight of each observation in [0, 1].
    jerk_density : (float, float)
        Along and across the path, m2/s5.
    """

    state: Array
    covariance: Array
    yaw_rad: Array
    sigma_yaw_rad: Array
    residual_m: Array
    weight: Array
    jerk_density: tuple[float, float]
