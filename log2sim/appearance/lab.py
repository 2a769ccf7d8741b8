"""CIELAB of linear RGB and back, where 1 is white; values beyond the gamut stay."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Array

# Linear sRGB to CIE XYZ relative to D65 white (IEC 61966-2-1).
XYZ_OF_RGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE_XYZ = XYZ_OF_RGB.sum(axis=1)
EPSILON, SLOPE = 216 / 24389, 24389 / 3132


def lab_of_linear(rgb: Array) -> Array:
    """Return CIELAB (N, 3) of linear RGB (N, 3), 1 for white; what is brighter has an L* above 100."""
    xyz = np.maximum(rgb @ XYZ_OF_RGB.T / WHITE_XYZ, 0.0)
    f = np.where(xyz > EPSILON, np.cbrt(xyz), xyz * SLOPE + 4 / 29)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def linear_of_lab(lab: Array) -> Array:
    """Return linear RGB (N, 3) of CIELAB (N, 3)."""
    y = (lab[:, 0] + 16) / 116
    f = np.stack([y + lab[:, 1] / 500, y, y - lab[:, 2] / 200], axis=1)
    xyz = np.where(f**3 > EPSILON, f**3, (f - 4 / 29) / SLOPE) * WHITE_XYZ
    return np.asarray(xyz @ np.linalg.inv(XYZ_OF_RGB).T)
