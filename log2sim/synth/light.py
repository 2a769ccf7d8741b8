"""Light of the sun and the sky on surfaces, and what shiny ones mirror. Directions are in the map frame, colors BGR."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.synth.surfaces import Paint

SUN = np.array([-0.45, -0.5, 0.74]) / np.linalg.norm([-0.45, -0.5, 0.74])
SUN_LIGHT = np.array([0.80, 0.88, 0.95], np.float32)  # BGR
SKY_LIGHT = np.array([0.56, 0.50, 0.45], np.float32)
HORIZON = np.array([0.78, 0.74, 0.70], np.float32)
ZENITH = np.array([0.72, 0.48, 0.30], np.float32)


def reflected(
    surface: Paint, n: NDArray[np.float32], to_camera: NDArray[np.float32], height: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Light (P, 3) from surfaces with unit normals (P, 3) towards a camera; `height` (P,) m above the road."""
    openness = (0.62 + 0.38 * n[:, 2]) * np.clip(0.55 + 0.6 * height, 0.0, 1.0)
    sun = np.clip(n @ SUN.astype(np.float32), 0, 1)
    light = surface.albedo * (openness[:, None] * SKY_LIGHT + sun[:, None] * SUN_LIGHT) + surface.glow
    facing = np.clip((n * to_camera).sum(1), 0, 1)
    mirrored = 2 * facing[:, None] * n - to_camera
    gloss = surface.gloss * (0.35 + 0.65 * (1 - facing) ** 3)
    light += gloss[:, None] * _surroundings(mirrored)
    glint = np.clip(mirrored @ SUN.astype(np.float32), 0, 1) ** 60
    total: NDArray[np.float32] = (light + (surface.gloss * 2.0 * glint)[:, None]).astype(np.float32)
    return total


def _surroundings(direction: NDArray[np.float32]) -> NDArray[np.float32]:
    """Light (P, 3) that a mirror reflects from a direction (P, 3): sky above, houses around, road below."""
    up = direction[:, 2:]
    sky = HORIZON + (ZENITH - HORIZON) * np.clip(up * 1.6, 0, 1)
    houses = np.float32(0.22)
    blend = np.clip((up - 0.12) / 0.1, 0, 1)
    below = np.clip((-up - 0.02) / 0.08, 0, 1)
    light: NDArray[np.float32] = ((houses * (1 - blend) + sky * blend) * (1 - below) + 0.09 * below).astype(np.float32)
    return light
