"""The first pass of earlier runs, a few ticks at a time, by all that it depends on.

The key holds the content of the records, where the sensors were, what was asked for and the code; the detectors say by a
`cache_key` what their results depend on besides.
"""

from __future__ import annotations

import hashlib
import platform
import re
from collections.abc import Collection
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from log2sim.datatypes import Log
from log2sim.errors import ConfigError
from log2sim.files.cache import DiskCache, detection_folder
from log2sim.files.packing import pack, unpack
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.detect3d.detectors import LidarDetector

KEY_BYTES = 16
MAX_NAME_CHARACTERS = 48
# Modules of log2sim between a record and what is kept of it, relative to the package; a change of any of them makes other
# keys, so that nobody has to remember to raise a version.
SOURCES = ("datatypes/*.py", "files/packing.py", "geometry/*.py", "logs/records.py", "perception/**/*.py", "plan.py")


class FirstPassCache:
    """Parts of the first pass of runs with one pair of detectors.

    `name`: of the detectors, for people. `cache_key`: all that their results depend on besides the records.
    """

    def __init__(self, store: DiskCache, name: str, cache_key: str) -> None:
        self._store = store
        self._detectors = _digest(cache_key.encode(), software_key().encode())
        word = re.sub(r"[^A-Za-z0-9_-]+", "-", name)[:MAX_NAME_CHARACTERS] or "detector"
        self._group = f"{word}.{self._detectors.hex()[:8]}"
        self._run = b""
        self.found = self.kept = 0
        self.problem: str | None = None

    def begin(self, log: Log, settings: Any) -> None:
        """Take what all parts of a run depend on: where the sensors are at any time, and settings that can be packed."""
        sensors = [log.cameras, log.lidars, log.ego, log.ego_vehicle, log.ground_z_ego_m]
        self._run = _digest(self._detectors, pack([sensors, settings]))

    def get(self, of: bytes, classes: Collection[type]) -> Any | None:
        """Return what was kept of a part by what it depends on besides, None where it is not known."""
        content = self._store.get(self._name_of(of))
        try:
            return None if content is None else unpack(content, classes)
        except ValueError:
            return None

    def put(self, of: bytes, part: Any) -> bool:
        """Keep a part; return whether that succeeded."""
        return self._store.put(self._name_of(of), pack(part))

    def count(self, found: int, kept: int, problem: str | None) -> None:
        """Count ticks of a part, which another process may have made."""
        self.found, self.kept, self.problem = self.found + found, self.kept + kept, self.problem or problem

    @property
    def store_problem(self) -> str | None:
        """Why nothing more is kept by this process."""
        return self._store.problem

    def finish(self) -> None:
        """Keep the limit of the cache, and note there what this run did; at the end of a run."""
        self._store.finish({"found": self.found, "kept": self.kept})

    def figures(self) -> dict[str, Any]:
        """Return what the report says: ticks found and kept, and why nothing more was kept."""
        return {"found": self.found, "kept": self.kept, "problem": self.problem}

    def _name_of(self, of: bytes) -> str:
        return f"{self._group}.{_digest(self._run, of).hex()}"


def open_cache(images: Detector | None, sweeps: LidarDetector | None) -> FirstPassCache | None:
    """Return the user's cache for detectors; None where one does not say by a `cache_key` what its result depends on."""
    keys = [(d.name, getattr(d, "cache_key", None)) for d in (images, sweeps) if d is not None]
    if not keys or not all(isinstance(key, str) for _, key in keys):
        return None
    try:
        store = DiskCache(detection_folder())
    except ConfigError:  # no home folder
        return None
    return FirstPassCache(store, "+".join(name for name, _ in keys), "\n".join(str(key) for _, key in keys))


def _digest(*parts: bytes) -> bytes:
    value = hashlib.blake2b(digest_size=KEY_BYTES)
    for part in parts:
        value.update(len(part).to_bytes(8, "little") + part)
    return value.digest()


@cache
def software_key() -> str:
    """Return a text that changes with whatever turns records into a first pass: log2sim's own code, libraries, the processor."""
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
