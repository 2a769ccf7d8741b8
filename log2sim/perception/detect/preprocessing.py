"""Preprocessing of images for a model: size, border, channel order, value range; and boxes back to the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# Gray value around a letterboxed image that the YOLO family is trained with.
LETTERBOX_GRAY = 114


@dataclass(frozen=True)
class InputSpec:
    """Image input of a model.

    Attributes
    ----------
    name : str
    height_px, width_px : int or None
        None where the model takes any size.
    channels_last : bool
        (1, H, W, 3) instead of (1, 3, H, W).
    dtype : numpy.dtype
    """

    name: str
    height_px: int | None
    width_px: int | None
    channels_last: bool
    dtype: np.dtype[Any]


@dataclass(frozen=True, eq=False)
class Placement:
    """Placement of the image in the input: `uv_input = uv_image * scale + shift_px`.

    Attributes
    ----------
    scale : (2,) float64
    shift_px : (2,) float64
    input_px : (int, int)
        Width and height of the input.
    """

    scale: Array
    shift_px: Array
    input_px: tuple[int, int]

    def to_image(self, box_input: Array) -> Array:
        """Convert boxes (M, 4) from px of the input to px of the image."""
        return (box_input - np.tile(self.shift_px, 2)) / np.tile(self.scale, 2)


@dataclass(frozen=True)
class Preprocessing:
    """Preprocessing of a family of models.

    Attributes
    ----------
    fit : str
        "corner" and "center" keep the aspect ratio and fill the rest with gray (letterbox), "stretch" does not, "tf1"
        stretches with the sampling of TensorFlow 1.
    rgb : bool
        Channel order RGB instead of BGR.
    unit : bool
        Values 0-1 instead of 0-255; never for integer inputs.
    default_px : int or None
        Side of the input of a model that takes any size, None for the image's own.
    """

    fit: Literal["corner", "center", "stretch", "tf1"]
    rgb: bool
    unit: bool
    default_px: int | None = 640

    def __call__(self, image_bgr: NDArray[np.uint8], spec: InputSpec) -> tuple[NDArray[Any], Placement]:
        """Convert an image (H, W, 3) uint8 BGR to the input (1, 3, h, w) or (1, h, w, 3), with its placement there."""
        height, width = image_bgr.shape[:2]
        size = (spec.width_px or self.default_px or width, spec.height_px or self.default_px or height)
        image, placement = self._place(image_bgr, size)
        if self.rgb:
            image = reversed_channels(image)
        if not spec.channels_last:
            image = image.transpose(2, 0, 1)
        tensor = np.ascontiguousarray(image[None], dtype=spec.dtype)
        if self.unit and spec.dtype.kind == "f":
            tensor /= 255
        return tensor, placement

    def _place(self, image: NDArray[np.uint8], size: tuple[int, int]) -> tuple[NDArray[np.uint8], Placement]:
        height, width = image.shape[:2]
        if self.fit in ("corner", "center"):
            return letterbox(image, size, centered=self.fit == "center")
        placement = Placement(np.array([size[0] / width, size[1] / height]), np.zeros(2), size)
        if size == (width, height):
            return image, placement
        return (resize_as_tf1 if self.fit == "tf1" else resize)(image, size), placement


def reversed_channels(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) with its channels in reverse order, copied in a tenth of the time that NumPy takes."""
    import cv2

    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def letterbox(
    image: NDArray[np.uint8], size: tuple[int, int], *, centered: bool
) -> tuple[NDArray[np.uint8], Placement]:
    """Fit an image into (width, height) px, keep its aspect ratio, and fill the rest with gray."""
    height, width = image.shape[:2]
    ratio = min(size[0] / width, size[1] / height)
    inner = (max(1, min(size[0], round(width * ratio))), max(1, min(size[1], round(height * ratio))))
    left, top = ((size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2) if centered else (0, 0)
    out = np.full((size[1], size[0], 3), LETTERBOX_GRAY, dtype=np.uint8)
    out[top : top + inner[1], left : left + inner[0]] = resize(image, inner)
    scale = np.array([inner[0] / width, inner[1] / height])
    return out, Placement(scale, np.array([left, top], dtype=np.float64), size)


def resize(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize to (width, height) px, bilinear, pixel centers at half."""
    import cv2

    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def resize_as_tf1(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize to (width, height) px as TensorFlow 1 did: output pixel i samples the input at i * in / out.

    Notes
    -----
    Pixel centers at the corner instead of the middle, border repeated. SSD models of that time were trained so: other
    sampling moves their scores by up to 0.27.
    """
    import cv2

    height, width = image.shape[:2]
    source_from_target = np.array([[width / size[0], 0, 0], [0, height / size[1], 0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(image, source_from_target, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, dtype=np.uint8)
