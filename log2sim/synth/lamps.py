"""Headlights and street lights: what they light up, and how they glare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from log2sim.geometry import Array, apply, inverse
from log2sim.synth.light import Color, Light
from log2sim.synth.render_camera import RenderCamera
from log2sim.synth.scene_places import Road
from log2sim.synth.scenery import FAR_M, Image

HEADLIGHT_COLOR: Color = (0.95, 0.95, 0.90)  # LED, 5000 K
STREET_COLOR: Color = (0.42, 0.72, 1.0)  # 2700 K
HEADLIGHT_POWER, HEADLIGHT_REACH_M = 1.1, 14.0
STREET_POWER, STREET_REACH_M = 0.9, 7.0
BEAM_HALF_WIDTH = 0.36  # tangent
CUTOFF_RISE, CUTOFF_SOFTNESS, ABOVE_CUTOFF = -0.01, 0.02, 0.12  # tangents of a low beam, and what is left above it
STREET_SPACING_M, STREET_HEIGHT_M = 30.0, 7.0
MAX_LAMPS, MAX_LAMP_DISTANCE_M = 14, 90.0
COARSENESS = 4  # of the grid on which the light of lamps on the static scene is computed
GLARE = 0.5
GROUND_BAND_M = 0.2  # what is lower counts as ground, which lamps light at a grazing angle


@dataclass(frozen=True, eq=False)
class Lamp:
    """A lamp at one time.

    Attributes
    ----------
    position_m : (3,) float64, m
    forward : (2,) float64 or None
        Direction of a headlight; None for a street light, which shines downwards.
    """

    position_m: Array
    forward: Array | None = None


def headlights(map_T_vehicle: Array, front_m: float, width_m: float) -> tuple[Lamp, ...]:
    """Lamps of a vehicle whose front is so far ahead of the origin of a pose on the ground."""
    R, origin = map_T_vehicle[:3, :3], map_T_vehicle[:3, 3]
    sides = (R @ np.array([front_m, side * 0.36 * width_m, 0.65]) for side in (-1, 1))
    return tuple(Lamp(origin + offset, R[:2, 0] / np.linalg.norm(R[:2, 0])) for offset in sides)


def street_lights(roads: Sequence[Road], around_m: Array) -> tuple[Lamp, ...]:
    """Lamps that hang over roads near a point (2,)."""
    lamps: list[Lamp] = []
    for road in roads:
        line = np.array(road.line)
        for a, b in pairwise(line):
            length = float(np.linalg.norm(b - a))
            middle = float(np.dot(around_m - a, b - a)) / max(length, 1e-9)
            first = max(
                np.ceil((middle - MAX_LAMP_DISTANCE_M) / STREET_SPACING_M) * STREET_SPACING_M, STREET_SPACING_M / 2
            )
            along = np.arange(first, min(length, middle + MAX_LAMP_DISTANCE_M), STREET_SPACING_M)
            lamps += [Lamp(np.append(a + (b - a) * s / length, STREET_HEIGHT_M)) for s in along]
    return tuple(lamps)


def nearest_lamps(view: RenderCamera, lamps: Sequence[Lamp]) -> tuple[Lamp, ...]:
    """Choose those that may light what a camera sees."""
    eye, axis = view.map_T_cam[:3, 3], view.map_T_cam[:3, 2]
    distance = {k: float(np.linalg.norm(lamp.position_m - eye)) for k, lamp in enumerate(lamps)}
    ahead = {k: float((lamp.position_m - eye) @ axis) for k, lamp in enumerate(lamps)}
    near = [k for k in distance if distance[k] < MAX_LAMP_DISTANCE_M and ahead[k] > -2 * STREET_REACH_M]
    return tuple(lamps[k] for k in sorted(near, key=lambda k: distance[k])[:MAX_LAMPS])


def lamplight(lamps: Sequence[Lamp], exposure: float, points: Image, normals: Image | None) -> Image:
    """Light (N, 3) on points (N, 3) in the map with normals (N, 3); None for surfaces that face all lamps."""
    out = np.zeros((len(points), 3), np.float32)
    for lamp in lamps:
        offset = points - lamp.position_m.astype(np.float32)
        square = np.einsum("ni,ni->n", offset, offset)
        reach = STREET_REACH_M if lamp.forward is None else HEADLIGHT_REACH_M
        power = STREET_POWER if lamp.forward is None else HEADLIGHT_POWER
        strength = np.float32(power * exposure) / (1 + square * np.float32(reach**-2))
        strength *= _downward(offset, square) if lamp.forward is None else _beam(offset, lamp.forward)
        if normals is not None:
            toward = -np.einsum("ni,ni->n", offset, normals) / np.sqrt(np.maximum(square, np.float32(1e-6)))
            strength *= np.clip(np.float32(0.15) + np.float32(0.85) * toward, 0, 1)
        for channel, value in enumerate(STREET_COLOR if lamp.forward is None else HEADLIGHT_COLOR):
            out[:, channel] += strength * np.float32(value)
    return out


def _downward(offset: Image, square: Image) -> Image:
    return np.asarray(np.clip(-offset[:, 2] / np.sqrt(np.maximum(square, np.float32(1e-6))) + 0.1, 0, 1), np.float32)


def _beam(offset: Image, forward: Array) -> Image:
    """Share of a low beam in a direction: wide to the sides, cut off above the horizon."""
    fx, fy = forward.astype(np.float32)
    along = offset[:, 0] * fx + offset[:, 1] * fy
    aside = offset[:, 1] * fx - offset[:, 0] * fy
    ahead = np.maximum(along, np.float32(0.3))
    wide = np.exp(-((aside / ahead / np.float32(BEAM_HALF_WIDTH)) ** 2))
    rise = np.clip((CUTOFF_RISE - offset[:, 2] / ahead) / CUTOFF_SOFTNESS, -10, 10)
    low = ABOVE_CUTOFF + (1 - ABOVE_CUTOFF) / (1 + np.exp(-rise))
    return np.where(along > 0.3, wide * low, 0).astype(np.float32)


def light_scenery(view: RenderCamera, lamps: Sequence[Lamp], light: Light, color: Image, depth: Image) -> None:
    """Add the light of lamps to a picture (H, W, 3) of the static scene, which the sky alone has lit so far."""
    if not lamps:
        return
    v = np.arange(COARSENESS // 2, view.height_px, COARSENESS)
    u = np.arange(COARSENESS // 2, view.width_px, COARSENESS)
    grid_u, grid_v = (x.ravel() for x in np.meshgrid(u, v))
    away = depth[grid_v, grid_u]
    points = view.directions(grid_u, grid_v) * away[:, None] + view.map_T_cam[:3, 3]
    added = lamplight(lamps, light.exposure, points.astype(np.float32), None)
    added[away >= FAR_M] = 0
    dry = np.add(light.sky_color, np.multiply(light.sun_color, light.sun[2])).astype(np.float32)
    factor = 1 + added / np.maximum(dry, np.float32(1e-4))
    size = (view.width_px, view.height_px)
    color *= np.where(
        (depth < FAR_M)[..., None],
        cv2.resize(factor.reshape(len(v), len(u), 3), size, interpolation=cv2.INTER_LINEAR),
        1,
    )


def glare(view: RenderCamera, lamps: Sequence[Lamp], light: Light, color: Image, depth: Image) -> None:
    """Draw the lamps themselves and let what is too bright shine over its surroundings, in place."""
    if light.lamps <= 0:
        return
    bright = np.zeros_like(color)
    for lamp in lamps:
        p = apply(inverse(view.map_T_cam), lamp.position_m[None])[0]
        if p[2] < 1.0:
            continue
        u, v = p[0] / p[2] * view.K[0, 0] + view.K[0, 2], p[1] / p[2] * view.K[1, 1] + view.K[1, 2]
        if not (0 <= u < view.width_px and 0 <= v < view.height_px) or depth[int(v), int(u)] < p[2] - 1.0:
            continue
        if lamp.forward is None:
            tint = tuple(0.6 * light.lamps * c for c in STREET_COLOR)
            radius = max(1, round(0.18 * view.K[0, 0] / p[2]))
        else:
            toward = float(np.dot(lamp.forward, (view.map_T_cam[:2, 3] - lamp.position_m[:2]) / p[2]))
            if toward < 0.2:
                continue
            tint = tuple(light.lamps * toward**2 * c for c in HEADLIGHT_COLOR)
            radius = max(1, round(0.09 * view.K[0, 0] / p[2]))
        passed = float(np.exp(-light.extinction_per_m * p[2]))
        cv2.circle(bright, (round(u), round(v)), radius, tuple(passed * c for c in tint), -1, cv2.LINE_AA)
    np.maximum(color, bright, out=color)
    small = cv2.resize(np.maximum(color - 0.9, 0), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    if small.max() <= 0:
        return
    # Fog scatters light around a lamp more widely than a lens does.
    wide = 3.0 + 200 * light.extinction_per_m
    halo = 0.6 * cv2.GaussianBlur(small, (0, 0), 1.5) + 0.4 * cv2.GaussianBlur(small, (0, 0), wide)
    color += GLARE * cv2.resize(
        halo.astype(np.float32), (view.width_px, view.height_px), interpolation=cv2.INTER_LINEAR
    )
