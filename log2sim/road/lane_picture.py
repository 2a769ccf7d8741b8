"""Lane markings in one picture: the ground is laid out flat, by a known camera or by its vanishing point.

Lane lines run beside each other. Edges of vehicles, walls and masts that stand upright point away from the camera when
they are laid out flat, so they do not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Marking, RoadBorder
from log2sim.geometry import Array, Camera, apply, inverse, project
from log2sim.road.ground_map import GroundMap, Raster
from log2sim.road.lane_course import LaneLine, find_lane_lines, find_shape
from log2sim.road.markings import list_markings
from log2sim.road.paint_network import find_paint_maps
from log2sim.road.pictures import Image, View, sample_at, warp_onto
from log2sim.road.samples import log_color
from log2sim.road.surface import Surface

WIDTH_PX = 960  # pictures are made smaller, so that grain is no line
MIN_LENGTH = 0.02  # of the width
ROWS = (0.1, 0.75)  # of the height, in which horizons of cameras that look along roads lie
COLUMNS = (0.15, 0.85)
LEAST_SLOPE_RAD = np.deg2rad(8)  # lines across the road
ANGLE_SIGMA_RAD = np.deg2rad(1.0)
LONGEST = 0.15  # of the width: what counts at most, so that no rail decides alone
TRIALS = 4000
MIN_SUPPORT = 0.1  # of the width, on either side


def find_vanishing_point(image_bgr: NDArray[np.uint8], *, rng: np.random.Generator) -> tuple[float, float] | None:
    """Find the pixel (u, v) in which lines along the road meet; None where too few do.

    Straight segments (von Gioi et al., "LSD: a fast line segment detector with a false detection control", PAMI 2010)
    that lean to the left and to the right are intersected in random pairs. The point is taken to which most length of
    both sides points: the lesser side counts.
    """
    scale = WIDTH_PX / image_bgr.shape[1]
    small = cv2.resize(image_bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    height, width = small.shape[:2]
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY))[0]
    segments = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4)
    upside = segments[:, 1] > segments[:, 3]
    segments[upside] = segments[upside][:, [2, 3, 0, 1]]  # the upper end first
    # Those left of a road lean to the right, those right of it to the left; masts do not.
    d = segments[:, 2:] - segments[:, :2]
    length = np.linalg.norm(d, axis=1)
    chosen = (np.abs(d[:, 1]) > np.sin(LEAST_SLOPE_RAD) * length) & (np.abs(d[:, 0]) >= 0.05 * length)
    chosen &= (length > MIN_LENGTH * width) & (segments[:, 3] > ROWS[0] * height)
    left, right = segments[chosen & (d[:, 0] < 0)], segments[chosen & (d[:, 0] > 0)]
    if not len(left) or not len(right):
        return None
    pairs = rng.integers(0, (len(left), len(right)), (TRIALS, 2))
    meeting = np.cross(_line(left[pairs[:, 0]]), _line(right[pairs[:, 1]]))
    with np.errstate(all="ignore"):
        points = meeting[:, :2] / meeting[:, 2:]
    low, high = np.array([COLUMNS[0] * width, ROWS[0] * height]), np.array([COLUMNS[1] * width, ROWS[1] * height])
    points = points[np.all((points > low) & (points < high), axis=1)]
    if not len(points):
        return None
    support = np.min([_weights(side, points, LONGEST * width).sum(axis=0) for side in (left, right)], axis=0)
    best = int(np.argmax(support))
    if support[best] < MIN_SUPPORT * width:
        return None
    u, v = _refine(np.concatenate([left, right]), points[best])
    return float(u / scale), float(v / scale)


def _line(segments: Array) -> Array:
    """Return the lines (N, 3) through segments, homogeneous, with unit normals."""
    a = np.column_stack([segments[:, :2], np.ones(len(segments))])
    b = np.column_stack([segments[:, 2:], np.ones(len(segments))])
    lines = np.cross(a, b)
    return np.asarray(lines / np.linalg.norm(lines[:, :2], axis=1, keepdims=True))


def _weights(segments: Array, points: Array, longest_px: float) -> Array:
    """How much each segment points to each point, (N, P), px; only those below it."""
    middle = (segments[:, :2] + segments[:, 2:]) / 2
    d = segments[:, 2:] - segments[:, :2]
    to = points[None] - middle[:, None]
    cross = d[:, None, 0] * to[..., 1] - d[:, None, 1] * to[..., 0]
    length = np.linalg.norm(d, axis=1)
    sine = cross / np.maximum(length[:, None] * np.linalg.norm(to, axis=2), 1e-9)
    below = segments[:, 1][:, None] > points[None, :, 1] - 2
    return np.asarray(below * np.minimum(length, longest_px)[:, None] * np.exp(-0.5 * (sine / ANGLE_SIGMA_RAD) ** 2))


def _refine(segments: Array, point: Array) -> Array:
    """Move a point to where the segments that point to it meet best, by their distances as angles."""
    for _ in range(5):
        weight = _weights(segments, point[None], np.inf)[:, 0]
        lines = _line(segments)
        reach = np.linalg.norm((segments[:, :2] + segments[:, 2:]) / 2 - point, axis=1)
        w = weight / np.maximum(reach, 1.0) ** 2
        normal = np.einsum("n,ni,nj->ij", w, lines[:, :2], lines[:, :2])
        right = -np.einsum("n,ni,n->i", w, lines[:, :2], lines[:, 2])
        if np.linalg.cond(normal) > 1e6:
            break
        point = np.linalg.solve(normal, right)
    return point


SURFACE_NEAR_M, BESIDE_M = 12.0, 3.0  # from the camera: ground that is mostly road in pictures that look along one
# Paint and joints are narrower; vehicles are wider.
NARROW_M = 0.7
# Logarithms: other surfaces, wear and far haze; shadows of vehicles and their lower parts are darker by far.
DARKER, BRIGHTER, COLORED = 0.6, 0.4, 0.12
MIN_SHARE = 0.02  # of what is seen: with less, the color near the camera is not that of a road
AROUND_M = 0.3


def keep_road(ground: GroundMap, camera_x_m: float, camera_y_m: float) -> GroundMap:
    """Hide what has not the color of the ground in front of the camera; all is kept where that is no wide surface."""
    seen = ground.alpha > 0
    # What is narrow across the road, which runs along the rows, is removed: bright lines first, then dark ones.
    across = np.ones((2 * round(NARROW_M / ground.resolution_m / 2) + 1, 1), np.uint8)
    opened = (cv2.morphologyEx(cv2.blur(a, (5, 5)), cv2.MORPH_OPEN, across) for a in log_color(ground.color_bgr))
    bright, yellow = (cv2.morphologyEx(a, cv2.MORPH_CLOSE, across) for a in opened)
    near = np.zeros(seen.shape, bool)
    x0, _, _, y1 = ground.extent_m
    rows = slice(*(max(round((y1 - camera_y_m + side * BESIDE_M) / ground.resolution_m), 0) for side in (-1, 1)))
    first = max(round((camera_x_m - x0) / ground.resolution_m), 0)
    near[rows, first : first + round(SURFACE_NEAR_M / ground.resolution_m)] = True
    near &= seen
    if not near.any():
        return ground
    level, tint = float(np.median(bright[near])), float(np.median(yellow[near]))
    road = seen & (bright > level - DARKER) & (bright < level + BRIGHTER) & (np.abs(yellow - tint) < COLORED)
    if np.count_nonzero(road) < MIN_SHARE * np.count_nonzero(seen):
        return ground
    size = (2 * round(AROUND_M / ground.resolution_m) + 1,) * 2
    whole = cv2.morphologyEx(road.astype(np.uint8), cv2.MORPH_OPEN, np.ones(size, np.uint8))
    wider = cv2.dilate(whole, np.ones((size[0] // 2 | 1,) * 2, np.uint8))
    return replace(ground, alpha=np.where(wider > 0, ground.alpha, 0).astype(np.uint8))


CELL_M = 0.05
HALF_WIDTH_M, REACH_M = 18.0, 90.0
COARSEST_M = 3.0  # a dash is 3 m long; what is coarser along the road shows no line's begin, but where it runs
# Behind the windshield of cars cameras are 1.2 m to 1.6 m above the road; widths scale with it.
CAMERA_HEIGHT_M = 1.5
HORIZONTAL_FIELD_RAD = np.deg2rad(60)  # dashboard cameras: 50 to 70 deg; lengths along the road scale with its tangent
# Rows that a line spans, as a share of the picture's height: less is too little to tell its course; more counts no more.
SHORT_LINE, LONG_LINE = 0.015, 0.1
FAR_M = 150.0  # to where lane lines are continued
# Of lines that do not count alone, but where others run beside them; dashes are 1 m and more.
MIN_CONFIDENCE, MIN_DASH_M = 0.15, 1.0


@dataclass(frozen=True, eq=False)
class PictureMarkings:
    """What one picture shows of the road."""

    markings: tuple[Marking, ...]  # in the frame of the ground below the camera: x forward, y left, z up
    borders: tuple[RoadBorder, ...]
    lane_lines: tuple[LaneLine, ...]  # the lines of which lane markings are parts, from left to right
    camera: Camera  # its `mount_T_cam` is its pose in that frame
    ground: GroundMap  # the ground as the picture shows it
    notes: tuple[str, ...]  # what was not seen or is assumed

    def project(self, points_m: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3) of the ground, NaN where they are not in front of the camera."""
        return project(self.camera, apply(inverse(self.camera.mount_T_cam), points_m))[0]


