"""What pixels of a vehicle look like for each color of its paint, and the paint that explains given pixels best.

Notes
-----
A pixel shows the paint in more or less light and with more or less of what the clear coat mirrors (the dichromatic model of
Shafer, 1985), or a dark part (glass, tire, grille, gap), or something else. For each of a grid of paints the distribution of
such pixels in CIELAB is drawn by simulation; a vehicle's pixels are a sample of one of them. So black paint under a bright
sky differs from gray paint by its many dark pixels, and red paint in the shade from black by the hue of the brighter ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from log2sim.appearance.lab import lab_of_linear, linear_of_lab
from log2sim.appearance.paint import WHITEST_L, Paint, weighted_quantile
from log2sim.color_names import name_indices, odds_of_names
from log2sim.geometry import Array

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
    """Paints and the distributions of their pixels.

    Attributes
    ----------
    lab : (C, 3) float64
        The paints.
    log_prior : (C,) float64
        Each name is as frequent as `odds_of_names` says, whatever number of paints it has.
    log_cells : (C, cells) float32
        Logarithms of the probabilities of the cells.
    """

    lab: Array
    log_prior: Array
    log_cells: NDArray[np.float32]

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
