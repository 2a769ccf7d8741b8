"""LiDARs as data, and what comes back to them.

Elevations are those of the makers' manuals: Velodyne VLP-16, HDL-32E, VLP-32C, HDL-64E S2; RoboSense RS-LiDAR-16, M1; Hesai
Pandar64, PandarGT; Ouster OS1.

The power of a return goes with reflectance x incidence / range^2 x exp(-2 extinction x range), the LiDAR equation of an
extended target; a return is lost when it falls below a threshold. Fog and rain also send returns back from close by.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from log2sim.errors import ConfigError
from log2sim.files.documents import first_problem
from log2sim.files.inputs import read_text
from log2sim.files.plugins import nearest
from log2sim.geometry import Array
from log2sim.synth.polytopes import Material
from log2sim.synth.scene import Environment

MAX_FILE_BYTES = 65536
MAX_RAYS = 4_000_000

Angle = Annotated[float, Field(ge=-90, le=90)]
Azimuth = Annotated[float, Field(ge=-180, le=180)]


class LidarModel(BaseModel):
    """A LiDAR whose rays form a grid of lines by azimuths; it turns clockwise from the left end of its field of view."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str = "custom"
    elevation_deg: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=512)]  # of each line, deg
    azimuth_deg: tuple[Azimuth, Azimuth] = (-180.0, 180.0)  # right and left end of the field of view, deg
    azimuth_step_deg: Annotated[float, Field(ge=0.02, le=10)] = 0.2  # angle between two firings, deg
    range_m: Annotated[float, Field(ge=1, le=500)] = 100.0  # largest measured distance, m
    noise_m: Annotated[float, Field(ge=0, le=1)] = 0.02  # standard deviation of a distance, m
    rate_hz: Annotated[float, Field(ge=0.1, le=100)] = 10.0  # sweeps per second, 1/s
    height_m: Annotated[float, Field(ge=0.1, le=50)] = 1.8  # usual height above the ground, m
    pitch_deg: Angle = 0.0  # usual pitch, positive downward, deg

    def azimuths_rad(self) -> Array:
        """Azimuths (A,) of the firings in their order, from the left (high) to the right (low), rad."""
        low, high = self.azimuth_deg
        count = max(1, round((high - low) / self.azimuth_step_deg))
        return np.asarray(np.deg2rad(high - (np.arange(count) + 0.5) * (high - low) / count))

    def elevations_rad(self) -> Array:
        """Elevations (L,) of the lines, rad."""
        return np.asarray(np.deg2rad(np.array(self.elevation_deg)))


def _even(low: float, high: float, lines: int) -> tuple[float, ...]:
    return tuple(np.linspace(low, high, lines).round(4).tolist())


_HDL64 = (*np.round(2 - np.arange(32) / 3, 3).tolist(), *np.round(-8.83 - np.arange(32) / 2, 3).tolist())
_PANDAR64 = (
    15.0, 11.0, 8.0, 5.0, 3.0, 2.0, *np.round(2 - np.arange(1, 49) / 6, 3).tolist(),
    -7.0, -8.0, -9.0, -10.0, -11.0, -12.0, -13.0, -14.0, -19.0, -25.0,
)  # fmt: skip
_VLP32C = (
    -25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667, -4.0, -3.667, -3.333, -3.0, -2.667, -2.333, -2.0, -1.667,
    -1.333, -1.0, -0.667, -0.333, 0.0, 0.333, 0.667, 1.0, 1.333, 1.667, 2.333, 3.333, 4.667, 7.0, 10.333, 15.0,
)  # fmt: skip

