"""Surfaces of road users: their appearance, and the optical properties of points on them.

Colors are linear BGR in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.vehicles import Material

Index = NDArray[np.int64]


@dataclass(frozen=True)
class Appearance:
    """Appearance of an actor; colors are sRGB from 0 to 255.

    Attributes
    ----------
    category : str
    size_m : (float, float, float)
        Length, width, height.
    color : (int, int, int)
    kind : str
        Body of a car.
    second_color : (int, int, int)
    skin : (int, int, int)
    hair : (int, int, int)
    seed : int
        Varies the folds of clothes.
    """

    category: str
    size_m: tuple[float, float, float]
    color: tuple[int, int, int]
    kind: str = ""
    second_color: tuple[int, int, int] = (45, 50, 66)
    skin: tuple[int, int, int] = (196, 150, 122)
    hair: tuple[int, int, int] = (52, 38, 28)
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Paint:
    """Optical properties of P surface points, colors in linear BGR.

    Attributes
    ----------
    albedo : (P, 3) float32
    gloss : (P,) float32
        Share of the surroundings that is mirrored.
    glow : (P, 3) float32
        Emitted light.
    """

    albedo: NDArray[np.float32]
    gloss: NDArray[np.float32]
    glow: NDArray[np.float32]


def linear_bgr(rgb: tuple[int, int, int]) -> NDArray[np.float32]:
    """Linear BGR of an sRGB color."""
    return ((np.array(rgb[::-1], dtype=np.float32) / 255) ** np.float32(2.2)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Patch:
    """Points of one material on an actor, to be painted.

    Attributes
    ----------
    appearance : Appearance
    out : Paint
        Of all points of the actor.
    rows : (Q,) int64
        Rows of this patch in `out`.
    p : (Q, 3) float64, m
        Points in the agent frame.
    z : (Q,) float64, m
        Heights above the ground.
    n : (Q, 3) float64
        Normals.
    part : Material
    """

    appearance: Appearance
    out: Paint
    rows: Index
    p: Array
    z: Array
    n: Array
    part: Material

    def set(self, mask: NDArray[np.bool_], albedo: Any, gloss: float = 0.0, glow: float = 0.0) -> None:
        """Paint the points of a mask (Q,)."""
        self._put(self.rows[mask], albedo, gloss, glow)

    def fill(self, albedo: Any, gloss: float = 0.0) -> None:
        """Paint all points."""
        self._put(self.rows, albedo, gloss, 0.0)

    def _put(self, index: Index, albedo: Any, gloss: float, glow: float) -> None:
        self.out.albedo[index] = albedo
        self.out.gloss[index] = gloss
        self.out.glow[index] = glow * np.asarray(albedo, np.float32)
