"""Wide pictures in overlapping tiles, so that far objects are large enough for a detector with a small input."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections
from log2sim.geometry import Array
from log2sim.perception.detect.suppression import suppress

OVERLAP = 0.35  # of a tile's width: what is wider is found in the whole picture
BORDER = 0.025  # of a tile's width: models place a cut edge only about so well
MAX_SHRINKING = 1.6  # a tile's pixels an input pixel; beyond, far cars are lost, below, time is
MAX_AUTO_TILES = 5


@dataclass(frozen=True)
class Tile:
    """A part of a picture: columns u0..u1 and rows v0..v1 in px, ends excluded."""

    u0: int
    v0: int
    u1: int
    v1: int

    def cut(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.ascontiguousarray(image[self.v0 : self.v1, self.u0 : self.u1])


def plan_tiles(width_px: int, height_px: int, tiles: Literal["auto"] | int, input_px: int | None) -> list[Tile]:
    """The whole picture, then the tiles of one row from left to right, in the middle and no higher than wide.

    Parameters
    ----------
    tiles
        1: only the whole picture; N: also N tiles; "auto": see `auto_count`.
    input_px
        Width of the model's input, None where it takes any size.

    Notes
    -----
    The sky and the road right before the car are left to the whole picture: nothing far away is there.
    """
    whole = Tile(0, 0, width_px, height_px)
    count = auto_count(width_px, input_px) if tiles == "auto" else tiles
    if count < 2:
        return [whole]
    tile_width = math.ceil(width_px / (count - (count - 1) * OVERLAP))
    tile_height = min(height_px, tile_width)
    v0 = (height_px - tile_height) // 2
    starts = np.rint(np.linspace(0, width_px - tile_width, count)).astype(int).tolist()
    return [whole, *(Tile(u, v0, u + tile_width, v0 + tile_height) for u in starts)]


def auto_count(width_px: int, input_px: int | None) -> int:
    """Number of tiles in a row, so that none is shrunk by more than `MAX_SHRINKING`; 1 where the whole picture is not."""
    if input_px is None or width_px <= MAX_SHRINKING * input_px:
        return 1
    needed = (width_px / (MAX_SHRINKING * input_px) - OVERLAP) / (1 - OVERLAP)
    return min(math.ceil(needed), MAX_AUTO_TILES)


def is_cut(box_px: Array, tile: Tile, width_px: int, height_px: int) -> NDArray[np.bool_]:
    """Mask (M,) of the boxes (M, 4), px of the whole picture, that end at a border of the tile inside the picture."""
    margin = BORDER * (tile.u1 - tile.u0)
    return (
        ((tile.u0 > 0) & (box_px[:, 0] < tile.u0 + margin))
        | ((tile.v0 > 0) & (box_px[:, 1] < tile.v0 + margin))
        | ((tile.u1 < width_px) & (box_px[:, 2] > tile.u1 - margin))
        | ((tile.v1 < height_px) & (box_px[:, 3] > tile.v1 - margin))
    )


def merge(found: list[tuple[Tile, Detections]], width_px: int, height_px: int, max_overlap: float) -> Detections:
    """One set of boxes from those of all tiles, each already in px of the whole picture.

    Notes
    -----
    A box cut by an inner border is dropped: tiles overlap, and what is too large for the overlap is found in the whole
    picture. A half box would give a wrong object, a missing one only a missing frame of a track.
    """
    kept = [d.take(~is_cut(d.box_px, tile, width_px, height_px)) for tile, d in found]
    if not kept:
        return Detections.empty()
    joined = Detections(
        np.concatenate([d.box_px for d in kept]),
        np.concatenate([d.score for d in kept]),
        np.concatenate([d.category for d in kept]),
    )
    return suppress(joined, max_overlap)
