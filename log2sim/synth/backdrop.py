"""The static parts of a scene: ground, terrain and facades."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, box_corners_bev
from log2sim.synth.ground import GROUND_M_PER_PX, LEVELS, MEADOW, TILE_PX, Ground, GroundPlan, grain
from log2sim.synth.light import FAR_M, MIN_FALL, Image, Light, RenderCamera, Texture, light_of, linear, rows_by_level
from log2sim.synth.scene import Scene
from log2sim.synth.terrain import Surface, meet

MAX_ERROR_M = 0.05  # of the ground's height where a ray meets it
MAX_MOSAIC_TILES = 24  # along a side: 113 MB at most
REACH_M = 250.0  # beyond which the ground is as level as it is under the camera


def draw_terrain(
    view: RenderCamera, ground: Ground, terrain: Surface, light: Light, color: Image, depth: Image
) -> None:
    """Draw the ground below the horizon."""
    by_column, by_row = view.rays()
    fall = -(by_row[:, None, 2] + by_column[None, :, 2])
    rows = np.flatnonzero((fall > MIN_FALL).any(1))
    if len(rows) == 0:
        return
    band = slice(int(rows[0]), int(rows[-1]) + 1)
    dx = by_row[band, None, 0] + by_column[None, :, 0]
    dy = by_row[band, None, 1] + by_column[None, :, 1]
    eye = view.map_T_cam[:3, 3].astype(np.float32)
    under = terrain.height(eye[:1], eye[1:2]) + terrain.relief(eye[:1], eye[1:2])
    level = np.maximum(eye[2] - under[0], np.float32(0.1)) / np.maximum(fall[band], np.float32(1e-6))
    level = np.minimum(level, np.float32(FAR_M))
    ray = [np.ravel(r) for r in (dx, dy, -fall[band])]
    t = np.minimum(level, np.float32(REACH_M)).ravel()
    t, error, rise = meet(terrain, tuple(eye), tuple(ray), t, flattest=1e-3, span=(0.1, 2 * REACH_M))
    met = (np.abs(error) < MAX_ERROR_M).reshape(level.shape)
    t += terrain.relief(eye[0] + t * ray[0], eye[1] + t * ray[1]) / np.minimum(rise, np.float32(-0.02))
    away = t.reshape(level.shape)
    met &= away < REACH_M
    away = np.where(met, away, level)
    seen = met | (fall[band] > MIN_FALL)
    x, y = eye[0] + away * dx, eye[1] + away * dy
    # For each row from the level of tiles whose resolution fits.
    texture = np.empty((*x.shape, 3), np.uint8)
    for tiles, part in rows_by_level(np.median(away, axis=1), max(float(view.map_T_cam[2, 3]), 0.5), view.K[0, 0]):
        texture[part] = _sampled(ground, tiles, x[part], y[part], seen[part])
    lit = linear(texture, light.on_ground())
    color[band][seen], depth[band][seen] = lit[seen], away[seen]


def _sampled(ground: Ground, level: int, x: Image, y: Image, seen: NDArray[np.bool_]) -> Texture:
    """Colors (H, W, 3) of positions (H, W) from tiles of a level, or of a coarser one where they would be too many."""
    if not seen.any():
        return np.zeros((*x.shape, 3), np.uint8)
    # On a slope, rays of one row meet the ground near by and far away: coarser tiles, so that all of them fit into memory.
    extent = max(float(np.ptp(x[seen])), float(np.ptp(y[seen])))
    while level < LEVELS - 1 and extent > MAX_MOSAIC_TILES * TILE_PX * GROUND_M_PER_PX * 2**level:
        level += 1
    step = np.float32(GROUND_M_PER_PX * 2**level)
    side = step * np.float32(TILE_PX)
    i, j = (np.floor(v[seen] / side).astype(np.int64) for v in (x, y))
    low = (int(i.min()), int(j.min()))
    touched = np.zeros((int(j.max()) - low[1] + 1, int(i.max()) - low[0] + 1), bool)
    touched[j - low[1], i - low[0]] = True
    mosaic = ground.mosaic(level, low, touched, MEADOW)
    u, v = ((c - np.float32(first) * side) / step - np.float32(0.5) for c, first in zip((x, y), low))
    return np.asarray(cv2.remap(mosaic, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


FACADE_M_PER_PX = 0.04
FACADE_LEVELS = 6
FLOOR_M, BAY_M = 3.1, 2.7
GRAIN = 0.5  # of plaster relative to asphalt


@dataclass(frozen=True, eq=False)
class Wall:
    """One side of a building."""

    foot_m: Array  # (2,), m: one end of its foot
    along: Array  # (2,): unit direction from there along the foot
    outward: Array  # (2,): unit normal
    length_m: float
    height_m: float
    color: tuple[int, int, int]  # RGB
    seed: tuple[int, ...]  # of its windows and stains

    @cached_property
    def texture(self) -> tuple[Texture, ...]:
        """Images (H, W, 3), sRGB as BGR, the first row at the ground, in pixels of `FACADE_M_PER_PX`, then ever twice as large.

        Painted are a plinth, floors of windows, and a cornice.
        """
        rng, px = np.random.default_rng(self.seed), 1 / FACADE_M_PER_PX
        h, w = max(8, round(self.height_m * px)), max(8, round(self.length_m * px))
        color = np.array(self.color[::-1])
        image = np.empty((h, w, 3), np.uint8)
        image[:] = color
        image[: round(0.8 * px)] = color * 0.78
        image[-round(0.35 * px) :] = np.minimum(color * 1.1, 255)
        bays, floors = int((self.length_m - 0.8) // BAY_M), int((self.height_m - 1.0) // FLOOR_M)
        start = (self.length_m - bays * BAY_M) / 2
        for floor in range(floors):
            for bay in range(bays):
                x, z = start + bay * BAY_M + 0.75, 1.1 + floor * FLOOR_M
                frame = [round(v * px) for v in (z - 0.08, z + 1.63, x - 0.08, x + 1.28)]
                image[frame[0] : frame[1], frame[2] : frame[3]] = np.minimum(color * 1.12, 255)
                pane = [round(v * px) for v in (z, z + 1.55, x, x + 1.2)]
                light = rng.uniform(0.75, 1.15)
                ramp = np.linspace(0.85, 1.15, pane[1] - pane[0])[:, None, None] * light
                image[pane[0] : pane[1], pane[2] : pane[3]] = np.clip(ramp * np.array((112, 100, 88)), 0, 255)
                middle = (pane[2] + pane[3]) // 2
                image[pane[0] : pane[1], middle - 1 : middle + 1] = np.minimum(color * 1.05, 255)
        shade = 1 + (grain(self.seed[0], 0, (0, int(rng.integers(1024))), (h, w)) - 1) * np.float32(GRAIN)
        levels = [np.clip(image * shade[..., None], 0, 255).astype(np.uint8)]
        while len(levels) < FACADE_LEVELS and min(levels[-1].shape[:2]) >= 8:
            half = cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            levels.append(np.asarray(half, np.uint8))
        return tuple(levels)


@dataclass(frozen=True, eq=False)
class Backdrop:
    """The static parts of a scene: the ground and facades, painted when and where they are looked at."""

    ground: Ground
    terrain: Surface | None = None  # heights of the ground, None where it is level
    buildings: tuple[tuple[Wall, ...], ...] = ()  # sides of each
    shadows: tuple[Array, ...] = ()  # convex outlines (P, 2), m, of the shadows of what does not move

    @classmethod
    def of(cls, scene: Scene, seed: int) -> Backdrop:
        """Take that of a scene file."""
        sun, walls = light_of(scene.environment).sun, []
        shadows = [_hull(np.array(s.outline)) for s in scene.shadow]
        for n, building in enumerate(scene.building):
            length, width, height = building.size_m
            corners = box_corners_bev(np.array(building.center), length, width, np.deg2rad(building.yaw_deg))[0]
            sides = []
            for k, (a, b) in enumerate(zip(corners, np.roll(corners, -1, axis=0))):
                span = float(np.linalg.norm(b - a))
                along = (b - a) / span
                outward = np.array([along[1], -along[0]])
                sides.append(Wall(a, along, outward, span, height, building.color, (seed, 5, n, k)))
            walls.append(tuple(sides))
            if building.shadow:
                shadows.append(_hull(np.concatenate([corners, corners - np.divide(sun[:2], sun[2]) * height])))
        return cls(Ground(GroundPlan.of(scene), seed), None, tuple(walls), tuple(shadows))


def _hull(points: Array) -> Array:
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], np.float64)


SUBPIXEL_BITS = 4  # of the coordinates of polygons


@dataclass(frozen=True, eq=False)
class _Seen:
    """A wall that looks at the camera, in the image."""

    wall: Wall
    gap_m: float  # distance of the camera from its plane
    polygon: NDArray[np.int32]  # (P, 2): in 1 / 2**SUBPIXEL_BITS px
    rows: slice  # the rectangle around it
    columns: slice

    @property
    def region(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return self.rows, self.columns

    def mask(self, polygon: NDArray[np.int32], line: int) -> Texture:
        """Draw a polygon on a mask of the region, from 0 to 255."""
        out = np.zeros((self.rows.stop - self.rows.start, self.columns.stop - self.columns.start), np.uint8)
        corner = np.array([self.columns.start, self.rows.start], np.int32) << SUBPIXEL_BITS
        cv2.fillConvexPoly(out, polygon - corner, 255, line, SUBPIXEL_BITS)
        return out

    def depth(self, view: RenderCamera) -> Image:
        """Depth of the wall's plane in the region."""
        by_column, by_row = view.rays()
        outward = (self.wall.outward / -self.gap_m).astype(np.float32)
        nearness = (by_row[self.rows, :2] @ outward)[:, None] + (by_column[self.columns, :2] @ outward)[None, :]
        ahead = nearness > 1e-9
        return np.divide(np.float32(1), nearness, out=np.full(nearness.shape, np.inf, np.float32), where=ahead)


