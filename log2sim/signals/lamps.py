"""Which lamp of a traffic light shines, by the pixels of one box: color, brightness, and place within the housing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

STATES = ("red", "red_yellow", "yellow", "green", "off")
# Hues of lamps in degrees (HSV), from EN 12368's chromaticities and what cameras make of them: the bounds lie between red (0 to
# 15), yellow (30 to 55) and green (130 to 185).
RED_HUES, YELLOW_HUES, GREEN_HUES = (330.0, 22.0), (22.0, 75.0), (95.0, 215.0)
# A lit lamp is brighter than its housing by at least this share of full scale, and has a color at least at its rim.
MIN_CONTRAST, MIN_SATURATION = 0.18, 0.35
# Lamps are in the middle of their housing: leaves and sky beside it are not looked at. Two lit lamps with their glare cover half of
# it; signs, cones, and rear lamps of vehicles shine all over.
SIDE_SHARE, MAX_LIT_SHARE = 0.22, 0.55
HOUSING_QUANTILE = 0.25  # a housing covers more than half of its box; the sky around it may be brighter than its lamps
# Share of a crop that a lamp covers: 0.1 of a box that fits; much less is a speck.
MIN_LAMP_SHARE = 0.012
# Middle of the lamps along the housing from its top, and how far off their light appears in a box that fits loosely.
PLACES, PLACE_SIGMA = (0.2, 0.5, 0.8), 0.25
UPRIGHT = 1.3  # height by width; other housings lie, or are round, and the place says nothing
# Probabilities of the colors that a lamp of each color shows: red and yellow lamps are alike where they are clipped.
SEEN_AS = np.array([[0.84, 0.14, 0.02], [0.2, 0.76, 0.04], [0.01, 0.05, 0.94]])
SEEN_SHARE, MIN_APART = 0.15, 0.15  # of what shines; of the housing's length
# One picture is wrong for reasons that the next ones share: what it says counts for no more than this, in nats.
MAX_EVIDENCE = 3.0
OFF_WHERE_LIT, LIT_WHERE_DARK = 0.03, 0.15


def lamp_evidence(crop_bgr: NDArray[np.uint8]) -> Array:
    """Return the log-likelihoods (S,) of `STATES`, up to a constant, of a crop (h, w, 3) around a box."""
    shares, places = find_lamps(crop_bgr)
    total = shares.sum()
    if total < MIN_LAMP_SHARE:
        log = np.full(len(STATES), np.log(LIT_WHERE_DARK))
        log[STATES.index("off")] = 0.0
        return log
    upright = crop_bgr.shape[0] > UPRIGHT * crop_bgr.shape[1]
    log = np.empty(len(STATES))
    for k, state in enumerate(STATES):
        lamps = {"red": [0], "red_yellow": [0, 1], "yellow": [1], "green": [2], "off": []}[state]
        log[k] = np.log(OFF_WHERE_LIT) if not lamps else _log_of(lamps, shares / total, places, upright)
    return np.asarray(np.maximum(log - log.max(), -MAX_EVIDENCE))


def _log_of(lamps: list[int], shares: Array, places: Array, upright: bool) -> float:
    """Return the log-likelihood of colors (3,), as shares of what shines, at places (3,), while lamps are lit."""
    log = float(shares @ np.log(SEEN_AS[lamps].mean(axis=0)))
    if len(lamps) == 2:
        # Both shine, one below the other.
        apart = not upright or places[1] - places[0] > MIN_APART
        log += 0.0 if min(shares[0], shares[1]) > SEEN_SHARE and apart else np.log(LIT_WHERE_DARK)
    seen = shares > SEEN_SHARE
    if upright:
        for color in np.flatnonzero(seen):
            off = min(abs(places[color] - PLACES[lamp]) for lamp in lamps) / PLACE_SIGMA
            log -= 0.5 * float(shares[color]) * off**2
    return log


def find_lamps(crop_bgr: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Return how much of a crop shines red, yellow and green (3,), and the mean places (3,) from its top, NaN where nothing does."""
    edge = int(SIDE_SHARE * crop_bgr.shape[1])
    rgb = crop_bgr[:, edge : crop_bgr.shape[1] - edge, ::-1].astype(np.float64) / 255
    value = rgb.max(axis=2)
    chroma = value - rgb.min(axis=2)
    saturation = np.divide(chroma, value, out=np.zeros_like(value), where=value > 0)
    lit = value > np.quantile(value, HOUSING_QUANTILE) + MIN_CONTRAST
    colored = lit & (saturation > MIN_SATURATION)
    shares, places = np.zeros(3), np.full(3, np.nan)
    if lit.mean() > MAX_LIT_SHARE:
        return shares, places
    hue = _hues(rgb, chroma)
    color = np.full(hue.shape, -1)
    color[_between(hue, RED_HUES)], color[_between(hue, YELLOW_HUES)], color[_between(hue, GREEN_HUES)] = 0, 1, 2
    rows = (np.arange(len(rgb)) + 0.5) / len(rgb)
    weight = np.where(colored, chroma * value, 0.0)
    for k in range(3):
        part = np.where(color == k, weight, 0.0).sum(axis=1)
        shares[k] = part.sum() / rgb[..., 0].size
        if part.sum() > 0:
            places[k] = float(part @ rows / part.sum())
    return shares, places


def _hues(rgb: Array, chroma: Array) -> Array:
    """Return the hues (h, w) in degrees of colors (h, w, 3); 0 where there is none."""
    red, green, blue = np.moveaxis(rgb, 2, 0)
    safe = np.where(chroma > 0, chroma, 1.0)
    top = rgb.argmax(axis=2)
    hue = np.select(
        [top == 0, top == 1], [((green - blue) / safe) % 6, (blue - red) / safe + 2], (red - green) / safe + 4
    )
    return np.asarray(60 * hue)


def _between(hue: Array, bounds: tuple[float, float]) -> NDArray[np.bool_]:
    low, high = bounds
    return np.asarray((hue >= low) & (hue < high) if low < high else (hue >= low) | (hue < high))
