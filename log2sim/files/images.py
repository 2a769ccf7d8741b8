"""JPEG and PNG files: their sizes known before anything is decoded; damaged ones as errors."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import RecordError

JPEG_MAGIC = b"\xff\xd8"
MAX_IMAGE_PX = 100_000_000


def decode_image(
    data: bytes, where: str, size_px: tuple[int, int], *, least_px: int = 0, gray: bool = False
) -> NDArray[np.uint8]:
    """Decode a JPEG or PNG file, for a calibration of width and height `size_px`, as (H, W, 3) uint8 BGR, or as (H, W) `gray`.

    `where`: names file and stamp in errors. `least_px`: a JPEG is decoded at a smaller scale as far as it stays this wide; 0 for
    the whole. Raises `RecordError` when it is truncated, no JPEG or PNG, or of another size.
    """
    width, height = image_size(data, where)
    if (width, height) != size_px:
        raise RecordError(f"{where}: {width}x{height} px, the calibration is for {size_px[0]}x{size_px[1]}")
    if data[:2] == JPEG_MAGIC:
        import simplejpeg

        try:
            least_px = min(least_px, width)
            image = simplejpeg.decode_jpeg(data, colorspace="GRAY" if gray else "BGR", min_width=least_px)
            return np.asarray(image[:, :, 0] if gray else image)
        except ValueError as error:
            raise RecordError(f"{where}: JPEG cannot be decoded: {error}") from None
    import cv2

    # OpenCV returns the upper part of a truncated PNG as if it were whole, and libpng prints what it finds wrong: lengths and check
    # sums are checked before, and what is said beside the picture is left out.
    at, kind, kept = 8, b"", [data[:8]]
    while kind != b"IEND":
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        kind = data[at + 4 : at + 8]
        if end + 4 > len(data):
            raise RecordError(f"{where}: PNG is truncated")
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise RecordError(f"{where}: the check sum of the PNG at byte {end} is wrong")
        kept += [data[at : end + 4]] if kind[:1].isupper() or kind == b"tRNS" else []
        at = end + 4
    png = np.frombuffer(b"".join(kept), np.uint8)
    image = cv2.imdecode(png, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise RecordError(f"{where}: PNG cannot be decoded")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if gray else image, dtype=np.uint8)


def image_size(data: bytes, where: str) -> tuple[int, int]:
    """Return width and height in px of a JPEG or PNG file from its header; `RecordError` for anything else, also for an impossible size."""
    if data[:2] == JPEG_MAGIC:
        import simplejpeg

        try:
            height, width, _, _ = simplejpeg.decode_jpeg_header(data)
        except ValueError as error:
            raise RecordError(f"{where}: not a readable JPEG: {error}") from None
    elif data[:8] != b"\x89PNG\r\n\x1a\n" or len(data) < 24:
        raise RecordError(f"{where}: neither a JPEG nor a PNG image")
    elif zlib.crc32(data[12:29]) != int.from_bytes(data[29:33], "big"):
        raise RecordError(f"{where}: the check sum of the PNG header is wrong")
    else:
        width, height = struct.unpack(">II", data[16:24])
    if not 0 < width * height <= MAX_IMAGE_PX:
        raise RecordError(f"{where}: {width}x{height} px, expected 1 to {MAX_IMAGE_PX} px")
    return width, height