def find_markings_in_picture(
    image_bgr: Image, camera: Camera | None = None, *, height_m: float = CAMERA_HEIGHT_M
) -> PictureMarkings:
    """Find markings in one picture that looks along a road.

    `image_bgr`: (H, W, 3) uint8: without lens distortion, unless a camera states it. `camera`: `mount_T_cam` is its
    pose above the ground z = 0 of its mount, x forward. Without it, the direction is that in which lines of the road
    meet, the field of view is assumed, and lengths along the road are no better than that. `height_m`: of the camera
    above the road, where there is no camera.

    Returns PictureMarkings: without markings where no lines meet.
    """
    if camera is not None:
        return _find(image_bgr, camera)
    point = find_vanishing_point(image_bgr, rng=np.random.default_rng(0))
    if point is None:
        nowhere = _camera_towards(image_bgr, (image_bgr.shape[1] / 2, image_bgr.shape[0] / 2), height_m)
        note = "no markings seen: no lines meet, so the horizon of the road is unknown"
        return PictureMarkings((), (), (), nowhere, lay_out(image_bgr, nowhere), (note,))
    found = _find(image_bgr, _camera_towards(image_bgr, point, height_m))
    field = f"{np.rad2deg(HORIZONTAL_FIELD_RAD):.0f} deg"
    assumed = f"camera: {height_m:g} m above the road and a field of view of {field} are assumed"
    return replace(found, notes=(*found.notes, assumed))