def draw_buildings(
    view: RenderCamera, buildings: tuple[tuple[Wall, ...], ...], light: Light, color: Image, depth: Image
) -> None:
    """Draw facades where they are nearer than the depth (H, W) so far, far ones first."""
    eye = view.map_T_cam[:2, 3]
    far_first = sorted(buildings, key=lambda walls: -float(np.min([np.linalg.norm(w.foot_m - eye) for w in walls])))
    for walls in far_first:
        seen = [s for wall in walls if (s := _visible_part(view, wall)) is not None]
        if not seen:
            continue
        region = (_around([s.rows for s in seen]), _around([s.columns for s in seen]))
        shape = (region[0].stop - region[0].start, region[1].stop - region[1].start)
        paint, share, away = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32), depth[region].copy()
        for part in seen:
            inner = tuple(slice(s.start - whole.start, s.stop - whole.start) for s, whole in zip(part.region, region))
            z = part.depth(view)
            covered = part.mask(part.polygon, cv2.LINE_AA) * np.float32(1 / 255)
            covered *= z < depth[part.region]
            sun = max(0.0, float(np.dot(part.wall.outward, light.sun[:2])))
            falling = np.multiply(light.sky_color, 0.75) + np.multiply(light.sun_color, sun)
            paint[inner] += linear(_texture(view, part), np.asarray(falling, np.float32)) * covered[..., None]
            share[inner] += covered
            away[inner] = np.where(covered >= 0.5, z, away[inner])
        # Where two walls of a building meet, their shares sum to one or more, so that nothing behind shines through.
        paint /= np.maximum(share, 1.0)[..., None]
        color[region] *= (1 - np.minimum(share, 1.0))[..., None]
        color[region] += paint
        depth[region] = away


