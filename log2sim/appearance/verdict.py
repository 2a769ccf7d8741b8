"""One color of several looks: a robust mean in CIELAB, its name, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.appearance.light import MIRRORED_SIGMA, Light, mirrored_share
from log2sim.appearance.paint import Paint
from log2sim.appearance.surface import Surface
from log2sim.color_names import name_probabilities, to_rgb
from log2sim.datatypes import COLOR_NAMES
from log2sim.geometry import Array

# Half of the errors of light are common to all looks: the same road, the same camera.
ENOUGH_PIXELS = 150.0
MIN_SIGMA_LAB = np.array([3.0, 3.0, 2.0])
# Errors of a pixel's value: half of a step of 8 bits and the noise of a sensor, relative to full scale after the camera's curve.
PIXEL_NOISE = 4 / 255
# Lenses and interpolation mix a door of a small vehicle with what is around it, which differs from it by this reflectance.
MIXED, BLUR_PX, DOOR_HEIGHT = 0.15, 1.5, 0.3
ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class Look:
    """What one picture says about a color.

    Attributes
    ----------
    lab : (3,) float64
        The most probable color.
    sigma : (3,) float64
        Standard deviations of its lightness, chroma, and across the chroma.
    probability : (K,) float64
        Of each of `COLOR_NAMES`.
    weight : float
    """

    lab: Array
    sigma: Array
    probability: Array
    weight: float

    @classmethod
    def of(cls, paint: Paint, light: Light, surface: Surface) -> Look:
        """Rate the paint of a surface by the light it was seen in."""
        sigma = np.array([_sigma_of(lab, light, surface) for lab in paint.lab])
        each = np.array([name_probabilities(lab, s) for lab, s in zip(paint.lab, sigma)])
        clear = float(surface.weight.sum() / (surface.weight.sum() + ENOUGH_PIXELS))
        # Haze and what is mirrored add light: of looks at dark paint the darkest, whose sigma is the least, is the best.
        return cls(paint.mean, paint.probability @ sigma, paint.probability @ each, clear / sigma[0, 0] ** 2)


def _sigma_of(lab: Array, light: Light, surface: Surface) -> Array:
    """Return the standard deviations (3,) of lightness, chroma, and across the chroma, of a color (3,)."""
    # L* + 16 and the differences of the cube roots grow with the cube root of light.
    root = (lab[0] + 16) / 116
    raw = float(np.median(surface.pixels.mean(axis=1))) ** (1 / 2.2)
    noise = PIXEL_NOISE / max(raw, PIXEL_NOISE)
    mirrored = float((mirrored_share(surface.facing)[:, None] * light.around / light.white).mean()) * MIRRORED_SIGMA
    mixed = MIXED * min(1.0, BLUR_PX / (DOOR_HEIGHT * surface.height_px))
    added = float(np.hypot(mirrored, mixed))
    lightness = 116 * (np.cbrt(root**3 + added) - np.cbrt(max(root**3 - added, 0.0))) / 2
    brightness = float(np.hypot(light.exposure_sigma, noise))
    tone = 500 / 3 * root * float(np.hypot(light.tone_sigma, noise))
    chroma = float(np.hypot(lab[1], lab[2])) * float(np.hypot(brightness / 3, added / (root**3 + added)))
    sigma = np.array([np.hypot(116 / 3 * root * brightness, lightness), np.hypot(tone, chroma), tone])
    return np.asarray(np.hypot(sigma, MIN_SIGMA_LAB))


def decide_color(looks: Sequence[Look]) -> dict[str, Any]:
    """Join looks and name the color, as `Agent.color` holds it."""
    lab, probability = decide_probabilities(looks)
    best = int(np.argmax(probability))
    return {
        "rgb": [int(v) for v in to_rgb(lab)[0]],
        "name": COLOR_NAMES[best],
        "confidence": round(float(probability[best]), 3),
        "lab": [round(float(v), 2) for v in lab],
        "frames": len(looks),
    }


def decide_probabilities(looks: Sequence[Look]) -> tuple[Array, Array]:
    """Join looks: the color (3,) in CIELAB and the probability (K,) of each of `COLOR_NAMES`.

    Notes
    -----
    Errors of the light are common to looks: more of them do not make the color surer, and looks that differ make it less sure.
    """
    if len(looks) == 1:
        return looks[0].lab, looks[0].probability
    weight = np.array([look.weight for look in looks])
    lab = np.array([look.lab for look in looks])
    middle = geometric_median(lab, weight)
    spread = np.average(np.linalg.norm(lab - middle, axis=1), weights=weight) / np.sqrt(len(looks))
    sigma = np.average([look.sigma for look in looks], axis=0, weights=weight)
    return middle, name_probabilities(middle, np.hypot(sigma, spread))


def geometric_median(points: Array, weight: Array) -> Array:
    """Return the point with the least weighted sum of distances to points (N, 3) (Weiszfeld 1937)."""
    middle = np.average(points, axis=0, weights=weight)
    for _ in range(ITERATIONS):
        distance = np.maximum(np.linalg.norm(points - middle, axis=1), 1e-6)
        middle = np.average(points, axis=0, weights=weight / distance)
    return np.asarray(middle)
