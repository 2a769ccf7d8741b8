"""Facades of buildings in a picture."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.backdrop import FACADE_M_PER_PX, Wall
from log2sim.synth.light import Light
from log2sim.synth.render_camera import RenderCamera
from log2sim.synth.scenery import Image, Texture, linear

SUBPIXEL_BITS = 4  # of the coordinates of polygons


@dataclass(frozen=True, eq=False)
class _Seen:
    """A wall that looks at the camera, in the image.

    Attributes
    ----------
    wall : Wall
    gap_m : float
        Distance of the camera from its plane.
    polygon : (P, 2) int32
        In 1 / 2**SUBPIXEL_BITS px.
    rows, columns : slice
        The rectangle around it.
    """

    wall: Wall
    gap_m: float
    polygon: NDArray[np.int32]
    rows: slice
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
        seen = [s for wall in walls if (s := _look_at(view, wall)) is not None]
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
            paint[inner] += linear(_texture(view, part), light.on_wall(part.wall.outward)) * covered[..., None]
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
            seen = _look_at(view, wall)
            if seen is not None:
                z = np.where(seen.mask(seen.polygon, cv2.LINE_8) > 0, seen.depth(view), np.inf)
                np.minimum(depth[seen.region], z, out=depth[seen.region])


def _around(slices: list[slice]) -> slice:
    return slice(min(s.start for s in slices), max(s.stop for s in slices))


def _look_at(view: RenderCamera, wall: Wall) -> _Seen | None:
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
        warped = cv2.warpPerspective(
            wall.texture[level],
            image_H_wall @ wall_H_texture,
            size,
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
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
