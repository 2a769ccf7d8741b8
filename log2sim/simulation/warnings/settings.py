"""Settings of warnings, with their units and limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

from log2sim.datatypes import ENDS
from log2sim.errors import ConfigError
from log2sim.registry import nearest

CHOICES = (*ENDS, "both")
"""Whose observations count: those of the sensors of the ego, of those at the roadside, or all."""

_RANGES = {
    "horizon_s": (0.5, 10.0),
    "min_probability": (0.01, 0.99),
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
        Collisions are predicted for so long.
    min_probability : float
        Of a predicted collision, from which on it is warned of.
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
    horizon_s: float = 3.0
    min_probability: float = 0.5
    reaction_s: float = 1.0
    brake_mps2: float = 8.0

    def __post_init__(self) -> None:
        """Check all values."""
        if self.ends not in CHOICES:
            raise ConfigError(f"warn '{self.ends}'{nearest(self.ends, CHOICES)}: expected one of {', '.join(CHOICES)}")
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise ConfigError(f"warnings: {name} is {value:g}, expected {low:g} to {high:g}")

    @property
    def used_ends(self) -> tuple[str, ...]:
        """Return the ends whose observations count."""
        return ENDS if self.ends == "both" else (self.ends,)

    def stopping_distance_m(self, speed_mps: float) -> float:
        """Return the way in m until a vehicle stands: reaction, then braking."""
        return abs(speed_mps) * self.reaction_s + speed_mps**2 / (2 * self.brake_mps2)

    def needed_mps2(self, speed_mps: float, way_m: float) -> float | None:
        """Return the deceleration that stops a vehicle within a way; None where it is driven before the brakes work."""
        left_m = way_m - abs(speed_mps) * self.reaction_s
        return speed_mps**2 / (2 * left_m) if left_m > 0 else None
