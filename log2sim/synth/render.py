"""Camera images: ground and facades by their planes, road users by a z-buffer, light from the sun and the sky."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, apply, inverse
from log2sim.synth.actors import Actor
from log2sim.synth.backdrop import FACADE_M_PER_PX, GAMMA, GROUND_M_PER_PX, Backdrop, linear_table
from log2sim.synth.light import HORIZON, SKY_LIGHT, SUN, SUN_LIGHT, ZENITH, reflected
from log2sim.synth.paint import paint
from log2sim.synth.raster import Fragments, rasterize
from log2sim.synth.render_camera import RenderCamera

HAZE_M = 500.0
FAR_M = 2000.0
OVERSAMPLING = 2
NO_ACTOR = -1
_LINEAR = linear_table()


@dataclass(frozen=True, eq=False)
class Visibility:
    """Visible part of an actor in an image.

    Attributes
    ----------
    visible_px : int
        Pixels that show it.
    silhouette_px : int
        Pixels of its whole silhouette in the image.
    box_px : (4,) float64, px
        Box of the visible part, edges of pixels counted from the image's corner.
    """

    visible_px: int
    silhouette_px: int
    box_px: Array


@dataclass(frozen=True, eq=False)
class SceneInstant:
    """Everything in a scene at one time.

    Attributes
    ----------
    backdrop : Backdrop
    actors : tuple of Actor
    t_s : float
        Since the start of the log.
    """

    backdrop: Backdrop
    actors: tuple[Actor, ...]
    t_s: float


def render(camera: Camera, map_T_cam: Array, instant: SceneInstant, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Render an image (H, W, 3) uint8 BGR."""
    backdrop, actors, t_s = instant.backdrop, instant.actors, instant.t_s
    view = RenderCamera.of(camera, map_T_cam, OVERSAMPLING)
    color, depth, on_ground = _sky_and_ground(view, backdrop)
    _draw_walls(view, backdrop, color, depth)
    _draw_shadows(view, actors, t_s, color, on_ground & (depth < FAR_M))
    flat_color, flat_depth = color.reshape(-1, 3), depth.ravel()
    for actor in actors:
        fragments = _fragments(view, actor, t_s)
        near = np.flatnonzero(fragments.depth_m < flat_depth[fragments.pixel])
        if len(near) == 0:
            continue
        pixel = fragments.pixel[near]
        flat_color[pixel] = _shade(view, actor, t_s, fragments, near)
        flat_depth[pixel] = fragments.depth_m[near]
    haze = (1 - np.exp(-depth / HAZE_M))[..., None]
    color += (HORIZON - color) * haze
    return _developed(color, rng)


def segment(camera: Camera, map_T_cam: Array, instant: SceneInstant) -> list[Visibility | None]:
    """Segment an image by actors: the visible part of each, None without one."""
    view = RenderCamera.of(camera, map_T_cam, 1)
    depth = np.full((view.height_px, view.width_px), np.inf, np.float32)
    _draw_walls(view, instant.backdrop, None, depth)
    owner = np.full(depth.size, NO_ACTOR)
    whole = []
    for index, actor in enumerate(instant.actors):
        fragments = _fragments(view, actor, instant.t_s)
        near = fragments.depth_m < depth.ravel()[fragments.pixel]
        pixel = fragments.pixel[near]
        depth.ravel()[pixel] = fragments.depth_m[near]
        owner[pixel] = index
        whole.append(len(fragments.pixel))
    out: list[Visibility | None] = []
    for index, silhouette in enumerate(whole):
        pixel = np.flatnonzero(owner == index) if silhouette else np.zeros(0, int)
        if len(pixel) == 0:
            out.append(None)
            continue
        v, u = np.divmod(pixel, view.width_px)
        out.append(Visibility(len(pixel), silhouette, np.array([u.min(), v.min(), u.max() + 1, v.max() + 1], float)))
    return out


def _fragments(view: RenderCamera, actor: Actor, t_s: float) -> Fragments:
    states = actor.at(t_s)
    cam_T_map = inverse(view.map_T_cam)
    center = apply(cam_T_map, states.center_m)[0]
    radius = float(np.linalg.norm(actor.spec.box_m)) / 2
    reach = (view.width_px + view.height_px) / view.K[0, 0]
    if center[2] < -radius or np.hypot(center[0], center[1]) - radius > reach * (center[2] + radius):
        nothing = np.zeros(0, np.int64)
        return Fragments(nothing, nothing.astype(np.float32), nothing, np.zeros((0, 3), np.float32))
    mesh = actor.mesh(t_s)
    vertices = apply(cam_T_map @ states.map_T_agent()[0], mesh.vertices_m)
    return rasterize(vertices, mesh.faces, view.K, view.width_px, view.height_px)


