"""Light of the sun and the sky on surfaces, and what shiny ones mirror. Directions are in the map frame, colors BGR."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.synth.returns import Weather
from log2sim.synth.scene import Environment
from log2sim.synth.surfaces import Paint

Color = tuple[float, float, float]

HOUSES, ROAD = 0.22, 0.09  # light from them relative to the sky's on a surface, as seen in a mirror
WET_ALBEDO = 0.62  # of a wet road relative to a dry one


@dataclass(frozen=True)
class Light:
    """Light on a scene and what the air does to it; colors are linear BGR at the exposure of the camera.

    Attributes
    ----------
    sun : (float, float, float)
        Unit direction towards the sun.
    sun_color, sky_color : (float, float, float)
        Light on a white surface that faces the sun, and on one that sees the whole sky.
    horizon, zenith : (float, float, float)
        The sky at the horizon and overhead.
    extinction_per_m : float
        Share of light that the air takes on a meter.
    lamps : float
        Brightness of headlights, rear lights and street lights, relative to what surfaces emit by day.
    wetness : float
        From 0 for a dry road to 1 for a wet one.
    rain_mm_h : float
    noise : float
        Of the camera, relative to daylight.
    exposure : float
        Relative to that of a night, at which lamps light the road well.
    glare : bool
        Whether wet ground mirrors the sun and lamps.
    """

    sun: Color
    sun_color: Color
    sky_color: Color
    horizon: Color
    zenith: Color
    extinction_per_m: float = 1 / 500
    lamps: float = 0.0
    wetness: float = 0.0
    rain_mm_h: float = 0.0
    noise: float = 1.0
    exposure: float = 0.01
    glare: bool = False

    def on_ground(self) -> NDArray[np.float32]:
        """Light (3,) that level ground under the open sky gives back relative to its dry color."""
        dry = np.add(self.sky_color, np.multiply(self.sun_color, self.sun[2]))
        return np.asarray(dry * (1 - (1 - WET_ALBEDO) * self.wetness), np.float32)

    def on_wall(self, outward: NDArray[np.float64]) -> NDArray[np.float32]:
        """Light (3,) on an upright wall with an outward normal (2,)."""
        share = max(0.0, float(np.dot(outward, self.sun[:2])))
        return np.asarray(np.multiply(self.sky_color, 0.75) + np.multiply(self.sun_color, share), np.float32)

    def sun_share(self) -> np.float32:
        """Share of the light on level ground that comes from the sun, less what houses and trees throw back."""
        sun = float(np.mean(self.sun_color)) * self.sun[2]
        return np.float32(0.96 * sun / (sun + float(np.mean(self.sky_color))))

    def hazy(self, color: NDArray[np.float32], depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Dim light (..., 3), in place, by the air over distances (...)."""
        passed = np.exp(depth_m * np.float32(-self.extinction_per_m))
        added = 1 - passed
        for channel, horizon in enumerate(self.horizon):
            color[..., channel] *= passed
            color[..., channel] += added * np.float32(horizon)
        return color


def _unit(x: float, y: float, z: float) -> Color:
    length = float(np.linalg.norm([x, y, z]))
    return x / length, y / length, z / length


_HIGH = _unit(-0.45, -0.5, 0.74)
NOON = Light(_HIGH, (0.80, 0.88, 0.95), (0.56, 0.50, 0.45), (0.78, 0.74, 0.70), (0.72, 0.48, 0.30))
# Colors follow the sun's temperature: 5500 K at noon, 6500 K under clouds, 3000 K when it sets; shadows are blue then.
OVERCAST = Light(
    _HIGH, (0.05, 0.05, 0.05), (0.78, 0.76, 0.74), (0.80, 0.79, 0.78), (0.66, 0.65, 0.64), extinction_per_m=1 / 400
)
DUSK = Light(
    _unit(-0.86, -0.42, 0.16), (0.16, 0.40, 0.85), (0.30, 0.22, 0.19), (0.42, 0.52, 0.70), (0.30, 0.18, 0.13),
    lamps=4.0, noise=2.0, exposure=0.2,
)  # fmt: skip
NIGHT = Light(
    _HIGH,
    (0.0, 0.0, 0.0),
    (0.030, 0.023, 0.019),
    (0.030, 0.024, 0.022),
    (0.012, 0.008, 0.006),
    lamps=10.0,
    noise=5.0,
    exposure=1.0,
)
LIGHTS = {"noon": NOON, "overcast": OVERCAST, "dusk": DUSK, "night": NIGHT}


def weather_of(environment: Environment) -> Weather:
    """Weather of a scene as it weakens light and a LiDAR's returns."""
    return Weather(environment.weather, environment.visibility_m, environment.rain_mm_h)


