"""Pictures of a camera that stands: their median over time shows the ground without what passes over it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.mapping.ground_view import Image

# Rows of pictures whose median is taken at a time, which bounds the memory.
ROWS_AT_A_TIME = 64


class StandingPictures:
    """Keep the few pictures that a map takes of a standing camera."""

    def __init__(self) -> None:
        self._images: list[Image] = []
        self._users: list[NDArray[np.uint8]] = []

    def add(self, image: Image, users: NDArray[np.uint8]) -> None:
        """Keep a picture (H, W, 3) and the mask (h, w), smaller, of what it shows of road users."""
        self._images.append(image)
        self._users.append(users)

    def median(self) -> tuple[Image, NDArray[np.uint8]]:
        """Return the median picture, and the mask that is 1 where road users were in more than half of the pictures."""
        out = np.empty_like(self._images[0])
        for k in range(0, len(out), ROWS_AT_A_TIME):
            rows = slice(k, k + ROWS_AT_A_TIME)
            out[rows] = np.median([image[rows] for image in self._images], axis=0).astype(np.uint8)
        often = 2 * np.sum(self._users, axis=0, dtype=np.int64) > len(self._users)
        return out, np.asarray(often, dtype=np.uint8)