def _shade(
    view: RenderCamera, actor: Actor, t_s: float, fragments: Fragments, near: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Light (P, 3) from an actor's surface."""
    mesh, map_T_agent = actor.mesh(t_s), actor.at(t_s).map_T_agent()[0]
    corner = mesh.faces[fragments.face[near]]
    weight = fragments.weight[near][:, :, None]
    points = (mesh.vertices_m.astype(np.float32)[corner] * weight).sum(1)
    normals = (mesh.normals.astype(np.float32)[corner] * weight).sum(1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
    surface = paint(actor.appearance, mesh.part[fragments.face[near]], points, normals)
    R = map_T_agent[:3, :3].astype(np.float32)
    n = normals @ R.T
    to_camera = (view.map_T_cam[:3, 3] - map_T_agent[:3, 3]).astype(np.float32) - points @ R.T
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    height = points[:, 2] + np.float32(actor.spec.box_m[2] / 2)
    return reflected(surface, n, to_camera, height)


def _sky_and_ground(
    view: RenderCamera, backdrop: Backdrop
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    by_column, by_row = view.rays()
    up = by_row[:, None, 2] + by_column[None, :, 2]
    rise = np.clip(up / np.sqrt(1 + up * up) * 1.8, 0, 1)[..., None]
    color = (HORIZON + (ZENITH - HORIZON) * rise).astype(np.float32)
    ground = up < -1e-3
    depth = np.full(up.shape, FAR_M, np.float32)
    np.divide(-np.float32(view.map_T_cam[2, 3]), up, out=depth, where=ground)
    np.minimum(depth, FAR_M, out=depth)
    image = _ground_image(view, backdrop, depth)
    lit = SKY_LIGHT + SUN_LIGHT * np.float32(SUN[2])
    color[ground] = _LINEAR[image[ground]] * lit
    return color, depth, ground


def _ground_image(view: RenderCamera, backdrop: Backdrop, depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Warp the ground texture into the image, from the pyramid level whose resolution fits each row."""
    h, w = view.height_px, view.width_px
    cam_T_map = inverse(view.map_T_cam)
    image_H_ground = view.K @ np.column_stack([cam_T_map[:3, 0], cam_T_map[:3, 1], cam_T_map[:3, 3]])
    middle = depth[:, w // 2]
    footprint = middle / view.K[0, 0] * np.sqrt(np.maximum(middle / max(view.map_T_cam[2, 3], 0.1), 1.0))
    level = np.clip(np.rint(np.log2(np.maximum(footprint / GROUND_M_PER_PX, 1.0))), 0, len(backdrop.ground) - 1).astype(
        int
    )
    out = np.empty((h, w, 3), np.uint8)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(level)) + 1, [h]])
    for top, bottom in pairwise(edges):
        k = int(level[top])
        step = GROUND_M_PER_PX * 2**k
        ground_H_texture = np.array(
            [[step, 0, backdrop.corner_m[0] + step / 2], [0, step, backdrop.corner_m[1] + step / 2], [0, 0, 1]]
        )
        shift = np.array([[1, 0, 0], [0, 1, -top], [0, 0, 1.0]])
        homography = shift @ image_H_ground @ ground_H_texture
        plain = backdrop.ground[-1][0, 0].tolist()
        out[top:bottom] = cv2.warpPerspective(
            backdrop.ground[k],
            homography,
            (w, int(bottom - top)),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=plain,
        )
    return out


def _draw_walls(
    view: RenderCamera, backdrop: Backdrop, color: NDArray[np.float32] | None, depth: NDArray[np.float32]
) -> None:
    """Draw facades where they are nearer than the depth so far; with `color` None only their depth."""
    eye = view.map_T_cam[:3, 3]
    by_column, by_row = view.rays()
    for wall in backdrop.walls:
        gap = float(np.dot(eye[:2] - wall.foot_m, wall.outward))
        if gap <= 0:
            continue
        end = wall.foot_m + wall.along * wall.length_m
        corners = np.array([[*wall.foot_m, 0], [*end, 0], [*end, wall.height_m], [*wall.foot_m, wall.height_m]])
        polygon = view.polygon(corners)
        if len(polygon) == 0:
            continue
        low = np.clip(polygon.min(0) // 16, 0, [view.width_px, view.height_px])
        high = np.clip(polygon.max(0) // 16 + 2, 0, [view.width_px, view.height_px])
        if np.any(high <= low):
            continue
        mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
        cv2.fillConvexPoly(mask, polygon - low.astype(np.int32) * 16, 1, cv2.LINE_8, 4)
        columns, rows = by_column[low[0] : high[0]], by_row[low[1] : high[1]]
        toward = (rows[:, None, :2] + columns[None, :, :2]) @ wall.outward.astype(np.float32)
        z = np.divide(np.float32(-gap), toward, out=np.full(mask.shape, np.inf, np.float32), where=toward < -1e-9)
        region = (slice(low[1], high[1]), slice(low[0], high[0]))
        drawn = (mask > 0) & (z < depth[region])
        depth[region][drawn] = z[drawn]
        if color is None:
            continue
        finite = np.where(np.isfinite(z), z, 0)
        s = ((rows[:, None, :2] + columns[None, :, :2]) @ wall.along.astype(np.float32)) * finite + np.float32(
            np.dot(eye[:2] - wall.foot_m, wall.along)
        )
        height = (rows[:, None, 2] + columns[None, :, 2]) * finite + np.float32(eye[2])
        texture = cv2.remap(
            wall.texture,
            s / FACADE_M_PER_PX - 0.5,
            height / FACADE_M_PER_PX - 0.5,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        light = SKY_LIGHT * 0.75 + SUN_LIGHT * np.float32(max(0.0, float(wall.outward @ SUN[:2])))
        color[region][drawn] = _LINEAR[texture[drawn]] * light


def _draw_shadows(
    view: RenderCamera, actors: tuple[Actor, ...], t_s: float, color: NDArray[np.float32], ground: NDArray[np.bool_]
) -> None:
    """Darken the ground in the shadow of actors and, right below them, further."""
    sun = np.zeros(ground.shape, np.uint8)
    sky = np.zeros(ground.shape, np.uint8)
    slope = SUN[:2] / SUN[2]
    for actor in actors:
        map_T_agent = actor.at(t_s).map_T_agent()[0]
        if np.linalg.norm(map_T_agent[:2, 3] - view.map_T_cam[:2, 3]) > 80.0:
            continue
        vertices = apply(map_T_agent, actor.mesh(t_s).vertices_m)
        cast = (vertices[:, :2] - slope * vertices[:, 2:]).astype(np.float32)
        below = vertices[vertices[:, 2] < 0.25 * actor.spec.box_m[2] + 0.05, :2].astype(np.float32)
        for mask, points in ((sun, cast), (sky, below)):
            hull = cv2.convexHull(points)[:, 0]
            polygon = view.polygon(np.column_stack([hull, np.zeros(len(hull))]).astype(float))
            if len(polygon):
                cv2.fillConvexPoly(mask, polygon, 255, cv2.LINE_AA, 4)
    soft_sun = np.asarray(cv2.GaussianBlur(sun, (0, 0), 1.6 * OVERSAMPLING), np.uint8)
    soft_sky = np.asarray(cv2.GaussianBlur(sky, (0, 0), 1.8 * OVERSAMPLING), np.uint8)
    rows = np.flatnonzero(((soft_sun > 0) | (soft_sky > 0)).any(1))
    if len(rows) == 0:
        return
    band = slice(int(rows[0]), int(rows[-1]) + 1)
    factor = (1 - 0.55 * (soft_sun[band] / np.float32(255))) * (1 - 0.5 * (soft_sky[band] / np.float32(255)))
    color[band] *= np.where(ground[band], factor, 1.0)[..., None].astype(np.float32)


def _developed(color: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Lens blur, sensor noise and gamma."""
    h, w = color.shape[0] // OVERSAMPLING, color.shape[1] // OVERSAMPLING
    image = cv2.resize(color, (w, h), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), 0.45)
    image = 255 * np.clip(image, 0, 1) ** np.float32(1 / GAMMA)
    grain = rng.standard_normal((h, w), dtype=np.float32)[..., None] * np.float32(0.8)
    return np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)
