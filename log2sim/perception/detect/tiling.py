"""Tiling of wide images, so that far objects are large enough for a detector with a small input."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections
from log2sim.geometry import Array
from log2sim.perception.detect.suppression import suppress

# Overlap of neighboring tiles as a share of a tile's width; wider objects are detected in the whole image.
OVERLAP = 0.35
# Margin at a tile's border as a share of its width: about how exactly models place the edge of a cut object.
BORDER = 0.025
# Pixels of a tile for each pixel of the input: with more, far cars are missed, with less, time is lost.
MAX_DOWNSCALING = 1.6
MAX_AUTO_TILES = 5


@dataclass(frozen=True)
class Tile:
    """Part of an image: columns u0..u1 and rows v0..v1 in px, ends excluded."""

    u0: int
    v0: int
    u1: int
    v1: int

    def cut(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Crop the tile (h, w, 3) from an image (H, W, 3), without a copy."""
        return image[self.v0 : self.v1, self.u0 : self.u1]


def plan_tiles(width_px: int, height_px: int, tiles: Literal["auto"] | int, input_px: int | None) -> list[Tile]:
    """Plan the whole image and one row of tiles from left to right, vertically centered, no higher than wide.

    Parameters
    ----------
    tiles
        1: only the whole image; N: also N tiles; "auto": see `auto_tile_count`.
    input_px
        Width of the model's input, None where it takes any size.

    Notes
    -----
    The sky and the road right in front of the car are seen in the whole image only: no far objects are there.
    """
    whole = Tile(0, 0, width_px, height_px)
    count = auto_tile_count(width_px, input_px) if tiles == "auto" else tiles
    if count < 2:
        return [whole]
    tile_width = math.ceil(width_px / (count - (count - 1) * OVERLAP))
    tile_height = min(height_px, tile_width)
    v0 = (height_px - tile_height) // 2
    starts = np.rint(np.linspace(0, width_px - tile_width, count)).astype(int).tolist()
    return [whole, *(Tile(u, v0, u + tile_width, v0 + tile_height) for u in starts)]


def auto_tile_count(width_px: int, input_px: int | None) -> int:
    """Count the tiles in a row so that none is downscaled by more than `MAX_DOWNSCALING`; 1 if the image is not."""
    if input_px is None or width_px <= MAX_DOWNSCALING * input_px:
        return 1
    needed = (width_px / (MAX_DOWNSCALING * input_px) - OVERLAP) / (1 - OVERLAP)
    return min(math.ceil(needed), MAX_AUTO_TILES)


def is_cut_by_tile(box_px: Array, tile: Tile, width_px: int, height_px: int) -> NDArray[np.bool_]:
    """Compute the mask (M,) of boxes (M, 4), px of the whole image, that end at a border of the tile inside the image."""
    margin = BORDER * (tile.u1 - tile.u0)
    return (
        ((tile.u0 > 0) & (box_px[:, 0] < tile.u0 + margin))
        | ((tile.v0 > 0) & (box_px[:, 1] < tile.v0 + margin))
        | ((tile.u1 < width_px) & (box_px[:, 2] > tile.u1 - margin))
        | ((tile.v1 < height_px) & (box_px[:, 3] > tile.v1 - margin))
    )


def merge(found: list[tuple[Tile, Detections]], width_px: int, height_px: int, max_overlap: float) -> Detections:
    """Merge the boxes of all tiles, in px of the whole image, into one set.

    Notes
    -----
    A box cut by an inner border is dropped: tiles overlap, and objects larger than the overlap are detected in the whole
    image. A half box would give a wrong object, a missing box only a missing observation of a track.
    """
    kept = [d.take(~is_cut_by_tile(d.box_px, tile, width_px, height_px)) for tile, d in found]
    if not kept:
        return Detections.empty()
    joined = Detections(
        np.concatenate([d.box_px for d in kept]),
        np.concatenate([d.score for d in kept]),
        np.concatenate([d.category for d in kept]),
    )
    return suppress(joined, max_overlap)
