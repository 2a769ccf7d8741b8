"""Profiles across straight pieces of ridges: the width of the paint, its contrasts, and whether both sides are alike."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.lanes.detection.layers import Layer, Samples, sample
from log2sim.mapping.ground_map import GroundMap

PROFILE_M, PROFILE_STEP_M, ALONG_SAMPLES = 1.5, 0.05, 11
MIN_SEEN = 0.6  # share of a profile's middle; of what is hidden beside a line, the other side tells
MAX_SHIFT_M = 0.12  # from the ridge, which is as fine as a coarse cell, to the middle of the paint
FLANK_M = (0.08, 0.4)  # from the middle: where the road beside the paint is looked for
# From the edge: between a line and a curb there are often 0.1 m of road, and paint may be blurred so far.
SIDES_M = ((0.03, 0.13), (0.1, 0.3))


@dataclass(frozen=True, eq=False)
class Pieces:
    """Straight pieces of ridges.

    Attributes
    ----------
    xy : (N, 2) float64, m
        Middles.
    direction : (N,) float64, rad in [0, pi)
    length_m, width_m : (N,) float64
        Width at half of the contrast.
    color, color_sigma : (N,) float64
        Contrast of the logarithm of color to the brighter side, and its standard error; NaN where no camera saw it.
    edge_m : (N,) float64
        Length in which the edges rise from a quarter to three quarters of the contrast.
    uneven : (N,) float64
        Difference of both sides.
    outshines : (N,) float64
        Logarithm by which it is brighter than the brightest quarter of the ground within 1.5 m, on the darker side.
    yellow : (N,) float64
        Contrast of yellowness.
    reflected, reflected_sigma : (N,) float64
        Contrast of the logarithm of LiDAR intensity, and its standard error; NaN where LiDAR saw too little.
    """

    xy: Array
    direction: Array
    length_m: Array
    width_m: Array
    color: Array
    color_sigma: Array
    edge_m: Array
    uneven: Array
    outshines: Array
    yellow: Array
    reflected: Array
    reflected_sigma: Array

    def __len__(self) -> int:
        """Count the pieces."""
        return len(self.xy)

    def take(self, chosen: NDArray[Any]) -> Pieces:
        """Choose pieces by a mask or by indices."""
        return Pieces(*(getattr(self, f.name)[chosen] for f in fields(self)))

    def ends(self, chosen: NDArray[np.int64]) -> Array:
        """Return both ends (K, 2, 2), m, of some pieces (K,)."""
        angle, xy = self.direction[chosen], self.xy[chosen]
        half = np.stack([np.cos(angle), np.sin(angle)], 1) * self.length_m[chosen, None] / 2
        return np.stack([xy - half, xy + half], 1)


def no_pieces(count: int, **known: Array) -> Pieces:
    """Make pieces of which only some attributes are known; the others are 1, so that all are alike."""
    plain = {f.name: np.ones((count, 2) if f.name == "xy" else count) for f in fields(Pieces)}
    return Pieces(**(plain | known))


def measure_pieces(ground: GroundMap, lines: Array) -> Pieces:
    """Measure the profiles across lines (N, 4): x, y, direction, length."""
    steps = round(PROFILE_M / PROFILE_STEP_M)
    across = np.arange(-steps, steps + 1, dtype=np.float64) * PROFILE_STEP_M
    along = (np.arange(ALONG_SAMPLES) + 0.5) / ALONG_SAMPLES - 0.5
    c, s = np.cos(lines[:, 2]), np.sin(lines[:, 2])
    # (N, along, across)
    u = np.broadcast_to((along[None] * lines[:, 3:4])[:, :, None], (len(lines), ALONG_SAMPLES, len(across)))
    x = lines[:, 0, None, None] + u * c[:, None, None] - across * s[:, None, None]
    y = lines[:, 1, None, None] + u * s[:, None, None] + across * c[:, None, None]
    flat = (len(lines), ALONG_SAMPLES * len(across))
    seen = sample(ground, x.reshape(flat), y.reshape(flat))
    samples = Samples(*(a.reshape(x.shape) for a in (seen.bright, seen.yellow, seen.intensity)))
    color, reflected = (_quiet(np.nanmean, a) for a in (samples.paint, samples.intensity))
    by_camera = np.isfinite(color[:, np.abs(across) <= 0.5]).mean(1) > MIN_SEEN
    # Of values, not of their logarithms, in which edges that are blurred lie farther out.
    left, right, edge = _edges(np.exp(np.where(by_camera[:, None], color, reflected)), across)
    shift, width = (left + right) / 2, right - left
    inside = np.abs(across - shift[:, None]) <= np.maximum(width / 2 - 0.02, 0.03)[:, None]
    sides = [_side(across, shift, width, side) for side in (-1, 1)]
    contrast, sigma, uneven = _contrast(samples.paint, inside, sides, one_side=True)
    yellow = _contrast(samples.yellow, inside, sides, one_side=True)[0]
    intensity, intensity_sigma, _ = _contrast(samples.intensity, inside, sides, one_side=False)
    xy = lines[:, :2] + shift[:, None] * np.stack([-s, c], 1)
    bright = np.where(inside, color, np.nan)
    around = [
        _quiet(
            np.nanquantile, np.where(side * (across - shift[:, None]) > width[:, None] / 2 + 0.1, color, np.nan), q=0.75
        )
        for side in (-1, 1)
    ]
    # Beside a road there are brighter grounds; the road itself is on one side at least.
    outshines = _quiet(np.nanmean, bright) - np.fmin(*around)
    return Pieces(
        xy,
        lines[:, 2],
        lines[:, 3],
        width,
        contrast,
        sigma,
        edge,
        uneven,
        outshines,
        yellow,
        intensity,
        intensity_sigma,
    )


def _quiet(function: Any, values: NDArray[Any], **options: Any) -> Array:
    """Reduce rows, of which some may be NaN altogether."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(function(values, axis=1, **options), np.float64)


