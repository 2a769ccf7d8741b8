"""Images of Image and CompressedImage messages as BGR."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import RecordError
from log2sim.logs.images import MAX_IMAGE_PX, decode_image, image_size
from log2sim.logs.ros.containers import printable

# Encodings of sensor_msgs/image_encodings.hpp: channels, bytes of each, conversion of OpenCV to BGR.
# OpenCV names Bayer patterns by their second row and column, ROS by the first pixel.
ENCODINGS: dict[str, tuple[int, int, str]] = {
    "bgr8": (3, 1, ""), "8UC3": (3, 1, ""), "rgb8": (3, 1, "COLOR_RGB2BGR"), "bgra8": (4, 1, "COLOR_BGRA2BGR"),
    "8UC4": (4, 1, "COLOR_BGRA2BGR"), "rgba8": (4, 1, "COLOR_RGBA2BGR"), "mono8": (1, 1, "COLOR_GRAY2BGR"),
    "8UC1": (1, 1, "COLOR_GRAY2BGR"), "mono16": (1, 2, "COLOR_GRAY2BGR"), "16UC1": (1, 2, "COLOR_GRAY2BGR"),
    "bgr16": (3, 2, ""), "rgb16": (3, 2, "COLOR_RGB2BGR"), "bgra16": (4, 2, "COLOR_BGRA2BGR"),
    "rgba16": (4, 2, "COLOR_RGBA2BGR"), "bayer_rggb8": (1, 1, "COLOR_BayerBG2BGR"), "bayer_bggr8": (1, 1, "COLOR_BayerRG2BGR"),
    "bayer_gbrg8": (1, 1, "COLOR_BayerGR2BGR"), "bayer_grbg8": (1, 1, "COLOR_BayerGB2BGR"),
    "bayer_rggb16": (1, 2, "COLOR_BayerBG2BGR"), "bayer_bggr16": (1, 2, "COLOR_BayerRG2BGR"),
    "bayer_gbrg16": (1, 2, "COLOR_BayerGR2BGR"), "bayer_grbg16": (1, 2, "COLOR_BayerGB2BGR"),
    "yuv422": (2, 1, "COLOR_YUV2BGR_UYVY"), "uyvy": (2, 1, "COLOR_YUV2BGR_UYVY"),
    "yuv422_yuy2": (2, 1, "COLOR_YUV2BGR_YUYV"), "yuyv": (2, 1, "COLOR_YUV2BGR_YUYV"),
}  # fmt: skip


def image_from(message: Any, where: str, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Convert a decoded Image to (H, W, 3) uint8 BGR; of 16 bits the upper 8 are kept.

    Raises
    ------
    RecordError
        For an unknown encoding, fewer bytes than width, height and step promise, or a size that is not that of the calibration.
    """
    import cv2

    width, height, step = int(message.width), int(message.height), int(message.step)
    if (width, height) != size_px or width * height > MAX_IMAGE_PX:
        raise RecordError(f"{where}: {width}x{height} px, the calibration is for {size_px[0]}x{size_px[1]}")
    if message.encoding not in ENCODINGS:
        raise RecordError(f"{where}: encoding '{printable(message.encoding)}' is not one of {', '.join(ENCODINGS)}")
    channels, depth, conversion = ENCODINGS[message.encoding]
    line = width * channels * depth
    data = np.asarray(message.data, dtype=np.uint8)
    if step < line or len(data) < (height - 1) * step + line:
        raise RecordError(
            f"{where}: {len(data)} bytes in lines of {step} for {width}x{height} px of {message.encoding}, "
            f"expected lines of at least {line}"
        )
    if len(data) < height * step:
        data = np.concatenate([data, np.zeros(height * step - len(data), np.uint8)])
    pixels = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :line])
    if depth == 2:
        pixels = (pixels.view(">u2" if message.is_bigendian else "<u2") >> 8).astype(np.uint8)
    pixels = pixels.reshape(height, width, channels) if channels > 1 else pixels.reshape(height, width)
    image = cv2.cvtColor(pixels, getattr(cv2, conversion)) if conversion else pixels
    return np.asarray(image, dtype=np.uint8)


def image_from_compressed(message: Any, where: str, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Decode a CompressedImage; its first bytes decide what it is, as drivers write any text as its format."""
    return decode_image(encoded_from(message, where), where, size_px)


def encoded_from(message: Any, where: str) -> bytes:
    """Return the JPEG or PNG file in a CompressedImage; `RecordError` for anything else."""
    data: bytes = np.asarray(message.data, dtype=np.uint8).tobytes()
    try:
        image_size(data, where)
    except RecordError as error:
        raise RecordError(f"{error} (its format states '{printable(message.format)}')") from None
    return data
