"""Camera images: sky, ground and facades by their planes, solid bodies by a z-buffer, light from the sun and the sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera
from log2sim.synth.backdrop import Wall
from log2sim.synth.bodies import Body, Lighting, draw_bodies, draw_shadows, is_hidden, near_first, samples_of
from log2sim.synth.facades import draw_buildings, hide_behind_buildings
from log2sim.synth.ground import Ground
from log2sim.synth.lamps import Lamp, glare, light_scenery, nearest_lamps
from log2sim.synth.light import NOON, Light
from log2sim.synth.polytope_caster import Terrain
from log2sim.synth.rain import draw_rain, mirror_sky
from log2sim.synth.raster import Fragments, ZBuffer, nearest_of
from log2sim.synth.render_camera import RenderCamera
from log2sim.synth.scenery import FAR_M, GAMMA, Image, draw_ground, draw_sky
from log2sim.synth.terrain_view import draw_terrain
from log2sim.synth.wet import mirror_lights

LENS_BLUR_PX = 0.45
GRAIN = 0.8  # standard deviation of the sensor's noise, of 255


@dataclass(frozen=True, eq=False)
class Visibility:
    """Visible part of a body in an image.

    Attributes
    ----------
    visible_px : int
        Pixels that show it.
    silhouette_px : int
        Pixels of its whole silhouette in the image.
    box_px : (4,) float64, px
        Box of the visible part, edges of pixels counted from the image's corner.
    silhouette_box_px : (4,) float64, px
        Box of the whole silhouette in the image.
    """

    visible_px: int
    silhouette_px: int
    box_px: Array
    silhouette_box_px: Array


class Scenery(Protocol):
    """The static parts of a scene."""

    @property
    def ground(self) -> Ground:
        """Colors of the ground."""
        ...

    @property
    def terrain(self) -> Terrain | None:
        """Heights of the ground, None where it is level."""
        ...

    @property
    def buildings(self) -> tuple[tuple[Wall, ...], ...]:
        """Sides of each building."""
        ...

    @property
    def shadows(self) -> tuple[Array, ...]:
        """Convex outlines (P, 2), m, of the shadows of what does not move."""
        ...


@dataclass(frozen=True, eq=False)
class SceneInstant:
    """Everything in a scene at one time.

    Attributes
    ----------
    backdrop : Scenery
    bodies : sequence of Body
    light : Light
    lamps : sequence of Lamp
        Headlights and street lights that are on.
    """

    backdrop: Scenery
    bodies: Sequence[Body]
    light: Light = NOON
    lamps: Sequence[Lamp] = ()


def render(camera: Camera, map_T_cam: Array, instant: SceneInstant, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Render an image (H, W, 3) uint8 BGR."""
    view, light = RenderCamera.of(camera, map_T_cam), instant.light
    lit = Lighting(light, nearest_lamps(view, instant.lamps))
    color, depth = draw_sky(view, light)
    if instant.backdrop.terrain is None:
        draw_ground(view, instant.backdrop.ground, light, color, depth)
    else:
        draw_terrain(view, instant.backdrop.ground, instant.backdrop.terrain, light, color, depth)
    ground = depth.copy()
    draw_shadows(view, instant.bodies, lit, color, ground < FAR_M, instant.backdrop.shadows)
    draw_buildings(view, instant.backdrop.buildings, light, color, depth)
    light_scenery(view, lit.lamps, light, color, depth)
    open_ground = (ground < FAR_M) & (depth == ground)
    mirror_sky(view, light, color, open_ground)
    mirror_lights(view, lit, color, depth, open_ground)
    color = light.hazy(color, depth)
    draw_bodies(view, instant.bodies, lit, color, depth)
    glare(view, lit.lamps, light, color, depth)
    draw_rain(view, light, color, rng)
    return _developed(color, light, rng)


def segment(camera: Camera, map_T_cam: Array, instant: SceneInstant) -> list[Visibility | None]:
    """Segment an image by bodies: the visible part of each, None without one."""
    view = RenderCamera.of(camera, map_T_cam)
    depth = np.full((view.height_px, view.width_px), np.inf, np.float32)
    hide_behind_buildings(view, instant.backdrop.buildings, depth)
    buffer = ZBuffer(np.reciprocal(depth).ravel())
    out: list[Visibility | None] = [None] * len(instant.bodies)
    added: dict[int, tuple[Fragments, NDArray[np.int32], int, Fragments]] = {}
    for index in near_first(view, instant.bodies):
        if not is_hidden(view, instant.bodies[index], buffer.nearness):
            samples = samples_of(view, instant.bodies[index])
            added[index] = (*buffer.add(samples), nearest_of(samples))
    for index, (fragments, pixel, first, silhouette) in added.items():
        out[index] = _visibility(silhouette, fragments.part(buffer.still_seen(pixel, first)))
    return out


def _visibility(silhouette: Fragments, visible: Fragments) -> Visibility | None:
    if len(visible.u) == 0:
        return None
    boxes = (np.array([f.u.min(), f.v.min(), f.u.max() + 1, f.v.max() + 1], float) for f in (visible, silhouette))
    return Visibility(len(visible.u), len(silhouette.u), *boxes)


def _developed(color: Image, light: Light, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Lens blur, sensor noise and gamma."""
    image = cv2.GaussianBlur(color, (3, 3), LENS_BLUR_PX)
    np.clip(image, 0, 1, out=image)
    np.power(image, np.float32(1 / GAMMA), out=image)
    image *= 255
    image += rng.standard_normal(image.shape[:2], dtype=np.float32)[..., None] * np.float32(GRAIN * light.noise)
    return np.asarray(cv2.convertScaleAbs(np.maximum(image, 0, out=image)), np.uint8)
