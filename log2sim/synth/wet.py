"""Glare on a wet road: the sun and lamps in a film of water that lies on rough asphalt."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.synth.bodies import Lighting
from log2sim.synth.lamps import HEADLIGHT_COLOR, STREET_COLOR, lamplight
from log2sim.synth.rain import ROUGH_SHARE, WATER_REFLECTANCE
from log2sim.synth.render_camera import RenderCamera
from log2sim.synth.scenery import Image

ROUGHNESS = 0.15  # root mean square slope of the film, as asphalt leaves it when it rains
MAX_GLARE = 3.0  # of the brightest white; more than a picture can show
COARSENESS = 2  # of the grid on which it is computed


def mirror_lights(view: RenderCamera, lit: Lighting, color: Image, depth: Image, ground: NDArray[np.bool_]) -> None:
    """Let wet ground (H, W) mirror the sun and lamps towards the camera; in place, nothing without glare.

    Notes
    -----
    Facets with Gaussian slopes (Beckmann & Spizzichino, 1963), the reflectance of water after Schlick (1994).
    """
    light = lit.light
    if not light.glare or light.wetness <= 0 or not ground.any():
        return
    u, v = np.arange(0, view.width_px, COARSENESS), np.arange(0, view.height_px, COARSENESS)
    grid_u, grid_v = (x.ravel() for x in np.meshgrid(u, v))
    rays = view.directions(grid_u, grid_v).astype(np.float32)
    points = rays * depth[grid_v, grid_u][:, None] + view.map_T_cam[:3, 3].astype(np.float32)
    to_camera = -rays / np.linalg.norm(rays, axis=1, keepdims=True)
    added = np.zeros((len(rays), 3), np.float32)
    if light.sun[2] > 0:
        toward = np.broadcast_to(np.array(light.sun, np.float32), rays.shape)
        added += _gain(to_camera, toward)[:, None] * np.array(light.sun_color, np.float32)
    for lamp in lit.lamps:
        offset = lamp.position_m.astype(np.float32) - points
        toward = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), np.float32(0.1))
        tint = np.array(STREET_COLOR if lamp.forward is None else HEADLIGHT_COLOR, np.float32)
        strength = lamplight((lamp,), light.exposure, points, None).mean(1) / tint.mean()
        added += (_gain(to_camera, toward) * strength)[:, None] * tint
    share = np.float32(light.wetness * ROUGH_SHARE)
    glare = np.clip(added * share, 0, MAX_GLARE).reshape(len(v), len(u), 3)
    wide = cv2.resize(glare, (view.width_px, view.height_px), interpolation=cv2.INTER_LINEAR)
    color += np.where(ground[..., None], wide, np.float32(0))


def _gain(to_camera: Image, to_light: Image) -> Image:
    """Light (N,) from level water relative to that from white ground which faces the light."""
    half = to_camera + to_light
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), np.float32(1e-6))
    up = np.clip(half[:, 2], 0.05, 1)
    steepness = (1 - up**2) / up**2
    facets = np.exp(-steepness / ROUGHNESS**2) / (4 * ROUGHNESS**2 * up**4)
    grazing = 1 - np.clip(np.einsum("ni,ni->n", half, to_camera), 0, 1)
    mirrored = WATER_REFLECTANCE + (1 - WATER_REFLECTANCE) * grazing**5
    lit = to_light[:, 2] > 0
    return np.asarray(np.where(lit, mirrored * facets / np.maximum(to_camera[:, 2], 0.05), 0), np.float32)