def light_of(environment: Environment) -> Light:
    """Light of a scene's environment: fog and rain hide the sun and gray the sky, lamps are on.

    Rain takes light besides what clear air takes, fog so much more that the air does not count.
    """
    light = _in_weather(LIGHTS[environment.light], environment)
    wetness = light.wetness if environment.wetness is None else environment.wetness
    return replace(light, wetness=wetness, glare=environment.glare)


def _in_weather(light: Light, environment: Environment) -> Light:
    if environment.weather == "clear":
        return light
    fog = environment.weather == "fog"
    extinction = weather_of(environment).extinction_per_m + (0.0 if fog else light.extinction_per_m)
    sky = np.add(light.sky_color, np.multiply(light.sun_color, 0.5 * light.sun[2]))
    gray = (sky + 2 * sky.mean()) / 3 * (1.0 if fog else 0.8)
    return replace(
        light,
        sun_color=_color(np.multiply(light.sun_color, 0.06)),
        sky_color=_color(gray),
        horizon=_color(gray * 0.92),
        zenith=_color(gray * (0.88 if fog else 0.7)),
        extinction_per_m=extinction,
        lamps=max(light.lamps, 3.0),
        wetness=0.3 if fog else 1.0,
        rain_mm_h=0.0 if fog else environment.rain_mm_h,
        noise=light.noise * 1.3,
    )


def _color(values: NDArray[np.float64]) -> Color:
    blue, green, red = (float(v) for v in values)
    return blue, green, red


def reflected(
    light: Light,
    surface: Paint,
    n: NDArray[np.float32],
    to_camera: NDArray[np.float32],
    height: NDArray[np.float32],
    lamplight: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Light (P, 3) from surfaces with unit normals (P, 3) towards a camera.

    Parameters
    ----------
    height : (P,) float32, m
        Above the road.
    lamplight : (P, 3) float32, optional
        Light of lamps on the surfaces.
    """
    # Channel by channel, because NumPy is slow where the last axis is short.
    sun_x, sun_y, sun_z = (np.float32(x) for x in light.sun)
    n_sun, n_camera = n[:, 0] * sun_x + n[:, 1] * sun_y + n[:, 2] * sun_z, np.einsum("pi,pi->p", n, to_camera)
    camera_sun = to_camera[:, 0] * sun_x + to_camera[:, 1] * sun_y + to_camera[:, 2] * sun_z
    openness = (0.62 + 0.38 * n[:, 2]) * np.clip(0.55 + 0.6 * height, 0.0, 1.0)
    sun, facing = np.clip(n_sun, 0, 1), np.clip(n_camera, 0, 1)
    gloss = surface.gloss * (0.35 + 0.65 * (1 - facing) ** 3)
    sky_share, house_share, road_share = _surroundings(2 * facing * n[:, 2] - to_camera[:, 2])
    glint = 2.0 * surface.gloss * _power_60(np.clip(2 * facing * n_sun - camera_sun, 0, 1))
    surrounding = np.float32(np.mean(light.sky_color) / np.mean(NOON.sky_color))
    emission = np.float32(max(1.0, light.lamps))
    out = np.empty((len(n), 3), np.float32)
    for c in range(3):
        lit = openness * np.float32(light.sky_color[c]) + sun * np.float32(light.sun_color[c])
        slope = np.float32(light.zenith[c] - light.horizon[c])
        mirrored = (np.float32(light.horizon[c]) + slope * sky_share[1]) * sky_share[0]
        mirrored += (np.float32(HOUSES) * house_share + np.float32(ROAD) * road_share) * surrounding
        if lamplight is not None:
            lit += lamplight[:, c]
        sparkle = glint * np.float32(light.sun_color[c] / NOON.sun_color[c])
        out[:, c] = surface.albedo[:, c] * lit + surface.glow[:, c] * emission + gloss * mirrored + sparkle
    return out


def _surroundings(
    up: NDArray[np.float32],
) -> tuple[tuple[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32], NDArray[np.float32]]:
    """Say what mirrors show that look up by a sine (P,): shares of the sky (and how high), of houses and of the road."""
    blend = np.clip((up - 0.12) / 0.1, 0, 1)
    below = np.clip((-up - 0.02) / 0.08, 0, 1)
    return (blend * (1 - below), np.clip(up * 1.6, 0, 1)), (1 - blend) * (1 - below), below


def _power_60(x: NDArray[np.float32]) -> NDArray[np.float32]:
    x4 = x * x * x * x
    x8 = x4 * x4
    x16 = x8 * x8
    power: NDArray[np.float32] = x16 * x16 * x16 * x8 * x4
    return power
