"""Frames as shades of gray and no larger than needed, which a JPEG gives in a fraction of the time of the whole image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Stream
from log2sim.errors import RecordError
from log2sim.geometry import Camera
from log2sim.logs.images import MAX_IMAGE_PX, image_size

# A pixel is then some hundredths of a degree in most cameras.
MIN_WIDTH_PX = 800


def read_gray(stream: Stream, index: int, camera: Camera) -> NDArray[np.uint8] | None:
    """Read a frame as (H, W) uint8, W between the camera's width and about `MIN_WIDTH_PX`; None where it cannot be read."""
    import cv2

    try:
        if stream.encoded is not None:
            small = _decode_small(stream.encoded(index), camera)
            if small is not None:
                return small
        gray = cv2.cvtColor(stream.read(index), cv2.COLOR_BGR2GRAY)
    except RecordError:
        return None
    scale = MIN_WIDTH_PX / camera.width_px
    if scale < 0.75:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(gray, dtype=np.uint8)


def _decode_small(data: bytes, camera: Camera) -> NDArray[np.uint8] | None:
    """Decode a JPEG at a reduced size; None for images of another kind or size."""
    import simplejpeg

    if data[:2] != b"\xff\xd8":
        return None
    width, height = image_size(data, camera.name)
    if (width, height) != (camera.width_px, camera.height_px) or width * height > MAX_IMAGE_PX:
        return None
    try:
        gray = simplejpeg.decode_jpeg(data, colorspace="GRAY", min_width=min(MIN_WIDTH_PX, width))
    except ValueError:
        return None
    return np.asarray(gray[:, :, 0], dtype=np.uint8)
