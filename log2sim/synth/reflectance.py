"""How strongly surfaces of a scene send a LiDAR's light back: the ground with its paint, buildings and road users.

Glass beads in paint send light back to where it comes from, so at 905 nm markings return two to four times as much as
asphalt; on flat lines a film of water ends that (Burghardt et al., Visibility of flat line and structured road markings for
machine vision, Case Studies in Construction Materials 18, 2023).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.synth.ground import GROUND_M_PER_PX, TILE_PX, Ground, Surface
from log2sim.synth.surfaces import linear_bgr

FULL_SCALE = 255.0  # intensities are whole numbers up to it, as most LiDARs have them
REFLECTANCE: Surface = {"meadow": 0.4, "sidewalk": 0.28, "curb": 0.32, "asphalt": 0.16, "paint": 0.48}
# Paint that is bright to the eye is bright at 905 nm, dark paint mostly dark.
BODY_REFLECTANCE = (0.06, 0.75)
AIR_REFLECTANCE = 0.02
WET_SHARE, WET_BEADS = 0.5, 0.1  # of a wet road's return, and of what beads add to it
SPECKLE = 0.15  # standard deviation of a return relative to its mean
INCIDENCE_POWER = 0.7  # of rough surfaces, as in `log2sim.synth.returns`
BEAM_RAD = 0.003  # divergence, as makers of spinning sensors state it
MAX_LEVEL = 4


class GroundReflectance:
    """Reflectance of the painted ground where beams meet it.

    Parameters
    ----------
    ground : Ground
    wetness : float
        From 0 for dry to 1 for wet ground.
    """

    def __init__(self, ground: Ground, wetness: float = 0.0) -> None:
        self._ground = ground
        self._tiles: dict[tuple[int, int, int], NDArray[np.uint8]] = {}
        asphalt = REFLECTANCE["asphalt"]
        beads = (REFLECTANCE["paint"] - asphalt) * (1 - (1 - WET_BEADS) * wetness)
        dry = {**REFLECTANCE, "paint": asphalt + beads}
        self._values = {name: float(value * (1 - (1 - WET_SHARE) * wetness)) for name, value in dry.items()}

    def at(self, xy_m: NDArray[np.float64], spot_m: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the mean reflectance (N,) over spots of some widths (N,) around points (N, 2) in the map."""
        out = np.empty(len(xy_m), np.float32)
        if len(xy_m) == 0:
            return out
        level = np.clip(np.rint(np.log2(np.maximum(spot_m / GROUND_M_PER_PX, 1.0))), 0, MAX_LEVEL).astype(np.int64)
        pixel = np.floor(xy_m / (GROUND_M_PER_PX * 2.0**level)[:, None]).astype(np.int64)
        keys, group = np.unique(np.column_stack([level, pixel // TILE_PX]), axis=0, return_inverse=True)
        order = np.argsort(group, kind="stable")
        column, row = (pixel % TILE_PX).T
        for key, rows in zip(keys.tolist(), np.split(order, np.flatnonzero(np.diff(group[order])) + 1)):
            out[rows] = self._tile(*key)[row[rows], column[rows]]
        return out / np.float32(FULL_SCALE)

    def _tile(self, level: int, i: int, j: int) -> NDArray[np.uint8]:
        where = (level, i, j)
        if where not in self._tiles:
            shade = self._ground.shade(*where, self._values)
            self._tiles[where] = np.asarray(np.rint(shade * FULL_SCALE), np.uint8)
        return self._tiles[where]


def spot_m(range_m: NDArray[np.float64], incidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """Width (N,) in m of the spot of a beam, the mean of those along and across it; `incidence` is the cosine at the surface."""
    return np.asarray(BEAM_RAD * range_m / np.sqrt(np.maximum(incidence, 0.01)))


def body_reflectance(color: Sequence[int]) -> float:
    """Return the reflectance of a body of an sRGB color."""
    red, green, blue = (int(c) for c in color)
    low, high = BODY_REFLECTANCE
    return float(low + (high - low) * linear_bgr((red, green, blue)).mean())


def intensity_of(
    reflectance: NDArray[np.float32], incidence: NDArray[np.float32], rng: np.random.Generator
) -> NDArray[np.float32]:
    """Intensities (N,) of returns, corrected for range as sensors do, with speckle."""
    speckle = 1 + SPECKLE * rng.standard_normal(len(reflectance), dtype=np.float32)
    strength = reflectance * np.maximum(incidence, np.float32(0.02)) ** np.float32(INCIDENCE_POWER) * speckle
    return np.asarray(np.clip(np.rint(strength * np.float32(FULL_SCALE)), 1, FULL_SCALE), np.float32)
