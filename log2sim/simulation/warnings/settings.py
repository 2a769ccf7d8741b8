"""Settings of warnings, with their units and limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ENDS
from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.registry import nearest

CHOICES = (*ENDS, "both")
"""Whose observations count: those of the sensors of the ego, of those at the roadside, or all."""

_RANGES = {
    "horizon_s": (0.5, 10.0),
    "margin_s": (0.0, 10.0),
    "early_probability": (0.01, 1.0),
    "min_probability": (0.01, 1.0),
    "reaction_s": (0.0, 10.0),
    "brake_mps2": (0.5, 20.0),
}


@dataclass(frozen=True)
class WarningSettings:
    """When the ego is warned, and how it brakes.

    With the defaults a vehicle at 30 km/h stands after 12.7 m, 8.3 m of which it drives before it brakes.

    Attributes
    ----------
    ends : {"both", "vehicle", "road"}
        Whose observations count.
    horizon_s : float, s
        Collisions are predicted for so long: from 200 km/h, a vehicle stands after 4.5 s.
    min_probability : float
        Of a predicted collision, from which on it is warned of when the ego has to react at once to stand before it.
    early_probability : float
        The same up to `margin_s` earlier: while there is time to wait, a doubtful prediction is waited for to become clear.
    margin_s : float, s
        Still earlier, there is no warning: who walks or drives toward the ego's path then usually stops before it.
    reaction_s : float, s
        From the warning until the brakes work.
    brake_mps2 : float, m/s2
        Deceleration: of a dry road, less what brakes need to build up.

    Raises
    ------
    ConfigError
        For a value out of its range.
    """

    ends: str = "both"
    horizon_s: float = 5.0
    min_probability: float = 0.5
    early_probability: float = 0.8
    margin_s: float = 1.0
    reaction_s: float = 1.0
    brake_mps2: float = 8.0

    def __post_init__(self) -> None:
        """Check all values."""
        if self.ends not in CHOICES:
            raise ConfigError(
                f"warn '{self.ends}'{nearest(self.ends, list(CHOICES))}: expected one of {', '.join(CHOICES)}"
            )
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise ConfigError(f"warnings: {name} is {value:g}, expected {low:g} to {high:g}")

    @property
    def used_ends(self) -> tuple[str, ...]:
        """Return the ends whose observations count."""
        return ENDS if self.ends == "both" else (self.ends,)

    def stopping_distance_m(self, speed_mps: Array) -> Array:
        """Return the ways in m until a vehicle stands: reaction, then braking."""
        return np.asarray(np.abs(speed_mps) * self.reaction_s + speed_mps**2 / (2 * self.brake_mps2))

    def is_due(self, probability: Array, way_m: Array, speed_mps: Array) -> NDArray[np.bool_]:
        """Whether to warn of collisions (C,) of probabilities, after ways of the ego in m, at its speeds."""
        left_m = way_m - self.stopping_distance_m(speed_mps)
        early = (probability >= self.early_probability) & (left_m <= np.abs(speed_mps) * self.margin_s)
        return np.asarray(early | (probability >= self.min_probability) & (left_m <= 0))

    def needed_mps2(self, speed_mps: float, way_m: float) -> float | None:
        """Return the deceleration that stops a vehicle within a way; None where it is driven before the brakes work."""
        left_m = way_m - abs(speed_mps) * self.reaction_s
        return speed_mps**2 / (2 * left_m) if left_m > 0 else None
