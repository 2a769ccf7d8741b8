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
from log2sim.synth.raster import NEAR_M, Fragments, rasterize
from log2sim.synth.render_camera import RenderCamera
from log2sim.synth.scenery import Image
from log2sim.synth.shapes import Mesh
from log2sim.synth.surfaces import Paint

SAMPLES = 2  # a pixel and direction
MAX_SHADED_SAMPLES = 6000  # of a body; a larger one has one color a pixel, which shows its details well enough
SHADOW_RANGE_M = 80.0
NOBODY = -1

Samples = NDArray[np.float32]


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


Painter = Callable[[NDArray[np.int64], Samples, Samples], Paint]  # of materials, points and normals


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
    reach_m : float or None
        Diameter around the origin that holds the mesh; None if the box holds it.
    """

    mesh: Mesh
    map_T_body: Array
    size_m: tuple[float, float, float]
    painter: Painter
    passes: NDArray[np.float32] | None = None
    reach_m: float | None = None

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


def is_hidden(view: RenderCamera, body: Body, nearest: Image) -> bool:
    """Decide whether all pixels around a body show something nearer, by a flat depth image."""
    if len(body.mesh.vertices_m) == 0:
        return True
    ends = np.stack([body.mesh.vertices_m.min(0), body.mesh.vertices_m.max(0)])
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), -1).reshape(-1, 3)
    p = apply(inverse(view.map_T_cam) @ body.map_T_body, corners)
    near = float(p[:, 2].min())
    if near < NEAR_M:
        return False
    uv = p[:, :2] / p[:, 2:] * np.diag(view.K)[:2] + view.K[:2, 2]
    size = [view.width_px, view.height_px]
    low, high = (np.clip(np.floor(v), 0, size).astype(int) for v in (uv.min(0), uv.max(0) + 1))
    part = nearest.reshape(view.height_px, view.width_px)[low[1] : high[1], low[0] : high[0]]
    return part.size == 0 or float(part.max()) < near


def fragments_of(view: RenderCamera, body: Body) -> Fragments | None:
    """Rasterize a body; None where it is outside the picture."""
    cam_T_body = inverse(view.map_T_cam) @ body.map_T_body
    radius = (body.reach_m or float(np.linalg.norm(body.size_m))) / 2
    center = cam_T_body[:3, 3]
    reach = (view.width_px + view.height_px) / view.K[0, 0]
    if center[2] < -radius or np.hypot(center[0], center[1]) - radius > reach * (center[2] + radius):
        return None
    vertices = apply(cam_T_body, body.mesh.vertices_m)
    fragments = rasterize(vertices, body.mesh.faces, view.K, view.width_px, view.height_px)
    if body.passes is not None:
        fragments = fragments.part(np.flatnonzero(_stops(fragments, body.passes[body.mesh.part[fragments.face]])))
    return fragments if len(fragments.u) else None


def _stops(fragments: Fragments, passes: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Decide for each sample whether something stops the ray, by a hash of its place."""
    mixed = fragments.u.astype(np.uint32) * np.uint32(73856093) ^ fragments.v.astype(np.uint32) * np.uint32(19349663)
    mixed = (mixed ^ (mixed >> np.uint32(13))) * np.uint32(1274126177)
    return np.asarray((mixed >> np.uint32(16)).astype(np.float32) / 65536 >= passes)


def draw_bodies(view: RenderCamera, bodies: Sequence[Body], lit: Lighting, color: Image, depth: Image) -> None:
    """Draw bodies where they are nearer than the depth (H, W) so far, softening their outlines."""
    fine = view.enlarged(SAMPLES)
    nearest = np.full(fine.width_px * fine.height_px, np.inf, np.float32)
    owner = np.full(len(nearest), NOBODY, np.int16)
    drawn: dict[int, Fragments] = {}
    for index in near_first(fine, bodies):
        if is_hidden(fine, bodies[index], nearest):
            continue
        fragments = fragments_of(fine, bodies[index])
        if fragments is None:
            continue
        pixel = fragments.pixel(fine.width_px)
        behind = np.minimum(nearest[pixel], depth.ravel()[_coarse(fragments, view.width_px)])
        drawn[index] = fragments.part(fragments.depth_m < behind)
        pixel = drawn[index].pixel(fine.width_px)
        nearest[pixel] = drawn[index].depth_m
        owner[pixel] = index
    if not drawn:
        return
    samples = np.zeros((fine.height_px * fine.width_px, 3), np.float32)
    for index, fragments in drawn.items():
        pixel = fragments.pixel(fine.width_px)
        left = np.flatnonzero(owner[pixel] == index)
        if len(left):
            samples[pixel[left]] = _colors(view, fine, bodies[index], lit, fragments.part(left))
    _resolve(view, samples.reshape(fine.height_px, fine.width_px, 3), owner.reshape(fine.height_px, -1), color)
    _bring_forward(depth, nearest.reshape(fine.height_px, -1))


def _coarse(fragments: Fragments, width_px: int) -> NDArray[np.int32]:
    """Index of the pixel that each sample lies in."""
    return (fragments.v // np.int32(SAMPLES)) * np.int32(width_px) + fragments.u // np.int32(SAMPLES)


def _colors(
    view: RenderCamera, fine: RenderCamera, body: Body, lit: Lighting, fragments: Fragments
) -> NDArray[np.float32]:
    """Light (P, 3) from samples of a body; those of one pixel share theirs if there are many."""
    count = len(fragments.u)
    if count <= MAX_SHADED_SAMPLES:
        return shade(fine, body, lit, fragments)
    coarse = _coarse(fragments, view.width_px)
    coarse -= coarse.min()
    slot = np.full(int(coarse.max()) + 1, -1, np.int32)
    slot[coarse] = np.arange(count, dtype=np.int32)
    chosen = np.flatnonzero(slot >= 0)
    shaded = shade(fine, body, lit, fragments.part(slot[chosen]))
    slot[chosen] = np.arange(len(chosen), dtype=np.int32)
    return shaded[slot[coarse]]


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


def _resolve(view: RenderCamera, samples: Image, owner: NDArray[np.int16], color: Image) -> None:
    """Average the samples of each pixel and put them over the picture."""
    covered = owner != NOBODY
    rows, columns = np.flatnonzero(covered.any(1)) // SAMPLES, np.flatnonzero(covered.any(0)) // SAMPLES
    if len(rows) == 0:
        return
    part = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
    fine = tuple(slice(s.start * SAMPLES, s.stop * SAMPLES) for s in part)
    size = (part[1].stop - part[1].start, part[0].stop - part[0].start)
    mean = cv2.resize(samples[fine], size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(covered[fine].astype(np.float32), size, interpolation=cv2.INTER_AREA)
    color[part] *= (1 - share)[..., None]
    color[part] += mean


def _bring_forward(depth: Image, nearest: Image) -> None:
    h, w = depth.shape
    np.minimum(depth, nearest.reshape(h, SAMPLES, w, SAMPLES)[:, 0, :, 0], out=depth)


def draw_shadows(
    view: RenderCamera, bodies: Sequence[Body], lit: Lighting, color: Image, ground: NDArray[np.bool_]
) -> None:
    """Darken the ground (H, W) in the shadow of bodies and, right below them, further."""
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
            hull = cv2.convexHull(points)[:, 0]
            polygon = view.polygon(np.column_stack([hull, np.full(len(hull), floor)]).astype(float))
            if len(polygon):
                cv2.fillConvexPoly(mask, polygon, 255, cv2.LINE_AA, 4)
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
