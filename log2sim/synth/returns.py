"""What comes back to a LiDAR: reflectances, losses, noise, mixed pixels, rain and fog.

The power of a return goes with reflectance x incidence / range^2 x exp(-2 extinction x range), the LiDAR equation of an
extended target; a return is lost when it falls below a threshold. Fog extinguishes 3.912 / visibility (Koschmieder, 1924),
rain 1.076 x rate^0.67 dB/km (Carbonneau & Wisely, SPIE 1998); both send returns back from close by.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.polytopes import Material

# Least and greatest reflectance at 905 nm and normal incidence, drawn for each object; dark paint and tires send little.
REFLECTANCE: dict[Material, tuple[float, float]] = {
    Material.GROUND: (0.1, 0.35),
    Material.PAINT: (0.06, 0.75),
    Material.GLASS: (0.02, 0.1),
    Material.DARK: (0.03, 0.15),
    Material.CLOTH: (0.08, 0.6),
    Material.WALL: (0.1, 0.6),
    Material.LEAVES: (0.2, 0.55),
    Material.METAL: (0.2, 0.9),
    Material.MESH: (0.1, 0.5),
    Material.WOOD: (0.15, 0.5),
}
# A target of reflectance 0.1 is seen to about 60 m, to what makers of sensors with a range of 100 to 150 m state.
REFERENCE_RANGE_M = 60.0
MIN_SIGNAL = 0.04
DB_PER_NEPER = 4.343
# Returns of fog and rain come from where the beams of sender and receiver overlap, near the sensor.
BACKSCATTER_REACH_M = 15.0
# Share of the extinguished light that comes back as a return of its own: droplets scatter a few percent backward.
BACKSCATTER_SHARE = 0.08

Kind = Literal["clear", "rain", "fog"]


@dataclass(frozen=True)
class Weather:
    """Weather as a LiDAR feels it.

    Attributes
    ----------
    kind : str
        clear, rain or fog.
    visibility_m : float
        Meteorological visibility in fog, m.
    rain_mm_h : float
        Rate of rain, mm/h.
    """

    kind: Kind = "clear"
    visibility_m: float = 200.0
    rain_mm_h: float = 10.0

    @property
    def extinction_per_m(self) -> float:
        """Share of light that is lost on a meter, 1/m."""
        if self.kind == "fog":
            return 3.912 / self.visibility_m
        if self.kind == "rain":
            return float(1.076 * self.rain_mm_h**0.67 / DB_PER_NEPER / 1000)
        return 0.0


@dataclass(frozen=True)
class ReturnModel:
    """How a sensor loses and disturbs returns.

    Attributes
    ----------
    noise_m : float
        Standard deviation of a distance, m.
    dropout : float
        Share of returns that are lost whatever they hit.
    mixed : float
        Share of returns that lie between two surfaces.
    weather : Weather
    """

    noise_m: float = 0.02
    dropout: float = 0.03
    mixed: float = 0.002
    weather: Weather = Weather()


def reflected(
    range_m: NDArray[np.float32], reflectance: NDArray[np.float32], incidence: NDArray[np.float32], weather: Weather
) -> NDArray[np.float32]:
    """Signal (N,) of returns relative to a target of reflectance 1 at `REFERENCE_RANGE_M` in clear air.

    Parameters
    ----------
    range_m : (N,) float32, m
    reflectance : (N,) float32
    incidence : (N,) float32
        Cosine of the angle between ray and normal.
    weather : Weather
    """
    lost = np.exp(np.float32(-2 * weather.extinction_per_m) * range_m)
    nearness = np.maximum(range_m / np.float32(REFERENCE_RANGE_M), np.float32(0.05))
    return np.asarray(reflectance * np.maximum(incidence, np.float32(0.05)) ** np.float32(0.7) * lost / nearness**2)


def detected(signal: NDArray[np.float32], model: ReturnModel, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw which returns (N,) are above the threshold; those near to it come and go."""
    chance = np.clip(1.15 - MIN_SIGNAL / np.maximum(signal, 1e-4), 0, 1) * (1 - model.dropout)
    return np.asarray(rng.random(len(signal), dtype=np.float32) < chance)


def backscattered(range_m: NDArray[np.float32], weather: Weather, rng: np.random.Generator) -> Array:
    """Distances (N,) at which rays come back from fog or rain before they reach a surface; inf where they do not.

    Parameters
    ----------
    range_m : (N,) float32, m
        Distances to the surfaces, inf without one.
    """
    out = np.full(len(range_m), np.inf)
    if weather.extinction_per_m == 0:
        return out
    reach = np.minimum(range_m, BACKSCATTER_REACH_M)
    # Rain drops are larger and fewer: what they take away comes back as single returns, too.
    chance = BACKSCATTER_SHARE * (1 - np.exp(-weather.extinction_per_m * reach))
    hit = rng.random(len(range_m)) < chance
    out[hit] = rng.uniform(0.05, 1, hit.sum()) * reach[hit]
    return out


def disturbed(range_m: NDArray[np.float32], model: ReturnModel, rng: np.random.Generator) -> NDArray[np.float32]:
    """Add noise to distances (N,) and move some of them off an edge, as pixels that mix two surfaces are."""
    out = range_m + rng.standard_normal(len(range_m), dtype=np.float32) * np.float32(model.noise_m)
    mixed = rng.random(len(out), dtype=np.float32) < model.mixed
    out[mixed] += rng.exponential(0.8, int(mixed.sum())).astype(np.float32)
    return np.asarray(out)
