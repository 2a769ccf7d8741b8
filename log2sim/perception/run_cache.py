"""What earlier runs found: the first pass, a few ticks at a time, and what whole stages made of the records that they read.

The key holds the content of the records, where the sensors were, what was asked for and the code; the detectors say by a
`cache_key` what their results depend on besides.
"""

from __future__ import annotations

import hashlib
import platform
import re
from collections.abc import Callable, Collection, Iterable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import scipy

from log2sim.datatypes import Log, Stream, Sweep
from log2sim.errors import ConfigError, RecordError
from log2sim.files.cache import DiskCache, detection_folder
from log2sim.files.packing import digest_of, pack, unpack
from log2sim.files.stages import StageClock
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.detect3d.detectors import LidarDetector

KEY_BYTES = 16
MAX_NAME_CHARACTERS = 48
# Modules of log2sim between a record and what is kept of it, relative to the package; a change of any of them makes other
# keys, so that nobody has to remember to raise a version.
SOURCES = ("datatypes/*.py", "files/packing.py", "geometry/*.py", "logs/**/*.py", "perception/**/*.py", "plan.py")
STAGE_SOURCES = (*SOURCES, "localization/*.py", "road/*.py", "road/weights/*.onnx")

Made = TypeVar("Made")


class StageCache:
    """What stages of earlier runs made of the records that they read.

    `log`: the opened log, which a run goes on with: its streams note what is read of them. `store`: None to keep nothing.
    `found`: stages that were known.
    """

    def __init__(self, log: Log, store: DiskCache | None, clock: StageClock) -> None:
        self._store, self._clock, self._streams = store, clock, log.streams
        self._read: set[tuple[str, int]] | None = None
        self._digests: dict[tuple[str, int], str] = {}
        self._failed = False
        self.found: list[str] = []
        self.log = log if store is None else log.changed(streams={n: self._noting(s) for n, s in log.streams.items()})

    def known(self, stage: str, log: Log, of: Any, classes: Collection[type], make: Callable[[], Made]) -> Made:
        """Return what `make` returns, or what it returned in an earlier run if the records that it read then are the same.

        `log`: as the stage gets it; `of`: all that the result depends on besides, and `classes`: of which it is made.
        What met a record that cannot be read is not kept, so that every run tells it.
        """
        if self._store is None:
            return make()
        with self._clock.stage("recall"):
            software = software_key(STAGE_SOURCES).encode()
            stamps = [log.streams[name].t_ns for name in (*log.cameras, *log.lidars)]
            about = [log.ground_z_ego_m, log.reference_camera, *stamps]
            key = [_sensors(self.log), _sensors(log), about, of]
            name = f"{stage}.{_digest(software).hex()[:8]}.{_digest(software, stage.encode(), pack(key)).hex()}"
            try:
                whose, records, content, value = unpack(self._store.get(name) or b"", classes)
                if whose == name and self._content(records) == content:
                    self.found.append(stage)
                    return value  # type: ignore[no-any-return]
            except (ValueError, TypeError, LookupError):  # nothing, or nothing that this wrote
                pass
        self._read, self._failed = set(), False
        try:
            made = make()
        finally:
            records, self._read = sorted(self._read), None
        if not self._failed:
            with self._clock.stage("recall"):
                self._store.put(name, pack([name, records, self._content(records), made]))
        return made

    def figures(self, first_pass: FirstPassCache | None) -> dict[str, Any] | None:
        """Return what the report says: stages that were known, and ticks of the first pass; None where nothing is kept."""
        if self._store is None:
            return None
        ticks = {"found": 0, "kept": 0, "problem": None} if first_pass is None else first_pass.figures()
        return {**ticks, "problem": ticks["problem"] or self._store.problem, "stages": self.found}

    def _noting(self, stream: Stream) -> Stream:
        """Return a stream that notes what is read of it; several threads may read at once."""

        def noting(take: Callable[[int], Any]) -> Callable[[int], Any]:
            def taken(i: int) -> Any:
                read, key = self._read, (stream.name, int(i))
                if read is None:
                    return take(i)
                read.add(key)
                try:
                    record = take(i)
                except RecordError:
                    self._failed = True
                    raise
                self._failed |= isinstance(record, Sweep) and not len(record.xyz_m)
                if stream.encoded is None and key not in self._digests:
                    self._digests[key] = digest_of(record)
                return record

            return taken

        encoded = None if stream.encoded is None else noting(stream.encoded)
        return Stream(stream.name, lambda: stream.t_ns, noting(stream.read), encoded)

    def _content(self, records: Iterable[tuple[str, int]]) -> str:
        """Return a digest of records: of their files where the log has them, which are not decoded then, else of what they hold."""
        value = hashlib.blake2b(digest_size=KEY_BYTES)
        for name, i in records:
            stream = self._streams[name]
            if (name, i) not in self._digests:
                try:
                    found = digest_of(stream.read(i)) if stream.encoded is None else _digest(stream.encoded(i)).hex()
                except RecordError as error:
                    found = _digest(str(error).encode()).hex()
                self._digests[name, i] = found
            value.update(self._digests[name, i].encode())
        return value.hexdigest()


