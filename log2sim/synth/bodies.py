"""Road users and other solid bodies in a picture, by a z-buffer of several samples a pixel, and their shadows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, apply, inverse
from log2sim.synth.actors import Actor
from log2sim.synth.lamps import Lamp, lamplight
from log2sim.synth.light import Light, reflected
from log2sim.synth.paint import paint
from log2sim.synth.raster import NEAR_M, Fragments, Samples, ZBuffer
from log2sim.synth.render_camera import RenderCamera
from log2sim.synth.scenery import Image
from log2sim.synth.shapes import Mesh
from log2sim.synth.surfaces import Paint

SAMPLES = 2  # a pixel and direction
SAMPLES_SHIFT = np.int32(1)  # a sample's row and column shifted by it are its pixel's
MAX_SHADED_SAMPLES = 6000  # of a body; a larger one has one color a pixel, which shows its details well enough
SHADOW_RANGE_M = 80.0
Values = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Lighting:
    """Light on bodies.

    Attributes
    ----------
    light : Light
    lamps : tuple of Lamp
    """

    light: Light
    lamps: tuple[Lamp, ...] = ()


Painter = Callable[[NDArray[np.int64], Values, Values], Paint]  # of materials, points and normals


@dataclass(frozen=True, eq=False)
class Body:
    """A solid body at one time.

    Attributes
    ----------
    mesh : Mesh
        In its own frame, which has its origin at the middle of the box.
    map_T_body : (4, 4) float64
    size_m : (float, float, float)
        Of the box.
    painter : Painter
    passes : (K,) float32 or None
        Share of samples through which one sees what is behind, by material; None for a solid body.
    """

    mesh: Mesh
    map_T_body: Array
    size_m: tuple[float, float, float]
    painter: Painter
    passes: NDArray[np.float32] | None = None

    @classmethod
    def of(cls, actor: Actor, t_s: float) -> Body:
        """Take a road user at a time in s since the start."""
        pose = actor.at(t_s).map_T_agent()[0]
        return cls(actor.mesh(t_s), pose, actor.spec.box_m, partial(paint, actor.appearance))


def near_first(view: RenderCamera, bodies: Sequence[Body]) -> list[int]:
    """Order bodies by the distance of their middles from the camera, so that those behind others are found early."""
    return sorted(
        range(len(bodies)), key=lambda k: float(np.linalg.norm(bodies[k].map_T_body[:3, 3] - view.map_T_cam[:3, 3]))
    )


def is_hidden(view: RenderCamera, body: Body, nearness: Image) -> bool:
    """Decide whether all pixels around a body show something nearer, by a flat image of inverse depths."""
    if len(body.mesh.vertices_m) == 0:
        return True
    ends = np.stack([body.mesh.vertices_m.min(0), body.mesh.vertices_m.max(0)])
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), -1).reshape(-1, 3)
    p = apply(inverse(view.map_T_cam) @ body.map_T_body, corners)
    if p[:, 2].max() < NEAR_M:
        return True
    if p[:, 2].min() < NEAR_M:
        return False
    uv = p[:, :2] / p[:, 2:] * np.diag(view.K)[:2] + view.K[:2, 2]
    size = [view.width_px, view.height_px]
    low, high = (np.clip(np.floor(v), 0, size).astype(int) for v in (uv.min(0), uv.max(0) + 1))
    part = nearness.reshape(view.height_px, view.width_px)[low[1] : high[1], low[0] : high[0]]
    return part.size == 0 or float(part.min()) > 1 / float(p[:, 2].min())


def samples_of(view: RenderCamera, body: Body) -> Samples:
    """Cover the pixels of a body."""
    vertices = apply(inverse(view.map_T_cam) @ body.map_T_body, body.mesh.vertices_m)
    passes = None if body.passes is None else body.passes[body.mesh.part]
    return Samples.of(vertices, body.mesh.faces, view.K, view.width_px, view.height_px, passes)


def draw_bodies(view: RenderCamera, bodies: Sequence[Body], lit: Lighting, color: Image, depth: Image) -> None:
    """Draw bodies where they are nearer than the depth (H, W) so far, softening their outlines."""
    fine = view.enlarged(SAMPLES)
    behind = np.repeat(np.repeat((1 / depth).astype(np.float32), SAMPLES, axis=0), SAMPLES, axis=1)
    buffer = ZBuffer(behind.ravel())
    drawn: dict[int, tuple[Fragments, NDArray[np.int32], int]] = {}
    for index in near_first(fine, bodies):
        if not is_hidden(fine, bodies[index], buffer.nearness):
            drawn[index] = buffer.add(samples_of(fine, bodies[index]))
    light, share = np.zeros((depth.size, 3), np.float32), np.zeros(depth.size, np.float32)
    for index, (fragments, pixel, first) in drawn.items():
        left = buffer.still_seen(pixel, first)
        if len(left):
            _add(view, fine, bodies[index], lit, fragments.part(left), light, share)
    color *= (1 - share).reshape(*depth.shape, 1)
    color += light.reshape(color.shape)
    depth[:] = 1 / buffer.nearness.reshape(behind.shape)[::SAMPLES, ::SAMPLES]


def _coarse(fragments: Fragments, width_px: int) -> NDArray[np.int32]:
    """Index of the pixel that each sample lies in."""
    return (fragments.v >> SAMPLES_SHIFT) * np.int32(width_px) + (fragments.u >> SAMPLES_SHIFT)


def _add(
    view: RenderCamera, fine: RenderCamera, body: Body, lit: Lighting, fragments: Fragments, light: Image, share: Image
) -> None:
    """Add samples of a body to the light (N, 3) of the pixels and to the shares (N,) of them that bodies cover."""
    coarse = _coarse(fragments, view.width_px)
    first = int(coarse.min())
    coarse -= np.int32(first)
    count = np.bincount(coarse).astype(np.float32) / SAMPLES**2
    part = slice(first, first + len(count))
    share[part] += count
    if len(coarse) <= MAX_SHADED_SAMPLES:
        shaded = shade(fine, body, lit, fragments)
        for channel in range(3):
            light[part, channel] += np.bincount(coarse, shaded[:, channel]) / SAMPLES**2
        return
    # One sample stands for all of its pixel.
    slot = np.empty(len(count), np.int32)
    slot[coarse] = np.arange(len(coarse), dtype=np.int32)
    chosen = np.flatnonzero(count)
    shaded = shade(fine, body, lit, fragments.part(slot[chosen]))
    shaded *= count[chosen][:, None]
    light[first + chosen] += shaded


def shade(view: RenderCamera, body: Body, lit: Lighting, fragments: Fragments) -> NDArray[np.float32]:
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
    lit: Lighting,
    color: Image,
    ground: NDArray[np.bool_],
    standing: Sequence[Array] = (),
) -> None:
    """Darken the ground (H, W) in the shadow of bodies and, right below them, further.

    Parameters
    ----------
    standing
        Convex outlines (P, 2), m, of further shadows on level ground.
    """
    sun = np.zeros(ground.shape, np.uint8)
    sky = np.zeros(ground.shape, np.uint8)
    slope = np.divide(lit.light.sun[:2], lit.light.sun[2])
    for body in bodies:
        if np.linalg.norm(body.map_T_body[:2, 3] - view.map_T_cam[:2, 3]) > SHADOW_RANGE_M:
            continue
        if len(body.mesh.vertices_m) == 0:
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
    soft_sun, soft_sky = (
        cv2.GaussianBlur(m[band], (0, 0), s) * np.float32(1 / 255) for m, s in ((sun, 1.6), (sky, 1.8))
    )
    share = lit.light.sun_share()
    factor = (1 - share * soft_sun) * (1 - 0.5 * soft_sky)
    color[band] *= np.where(ground[band], factor, np.float32(1))[..., None]
