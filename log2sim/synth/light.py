"""Light of the sun and the sky on surfaces, and what shiny ones mirror. Directions are in the map frame, colors BGR."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.synth.surfaces import Paint

HAZE_M = 500.0  # distance after which 1/e of the light is left
HOUSES, ROAD = 0.22, 0.09  # light from them, as seen in a mirror


@dataclass(frozen=True)
class Light:
    """Light on a scene; colors are linear BGR.

    Attributes
    ----------
    sun : (float, float, float)
        Unit direction towards the sun.
    sun_color, sky_color : (float, float, float)
        Light on a white surface that faces the sun, and on one that sees the whole sky.
    horizon, zenith : (float, float, float)
        The sky at the horizon and overhead.
    """

    sun: tuple[float, float, float]
    sun_color: tuple[float, float, float]
    sky_color: tuple[float, float, float]
    horizon: tuple[float, float, float]
    zenith: tuple[float, float, float]

    def on_ground(self) -> NDArray[np.float32]:
        """Light (3,) on level ground under the open sky."""
        return np.asarray(np.add(self.sky_color, np.multiply(self.sun_color, self.sun[2])), np.float32)

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
        passed = np.exp(depth_m * np.float32(-1 / HAZE_M))
        added = 1 - passed
        for channel, horizon in enumerate(self.horizon):
            color[..., channel] *= passed
            color[..., channel] += added * np.float32(horizon)
        return color


def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    length = float(np.linalg.norm([x, y, z]))
    return x / length, y / length, z / length


NOON = Light(_unit(-0.45, -0.5, 0.74), (0.80, 0.88, 0.95), (0.56, 0.50, 0.45), (0.78, 0.74, 0.70), (0.72, 0.48, 0.30))


def reflected(
    light: Light,
    surface: Paint,
    n: NDArray[np.float32],
    to_camera: NDArray[np.float32],
    height: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Light (P, 3) from surfaces with unit normals (P, 3) towards a camera; `height` (P,) m above the road."""
    # Channel by channel, because NumPy is slow where the last axis is short.
    sun_x, sun_y, sun_z = (np.float32(x) for x in light.sun)
    n_sun, n_camera = n[:, 0] * sun_x + n[:, 1] * sun_y + n[:, 2] * sun_z, np.einsum("pi,pi->p", n, to_camera)
    camera_sun = to_camera[:, 0] * sun_x + to_camera[:, 1] * sun_y + to_camera[:, 2] * sun_z
    openness = (0.62 + 0.38 * n[:, 2]) * np.clip(0.55 + 0.6 * height, 0.0, 1.0)
    sun, facing = np.clip(n_sun, 0, 1), np.clip(n_camera, 0, 1)
    gloss = surface.gloss * (0.35 + 0.65 * (1 - facing) ** 3)
    sky_share, house_share, road_share = _surroundings(2 * facing * n[:, 2] - to_camera[:, 2])
    glint = 2.0 * surface.gloss * _power_60(np.clip(2 * facing * n_sun - camera_sun, 0, 1))
    out = np.empty((len(n), 3), np.float32)
    for c in range(3):
        lit = openness * np.float32(light.sky_color[c]) + sun * np.float32(light.sun_color[c])
        slope = np.float32(light.zenith[c] - light.horizon[c])
        mirrored = (np.float32(light.horizon[c]) + slope * sky_share[1]) * sky_share[0]
        mirrored += np.float32(HOUSES) * house_share + np.float32(ROAD) * road_share
        out[:, c] = surface.albedo[:, c] * lit + surface.glow[:, c] + gloss * mirrored + glint
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
