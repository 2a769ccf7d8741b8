"""Detections of earlier runs, by what was searched, with what, and how; what is found in one picture.

The bytes are read as if a stranger had written them: no count is believed before the length agrees with it, and nothing but
numbers and texts of limited size is made of them.

The key holds the file of the picture, or its pixels where the log has no file, and all that the detector's result depends on. A
picture that was searched before is not decoded: what else the first pass takes from it is kept along.
"""

from __future__ import annotations

import hashlib
import platform
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections, Frame
from log2sim.errors import ConfigError, RecordError
from log2sim.files.cache import DiskCache, detection_folder
from log2sim.geometry import Array
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.projection import ProjectedPoints, View, project_points
from log2sim.perception.records import CELLS, Thumbnail

# Lamps of a crop of this height are 10 px wide, which is enough to tell their colors; larger crops are scaled down.
MAX_CROP_PX = 40
# Around a box, as a share of its sides: boxes of detectors are off by so much, and lamps shine beyond their housing.
MARGIN = 0.1
MIN_SIDE_PX = 3
# Points of a housing lie in the middle of its box, and none behind the first ones; below this height above ground are vehicles.
MIDDLE, HOUSING_DEPTH_M, MIN_HEIGHT_M, MIN_POINTS = 0.7, 0.6, 1.5, 2
MAX_OVERLAP = 0.2  # of the smaller of two boxes; more have parts of one housing
# Of a log; 40 MB. Later ones are not kept.
MAX_CROPS = 20_000


@dataclass(frozen=True, eq=False)
class LightBox:
    """A traffic light in one frame.

    Attributes
    ----------
    t_ns : int
        Stamp of the frame.
    box_px : (4,) float64
        u0, v0, u1, v1.
    crop : (h, w, 3) uint8
        The picture there, BGR.
    range_m : float
        Distance of LiDAR points in the box from the camera, NaN without any.
    """

    camera: str
    t_ns: int
    box_px: Array
    score: float
    crop: NDArray[np.uint8]
    range_m: float = float("nan")


def crop_lights(camera: str, t_ns: int, image_bgr: NDArray[np.uint8], lights: Array) -> list[LightBox]:
    """Cut traffic lights (K, 5), boxes and scores, out of a frame.

    Those at its border are incomplete and left out, and of boxes within each other the weaker ones: housings hang side by side.
    """
    height, width = image_bgr.shape[:2]
    out: list[LightBox] = []
    for u0, v0, u1, v1, score in sorted(lights.tolist(), key=lambda row: -row[4]):
        box = np.array([u0, v0, u1, v1])
        inside = u0 > 1 and v0 > 1 and u1 < width - 1 and v1 < height - 1
        if not inside or min(u1 - u0, v1 - v0) < MIN_SIDE_PX:
            continue
        if any(_share_within(box, other.box_px) > MAX_OVERLAP for other in out):
            continue
        du, dv = MARGIN * (u1 - u0), MARGIN * (v1 - v0)
        left, top, right, bottom = round(u0 - du), round(v0 - dv), round(u1 + du) + 1, round(v1 + dv) + 1
        crop = image_bgr[max(top, 0) : bottom, max(left, 0) : right]
        scale = min(1.0, MAX_CROP_PX / max(crop.shape[:2]))
        small = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else crop.copy()
        out.append(LightBox(camera, t_ns, box, score, np.asarray(small, np.uint8)))
    return out


def _share_within(a: Array, b: Array) -> float:
    """Return the common part of two boxes (4,) as a share of the smaller one."""
    common = np.prod(np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None))
    return float(common / min(np.prod(a[2:] - a[:2]), np.prod(b[2:] - b[:2])))


def with_ranges(lights: Sequence[LightBox], view: View, cloud: Cloud) -> list[LightBox]:
    """Return the traffic lights of a frame with the distance of the points in the middle of each, if there are some of a housing."""
    if not lights:
        return []
    high = np.flatnonzero(cloud.height > MIN_HEIGHT_M)
    visible = project_points(view, cloud.origin, np.ascontiguousarray(cloud.xyz[high].T))
    return [_with_range(light, view, cloud, high, visible) for light in lights]


def _with_range(
    light: LightBox, view: View, cloud: Cloud, high: NDArray[np.intp], visible: ProjectedPoints
) -> LightBox:
    """Return a traffic light with its distance by the points of a cloud at `high` (n,), which are projected."""
    (u0, v0, u1, v1), reach = light.box_px, (light.box_px[2:] - light.box_px[:2]) * MIDDLE / 2
    inside = (np.abs(visible.u - (u0 + u1) / 2) <= reach[0]) & (np.abs(visible.v - (v0 + v1) / 2) <= reach[1])
    if inside.sum() < MIN_POINTS:
        return light
    points = cloud.xyz[high[visible.index[inside]]] + cloud.origin - view.map_T_cam[:3, 3]
    away = np.linalg.norm(points, axis=1)
    front = away[away < away.min() + HOUSING_DEPTH_M]
    return replace(light, range_m=float(np.median(front))) if len(front) >= MIN_POINTS else light


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


