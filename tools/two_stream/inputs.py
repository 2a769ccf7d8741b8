"""Inputs of the two-stream network: maps from above, picture, and anchors with their places in both.

Lin, Tian, Duan and Zhou (2021) build on AVOD (Ku et al., IROS 2018), whose slices, density and anchors are taken where their
text says nothing. Cells are twice as large and the picture half as high as AVOD's, for a CPU.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, wrap_angle
from two_stream.pairs import MIN_DEPTH_M, Pair, in_image

X_M, Y_M = (0.0, 70.0), (-40.0, 40.0)
CELL_M = 0.2
SHAPE = (350, 400)
SLICES_M = np.linspace(-0.2, 2.3, 6)
DENSITY_POINTS = 16
IMAGE_PX = (176, 600)
CLASSES = ("car", "pedestrian")
# Length, width, height, and headings of the anchors of each class; the means of the simulated road users.
ANCHOR_SIZES_M = {"car": (4.5, 1.85, 1.6), "pedestrian": (0.7, 0.65, 1.72)}
ANCHOR_YAWS = {"car": (0.0, np.pi / 2), "pedestrian": (0.0,)}
ANCHOR_STEP_M = 0.6
MIN_IMAGE_SIDE_PX = 2.0
# Overlap of rectangles along the axes, as AVOD's; people are too small for the step of the anchors, so for them it is distance.
POSITIVE_IOU, NEGATIVE_IOU = 0.5, 0.35
POSITIVE_M, NEGATIVE_M = 0.45, 0.8
MIN_POINTS = 4
DENSE, POSITIVE, NEGATIVE, UNJUDGED = 5, 1, 0, -1


@dataclass(frozen=True, eq=False)
class Inputs:
    """What the network sees of a pair, and what it is to answer.

    Attributes
    ----------
    bev : (6, 350, 400) float32
        Greatest height in each of five slices as a share of the slice's top, and density.
    image : (3, 176, 600) float32
        In [-1, 1].
    anchors : (N, 7) float32
        x, y, z of the center above the ground, length, width, height, heading.
    kind : (N,) int64
        Index into CLASSES.
    bev_boxes, image_boxes : (N, 4) float32
        First and last coordinate of each axis (rows, columns), in [-1, 1] over the map or the picture.
    label : (N,) int64
        1 object, 0 none, -1 not judged.
    goal : (N, 7) float32
        Offsets from the anchor of positive ones.
    """

    bev: NDArray[np.float32]
    image: NDArray[np.float32]
    anchors: NDArray[np.float32]
    kind: NDArray[np.int64]
    bev_boxes: NDArray[np.float32]
    image_boxes: NDArray[np.float32]
    label: NDArray[np.int64]
    goal: NDArray[np.float32]


def inputs_of(pair: Pair, *, mirrored: bool = False) -> Inputs:
    """Prepare a pair; mirrored from left to right if asked for."""
    boxes, projection, image = pair.boxes.copy(), pair.pixel_T_cloud.copy(), pair.image
    xyz = np.column_stack([pair.cloud.xyz[:, :2], pair.cloud.height])
    seen = in_image(pair.cloud.xyz, projection, image.shape[:2])
    ground = pair.ground
    if mirrored:
        xyz[:, 1] *= -1
        boxes[:, [1, 6]] *= -1
        flip = np.array([[-1.0, 0, image.shape[1] - 1], [0, 1, 0], [0, 0, 1]])
        projection = flip @ projection @ np.diag([1.0, -1, 1, 1])
        image, ground = image[:, ::-1], ground * [1, -1, 1]
    bev = bev_maps(xyz[seen])
    anchors, kind = all_anchors()
    kept = np.flatnonzero(points_in(bev[DENSE], anchors))
    image_boxes, visible = image_boxes_of(anchors[kept], ground, projection, image.shape[:2])
    kept, image_boxes = kept[visible], image_boxes[visible]
    anchors, kind = anchors[kept], kind[kept]
    label, goal = targets_of(anchors, kind, boxes, pair)
    return Inputs(bev, small_image(image), anchors, kind, bev_boxes_of(anchors), image_boxes, label, goal)


def bev_maps(xyz: NDArray[np.floating]) -> NDArray[np.float32]:
    """Make the maps of points (N, 3) whose z is the height above the ground."""
    place = ((xyz[:, :2] - [X_M[0], Y_M[0]]) / CELL_M).astype(np.intp)
    layer = np.searchsorted(SLICES_M, xyz[:, 2], side="right") - 1
    inside = (place >= 0).all(axis=1) & (place < SHAPE).all(axis=1) & (layer >= 0) & (layer < len(SLICES_M) - 1)
    place, layer, z = place[inside], layer[inside], xyz[inside, 2]
    flat = place[:, 0] * SHAPE[1] + place[:, 1]
    out = np.zeros((6, SHAPE[0] * SHAPE[1]), np.float32)
    heights = out[:DENSE].reshape(-1)
    np.maximum.at(heights, layer * out.shape[1] + flat, ((z - SLICES_M[0]) / np.ptp(SLICES_M)).astype(np.float32))
    count = np.bincount(flat, minlength=out.shape[1])
    out[DENSE] = np.minimum(1.0, np.log1p(count) / np.log(DENSITY_POINTS))
    return out.reshape(6, *SHAPE)


def small_image(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Scale a picture to `IMAGE_PX`, channels first, in [-1, 1]."""
    import cv2

    small = cv2.resize(np.ascontiguousarray(image), IMAGE_PX[::-1], interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small.transpose(2, 0, 1)).astype(np.float32) / 127.5 - 1