def hide_behind_buildings(view: RenderCamera, buildings: tuple[tuple[Wall, ...], ...], depth: Image) -> None:
    """Bring the depth (H, W) forward to the facades."""
    for walls in buildings:
        for wall in walls:
            seen = _visible_part(view, wall)
            if seen is not None:
                z = np.where(seen.mask(seen.polygon, cv2.LINE_8) > 0, seen.depth(view), np.inf)
                np.minimum(depth[seen.region], z, out=depth[seen.region])


def _around(slices: list[slice]) -> slice:
    return slice(min(s.start for s in slices), max(s.stop for s in slices))


def _visible_part(view: RenderCamera, wall: Wall) -> _Seen | None:
    gap = float(np.dot(view.map_T_cam[:2, 3] - wall.foot_m, wall.outward))
    if gap <= 0:
        return None
    polygon = view.polygon(_corners(wall, 0.0, wall.length_m))
    if len(polygon) == 0:
        return None
    size = [view.width_px, view.height_px]
    low = np.clip((polygon.min(0) >> SUBPIXEL_BITS) - 1, 0, size)
    high = np.clip((polygon.max(0) >> SUBPIXEL_BITS) + 3, 0, size)
    if np.any(high <= low):
        return None
    return _Seen(wall, gap, polygon, slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))


