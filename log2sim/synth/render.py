"""Camera images: sky, ground and facades by their planes, solid bodies by a z-buffer, rain and wet roads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Signal
from log2sim.geometry import NS_PER_S, Array, Camera, apply, inverse, rotation_from_rpy, transform, wrap_angle
from log2sim.synth.actors import Actor
from log2sim.synth.backdrop import Backdrop, draw_buildings, draw_terrain, hide_behind_buildings
from log2sim.synth.light import (
    FAR_M,
    GAMMA,
    HEADLIGHT_COLOR,
    NOON,
    STREET_COLOR,
    Image,
    Lamp,
    Light,
    RenderCamera,
    draw_ground,
    draw_sky,
    glare,
    lamplight,
    light_scenery,
    nearest_lamps,
    reflected,
)
from log2sim.synth.paint import Paint, linear_bgr, paint
from log2sim.synth.raster import NEAR_M, Fragments, Samples, ZBuffer, nearest_of
from log2sim.synth.scene import CameraSpec, Scene, TrafficLight
from log2sim.synth.shapes import Mesh, block, merged, surface

SAMPLES = 2  # a pixel and direction
SAMPLES_SHIFT = np.int32(1)  # a sample's row and column shifted by it are its pixel's
MAX_SHADED_SAMPLES = 6000  # of a body; a larger one has one color a pixel, which shows its details well enough
SHADOW_RANGE_M = 80.0
Values = NDArray[np.float32]


Painter = Callable[[NDArray[np.int64], Values, Values], Paint]  # of materials, points and normals


@dataclass(frozen=True, eq=False)
class Body:
    """A solid body at one time."""

    mesh: Mesh  # in its own frame, which has its origin at the middle of the box
    map_T_body: Array  # (4, 4)
    size_m: tuple[float, float, float]  # of the box
    painter: Painter
    passes: Values | None = None  # (K,): by material, the share of samples that show what is behind; None: solid

    @classmethod
    def of(cls, actor: Actor, t_s: float) -> Body:
        """Take a road user at a time in s since the start."""
        pose = actor.at(t_s).map_T_agent()[0]
        return cls(actor.mesh(t_s), pose, actor.spec.box_m, partial(paint, actor.spec, seed=actor.seed))


def near_first(view: RenderCamera, bodies: Sequence[Body], nearness: Image) -> Iterator[int]:
    """Yield bodies by the distance of their middles from the camera, but those around which all pixels show something nearer.

    `nearness`: a flat image of inverse depths, into which each body that is yielded may be drawn before the next one.
    """
    away = [float(np.linalg.norm(body.map_T_body[:3, 3] - view.map_T_cam[:3, 3])) for body in bodies]
    for index in sorted(range(len(bodies)), key=away.__getitem__):
        vertices = bodies[index].mesh.vertices_m
        if len(vertices) == 0:
            continue
        ends = np.stack([vertices.min(0), vertices.max(0)])
        corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), -1).reshape(-1, 3)
        p = apply(inverse(view.map_T_cam) @ bodies[index].map_T_body, corners)
        if p[:, 2].max() < NEAR_M:
            continue
        if p[:, 2].min() >= NEAR_M:
            uv = p[:, :2] / p[:, 2:] * np.diag(view.K)[:2] + view.K[:2, 2]
            size = [view.width_px, view.height_px]
            low, high = (np.clip(np.floor(v), 0, size).astype(int) for v in (uv.min(0), uv.max(0) + 1))
            part = nearness.reshape(view.height_px, view.width_px)[low[1] : high[1], low[0] : high[0]]
            if part.size == 0 or float(part.min()) > 1 / float(p[:, 2].min()):
                continue
        yield index


def samples_of(view: RenderCamera, body: Body) -> Samples:
    """Cover the pixels of a body."""
    vertices = apply(inverse(view.map_T_cam) @ body.map_T_body, body.mesh.vertices_m)
    passes = None if body.passes is None else body.passes[body.mesh.part]
    return Samples.of(vertices, body.mesh.faces, view.K, view.width_px, view.height_px, passes)


def draw_bodies(view: RenderCamera, bodies: Sequence[Body], lit: SceneInstant, color: Image, depth: Image) -> None:
    """Draw bodies where they are nearer than the depth (H, W) so far, softening their outlines."""
    fine = view.divided(SAMPLES, SAMPLES)
    behind = np.repeat(np.repeat((1 / depth).astype(np.float32), SAMPLES, axis=0), SAMPLES, axis=1)
    buffer = ZBuffer(behind.ravel())
    drawn: dict[int, tuple[Fragments, NDArray[np.int32], int]] = {}
    for index in near_first(fine, bodies, buffer.nearness):
        drawn[index] = buffer.add(samples_of(fine, bodies[index]))
    # Of each pixel the light, and the share of it that bodies cover.
    light, share = np.zeros((depth.size, 3), np.float32), np.zeros(depth.size, np.float32)
    for index, (samples, pixel, number) in drawn.items():
        fragments, body = samples.part(buffer.still_seen(pixel, number)), bodies[index]
        if not len(fragments.u):
            continue
        # The pixel that each sample lies in.
        coarse = (fragments.v >> SAMPLES_SHIFT) * np.int32(view.width_px) + (fragments.u >> SAMPLES_SHIFT)
        first = int(coarse.min())
        coarse -= np.int32(first)
        count = np.bincount(coarse).astype(np.float32) / SAMPLES**2
        part = slice(first, first + len(count))
        share[part] += count
        if len(coarse) <= MAX_SHADED_SAMPLES:
            shaded = shade(fine, body, lit, fragments)
            for channel in range(3):
                light[part, channel] += np.bincount(coarse, shaded[:, channel]) / SAMPLES**2
        else:  # one sample stands for all of its pixel
            slot = np.empty(len(count), np.int32)
            slot[coarse] = np.arange(len(coarse), dtype=np.int32)
            chosen = np.flatnonzero(count)
            shaded = shade(fine, body, lit, fragments.part(slot[chosen]))
            shaded *= count[chosen][:, None]
            light[first + chosen] += shaded
    color *= (1 - share).reshape(*depth.shape, 1)
    color += light.reshape(color.shape)
    depth[:] = 1 / buffer.nearness.reshape(behind.shape)[::SAMPLES, ::SAMPLES]


def shade(view: RenderCamera, body: Body, lit: SceneInstant, fragments: Fragments) -> NDArray[np.float32]:
    """Light (P, 3) from fragments of a body, dimmed by haze."""
    R, eye = body.map_T_body[:3, :3].astype(np.float32), view.map_T_cam[:3, 3] - body.map_T_body[:3, 3]
    rays = view.directions(fragments.u, fragments.v).astype(np.float32)
    points = np.asarray((rays * fragments.depth_m[:, None] + eye.astype(np.float32)) @ R, np.float32)
    normals = fragments.interpolated(body.mesh.normals, body.mesh.faces)
    normals /= np.maximum(np.sqrt(np.einsum("pi,pi->p", normals, normals)), np.float32(1e-12))[:, None]
    surface = body.painter(body.mesh.part[fragments.face], points, normals)
    to_camera = rays / -np.sqrt(np.einsum("pi,pi->p", rays, rays))[:, None]
    height = np.asarray(points[:, 2] + np.float32(body.size_m[2] / 2), np.float32)
    turned = normals @ R.T
    lamps = None
    if lit.lamps:
        offset = body.map_T_body[:3, 3].astype(np.float32)
        lamps = lamplight(lit.lamps, lit.light.exposure, points @ R.T + offset, turned)
    return lit.light.hazy(reflected(lit.light, surface, turned, to_camera, height, lamps), fragments.depth_m)


def draw_shadows(
    view: RenderCamera,
    bodies: Sequence[Body],
    lit: SceneInstant,
    color: Image,
    ground: NDArray[np.bool_],
    standing: Sequence[Array] = (),
) -> None:
    """Darken the ground (H, W) in the shadow of bodies and, right below them, further.

    `standing`: convex outlines (P, 2), m, of further shadows on level ground.
    """
    light, sun, sky = lit.light, np.zeros(ground.shape, np.uint8), np.zeros(ground.shape, np.uint8)
    slope = np.divide(light.sun[:2], light.sun[2])
    for body in bodies:
        far = np.linalg.norm(body.map_T_body[:2, 3] - view.map_T_cam[:2, 3]) > SHADOW_RANGE_M
        if far or len(body.mesh.vertices_m) == 0:
            continue
        vertices = apply(body.map_T_body, body.mesh.vertices_m)
        floor = body.map_T_body[2, 3] - body.size_m[2] / 2
        height = vertices[:, 2] - floor
        cast = (vertices[:, :2] - slope * height[:, None]).astype(np.float32)
        below = vertices[height < 0.25 * body.size_m[2] + 0.05, :2].astype(np.float32)
        for mask, points in ((sun, cast), (sky, below)):
            if len(points) < 3:
                continue
            hull = cv2.convexHull(points)[:, 0]
            polygon = view.polygon(np.column_stack([hull, np.full(len(hull), floor)]).astype(float))
            if len(polygon):
                cv2.fillConvexPoly(mask, polygon, 255, cv2.LINE_AA, 4)
    for outline in standing:
        polygon = view.polygon(np.column_stack([outline, np.zeros(len(outline))]))
        if len(polygon):
            cv2.fillConvexPoly(sun, polygon, 255, cv2.LINE_AA, 4)
    rows = np.flatnonzero(sun.any(1) | sky.any(1))
    if len(rows) == 0:
        return
    band = slice(max(int(rows[0]) - 5, 0), int(rows[-1]) + 6)
    soft_sun = cv2.GaussianBlur(sun[band], (0, 0), 1.6) * np.float32(1 / 255)
    soft_sky = cv2.GaussianBlur(sky[band], (0, 0), 1.8) * np.float32(1 / 255)
    # The share of the light that comes from the sun, less what houses and trees throw back.
    bright = float(np.mean(light.sun_color)) * light.sun[2]
    share = np.float32(0.96 * bright / (bright + float(np.mean(light.sky_color))))
    factor = (1 - share * soft_sun) * (1 - 0.5 * soft_sky)
    color[band] *= np.where(ground[band], factor, np.float32(1))[..., None]


# Three lenses of 200 mm in a housing, as EN 12368 has them.
DEPTH_M, WIDTH_M, HEIGHT_M = 0.25, 0.34, 0.96
LENS_RADIUS_M, LENS_SPACING_M, LENS_AHEAD_M = 0.1, 0.3, 0.006
POLE_M = 0.12
CORNERS = 20  # of a lens
HOUSING, POLE, RED, YELLOW, GREEN = range(5)
LAMPS = (RED, YELLOW, GREEN)
LIT = {"red": (RED,), "red_yellow": (RED, YELLOW), "yellow": (YELLOW,), "green": (GREEN,), "off": ()}
COLORS = {RED: (255, 40, 28), YELLOW: (255, 190, 30), GREEN: (40, 235, 150)}
DARK_LENS, GLOW = 0.06, 1.4  # of the color of a lamp: what a dark lens reflects, what a lit one emits by day
HOUSING_RGB, POLE_RGB = (34, 36, 36), (122, 126, 128)


def signals_of(scene: Scene) -> tuple[Signal, ...]:
    """Return the true states of all traffic lights over a scene."""
    out = []
    for light in scene.traffic_light:
        t, times, states = light.start_s, list[float](), list[str]()
        for state, seconds in cycle(light.program):
            if t >= scene.duration_s:
                break
            if t + seconds > 0 and (not states or states[-1] != state):
                times.append(max(t, 0.0))
                states.append(state)
            t += seconds
        heading = float(wrap_angle(np.deg2rad(light.yaw_deg)))
        out.append(Signal(light.id, np.array(light.position), heading, np.array(times), np.array(states)))
    return tuple(out)


def bodies_at(scene: Scene, t_s: float) -> list[Body]:
    """Traffic lights as they look at a time in s since the start."""
    out = []
    for light, signal in zip(scene.traffic_light, signals_of(scene)):
        size = (DEPTH_M, WIDTH_M, 2 * light.position[2])  # so that its ground is that of the scene
        out.append(Body(*_housing(light), size, partial(_paint, str(signal.at(t_s)[0]))))
    return out


def triangles_of(scene: Scene) -> tuple[Array, ...]:
    """Triangles (F, 3, 3) in the map of each traffic light, as a LiDAR meets them."""
    out = []
    for light in scene.traffic_light:
        mesh, pose = _housing(light)
        out.append(apply(pose, mesh.vertices_m)[mesh.faces])
    return tuple(out)


def _housing(light: TrafficLight) -> tuple[Mesh, Array]:
    """Shape a traffic light around the middle of its housing, which faces +x; and return its pose (4, 4) in the map."""
    low, high = [-DEPTH_M / 2, -WIDTH_M / 2, -HEIGHT_M / 2], [DEPTH_M / 2, WIDTH_M / 2, HEIGHT_M / 2]
    parts = [block(low, high, HOUSING)]
    angle, k = np.arange(CORNERS) * 2 * np.pi / CORNERS, np.arange(CORNERS)
    x = DEPTH_M / 2 + LENS_AHEAD_M
    ring = np.stack([np.full(CORNERS, x), np.cos(angle), np.sin(angle)], 1) * [1, LENS_RADIUS_M, LENS_RADIUS_M]
    faces = np.stack([k, (k + 1) % CORNERS, np.full(CORNERS, CORNERS)], 1)
    for row, part in enumerate(LAMPS):
        lens = np.concatenate([ring, [[x, 0.0, 0.0]]]) + np.array([0, 0, (1 - row) * LENS_SPACING_M])
        parts.append(surface(lens, faces, part))
    if light.pole:
        behind = -DEPTH_M / 2 - POLE_M
        low, high = [behind, -POLE_M / 2, -light.position[2]], [-DEPTH_M / 2, POLE_M / 2, HEIGHT_M / 2]
        parts.append(block(low, high, POLE))
    pose = transform(rotation_from_rpy(0.0, 0.0, np.deg2rad(light.yaw_deg)), np.array(light.position))
    return merged(parts), pose


def _paint(state: str, part: NDArray[np.int64], p: Values, n: Values) -> Paint:
    out = Paint(np.empty((len(p), 3), np.float32), np.full(len(p), 0.1, np.float32), np.zeros((len(p), 3), np.float32))
    out.albedo[:] = linear_bgr(HOUSING_RGB)
    out.albedo[part == POLE] = linear_bgr(POLE_RGB)
    for lamp in LAMPS:
        color = linear_bgr(COLORS[lamp])
        out.albedo[part == lamp] = DARK_LENS * color
        if lamp in LIT[state]:
            out.glow[part == lamp] = GLOW * color
    return out


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


ROUGHNESS = 0.15  # root mean square slope of the film, as asphalt leaves it when it rains
MAX_GLARE = 3.0  # of the brightest white; more than a picture can show
WET_COARSENESS = 2  # of the grid on which it is computed


def mirror_lights(view: RenderCamera, lit: SceneInstant, color: Image, depth: Image, ground: NDArray[np.bool_]) -> None:
    """Let wet ground (H, W) mirror the sun and lamps towards the camera; in place, nothing without glare.

    Facets with Gaussian slopes (Beckmann & Spizzichino, 1963), the reflectance of water after Schlick (1994).
    """
    light = lit.light
    if not light.glare or light.wetness <= 0 or not ground.any():
        return
    u, v = np.arange(0, view.width_px, WET_COARSENESS), np.arange(0, view.height_px, WET_COARSENESS)
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


def camera_of(spec: CameraSpec) -> Camera:
    """Make the pinhole camera that a scene describes; pixel centers are whole numbers."""
    width, height = spec.size_px
    focal = width / 2 / np.tan(np.deg2rad(spec.fov_deg) / 2)
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    forward_T_cam = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])
    rotation = rotation_from_rpy(0.0, -np.deg2rad(spec.pitch_deg), np.deg2rad(spec.yaw_deg)) @ forward_T_cam
    return Camera(spec.name, width, height, K, spec.mount, transform(rotation, np.array(spec.position_m)))


def frame_stamps(spec: CameraSpec, scene: Scene) -> NDArray[np.int64]:
    """Stamps (F,) of a camera's frames, absolute ns, all within the log."""
    first = int(np.ceil(-spec.offset_s * spec.rate_hz - 1e-9))
    last = int(np.floor((scene.duration_s - spec.offset_s) * spec.rate_hz + 1e-9))
    t = np.arange(first, last + 1) / spec.rate_hz + spec.offset_s
    return scene.start_ns + np.rint(t * NS_PER_S).astype(np.int64)


