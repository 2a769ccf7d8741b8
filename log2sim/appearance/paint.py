"""The color of the paint from pixels of a vehicle, some of which show other things.

Notes
-----
Light on a surface changes how bright a color is, gloss adds the color of the sky (the dichromatic model of Shafer, 1985); in
CIELAB the first moves a color towards black at a constant hue, the second towards gray. So hues are compared by chroma
relative to lightness, a hue that a good part of the surface shares is the paint's, and what is gray is the paint only
where no hue is shared: tires, glass, chrome, and mirrored clouds are gray on cars of every color.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array

# Chroma as it would be at this lightness; darker pixels than the least are too noisy to be scaled up from.
REFERENCE_L, MIN_L, MAX_L = 55.0, 14.0, 115.0
# A pixel has a hue from this chroma at the reference: three sigmas of the color of the light (0.06 in the logarithm, see `light.py`).
MIN_CHROMA = 17.5
HUE_BINS, HUE_REACH_DEG = 72, 25.0
MIN_HUE_SHARE = 0.38
WHITEST_L = 94.0  # the whitest paints reflect 0.85
# Of the pixels of one hue those in bright, direct light mirror least of other things and are not clipped.
CHROMA_QUANTILE, LIGHTNESS_QUANTILE = 0.5, 0.6
LIGHTNESS_BANDWIDTH = 7.0
# Glass, tires, grilles and shade are dark on vehicles of every color, a third of what one sees; only where more is, it is the paint.
DARK_L, MIN_DARK_SHARE = 20.0, 0.45
DARKER_QUANTILE, LIGHT_L = 0.2, 60.0


@dataclass(frozen=True, eq=False)
class Paint:
    """Colors that a surface may have.

    Attributes
    ----------
    lab : (C, 3) float64
        CIELAB, the most probable first.
    probability : (C,) float64
        They sum to 1.
    """

    lab: Array
    probability: Array

    @property
    def mean(self) -> Array:
        """Return the mean (3,) of the colors."""
        return np.asarray(self.probability @ self.lab)


def find_paint(lab: Array, weight: Array) -> Paint:
    """Find the color that most of a surface has from pixels (N, 3) in CIELAB with weights (N,), not all of them 0.

    Where it would reflect more light than the whitest paints, the light is brighter than was thought, and the color is scaled.
    """
    paint = _most_frequent(lab, weight)
    return Paint((paint * min(1.0, WHITEST_L / max(paint[0], 1.0)))[None], np.ones(1))


def _most_frequent(lab: Array, weight: Array) -> Array:
    weight = weight / weight.sum()
    L, chroma = np.clip(lab[:, 0], 0, MAX_L), np.hypot(lab[:, 1], lab[:, 2])
    relative = chroma * REFERENCE_L / np.maximum(L, MIN_L)
    hue = np.degrees(np.arctan2(lab[:, 2], lab[:, 1])) % 360
    colored = relative >= MIN_CHROMA
    votes = np.bincount((hue[colored] * HUE_BINS / 360).astype(int) % HUE_BINS, weight[colored], HUE_BINS)
    reach = round(HUE_REACH_DEG * HUE_BINS / 360)
    windows = np.sum([np.roll(votes, k) for k in range(-reach, reach + 1)], axis=0)
    best = int(np.argmax(windows))
    if windows[best] >= MIN_HUE_SHARE:
        center = (best + 0.5) * 360 / HUE_BINS
        rows = colored & (np.abs((hue - center + 180) % 360 - 180) <= HUE_REACH_DEG + 180 / HUE_BINS)
        return _colored_paint(lab[rows], relative[rows], weight[rows])
    rows = ~colored
    if not weight[rows].sum() > 0:
        rows = np.ones(len(lab), bool)
    light = rows & (L >= DARK_L)
    if weight[light].sum() > (1 - MIN_DARK_SHARE) * weight[rows].sum():
        rows = light
    level = _mode(L[rows], weight[rows])
    near = rows & (np.abs(L - level) <= LIGHTNESS_BANDWIDTH)
    tone = [weighted_quantile(lab[near, k], weight[near], 0.5) for k in (1, 2)]
    # The lower halves of doors mirror the dark road, which matters where the paint is dark itself.
    darker = weighted_quantile(L[rows], weight[rows], DARKER_QUANTILE)
    share = np.clip((level - DARK_L) / (LIGHT_L - DARK_L), 0.0, 1.0)
    return np.array([share * level + (1 - share) * min(darker, level), *tone])


def _colored_paint(lab: Array, relative: Array, weight: Array) -> Array:
    """Return the color of pixels of one hue."""
    level = weighted_quantile(lab[:, 0], weight, LIGHTNESS_QUANTILE)
    scale = level / np.maximum(lab[:, 0], MIN_L)
    strength = weighted_quantile(relative, weight, CHROMA_QUANTILE) * level / REFERENCE_L
    a, b = (weighted_quantile(lab[:, k] * scale, weight, 0.5) for k in (1, 2))
    return np.array([level, *(np.array([a, b]) / np.hypot(a, b) * strength)])


def _mode(values: Array, weight: Array) -> float:
    """Return the value around which weights are densest, by a triangular kernel."""
    steps = np.arange(0.0, MAX_L + 1)
    kernel = np.clip(1 - np.abs(steps[:, None] - values) / LIGHTNESS_BANDWIDTH, 0, None)
    level = steps[int(np.argmax(kernel @ weight))]
    near = np.abs(values - level) <= LIGHTNESS_BANDWIDTH
    return weighted_quantile(values[near], weight[near], 0.5)


def weighted_quantile(values: Array, weight: Array, share: float) -> float:
    """Return the value below which a share of the weights lies."""
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][min(int(np.searchsorted(total, share * total[-1])), len(values) - 1)])