@cache
def all_anchors() -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Lay out all anchors (N, 7) and their classes (N,)."""
    x, y = (np.arange(low + ANCHOR_STEP_M / 2, high, ANCHOR_STEP_M) for low, high in (X_M, Y_M))
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    parts, kinds = [], []
    for kind, name in enumerate(CLASSES):
        for yaw in ANCHOR_YAWS[name]:
            size = ANCHOR_SIZES_M[name]
            rest = np.tile([size[2] / 2, *size, yaw], (len(xy), 1))
            parts.append(np.column_stack([xy, rest]))
            kinds.append(np.full(len(xy), kind))
    return np.concatenate(parts).astype(np.float32), np.concatenate(kinds)


def rectangles(boxes: NDArray[np.floating]) -> NDArray[np.floating]:
    """Rectangles (N, 4) along the axes, x0, y0, x1, y1, of boxes (N, 7) turned to the nearest axis."""
    across = np.abs(np.sin(boxes[:, 6])) > np.sqrt(0.5)
    half = np.where(across[:, None], boxes[:, [4, 3]], boxes[:, [3, 4]]) / 2
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)


def points_in(density: NDArray[np.float32], anchors: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mark the anchors (N,) above which there are points."""
    total = np.pad(np.cumsum(np.cumsum(density > 0, axis=0), axis=1), ((1, 0), (1, 0)))
    place = (rectangles(anchors) - [X_M[0], Y_M[0], X_M[0], Y_M[0]]) / CELL_M
    i0, j0 = (np.clip(np.floor(place[:, k]), 0, SHAPE[k]).astype(int) for k in (0, 1))
    i1, j1 = (np.clip(np.ceil(place[:, k + 2]), 0, SHAPE[k]).astype(int) for k in (0, 1))
    return np.asarray(total[i1, j1] - total[i0, j1] - total[i1, j0] + total[i0, j0] > 0)


def bev_boxes_of(anchors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Places (N, 4) of anchors in the maps."""
    span = np.array([X_M[1] - X_M[0], Y_M[1] - Y_M[0]] * 2)
    low = np.array([X_M[0], Y_M[0]] * 2)
    return ((rectangles(anchors) - low) / span * 2 - 1).astype(np.float32)


def image_boxes_of(
    anchors: NDArray[np.float32], ground: Array, projection: Array, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Places (N, 4) of anchors in the picture, clipped to it, and whether it shows them (N,)."""
    c, s = np.cos(anchors[:, 6:7]), np.sin(anchors[:, 6:7])
    signs = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5], indexing="ij"), -1).reshape(1, 8, 3)
    corners = signs * anchors[:, None, 3:6]
    x = anchors[:, :1] + corners[..., 0] * c - corners[..., 1] * s
    y = anchors[:, 1:2] + corners[..., 0] * s + corners[..., 1] * c
    z = anchors[:, 2:3] + corners[..., 2] + ground[0] * x + ground[1] * y + ground[2]
    p = np.stack([x, y, z, np.ones_like(z)], axis=-1) @ projection.T
    ahead = (p[..., 2] > MIN_DEPTH_M).all(axis=1)
    uv = p[..., :2] / np.where(p[..., 2:] > MIN_DEPTH_M, p[..., 2:], 1.0)
    limit = np.array([shape[1], shape[0]], float)
    low, high = np.clip(uv.min(axis=1), 0, limit), np.clip(uv.max(axis=1), 0, limit)
    shown = ahead & ((high - low) >= MIN_IMAGE_SIDE_PX).all(axis=1)
    # Rows first, as in the maps.
    box = np.stack([low[:, 1], low[:, 0], high[:, 1], high[:, 0]], axis=1) / limit[[1, 0, 1, 0]] * 2 - 1
    return box.astype(np.float32), shown


