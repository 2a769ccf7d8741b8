"""One color of several looks: a robust mean in CIELAB, its name, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.appearance.light import MIRRORED_SIGMA, Light, mirrored_share
from log2sim.appearance.paint import Paint
from log2sim.color_names import name_probabilities, to_rgb
from log2sim.datatypes import COLOR_NAMES
from log2sim.geometry import Array

# Half of the errors of light are common to all looks: the same road, the same camera.
ENOUGH_PIXELS = 150.0
MIN_SIGMA_LAB = np.array([3.0, 3.0, 2.0])
# Errors of a pixel's value: half of a step of 8 bits and the noise of a sensor, relative to full scale after the camera's curve.
PIXEL_NOISE = 3 / 255
# Lenses and interpolation mix a door of a small vehicle with what is around it, which differs from it by this reflectance.
MIXED, BLUR_PX, DOOR_HEIGHT = 0.15, 1.5, 0.3
ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class Look:
    """What one picture says about a color.

    Attributes
    ----------
    lab : (3,) float64
    sigma : (3,) float64
        Standard deviations of lightness, chroma, and across the chroma.
    weight : float
    """

    lab: Array
    sigma: Array
    weight: float

    @classmethod
    def of(cls, paint: Paint, light: Light, pixels: Array, weight: Array, facing: Array, height_px: float) -> Look:
        """Rate a paint by the light it was seen in, by pixels (N, 3), linear RGB, with weights and cosines (N,), and by its size."""
        # L* + 16 and the differences of the cube roots grow with the cube root of light.
        root = (paint.lab[0] + 16) / 116
        raw = float(np.median(pixels.mean(axis=1))) ** (1 / 2.2)
        noise = PIXEL_NOISE / max(raw, PIXEL_NOISE)
        mirrored = float((mirrored_share(facing)[:, None] * light.around / light.white).mean()) * MIRRORED_SIGMA
        mixed = MIXED * min(1.0, BLUR_PX / (DOOR_HEIGHT * height_px))
        added = float(np.hypot(mirrored, mixed))
        lightness = 116 * (np.cbrt(root**3 + added) - np.cbrt(max(root**3 - added, 0.0))) / 2
        brightness = float(np.hypot(light.exposure_sigma, noise))
        chroma = float(np.hypot(paint.lab[1], paint.lab[2]))
        tone = 500 / 3 * root * float(np.hypot(light.tone_sigma, noise))
        relative = float(np.hypot(brightness / 3, added / (root**3 + added)))
        sigma = np.array([np.hypot(116 / 3 * root * brightness, lightness), np.hypot(tone, chroma * relative), tone])
        return cls(paint.lab, sigma, paint.share * float(weight.sum() / (weight.sum() + ENOUGH_PIXELS)))


def decide_color(looks: Sequence[Look]) -> dict[str, Any]:
    """Join looks and name the color, as `Agent.color` holds it."""
    lab = np.array([look.lab for look in looks])
    # Lightness is what looks differ in: by their light, by how much they mirror, by haze.
    weight = np.array([look.weight / look.sigma[0] ** 2 for look in looks])
    middle = geometric_median(lab, weight)
    nearest = np.linalg.norm(lab - middle, axis=1)
    spread = float(np.average(nearest, weights=weight)) / np.sqrt(len(looks))
    sigma = np.average([look.sigma for look in looks], axis=0, weights=weight)
    sigma = np.sqrt(sigma**2 + MIN_SIGMA_LAB**2 + spread**2)
    probability = name_probabilities(middle, sigma)
    return color_entry(middle, probability, len(looks))


def color_entry(lab: Array, probability: Array, frames: int) -> dict[str, Any]:
    """Return a color as `Agent.color` holds it."""
    best = int(np.argmax(probability))
    return {
        "rgb": [int(v) for v in to_rgb(lab)[0]],
        "name": COLOR_NAMES[best],
        "confidence": round(float(probability[best]), 3),
        "lab": [round(float(v), 2) for v in lab],
        "frames": frames,
    }


def geometric_median(points: Array, weight: Array) -> Array:
    """Return the point with the least weighted sum of distances to points (N, 3) (Weiszfeld 1937)."""
    middle = np.average(points, axis=0, weights=weight)
    for _ in range(ITERATIONS):
        distance = np.maximum(np.linalg.norm(points - middle, axis=1), 1e-6)
        middle = np.average(points, axis=0, weights=weight / distance)
    return np.asarray(middle)
