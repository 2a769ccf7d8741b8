"""A map of the ground as the page shows it: a small picture with its place."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.visualization.plot.drawing import Background

# A screen shows no more, and a browser decodes it in an instant.
MAX_EDGE_PX = 2400
# Of the picture; half the edge has about a quarter of the bytes.
MAX_BYTES = 3_000_000
QUALITY = 75  # of 100; artifacts are invisible below the tracks


def embed(picture: Background) -> dict[str, Any] | None:
    """Return the picture as a data URL with its extent, x0, x1, y0, y1, m; None where it shows nothing.

    Cut to what it shows; WebP, since that has opacity and every browser shows it.
    """
    seen = picture.alpha > 0
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if not len(rows):
        return None
    part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    image = _shrunk(np.dstack([picture.image_bgr[part], picture.alpha[part]]), MAX_EDGE_PX)
    x0, x1, y0, y1 = picture.extent_m
    dx, dy = (x1 - x0) / seen.shape[1], (y1 - y0) / seen.shape[0]
    extent = [x0 + part[1].start * dx, x0 + part[1].stop * dx, y1 - part[0].stop * dy, y1 - part[0].start * dy]
    data = _encode(image)
    while len(data) > MAX_BYTES:
        image = _shrunk(image, max(image.shape[:2]) // 2)
        data = _encode(image)
    source = "data:image/webp;base64," + base64.b64encode(data).decode()
    return {"source": source, "extent_m": [round(float(v), 3) for v in extent]}


def _encode(image: NDArray[np.uint8]) -> bytes:
    done, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return bytes(data.tobytes()) if done else b""


def _shrunk(image: NDArray[np.uint8], edge_px: int) -> NDArray[np.uint8]:
    """Return a picture whose longer edge has at most so many pixels."""
    shrink = min(edge_px / max(image.shape[:2]), 1.0)
    if shrink == 1:
        return image
    return np.asarray(cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA), dtype=np.uint8)