LIDAR_MODELS = {
    model.name: model
    for model in (
        LidarModel(name="vlp16", elevation_deg=_even(-15, 15, 16), noise_m=0.03, range_m=100),
        LidarModel(name="rslidar16-roadside", elevation_deg=_even(-15, 15, 16), range_m=150, height_m=3.6, pitch_deg=31.25),
        LidarModel(name="rslidar16", elevation_deg=_even(-15, 15, 16), range_m=150),
        LidarModel(name="hdl32e", elevation_deg=_even(-30.67, 10.67, 32), range_m=80),
        LidarModel(name="vlp32c", elevation_deg=_VLP32C, noise_m=0.03, range_m=150),
        LidarModel(name="hdl64e", elevation_deg=_HDL64, azimuth_step_deg=0.17, height_m=1.73),
        LidarModel(name="pandar64", elevation_deg=_PANDAR64, range_m=150),
        LidarModel(name="os1-64", elevation_deg=_even(-22.5, 22.5, 64), azimuth_step_deg=0.3516, noise_m=0.015),
        LidarModel(name="os1-128", elevation_deg=_even(-22.5, 22.5, 128), azimuth_step_deg=0.3516, noise_m=0.015),
        LidarModel(name="rslidar-m1", elevation_deg=_even(-12.5, 12.5, 125), azimuth_deg=(-60.0, 60.0), range_m=150, noise_m=0.025),
        LidarModel(name="pandargt", elevation_deg=_even(-10, 10, 150), azimuth_deg=(-30.0, 30.0), azimuth_step_deg=0.1, range_m=200),
    )
}  # fmt: skip
"""Sensors by name: spinning ones of 16, 32, 64 and 128 lines, solid-state ones with a field of view of 120 and 60 degrees."""


def lidar_model(name_or_path: str) -> LidarModel:
    """Return a LiDAR of the table, or read one from a TOML file with the attributes of `LidarModel` as keys.

    Raises `ConfigError` for an unknown name, an unreadable file, an unknown key or an impossible value.
    """
    if name_or_path in LIDAR_MODELS:
        return LIDAR_MODELS[name_or_path]
    path = Path(name_or_path)
    if path.suffix != ".toml":
        known = list(LIDAR_MODELS)
        raise ConfigError(
            f"no LiDAR '{name_or_path}'{nearest(name_or_path, known)}; known: {', '.join(known)}, or a .toml file"
        )
    text = read_text(path, MAX_FILE_BYTES, ConfigError)
    try:
        model = LidarModel.model_validate({"name": path.stem, **tomllib.loads(text)})
    except ValidationError as problem:
        raise ConfigError(f"{path}: {first_problem(problem, LidarModel)}") from None
    except (tomllib.TOMLDecodeError, RecursionError) as problem:
        raise ConfigError(f"{path}: not valid TOML: {problem}") from None
    if model.azimuth_deg[0] >= model.azimuth_deg[1]:
        raise ConfigError(f"{path}: azimuth_deg {list(model.azimuth_deg)}: expected the right end before the left end")
    if len(model.elevation_deg) * len(model.azimuths_rad()) > MAX_RAYS:
        raise ConfigError(f"{path}: more than {MAX_RAYS} rays a sweep")
    return model


# Least and greatest reflectance at 905 nm and normal incidence, drawn for each object; dark paint and tires send little.
REFLECTANCE: dict[Material, tuple[float, float]] = {
    Material.GROUND: (0.1, 0.35), Material.PAINT: (0.06, 0.75), Material.GLASS: (0.02, 0.1),
    Material.DARK: (0.03, 0.15), Material.CLOTH: (0.08, 0.6), Material.WALL: (0.1, 0.6), Material.LEAVES: (0.2, 0.55),
    Material.METAL: (0.2, 0.9), Material.MESH: (0.1, 0.5), Material.WOOD: (0.15, 0.5),
}  # fmt: skip
# A target of reflectance 0.1 is seen to about 60 m, to what makers of sensors with a range of 100 to 150 m state.
REFERENCE_RANGE_M = 60.0
MIN_SIGNAL = 0.04
# Returns of fog and rain come from where the beams of sender and receiver overlap, near the sensor.
BACKSCATTER_REACH_M = 15.0
# Share of the extinguished light that comes back as a return of its own: droplets scatter a few percent backward.
BACKSCATTER_SHARE = 0.08
CLEAR = Environment()