def _corners(wall: Wall, start_m: float, end_m: float) -> Array:
    a, b = wall.foot_m + wall.along * start_m, wall.foot_m + wall.along * end_m
    return np.array([[*a, 0], [*b, 0], [*b, wall.height_m], [*a, wall.height_m]])


def _texture(view: RenderCamera, seen: _Seen) -> Texture:
    """Warp the facade into the region, in pieces along the wall whose resolution fits their distance."""
    wall = seen.wall
    size = (seen.columns.stop - seen.columns.start, seen.rows.stop - seen.rows.start)
    out = np.zeros((size[1], size[0], 3), np.uint8)
    eye = view.map_T_cam[:3, 3]
    shift = np.array([[1, 0, -seen.columns.start], [0, 1, -seen.rows.start], [0, 0, 1.0]])
    image_H_wall = shift @ view.image_H_plane(
        np.array([*wall.foot_m, 0.0]) - eye, np.array([*wall.along, 0.0]), np.array([0, 0, 1.0])
    )
    pieces = _pieces(view, seen)
    for start, end, level in pieces:
        polygon = view.polygon(_corners(wall, start, end))
        if len(polygon) == 0:
            continue
        step = FACADE_M_PER_PX * 2**level
        wall_H_texture = np.array([[step, 0, step / 2], [0, step, step / 2], [0, 0, 1]])
        image_H_texture = image_H_wall @ wall_H_texture
        warped = cv2.warpPerspective(
            wall.texture[level], image_H_texture, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        if len(pieces) == 1:
            return np.asarray(warped, np.uint8)
        # Two pixels wider, for the softened outline of the wall.
        mask = cv2.dilate(seen.mask(polygon, cv2.LINE_8), np.ones((5, 5), np.uint8))
        cv2.copyTo(warped, mask, out)
    return out


def _pieces(view: RenderCamera, seen: _Seen) -> list[tuple[float, float, int]]:
    """Begin and end of pieces along a wall in m, far ones first, and the level of the texture for each."""
    wall, gap, focal = seen.wall, max(seen.gap_m, 0.1), view.K[0, 0]
    foot = float(np.dot(view.map_T_cam[:2, 3] - wall.foot_m, wall.along))  # where the camera is nearest
    # A pixel covers distance / focal across and distance / gap as much along the wall; the mean decides, rather sharp.
    limits = FACADE_M_PER_PX * 2.0 ** (np.arange(len(wall.texture) - 1) + 1)
    reach = np.sqrt(np.maximum((limits * focal * np.sqrt(gap)) ** (4 / 3) - gap**2, 0.0))
    edges = np.unique(np.clip([0.0, wall.length_m, *(foot + reach), *(foot - reach)], 0.0, wall.length_m))
    pieces = []
    for start, end in pairwise(edges):
        if end - start > 1e-6:
            pieces.append((float(start), float(end), int(np.sum(reach <= abs((start + end) / 2 - foot)))))
    return sorted(pieces, key=lambda piece: -piece[2])