def _sensors(log: Log) -> list[Any]:
    """Return where the sensors of a log are at any time."""
    return [log.cameras, log.lidars, log.ego, log.ego_vehicle]


class FirstPassCache:
    """Parts of the first pass of runs with one pair of detectors.

    `name`: of the detectors, for people. `cache_key`: all that their results depend on besides the records.
    """

    def __init__(self, store: DiskCache, name: str, cache_key: str) -> None:
        self.store = store  # its `problem` says why nothing more is kept by this process
        self._detectors = _digest(cache_key.encode(), software_key().encode())
        word = re.sub(r"[^A-Za-z0-9_-]+", "-", name)[:MAX_NAME_CHARACTERS] or "detector"
        self._group = f"{word}.{self._detectors.hex()[:8]}"
        self._run = b""
        self.found = self.kept = 0
        self.problem: str | None = None

    def begin(self, log: Log, settings: Any) -> None:
        """Take what all parts of a run depend on: where the sensors are at any time, and settings that can be packed."""
        self._run = _digest(self._detectors, pack([_sensors(log), log.ground_z_ego_m, settings]))

    def get(self, of: bytes, classes: Collection[type]) -> Any | None:
        """Return what was kept of a part by what it depends on besides, None where it is not known."""
        content = self.store.get(self._name_of(of))
        try:
            return None if content is None else unpack(content, classes)
        except ValueError:
            return None

    def put(self, of: bytes, part: Any) -> bool:
        """Keep a part; return whether that succeeded."""
        return self.store.put(self._name_of(of), pack(part))

    def count(self, found: int, kept: int, problem: str | None) -> None:
        """Count ticks of a part, which another process may have made."""
        self.found, self.kept, self.problem = self.found + found, self.kept + kept, self.problem or problem

    def finish(self) -> None:
        """Keep the limit of the cache, and note there what this run did; at the end of a run."""
        self.store.finish({"found": self.found, "kept": self.kept})

    def figures(self) -> dict[str, Any]:
        """Return what the report says: ticks found and kept, and why nothing more was kept."""
        return {"found": self.found, "kept": self.kept, "problem": self.problem}

    def _name_of(self, of: bytes) -> str:
        return f"{self._group}.{_digest(self._run, of).hex()}"


def open_cache(store: DiskCache | None, images: Detector | None, sweeps: LidarDetector | None) -> FirstPassCache | None:
    """Return a cache for detectors; None where one does not say by a `cache_key` what its result depends on."""
    keys = [(d.name, getattr(d, "cache_key", None)) for d in (images, sweeps) if d is not None]
    if store is None or not keys or not all(isinstance(key, str) for _, key in keys):
        return None
    return FirstPassCache(store, "+".join(name for name, _ in keys), "\n".join(str(key) for _, key in keys))


def open_store() -> DiskCache | None:
    """Return the user's cache; None where the user has no home folder."""
    try:
        return DiskCache(detection_folder())
    except ConfigError:
        return None


def _digest(*parts: bytes) -> bytes:
    value = hashlib.blake2b(digest_size=KEY_BYTES)
    for part in parts:
        value.update(len(part).to_bytes(8, "little") + part)
    return value.digest()


@cache
def software_key(sources: Collection[str] = SOURCES) -> str:
    """Return a text that changes with whatever turns records into a result: log2sim's own code, libraries, the processor."""
    import simplejpeg

    package, value = Path(__file__).resolve().parents[1], hashlib.blake2b(digest_size=KEY_BYTES)
    for pattern in sources:
        for source in sorted(package.glob(pattern)):
            value.update(source.read_bytes())
    try:  # the instructions that the processor has: libraries choose their code by them, and sums differ in the last bits
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # not on Linux
        lines = []
    instructions = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    versions = (library.__version__ for library in (np, scipy, cv2, simplejpeg))
    return "\n".join((value.hexdigest(), *versions, platform.machine(), instructions))
