"""What is found in one picture, and its form as bytes: a check sum, counts, then the arrays.

The bytes are read as if a stranger had written them: no count is believed before the length agrees with it, and nothing but
numbers and texts of limited size is made of them.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections
from log2sim.geometry import Array
from log2sim.perception.light_boxes import MAX_CROP_PX, LightBox
from log2sim.perception.record_checks.thumbnails import CELLS, Thumbnail

MAGIC = b"l2sfound"
DIGEST_BYTES = 16
MAX_BOXES, MAX_WORD, MAX_LIGHTS = 10_000, 64, 10_000
# Rounding of a scaled crop.
MAX_CROP_SIDE_PX = MAX_CROP_PX + 1

_HEAD = struct.Struct("=8s16s16s")  # magic, of which picture and detector this is, check sum of the rest
_COUNTS = struct.Struct("=6I")  # boxes, letters of a category, traffic lights, height and width of the thumbnail, crops
_CROP = struct.Struct("=2H")  # height and width


@dataclass(frozen=True, eq=False)
class PictureFindings:
    """What a run takes from a picture.

    Attributes
    ----------
    detections : Detections
    thumbnail : (h, w) float32
        By which it is compared with other pictures.
    lights : tuple of LightBox
        Traffic lights, cut out.
    """

    detections: Detections
    thumbnail: Thumbnail
    lights: tuple[LightBox, ...] = ()


def to_bytes(findings: PictureFindings, key: bytes) -> bytes | None:
    """Return findings as bytes; None where they would not come back as they are.

    Parameters
    ----------
    key : (16,) bytes
        Of the picture and the detector; `from_bytes` wants the same.
    """
    found, thumbnail, lights = findings.detections, findings.thumbnail, findings.lights
    letters = found.category.dtype.itemsize // 4
    expected = (
        (found.box_px, (len(found), 4), np.float64),
        (found.score, (len(found),), np.float64),
        (found.category, (len(found),), np.dtype(f"U{letters}")),
        (found.traffic_lights, (len(found.traffic_lights), 5), np.float64),
        (thumbnail, (*thumbnail.shape[:2],), np.float32),
    )
    if any(array.shape != shape or array.dtype != dtype for array, shape, dtype in expected):
        return None
    counts = (len(found), letters, len(found.traffic_lights), *thumbnail.shape, len(lights))
    parts = [_COUNTS.pack(*counts), *(np.ascontiguousarray(array).tobytes() for array, _, _ in expected)]
    for light in lights:
        numbers = np.array([*light.box_px, light.score], dtype=np.float64)
        parts += [_CROP.pack(*light.crop.shape[:2]), numbers.tobytes(), np.ascontiguousarray(light.crop).tobytes()]
    body = b"".join(parts)
    out = _HEAD.pack(MAGIC, key, _digest(body)) + body
    return out if _are_possible(counts) and from_bytes(out, key, "", 0) is not None else None


def from_bytes(content: bytes, key: bytes, camera: str, t_ns: int) -> PictureFindings | None:
    """Return findings from bytes; None for whatever `to_bytes` did not write for this key.

    Parameters
    ----------
    camera, t_ns
        Of the frame that shows the picture now.
    """
    if len(content) < _HEAD.size + _COUNTS.size:
        return None
    magic, of_key, digest = _HEAD.unpack_from(content)
    if magic != MAGIC or of_key != key or digest != _digest(memoryview(content)[_HEAD.size :]):
        return None
    counts = _COUNTS.unpack_from(content, _HEAD.size)
    if not _are_possible(counts):
        return None
    boxes, letters, lights, height, width, crops = counts
    reader = _Reader(content, _HEAD.size + _COUNTS.size)
    try:
        box = reader.take((boxes, 4), np.dtype(np.float64))
        score = reader.take((boxes,), np.dtype(np.float64))
        category = reader.take((boxes,), np.dtype(f"U{letters}"))
        traffic_lights = reader.take((lights, 5), np.dtype(np.float64))
        thumbnail = reader.take((height, width), np.dtype(np.float32))
        cut = tuple(reader.light(camera, t_ns) for _ in range(crops))
    except ValueError:
        return None
    finite = all(np.isfinite(a).all() for a in (box, score, traffic_lights, thumbnail))
    if not reader.is_at_end or not finite or not ((score >= 0) & (score <= 1)).all() or not _are_words(category):
        return None
    return PictureFindings(Detections(box, score, category, traffic_lights), thumbnail, cut)


class _Reader:
    """Arrays from bytes, one after the other."""

    def __init__(self, content: bytes, start: int) -> None:
        self._content, self._at = content, start

    @property
    def is_at_end(self) -> bool:
        """Whether nothing is left."""
        return self._at == len(self._content)

    def take(self, shape: tuple[int, ...], dtype: np.dtype) -> NDArray:  # type: ignore[type-arg]
        """Return the next array as a copy; `ValueError` where the bytes end before."""
        count = int(np.prod(shape))
        values = np.frombuffer(self._content, dtype, count, self._at) if count else np.zeros(0, dtype)
        self._at += count * dtype.itemsize
        return values.reshape(shape).copy()

    def light(self, camera: str, t_ns: int) -> LightBox:
        """Return the next traffic light."""
        height, width = self.take((2,), np.dtype(np.uint16)).tolist()
        numbers: Array = self.take((5,), np.dtype(np.float64))
        if not (0 < height <= MAX_CROP_SIDE_PX and 0 < width <= MAX_CROP_SIDE_PX and np.isfinite(numbers).all()):
            raise ValueError("no crop")
        crop = self.take((height, width, 3), np.dtype(np.uint8))
        return LightBox(camera, t_ns, numbers[:4].copy(), float(numbers[4]), crop)


def _are_words(category: NDArray[np.str_]) -> bool:
    """Return whether texts consist of letters that Unicode has, none of them half of a pair."""
    code = np.ascontiguousarray(category).view(np.uint32)
    return bool(((code <= 0x10FFFF) & ~((code >= 0xD800) & (code < 0xE000))).all())


def _are_possible(counts: tuple[int, ...]) -> bool:
    boxes, letters, lights, height, width, crops = counts
    return (
        boxes <= MAX_BOXES
        and 0 < letters <= MAX_WORD
        and crops <= lights <= MAX_LIGHTS
        and 0 < height <= CELLS
        and 0 < width <= CELLS
    )


def _digest(body: bytes | memoryview) -> bytes:
    return hashlib.blake2b(body, digest_size=DIGEST_BYTES).digest()
