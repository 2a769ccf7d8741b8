"""The color of the vehicle in a single photo.

Notes
-----
A pixel shows the paint in more or less light and with more or less of what the clear coat mirrors (the dichromatic model of
Shafer, 1985), or a dark part (glass, tire, grille, gap), or something else. For each of a grid of paints the distribution of
such pixels in CIELAB is drawn by simulation; a vehicle's pixels are a sample of one of them. So black paint under a bright
sky differs from gray paint by its many dark pixels, and red paint in the shade from black by the hue of the brighter ones.

Without a box the vehicle is taken to fill most of the photo. Where in its box a vehicle is, and its paint, is averaged over views
from all around with the weights of `light.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from log2sim.datatypes.color_names import name_indices, odds_of_names
from log2sim.geometry import Array, weighted_quantile
from log2sim.road.colors import (
    WHITEST_L,
    Look,
    Paint,
    decide_color,
    decide_probabilities,
    find_paint,
    lab_of_linear,
    linear_of_lab,
)
from log2sim.road.light import (
    CAMERA_EXPOSURE_SIGMA,
    CAMERA_TONE_SIGMA,
    Light,
    Surface,
    estimate_light,
    hit_vehicle,
    linear_values,
    reflectances,
)

SEED = 0
SAMPLES = 1000  # of each paint
# The shares of pixels that show dark parts and other things: mirrors, plates, lights, what is behind.
DARK_SHARE, OTHER_SHARE = 0.2, 0.12
# Logarithm of the light on a part of the surface relative to others: sides and roofs, folds, shade below.
SHADE_SIGMA = 0.4
# What is mirrored beyond its mean, as reflectances: mostly little, sometimes the sky or the sun.
MIRRORED_MEAN, BRIGHT_SHARE, BRIGHT_MEAN = 0.02, 0.15, 0.25
MIRRORED_TONE_SIGMA = 0.12
DARK_MEAN = 0.02
# Cells of the distributions: lightness in even steps, a and b finer near gray.
L_CELLS, AB_CELLS, L_MAX, AB_SCALE, AB_MAX = 18, 17, 108.0, 8.0, 100.0
SMOOTHING_CELLS = 0.8
FLOOR = 1e-4  # of a cell's probability: no pixel rules a paint out
# Pixels side by side are not independent: so many would say as much as all of them.
INDEPENDENT_PIXELS = 25.0
HUES, CHROMAS, LIGHTNESSES = 24, (7.0, 15.0, 24.0, 36.0, 52.0, 75.0), np.arange(4.0, 97.0, 6.0)
MAX_OUT_OF_GAMUT = 0.03
MANY_BRIGHT = 0.3
# Paints that are less probable than this share of the most probable one do not count.
LEAST_RATIO = 0.01


@dataclass(frozen=True, eq=False)
class PaintModel:
    """Paints and the distributions of their pixels."""

    lab: Array  # (C, 3): the paints
    log_prior: Array  # (C,): each name is as frequent as `odds_of_names` says, whatever number of paints it has
    log_cells: NDArray[np.float32]  # (C, cells): logarithms of the probabilities of the cells

    def explain(self, lab: Array, weight: Array) -> Array:
        """Return the probability (C,) of each paint, of pixels (N, 3) in CIELAB with weights (N,), not all of them 0."""
        counts = np.bincount(cells_of(lab), weight, self.log_cells.shape[1]) / weight.sum()
        log = self.log_prior + INDEPENDENT_PIXELS * (self.log_cells @ counts)
        probability = np.exp(log - log.max())
        return np.asarray(probability / probability.sum(), np.float64)


def explain_paint(lab: Array, weight: Array) -> Paint:
    """Find the paints that explain pixels (N, 3) in CIELAB with weights (N,), not all of them 0.

    Pixels brighter than the whitest paints, where they are many, say that the light is brighter than was thought.
    """
    bright = weighted_quantile(lab[:, 0], weight, 1 - MANY_BRIGHT)
    model = paint_model()
    probability = model.explain(lab * min(1.0, WHITEST_L / max(bright, 1.0)), weight)
    order = np.argsort(-probability, kind="stable")
    order = order[probability[order] > LEAST_RATIO * probability[order[0]]]
    return Paint(model.lab[order], probability[order] / probability[order].sum())


@lru_cache(maxsize=1)
def paint_model() -> PaintModel:
    """Return the paints with the distributions of their pixels, simulated at the first call (half a second)."""
    rng = np.random.default_rng(SEED)
    lab = _paints()
    rows = [_log_cells(paint, rng) for paint in linear_of_lab(lab)]
    names = name_indices(lab)
    per_name = np.bincount(names)
    prior = odds_of_names()[names] / per_name[names]
    return PaintModel(lab, np.log(prior / prior.sum()), np.array(rows, np.float32))


def _paints() -> Array:
    """Return the grid of paints (C, 3) within the gamut of sRGB."""
    hue = np.arange(HUES) * 2 * np.pi / HUES
    ring = np.concatenate([[[0.0, 0.0]], *(np.column_stack([np.cos(hue), np.sin(hue)]) * c for c in CHROMAS)])
    lab = np.array([[level, a, b] for level in LIGHTNESSES for a, b in ring])
    linear = linear_of_lab(lab)
    return np.asarray(
        lab[((linear > -MAX_OUT_OF_GAMUT * linear.max(axis=1, keepdims=True)) & (linear < 1)).all(axis=1)]
    )


def _log_cells(paint: Array, rng: np.random.Generator) -> Array:
    """Simulate pixels of a paint (3,), linear RGB: logarithms of the probabilities of the cells."""
    shade = np.exp(rng.normal(0.0, SHADE_SIGMA, (SAMPLES, 1)))
    bright = rng.random((SAMPLES, 1)) < BRIGHT_SHARE
    mirrored = rng.exponential(np.where(bright, BRIGHT_MEAN, MIRRORED_MEAN)) * np.exp(
        rng.normal(0.0, MIRRORED_TONE_SIGMA, (SAMPLES, 3))
    )
    seen = np.maximum(paint, 0.0) * shade + mirrored - MIRRORED_MEAN
    dark = rng.random(SAMPLES) < DARK_SHARE
    seen[dark] = (rng.exponential(DARK_MEAN, (SAMPLES, 1)) * np.ones(3))[dark]
    cells = np.bincount(cells_of(lab_of_linear(seen)), minlength=L_CELLS * AB_CELLS**2) / SAMPLES
    smooth = gaussian_filter(cells.reshape(L_CELLS, AB_CELLS, AB_CELLS), SMOOTHING_CELLS).ravel()
    return np.asarray(np.log((1 - OTHER_SHARE) * smooth + OTHER_SHARE / smooth.size + FLOOR))


def cells_of(lab: Array) -> NDArray[np.intp]:
    """Return the cells (N,) of colors (N, 3)."""
    level = np.clip(lab[:, 0] * L_CELLS / L_MAX, 0, L_CELLS - 1).astype(np.intp)
    reach = np.arcsinh(AB_MAX / AB_SCALE)
    ab = np.arcsinh(np.clip(lab[:, 1:], -AB_MAX, AB_MAX) / AB_SCALE) / reach
    column = np.clip((ab + 1) / 2 * AB_CELLS, 0, AB_CELLS - 1).astype(np.intp)
    return np.asarray((level * AB_CELLS + column[:, 0]) * AB_CELLS + column[:, 1])


Image = NDArray[np.uint8]

SIDE_PX = 160  # of the picture that is worked on
MIN_SIDE_PX = 8
PRIOR_CELLS, PRIOR_VIEWS = 24, 72
PRIOR_SIZE_M = (4.5, 1.8, 1.5)
# Eyes and masts that take pictures of vehicles, and from how far.
HEIGHTS_M, DISTANCE_M = (1.0, 1.6, 2.4), 7.0
# Share of views in which a place of the box shows the vehicle, below which it is likelier background.
LIKELY = 0.5
FACING = 0.8  # typical cosine of the angle at which a side is seen
MIN_BACKGROUND_PX = 60
# What upright white looks like where a photo shows level white as just not clipped.
PHOTO_WHITE = 0.7


@dataclass(frozen=True, eq=False)
class PictureColor:
    """Color of a vehicle in a photo."""

    color: dict[str, Any]  # as `Agent.color` holds it
    probability: Array  # (K,): of each of `COLOR_NAMES`
    weight: NDArray[np.float32]  # (H, W): which pixels of the photo, scaled down, it was taken from


def color_of_picture(image_bgr: Image, box_px: ArrayLike | None = None) -> PictureColor | None:
    """Name the color of the vehicle in a photo (H, W, 3); None where the box is too small or nothing in it is seen.

    `box_px`: (4,): u0, v0, u1, v1 of the vehicle; the whole photo without it.
    """
    height, width = image_bgr.shape[:2]
    box = np.array([0, 0, width, height], float) if box_px is None else np.asarray(box_px, float)
    box = np.clip(box, 0, [width, height, width, height])
    if np.min(box[2:] - box[:2]) < MIN_SIDE_PX:
        return None
    scale = min(1.0, SIDE_PX / max(box[2:] - box[:2]))
    resized = cv2.resize(image_bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    small = np.asarray(resized, np.uint8)
    corners = np.clip(np.round(box * scale).astype(int), 0, [small.shape[1], small.shape[0]] * 2)
    u0, v0, u1, v1 = corners
    paint, presence = (
        cv2.resize(cells, (int(u1 - u0), int(v1 - v0)), interpolation=cv2.INTER_LINEAR) for cells in where_paint_is()
    )
    weight, vehicle = np.zeros(small.shape[:2], np.float32), np.zeros(small.shape[:2], bool)
    vehicle[v0:v1, u0:u1] = presence > LIKELY
    weight[v0:v1, u0:u1] = np.where(presence > LIKELY, paint, 0)
    if not weight.any():
        return None
    light = _light_around(small, vehicle)
    rows = weight > 0
    pixels = linear_values(small[rows][:, ::-1])
    surface = Surface(pixels, weight[rows].astype(np.float64), np.full(len(pixels), FACING), float(box[3] - box[1]))
    lab = lab_of_linear(reflectances(pixels, light, surface.facing, np.zeros(3)))
    look = Look.of(_joined(find_paint(lab, surface.weight), explain_paint(lab, surface.weight)), light, surface)
    return PictureColor(decide_color([look]), decide_probabilities([look])[1], weight)


def _joined(one: Paint, other: Paint) -> Paint:
    """Return the mean of two opinions: the most frequent color, and the one that explains other parts of a vehicle too."""
    return Paint(np.concatenate([one.lab, other.lab]), np.concatenate([one.probability, other.probability]) / 2)


def _light_around(image_bgr: Image, vehicle: NDArray[np.bool_]) -> Light:
    """Estimate the light by what is around the vehicle."""
    half = len(image_bgr) // 2
    below, above = (
        linear_values(image_bgr[rows][~vehicle[rows]][:, ::-1]) for rows in (slice(half, None), slice(half))
    )
    light = estimate_light(below, above if len(above) >= MIN_BACKGROUND_PX else below, np.zeros((0, 3)))
    # A photo of a vehicle is exposed and balanced for it, whatever it stands before.
    white = np.full(3, PHOTO_WHITE)
    return replace(light, white=white, exposure_sigma=CAMERA_EXPOSURE_SIGMA, tone_sigma=CAMERA_TONE_SIGMA)


@lru_cache(maxsize=1)
def where_paint_is() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return for the cells (K, K) of an upright box how much they show of a car's paint, and how often of a car at all."""
    size = np.array(PRIOR_SIZE_M)
    paint, presence = np.zeros((2, PRIOR_CELLS, PRIOR_CELLS), np.float32)
    for height in HEIGHTS_M:
        for yaw in np.linspace(0, 2 * np.pi, PRIOR_VIEWS, endpoint=False):
            eye = np.array([DISTANCE_M * np.cos(yaw), DISTANCE_M * np.sin(yaw), height - size[2] / 2])
            ahead = -eye / np.linalg.norm(eye)
            right = np.cross(ahead, [0.0, 0.0, 1.0])
            right /= np.linalg.norm(right)
            axes = np.stack([right, np.cross(ahead, right), ahead])
            corners = (np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(-1, 3) * size - eye) @ axes.T
            tangents = corners[:, :2] / corners[:, 2:]
            low, high = tangents.min(axis=0), tangents.max(axis=0)
            cell = (np.arange(PRIOR_CELLS) + 0.5) / PRIOR_CELLS
            x, y = np.meshgrid(low[0] + cell * (high[0] - low[0]), low[1] + cell * (high[1] - low[1]))
            rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ axes
            hits = hit_vehicle("car", size, eye, rays)
            paint += hits.weight.reshape(x.shape).astype(np.float32)
            presence += np.isfinite(hits.distance).reshape(x.shape)
    count = PRIOR_VIEWS * len(HEIGHTS_M)
    return (paint / count).astype(np.float32), (presence / count).astype(np.float32)
