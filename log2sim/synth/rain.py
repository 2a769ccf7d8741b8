"""Rain in a picture: streaks of drops that fall during the exposure, and a wet road."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.synth.light import Light
from log2sim.synth.render_camera import RenderCamera
from log2sim.synth.scenery import Image

STREAKS_PER_MM_H = 40.0  # in an image of a million pixels, as wide as high fields of view are
FALL_M_PER_EXPOSURE = 0.07  # 7 m/s in a hundredth of a second
NEAREST_M, FARTHEST_M = 0.6, 8.0
DROP_M = 0.002
WATER_REFLECTANCE = 0.02  # at normal incidence
ROUGH_SHARE = 0.5  # a road is rough, so it mirrors less than a pond


def mirror_sky(view: RenderCamera, light: Light, color: Image, ground: NDArray[np.bool_]) -> None:
    """Let wet ground (H, W) mirror the sky, the more the flatter the view (Schlick, 1994); in place."""
    if light.wetness <= 0:
        return
    rows = np.flatnonzero(ground.any(1))
    if len(rows) == 0:
        return
    band = slice(int(rows[0]), int(rows[-1]) + 1)
    below = np.clip(-view.rise()[band], 0, None)
    sine = below / np.sqrt(1 + below * below)
    share = np.float32(light.wetness * ROUGH_SHARE) * (WATER_REFLECTANCE + (1 - WATER_REFLECTANCE) * (1 - sine) ** 5)
    share = np.where(ground[band], share, np.float32(0))[..., None]
    color[band] += (np.array(light.horizon, np.float32) - color[band]) * share


def draw_rain(view: RenderCamera, light: Light, color: Image, rng: np.random.Generator) -> None:
    """Draw streaks over a picture (H, W, 3), in place."""
    if light.rain_mm_h <= 0:
        return
    count = int(STREAKS_PER_MM_H * light.rain_mm_h * view.width_px * view.height_px / 1e6)
    # Uniform in the volume of the view: a share of depth cubed.
    away = np.cbrt(rng.uniform(NEAREST_M**3, FARTHEST_M**3, count))
    u, v = rng.uniform(0, view.width_px, count), rng.uniform(-20, view.height_px, count)
    slant = rng.normal(0.06, 0.03, count)
    length = FALL_M_PER_EXPOSURE * view.K[1, 1] / away
    width = DROP_M * view.K[0, 0] / away
    mask = np.zeros(color.shape[:2], np.uint8)
    for k in range(count):
        # Thinner than a pixel: fainter instead.
        shade = int(255 * min(1.0, 0.3 + width[k]) * 0.55)
        start = (round(u[k] * 16), round(v[k] * 16))
        end = (round((u[k] + slant[k] * length[k]) * 16), round((v[k] + length[k]) * 16))
        cv2.line(mask, start, end, shade, max(1, round(width[k])), cv2.LINE_AA, 4)
    share = cv2.GaussianBlur(mask, (0, 0), 0.7).astype(np.float32)[..., None] * np.float32(1 / 255)
    drops = np.array(light.horizon, np.float32) * np.float32(1.1) + np.float32(0.1 * light.exposure)
    color += (drops - color) * share