LENS_BLUR_PX = 0.45
GRAIN = 0.8  # standard deviation of the sensor's noise, of 255


@dataclass(frozen=True, eq=False)
class Visibility:
    """Visible part of a body in an image."""

    visible_px: int  # pixels that show it
    silhouette_px: int  # pixels of its whole silhouette in the image
    box_px: Array  # (4,), px: box of the visible part, edges of pixels counted from the image's corner
    silhouette_box_px: Array  # (4,), px: box of the whole silhouette in the image


@dataclass(frozen=True, eq=False)
class SceneInstant:
    """Everything in a scene at one time."""

    backdrop: Backdrop
    bodies: Sequence[Body]
    light: Light = NOON
    lamps: Sequence[Lamp] = ()  # headlights and street lights that are on


def render(camera: Camera, map_T_cam: Array, instant: SceneInstant, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Render an image (H, W, 3) uint8 BGR."""
    view, light = RenderCamera.of(camera, map_T_cam), instant.light
    instant = replace(instant, lamps=nearest_lamps(view, instant.lamps))
    color, depth = draw_sky(view, light)
    if instant.backdrop.terrain is None:
        draw_ground(view, instant.backdrop.ground, light, color, depth)
    else:
        draw_terrain(view, instant.backdrop.ground, instant.backdrop.terrain, light, color, depth)
    ground = depth.copy()
    draw_shadows(view, instant.bodies, instant, color, ground < FAR_M, instant.backdrop.shadows)
    draw_buildings(view, instant.backdrop.buildings, light, color, depth)
    light_scenery(view, instant.lamps, light, color, depth)
    open_ground = (ground < FAR_M) & (depth == ground)
    mirror_sky(view, light, color, open_ground)
    mirror_lights(view, instant, color, depth, open_ground)
    color = light.hazy(color, depth)
    draw_bodies(view, instant.bodies, instant, color, depth)
    glare(view, instant.lamps, light, color, depth)
    draw_rain(view, light, color, rng)
    # Lens blur, sensor noise and gamma
    image = cv2.GaussianBlur(color, (3, 3), LENS_BLUR_PX)
    np.clip(image, 0, 1, out=image)
    np.power(image, np.float32(1 / GAMMA), out=image)
    image *= 255
    image += rng.standard_normal(image.shape[:2], dtype=np.float32)[..., None] * np.float32(GRAIN * light.noise)
    return np.asarray(cv2.convertScaleAbs(np.maximum(image, 0, out=image)), np.uint8)


def segment(camera: Camera, map_T_cam: Array, instant: SceneInstant) -> list[Visibility | None]:
    """Segment an image by bodies: the visible part of each, None without one."""
    view = RenderCamera.of(camera, map_T_cam)
    depth = np.full((view.height_px, view.width_px), np.inf, np.float32)
    hide_behind_buildings(view, instant.backdrop.buildings, depth)
    buffer = ZBuffer(np.reciprocal(depth).ravel())
    out: list[Visibility | None] = [None] * len(instant.bodies)
    added: dict[int, tuple[Fragments, NDArray[np.int32], int, Fragments]] = {}
    for index in near_first(view, instant.bodies, buffer.nearness):
        samples = samples_of(view, instant.bodies[index])
        added[index] = (*buffer.add(samples), nearest_of(samples))
    for index, (fragments, pixel, first, whole) in added.items():
        visible = fragments.part(buffer.still_seen(pixel, first))
        if len(visible.u):
            boxes = (np.array([f.u.min(), f.v.min(), f.u.max() + 1, f.v.max() + 1], float) for f in (visible, whole))
            out[index] = Visibility(len(visible.u), len(whole.u), *boxes)
    return out