KEY_BYTES = 16
MAX_NAME_CHARACTERS = 48
# Modules of log2sim between the file of a picture and what is kept of it, relative to the package; a change of any of them
# makes other keys, so that nobody has to remember to raise a version.
SOURCES = (
    "datatypes/categories.py",
    "logs/records.py",
    "perception/detect/*.py",
    "perception/detection_cache.py",
    "perception/detection_cache.py",
    "perception/records.py",
)


class DetectionCache:
    """Findings in pictures by one detector; safe to share between threads.

    Parameters
    ----------
    store : DiskCache
    name : str
        Of the detector, for people.
    cache_key : str
        All that its result depends on besides the picture.

    Attributes
    ----------
    found, kept : int
        Pictures whose findings were there, and whose findings were kept for later runs.
    """

    def __init__(self, store: DiskCache, name: str, cache_key: str) -> None:
        self._store = store
        self._detector = hashlib.blake2b(f"{cache_key}\n{software_key()}".encode(), digest_size=KEY_BYTES).digest()
        word = re.sub(r"[^A-Za-z0-9_-]+", "-", name)[:MAX_NAME_CHARACTERS] or "detector"
        self._group = f"{word}.{self._detector.hex()[:8]}"
        self.found = self.kept = 0

    @property
    def problem(self) -> str | None:
        """Why nothing more is kept."""
        return self._store.problem

    def key_of(self, frame: Frame) -> bytes | None:
        """Return the key of a frame; None for one that cannot be read."""
        value = hashlib.blake2b(self._detector, digest_size=KEY_BYTES)
        # The size that the calibration is for decides whether a file can be read.
        value.update(f" {frame.camera.width_px} {frame.camera.height_px} ".encode())
        try:
            if frame.encoded is not None:
                value.update(b"file ")
                value.update(frame.encoded())
            else:
                image = frame.image()
                value.update(f"pixels {image.shape} ".encode())
                value.update(np.ascontiguousarray(image).data)
        except RecordError:
            return None
        return value.digest()

    def get(self, key: bytes, frame: Frame) -> PictureFindings | None:
        """Return what was found in a frame by its key; None where it is not known."""
        content = self._store.get(self._name_of(key))
        return None if content is None else from_bytes(content, key, frame.camera.name, frame.t_ns)

    def put(self, key: bytes, findings: PictureFindings) -> None:
        """Keep what was found in a frame."""
        content = to_bytes(findings, key)
        if content is not None:
            self.kept += self._store.put(self._name_of(key), content)

    def counts(self, back_to: tuple[int, int] = (0, 0)) -> tuple[int, int]:
        """Return found and kept, and count on from other numbers."""
        counted = self.found, self.kept
        self.found, self.kept = back_to
        return counted

    def add(self, found: int, kept: int) -> None:
        """Add what a part of the log found and kept."""
        self.found, self.kept = self.found + found, self.kept + kept

    def finish(self) -> None:
        """Keep the limit of the cache, and note there what this run did; at the end of a run."""
        self._store.finish({"found": self.found, "kept": self.kept})

    def figures(self) -> dict[str, Any]:
        """Return what the report says: pictures found and kept, and why nothing more was kept."""
        return {"found": self.found, "kept": self.kept, "problem": self.problem}

    def _name_of(self, key: bytes) -> str:
        return f"{self._group}.{key.hex()}"


def open_cache(detector: Detector) -> DetectionCache | None:
    """Return the user's cache for a detector; None for one that does not say by a `cache_key` what its result depends on."""
    cache_key = getattr(detector, "cache_key", None)
    try:
        store = DiskCache(detection_folder())
    except ConfigError:  # no home folder
        return None
    return DetectionCache(store, detector.name, cache_key) if isinstance(cache_key, str) else None


@cache
def software_key() -> str:
    """Return a text that changes with whatever turns files into findings: log2sim's own code, decoders, the processor."""
    import simplejpeg

    package, value = Path(__file__).resolve().parents[1], hashlib.blake2b(digest_size=KEY_BYTES)
    for pattern in SOURCES:
        for source in sorted(package.glob(pattern)):
            value.update(source.read_bytes())
    parts = (np.__version__, cv2.__version__, simplejpeg.__version__, platform.machine(), _instructions())
    return "\n".join((value.hexdigest(), *parts))


def _instructions() -> str:
    """Return the instructions that the processor has: libraries choose their code by them, and sums differ in the last bits."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # not on Linux
        return platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
