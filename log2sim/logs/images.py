"""Image files of a log: JPEG and PNG, with their size known before anything is decoded."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Stream
from log2sim.errors import LogError, RecordError
from log2sim.input_files import read_file

MAX_IMAGE_PX = 100_000_000
MAX_IMAGE_BYTES = 256 * 1024 * 1024


def read_image(path: Path, t_ns: int, width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Read an image file as (H, W, 3) uint8 BGR; raise `RecordError` as `decode_image` does, or when it is missing."""
    return decode_image(read_bytes(path, t_ns, MAX_IMAGE_BYTES), f"{path} (stamp {t_ns})", (width_px, height_px))


def decode_image(data: bytes, where: str, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Decode a JPEG or PNG file as (H, W, 3) uint8 BGR.

    Parameters
    ----------
    data : bytes
    where : str
        Names file and stamp in errors.
    size_px : (int, int)
        Width and height that the calibration is for.

    Raises
    ------
    RecordError
        When it is truncated, no JPEG or PNG, or of another size.
    """
    jpeg = data[:2] == b"\xff\xd8"
    width, height = image_size(data, where)
    if (width, height) != size_px:
        raise RecordError(f"{where}: {width}x{height} px, the calibration is for {size_px[0]}x{size_px[1]}")
    return _decode_jpeg(data, where) if jpeg else _decode_png(data, where)


def image_size(data: bytes, where: str) -> tuple[int, int]:
    """Return width and height in px of a JPEG or PNG file from its header; `RecordError` for anything else, also for an impossible size."""
    width, height = _jpeg_size(data, where) if data[:2] == b"\xff\xd8" else _png_size(data, where)
    if not 0 < width * height <= MAX_IMAGE_PX:
        raise RecordError(f"{where}: {width}x{height} px, expected 1 to {MAX_IMAGE_PX} px")
    return width, height


def image_stream(name: str, t_ns: NDArray[np.int64], files: list[Path], size_px: tuple[int, int]) -> Stream:
    """Stream of image files.

    Parameters
    ----------
    name : str
        Of the camera.
    t_ns : (F,) int64
    files : list of Path
        F image files.
    size_px : (int, int)
        Width and height that the calibration is for.
    """

    def read(i: int) -> NDArray[np.uint8]:
        return read_image(files[i], int(t_ns[i]), *size_px)

    def encoded(i: int) -> bytes:
        return read_bytes(files[i], int(t_ns[i]), MAX_IMAGE_BYTES)

    return Stream(name, t_ns, read, encoded)


def first_image_size(files: list[Path]) -> tuple[int, int]:
    """Width and height in px of image files, from the headers of the first and the last readable one.

    Where these differ, one of them is damaged, and the next that has either size decides.
    """
    found = list[tuple[int, int]]()
    for file in (files[0], *files[:0:-1]):
        try:
            found.append(image_size(read_bytes(file, 0, MAX_IMAGE_BYTES), str(file)))
        except RecordError:
            continue
        if found.count(found[-1]) > 1:
            return found[-1]
    if not found:
        raise LogError(f"{files[0].parent}: none of its {len(files)} images can be read")
    return found[0]


def read_bytes(path: Path, t_ns: int, limit_bytes: int) -> bytes:
    """Read the file of one record; `RecordError` when it is missing, no regular file or larger than `limit_bytes`."""
    missing = "cannot be read: No such file or directory"
    return read_file(path, limit_bytes, RecordError, where=f"{path} (stamp {t_ns})", missing=missing)


def _jpeg_size(data: bytes, where: str) -> tuple[int, int]:
    import simplejpeg

    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(data)
    except ValueError as error:
        raise RecordError(f"{where}: not a readable JPEG: {error}") from None
    return width, height


def _decode_jpeg(data: bytes, where: str) -> NDArray[np.uint8]:
    import simplejpeg

    try:
        image: NDArray[np.uint8] = simplejpeg.decode_jpeg(data, colorspace="BGR")
        return image
    except ValueError as error:
        raise RecordError(f"{where}: JPEG cannot be decoded: {error}") from None


def _png_size(data: bytes, where: str) -> tuple[int, int]:
    if data[:8] != b"\x89PNG\r\n\x1a\n" or len(data) < 24:
        raise RecordError(f"{where}: neither a JPEG nor a PNG image")
    if zlib.crc32(data[12:29]) != int.from_bytes(data[29:33], "big"):
        raise RecordError(f"{where}: the check sum of the PNG header is wrong")
    return struct.unpack(">II", data[16:24])


def _decode_png(data: bytes, where: str) -> NDArray[np.uint8]:
    import cv2

    # OpenCV returns the upper part of a truncated PNG as if it were whole.
    if b"IEND" not in data[-64:]:
        raise RecordError(f"{where}: PNG is truncated")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise RecordError(f"{where}: PNG cannot be decoded")
    return image.astype(np.uint8, copy=False)
