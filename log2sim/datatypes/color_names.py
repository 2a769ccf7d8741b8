"""Names of colors: regions of CIELAB.

The names are those of `COLOR_NAMES`, into which all colors are sorted: purple is blue, pink and magenta are red, beige is
brown, turquoise is green or blue by its hue.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes import COLOR_NAMES
from log2sim.geometry import Array

# Lightness L* up to which an achromatic color is black, gray, silver; above that it is white. Kelly and Judd (1976), ISCC-NBS:
# black up to Munsell value 2.5 (L* 25), white from value 8.5 (L* 85); silver paint is a light gray, from value 6 (L* 61).
BLACK_L, GRAY_L, SILVER_L = 25.0, 60.0, 84.0
# Chroma C*ab from which a color is not called achromatic: ISCC-NBS calls colors of Munsell chroma below 1.5 to 2 grayish, one
# step of which is about 5 to 6 units. Surfaces under the open sky look bluish, so blue starts later.
GRAY_CHROMA, BLUISH_GRAY_CHROMA = 10.0, 12.5
# What is nearly black or white needs more chroma before a hue is named; cream and ivory are whites of vehicles.
BLACK_CHROMA_PER_L, WHITE_L, WHITE_CHROMA, CREAM_CHROMA = 0.5, 86.0, 17.0, 27.0
# Upper ends of hue angles hab in degrees. They part the basic terms of the XKCD survey (Munroe 2010; 140 000 answers) about
# where the answers change; tests/test_appearance_colors.py holds the agreement.
RED_FROM, RED_TO, ORANGE_TO, YELLOW_TO, GREEN_TO = 318.0, 45.0, 74.0, 111.0, 190.0
# Orange and yellow that are dark (orange below the first lightness, yellow below the second) or dull are brown, red only where it is dull; dark yellow next to green is olive.
BROWN_L, BROWN_CHROMA, BROWN_FROM, DULL_RED_CHROMA, LIGHT_L, OLIVE_FROM = (42.0, 55.0), 42.0, 20.0, 30.0, 66.0, 99.0


def to_lab(rgb: ArrayLike) -> Array:
    """Return CIELAB (N, 3), illuminant D65, of sRGB colors (N, 3) from 0 to 255."""
    from skimage.color import rgb2lab

    return np.asarray(rgb2lab(np.atleast_2d(np.asarray(rgb, float)) / 255), np.float64)


def to_rgb(lab: ArrayLike) -> NDArray[np.uint8]:
    """Return sRGB colors (N, 3) from 0 to 255 of CIELAB (N, 3), clipped to the gamut."""
    import warnings

    from skimage.color import lab2rgb

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # colors outside the gamut are clipped
        rgb = lab2rgb(np.atleast_2d(np.asarray(lab, float)))
    return np.asarray(np.round(np.clip(rgb, 0, 1) * 255), np.uint8)


def name_of(rgb: ArrayLike) -> str:
    """Name an sRGB color (3,) from 0 to 255."""
    return COLOR_NAMES[int(name_indices(to_lab(rgb))[0])]


def name_indices(lab: Array) -> NDArray[np.intp]:
    """Return the indices (...) into `COLOR_NAMES` of colors (..., 3) in CIELAB."""
    L, chroma = lab[..., 0], np.hypot(lab[..., 1], lab[..., 2])
    hue = np.degrees(np.arctan2(lab[..., 2], lab[..., 1])) % 360
    index = {name: k for k, name in enumerate(COLOR_NAMES)}
    out = np.full(L.shape, index["blue"])
    out[(hue >= RED_FROM) | (hue < RED_TO)] = index["red"]
    dull = (np.where(hue < ORANGE_TO, *BROWN_L) > L) | (chroma < BROWN_CHROMA)
    for low, high, name in ((RED_TO, ORANGE_TO, "orange"), (ORANGE_TO, YELLOW_TO, "yellow")):
        sector = (hue >= low) & (hue < high)
        out[sector] = np.where(dull[sector], index["brown"], index[name])
    out[(hue >= BROWN_FROM) & (hue < RED_TO) & (chroma < DULL_RED_CHROMA) & (L < LIGHT_L)] = index["brown"]
    out[(hue >= YELLOW_TO) & (hue < GREEN_TO) | (hue >= OLIVE_FROM) & (hue < YELLOW_TO) & dull] = index["green"]
    bluish = (hue >= GREEN_TO) & (hue < RED_FROM)
    achromatic = chroma < np.where(bluish, BLUISH_GRAY_CHROMA, GRAY_CHROMA)
    achromatic |= (L > WHITE_L) & (chroma < np.where((hue >= RED_TO) & (hue < YELLOW_TO), CREAM_CHROMA, WHITE_CHROMA))
    gray = np.searchsorted([BLACK_L, GRAY_L, SILVER_L], L)
    grays = np.array([index[name] for name in ("black", "gray", "silver", "white")])
    out[achromatic] = grays[gray[achromatic]]
    out[(chroma < GRAY_CHROMA + BLACK_CHROMA_PER_L * (BLACK_L - L)) & (L < BLACK_L)] = index["black"]
    return np.asarray(out, np.intp)