def _edges(profile: Array, across: Array) -> tuple[Array, Array, Array]:
    """Positions (N,) left and right of the middle where profiles (N, P) fall to half of their contrast on that side.

    The third result is the length in which they fall from three quarters to one.
    """
    filled, soft = _without_gaps(profile)
    near = np.abs(across) <= MAX_SHIFT_M
    peak = np.argmax(np.where(near, soft, -np.inf), axis=1)
    index = np.arange(len(profile))
    top = soft[index, peak]
    # Lines wider than the blur have a flat top: its mean is nearer to the paint than its largest value.
    edges, falls = [], []
    distance = across - across[peak][:, None]
    roads = [_darkest(soft, (side * distance > FLANK_M[0]) & (side * distance < FLANK_M[1])) for side in (-1, 1)]
    for side, road, other in zip((-1, 1), roads, roads[::-1]):
        road = np.where(np.isfinite(road), road, other)
        high, half, low = (_crossing(filled, peak, road + q * (top - road), side, across) for q in (0.75, 0.5, 0.25))
        edges.append(half)
        falls.append(side * (low - high))
    return edges[0], edges[1], np.fmax(falls[0], falls[1])


def _darkest(soft: Array, where: NDArray[np.bool_]) -> Array:
    """Least value (N,) of profiles (N, P) somewhere; NaN where nothing is known there."""
    least = np.where(where & np.isfinite(soft), soft, np.inf).min(axis=1)
    return np.where(np.isfinite(least), least, np.nan)


def _without_gaps(profile: Array) -> tuple[Array, Array]:
    """Fill gaps of profiles (N, P), where LiDAR hit no cell, from their neighbors; also blur them, without gaps."""
    known = np.isfinite(profile).astype(np.float64)
    total, count = cv2.blur(np.nan_to_num(profile), (3, 1)), cv2.blur(known, (3, 1))
    soft = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
    soft[count == 0] = np.nan
    return np.where(known > 0, profile, soft), np.asarray(soft)


def _crossing(profile: Array, peak: NDArray[Any], half: Array, side: int, across: Array) -> Array:
    """Position (N,) of the first crossing of a level, going to one side from the peak; NaN where there is none."""
    steps = len(across)
    index = np.arange(len(profile))
    at = np.full(len(profile), np.nan)
    for k in range(1, steps):
        column, before = peak + side * k, peak + side * (k - 1)
        inside = (column >= 0) & (column < steps)
        value = profile[index, np.clip(column, 0, steps - 1)]
        crossed = np.isnan(at) & inside & (value < half)
        if crossed.any():
            previous = profile[index, np.clip(before, 0, steps - 1)]
            fall = previous - value
            part = np.divide(previous - half, fall, out=np.full(len(fall), 0.5), where=np.isfinite(fall) & (fall > 0))
            at[crossed] = (across[np.clip(before, 0, steps - 1)] + side * np.clip(part, 0, 1) * PROFILE_STEP_M)[crossed]
    return at


def _side(across: Array, shift: Array, width: Array, side: int) -> list[NDArray[np.bool_]]:
    """Masks (N, P) of the road beside the paint, near and farther, on one side."""
    distance = side * (across - shift[:, None]) - width[:, None] / 2
    return [np.asarray((distance > low) & (distance < high)) for low, high in SIDES_M]


def _contrast(
    values: Layer, inside: NDArray[np.bool_], sides: list[list[NDArray[np.bool_]]], *, one_side: bool
) -> tuple[Array, Array, Array]:
    """Contrast (N,) of samples (N, along, across) to the brighter side, its standard error, and the sides' difference."""
    middle = _masked_mean(values, inside)
    beside = [_darker([_masked_mean(values, part) for part in side]) for side in sides]
    left, right = (_quiet(np.nanmean, b) for b in beside)
    ridge = middle - np.maximum(*beside)
    count = np.isfinite(ridge).sum(1)
    mean = _quiet(np.nanmean, middle) - (np.fmax if one_side else np.maximum)(left, right)
    sigma = _quiet(np.nanstd, ridge) / np.sqrt(np.maximum(count - 1, 1))
    enough = count >= 3
    return (
        np.where(enough, mean, np.nan),
        np.where(enough, sigma, np.nan),
        np.where(enough, np.abs(left - right), np.nan),
    )


def _darker(parts: list[Array]) -> Array:
    """Choose, for each profile, that of two parts (N, along) whose mean is darker."""
    means = [_quiet(np.nanmean, part) for part in parts]
    return np.where((means[0] < means[1])[:, None] | ~np.isfinite(means[1])[:, None], parts[0], parts[1])


def _masked_mean(values: Layer, mask: NDArray[Any]) -> Array:
    """Mean (N, along) over the samples across that a mask (N, P) has."""
    known = np.isfinite(values) & mask[:, None, :]
    count = known.sum(2)
    total = np.where(known, values, 0).sum(2, dtype=np.float64)
    return np.asarray(np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0), np.float64)