@dataclass(frozen=True)
class ReturnModel:
    """How a sensor loses and disturbs returns."""

    noise_m: float = 0.02  # standard deviation of a distance, m
    dropout: float = 0.03  # share of returns that are lost whatever they hit
    mixed: float = 0.002  # share of returns that lie between two surfaces
    weather: Environment = CLEAR
    line_m: float = 0.0  # standard deviation of the errors that the lines have after calibration, m
    walk_m: float = 0.0  # by how much a return is measured nearer for each factor of e of its intensity, m
    edge_m: float = 0.0  # mean by which a beam that an outline cuts is measured farther, m


def reflected(
    range_m: NDArray[np.float32], reflectance: NDArray[np.float32], incidence: NDArray[np.float32], weather: Environment
) -> NDArray[np.float32]:
    """Signal (N,) of returns relative to a target of reflectance 1 at `REFERENCE_RANGE_M` in clear air.

    `range_m`, m, `reflectance`, and `incidence`, the cosine of the angle between ray and normal: (N,) float32.
    """
    lost = np.exp(np.float32(-2 * weather.extinction_per_m) * range_m)
    nearness = np.maximum(range_m / np.float32(REFERENCE_RANGE_M), np.float32(0.05))
    return np.asarray(reflectance * np.maximum(incidence, np.float32(0.05)) ** np.float32(0.7) * lost / nearness**2)


def detected(signal: NDArray[np.float32], model: ReturnModel, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw which returns (N,) are above the threshold; those near to it come and go."""
    chance = np.clip(1.15 - MIN_SIGNAL / np.maximum(signal, 1e-4), 0, 1) * (1 - model.dropout)
    return np.asarray(rng.random(len(signal), dtype=np.float32) < chance)


def backscattered(range_m: NDArray[np.float32], weather: Environment, rng: np.random.Generator) -> Array:
    """Distances (N,) at which rays come back from fog or rain before they reach a surface; inf where they do not.

    `range_m` (N,) float32, m: distances to the surfaces, inf without one.
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


# A beam is so wide, as makers of spinning sensors state it, rad; distances are calibrated on surfaces of this intensity.
BEAM_RAD, CALIBRATED_INTENSITY = 0.003, 0.2


def disturbed(
    range_m: NDArray[np.float32], intensity: NDArray[np.float32], line: NDArray[np.intp], gap_m: NDArray[np.float32],
    lidar: LidarModel, model: ReturnModel, rng: np.random.Generator,
) -> NDArray[np.float32]:  # fmt: skip
    """Add to distances (N,) the errors that a sensor has: noise, of its lines, by intensity, and at outlines.

    `gap_m` (N,): how much farther the next ray of the same line reaches, to either side. An outline is anywhere between two rays, and
    what it leaves of a beam returns late. On posts of 0.1 m KITTI's LiDAR errs by 0.10 to 0.12 m (standard deviation; BENCHMARKS.md).
    """
    out = range_m + rng.standard_normal(len(range_m), dtype=np.float32) * np.float32(model.noise_m)
    mixed = rng.random(len(out), dtype=np.float32) < model.mixed
    out[mixed] += rng.exponential(0.8, int(mixed.sum())).astype(np.float32)
    out += rng.normal(0, model.line_m, len(lidar.elevation_deg)).astype(np.float32)[line]
    out -= np.float32(model.walk_m) * np.log(intensity / np.float32(CALIBRATED_INTENSITY))
    cut = np.flatnonzero(rng.random(len(out)) < BEAM_RAD / np.deg2rad(lidar.azimuth_step_deg))
    out[cut] += np.clip(rng.exponential(model.edge_m, len(cut)), 0, gap_m[cut]).astype(np.float32)
    return np.asarray(out)
