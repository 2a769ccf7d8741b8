"""Where lines along the road meet in a picture: the horizon of a road that is flat, and the direction of the road."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

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

    Notes
    -----
    Straight segments (von Gioi et al., "LSD: a fast line segment detector with a false detection control", PAMI 2010)
    that lean to the left and to the right are intersected in random pairs. The point is taken to which most length of
    both sides points: the lesser side counts.
    """
    scale = WIDTH_PX / image_bgr.shape[1]
    small = cv2.resize(image_bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    height, width = small.shape[:2]
    segments = _segments(np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.uint8))
    left, right = _sides(segments, width, height)
    if not len(left) or not len(right):
        return None
    pairs = rng.integers(0, (len(left), len(right)), (TRIALS, 2))
    points = _meet(left[pairs[:, 0]], right[pairs[:, 1]])
    low, high = np.array([COLUMNS[0] * width, ROWS[0] * height]), np.array([COLUMNS[1] * width, ROWS[1] * height])
    points = points[np.all((points > low) & (points < high), axis=1)]
    if not len(points):
        return None
    support = np.array([_support(side, points, LONGEST * width) for side in (left, right)]).min(axis=0)
    best = int(np.argmax(support))
    if support[best] < MIN_SUPPORT * width:
        return None
    u, v = _refine(np.concatenate([left, right]), points[best])
    return float(u / scale), float(v / scale)


def _segments(gray: NDArray[np.uint8]) -> Array:
    """Detect straight segments (N, 4): both ends, the upper one first."""
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(gray)[0]
    if found is None:
        return np.zeros((0, 4))
    lines = np.asarray(found, np.float64).reshape(-1, 4)
    upside = lines[:, 1] > lines[:, 3]
    lines[upside] = lines[upside][:, [2, 3, 0, 1]]
    return lines


def _sides(segments: Array, width: int, height: int) -> tuple[Array, Array]:
    """Part segments into those that lean to the right, as left of a road, and to the left."""
    d = segments[:, 2:] - segments[:, :2]
    length = np.linalg.norm(d, axis=1)
    steep = np.abs(d[:, 1]) > np.sin(LEAST_SLOPE_RAD) * length
    chosen = steep & (length > MIN_LENGTH * width) & (segments[:, 3] > ROWS[0] * height)
    upright = np.abs(d[:, 0]) < 0.05 * length  # masts
    return segments[chosen & ~upright & (d[:, 0] < 0)], segments[chosen & ~upright & (d[:, 0] > 0)]


def _line(segments: Array) -> Array:
    """Return the lines (N, 3) through segments, homogeneous, with unit normals."""
    a = np.column_stack([segments[:, :2], np.ones(len(segments))])
    b = np.column_stack([segments[:, 2:], np.ones(len(segments))])
    lines = np.cross(a, b)
    return np.asarray(lines / np.linalg.norm(lines[:, :2], axis=1, keepdims=True))


def _meet(a: Array, b: Array) -> Array:
    meeting = np.cross(_line(a), _line(b))
    with np.errstate(all="ignore"):
        return np.asarray(meeting[:, :2] / meeting[:, 2:])


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


def _support(segments: Array, points: Array, longest_px: float) -> Array:
    return np.asarray(_weights(segments, points, longest_px).sum(axis=0))


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