def _find(image_bgr: Image, camera: Camera) -> PictureMarkings:
    """Find markings by a camera's pose, and leave out lines that do not follow the course of the road."""
    whole = lay_out(image_bgr, camera)
    ground = keep_road(whole, *camera.mount_T_cam[:2, 3].tolist())
    markings = list_markings(ground, find_paint_maps(ground), min_confidence=MIN_CONFIDENCE, min_line_m=MIN_DASH_M)
    notes = ("markings by a camera only: light streaks are harder to tell from paint",)
    found = PictureMarkings(markings, (), (), camera, ground, notes)
    lines, shares = [], []
    for m in markings:
        if m.is_lane_line:
            share = _visible(found, m) * m.confidence / (LONG_LINE * camera.height_px)
            if share >= SHORT_LINE / LONG_LINE:
                lines.append(m)
                shares.append(share)
    shape = find_shape(lines, np.array(shares))
    others = tuple(m for m in markings if not m.is_lane_line)
    if shape is None:
        return replace(found, markings=others, notes=(*notes, "no lane lines seen: none run beside each other"))
    kept = [lines[k] for k in shape[1]]
    lane_lines = find_lane_lines(whole, ground, camera, shape[0], kept, FAR_M)
    return replace(found, markings=(*kept, *others), lane_lines=tuple(lane_lines))


def _visible(found: PictureMarkings, marking: Marking) -> float:
    """Count the rows of the picture that a marking spans."""
    uv = found.project(marking.points_m)
    rows = uv[np.isfinite(uv[:, 1]), 1]
    return float(np.ptp(rows)) if len(rows) > 1 else 0.0


def lay_out(image_bgr: Image, camera: Camera) -> GroundMap:
    """Lay the ground in front of a camera out flat."""
    x, y = camera.mount_T_cam[:2, 3]
    raster = Raster.covering((x, x + REACH_M, y - HALF_WIDTH_M, y + HALF_WIDTH_M), CELL_M)
    color, alpha = np.zeros((*raster.shape, 3), np.uint8), np.zeros(raster.shape, np.uint8)
    unknown = np.full(raster.shape, np.nan, np.float32)
    flat = Surface(raster, np.zeros(raster.shape, np.float32), np.ones(raster.shape, bool))
    warp = warp_onto(View(camera, camera.mount_T_cam), flat, 0.0, raster, COARSEST_M)
    if warp is not None:
        color.reshape(-1, 3)[warp.cell] = sample_at(image_bgr, warp.u, warp.v, warp.scale)
        alpha.reshape(-1)[warp.cell] = np.rint(255 * warp.opacity)
    return GroundMap(color, alpha, unknown, unknown, raster.resolution_m, raster.extent_m)


def _camera_towards(image_bgr: Image, point: tuple[float, float], height_m: float) -> Camera:
    """Make the camera whose pixel `point` looks along the road, without roll."""
    height, width = image_bgr.shape[:2]
    focal = width / 2 / np.tan(HORIZONTAL_FIELD_RAD / 2)
    K = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1.0]])
    forward = np.linalg.solve(K, np.array([*point, 1.0]))
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, -1.0, (point[1] - K[1, 2]) / focal])  # the horizon is a row
    up /= np.linalg.norm(up)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([forward, np.cross(up, forward), up])
    pose[2, 3] = height_m
    return Camera("picture", width, height, K, "ego", pose)
