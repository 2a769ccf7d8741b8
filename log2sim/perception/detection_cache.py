"""Detections of earlier runs, found again by what was searched, with what, and how.

The key holds the file of the picture, or its pixels where the log has no file, and all that the detector's result depends on. A
picture that was searched before is not decoded: what else the first pass takes from it is kept along.
"""

from __future__ import annotations

import hashlib
import platform
import re
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from log2sim.cache_folder import detection_folder
from log2sim.datatypes import Frame
from log2sim.disk_cache import DiskCache
from log2sim.errors import ConfigError, RecordError
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.picture_findings import PictureFindings, from_bytes, to_bytes

KEY_BYTES = 16
MAX_NAME_CHARACTERS = 48
# Modules of log2sim between the file of a picture and what is kept of it, relative to the package; a change of any of them
# makes other keys, so that nobody has to remember to raise a version.
SOURCES = (
    "datatypes/categories.py",
    "logs/images.py",
    "perception/detect/*.py",
    "perception/light_boxes.py",
    "perception/picture_findings.py",
    "perception/record_checks/thumbnails.py",
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