def targets_of(
    anchors: NDArray[np.float32], kind: NDArray[np.int64], boxes: Array, pair: Pair
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Assign true boxes to anchors: labels (N,) and goals (N, 7)."""
    label, goal = np.full(len(anchors), NEGATIVE), np.zeros((len(anchors), 7), np.float32)
    category, points = pair.truth.category, pair.truth.points
    assert points is not None
    known = np.isin(category, CLASSES) & (points >= MIN_POINTS) & ~pair.truth.ignored
    label[near_any(anchors, boxes[~known])] = UNJUDGED
    for k, name in enumerate(CLASSES):
        own, true = np.flatnonzero(kind == k), boxes[known & (category == name)]
        if not len(own) or not len(true):
            continue
        if name == "pedestrian":
            fit = -np.hypot(*(anchors[own, None, :2] - true[None, :, :2]).transpose(2, 0, 1))
            positive, negative = -POSITIVE_M, -NEGATIVE_M
        else:
            fit = overlaps(rectangles(anchors[own]), rectangles(true))
            positive, negative = POSITIVE_IOU, NEGATIVE_IOU
            # An anchor across the object has to turn too far.
            turn = np.abs(wrap_angle(2 * (anchors[own, None, 6] - true[None, :, 6]))) / 2
            fit = np.where(turn <= np.pi / 4 + 1e-6, fit, 0.0)
        best = fit.argmax(axis=1)
        value = fit[np.arange(len(own)), best]
        label[own[(value > negative) & (value < positive)]] = UNJUDGED
        # Each object has the anchor that fits it best.
        forced = fit.argmax(axis=0)[fit.max(axis=0) > negative]
        best[forced] = np.flatnonzero(fit.max(axis=0) > negative)
        found = np.union1d(np.flatnonzero(value >= positive), forced)
        label[own[found]] = POSITIVE
        goal[own[found]] = encode(true[best[found]], anchors[own[found]])
    return label, goal


def near_any(anchors: NDArray[np.float32], boxes: Array) -> NDArray[np.bool_]:
    """Mark the anchors (N,) that overlap a box that nobody has to find."""
    if not len(boxes):
        return np.zeros(len(anchors), bool)
    return np.asarray((overlaps(rectangles(anchors), rectangles(boxes)) > 0).any(axis=1))


def overlaps(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.floating]:
    """Intersection over union (N, M) of rectangles along the axes."""
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.clip(high - low, 0, None).prod(axis=2)
    area_a, area_b = ((r[:, 2:] - r[:, :2]).prod(axis=1) for r in (a, b))
    return np.asarray(shared / (area_a[:, None] + area_b[None, :] - shared))


def encode(boxes: Array, anchors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Offsets (N, 7) of boxes from anchors: by the diagonal of the anchor's base, logarithms, and the turn.

    The paper's d_a is not defined; it is SECOND's, the diagonal (Yan et al., Sensors 2018). Front and back are not told
    apart: the turn is that of the axis.
    """
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])[:, None]
    turn = wrap_angle(2 * (boxes[:, 6] - anchors[:, 6])) / 2
    return np.column_stack(
        [(boxes[:, :3] - anchors[:, :3]) / diagonal, np.log(boxes[:, 3:6] / anchors[:, 3:6]), turn]
    ).astype(np.float32)


def decode(goal: NDArray[np.floating], anchors: NDArray[np.float32]) -> Array:
    """Boxes (N, 7) from offsets, the inverse of `encode` but for front and back."""
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])[:, None].astype(np.float64)
    return np.column_stack(
        [
            anchors[:, :3] + goal[:, :3] * diagonal,
            anchors[:, 3:6] * np.exp(np.clip(goal[:, 3:6], -1.5, 1.5)),
            anchors[:, 6] + goal[:, 6],
        ]
    )
