"""The detectors of a run, from its settings or handed over by a program, and what earlier runs found with them.

The key of what is kept of a first pass, a few ticks at a time, or of a whole stage holds the content of the records, where
the sensors were, what was asked for and the code; the detectors say by a `cache_key` what their results depend on besides.
"""

from __future__ import annotations

import hashlib
import platform
import re
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import scipy

from log2sim.config import AUTO, GIVEN_PREFIX, LIDAR_PREFIX, Config
from log2sim.datatypes import Labels, Log, Stream, Sweep
from log2sim.errors import ConfigError, RecordError
from log2sim.files import plugins
from log2sim.files.cache import DiskCache, detection_folder
from log2sim.files.packing import digest_of, pack, unpack
from log2sim.files.plugins import DETECT_IN_CLOUD, find_call_defect
from log2sim.files.stages import StageClock
from log2sim.geometry import Camera
from log2sim.perception.cooperative import create_for_ends
from log2sim.perception.detect.detectors import (
    CheckedDetector,
    Detector,
    FunctionDetector,
    create_detector,
)
from log2sim.perception.detect.onnx_detector import OnnxDetector
from log2sim.perception.detect3d.detectors import CheckedLidarDetector, LidarDetector, create_lidar_detector

KEY_BYTES = 16
MAX_NAME_CHARACTERS = 48
# Modules between a record and what is kept of it; a change of any makes other keys, so that no version has to be raised.
SOURCES = ("datatypes/*.py", "files/packing.py", "geometry/*.py", "logs/**/*.py", "perception/**/*.py", "plan.py")
STAGE_SOURCES = (*SOURCES, "localization/*.py", "road/*.py", "road/weights/*.onnx")

Made = TypeVar("Made")


class StageCache:
    """What stages of earlier runs made of the records that they read.

    `log`: the opened log, whose streams note what is read. `store`: None to keep nothing. `found`: stages that were known.
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

    def add(self, stages: Iterable[str]) -> None:
        """Add stages that were known in another process of this run."""
        self.found = [*dict.fromkeys([*self.found, *stages])]

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

    def _content(self, records: Collection[tuple[str, int]]) -> str:
        """Return a digest of records."""
        for name, i in records:
            if (name, i) not in self._digests:
                stream = self._streams[name]
                self._digests[name, i] = digest_of_record(stream, i, stream.read)
        return _digest(*(self._digests[name, i].encode() for name, i in records)).hex()


def digest_of_record(stream: Stream, i: int, read: Callable[[int], Any]) -> str:
    """Return a digest of a record: of its file where the log has one, which is not read then, else of what it holds."""
    try:
        return digest_of(read(i)) if stream.encoded is None else _digest(stream.encoded(i)).hex()
    except RecordError as error:
        return _digest(str(error).encode()).hex()


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


EXPECTED = (
    "a function of a picture that returns rows, an object with name, default_min_score and detect(frame) or, for LiDAR "
    "sweeps, with name and detect(cloud, earlier), a name such as 'lidar:vehicle', or a list of one for pictures and one for sweeps"
)

GivenDetector = Callable[..., Any] | Detector | LidarDetector | str


@dataclass(frozen=True, eq=False)
class GivenDetectors:
    """Detectors that were handed over, and the settings that name them."""

    config: Config
    images: Detector | None = None  # searches pictures in place of the one that the settings name
    sweeps: LidarDetector | None = None  # searches clouds in place of the one that the settings name


def sort_detectors(
    given: GivenDetector | list[GivenDetector] | tuple[GivenDetector, ...] | None, config: Config
) -> GivenDetectors:
    """Tell apart what was handed over; it takes the place of `detect.name` in the settings.

    `given`: see `log2sim.reconstruct`.

    Raises `TypeError` when it is none of these, or two are for the same sensors; `PluginError` when a detector lacks
    something.
    """
    if given is None:
        return GivenDetectors(config)
    parts = list(given) if isinstance(given, (list, tuple)) else [given]
    names: dict[str, str] = {}
    images: Detector | None = None
    sweeps: LidarDetector | None = None
    for part in parts:
        detect, label = getattr(part, "detect", None), f"detector '{getattr(part, 'name', type(part).__name__)}'"
        if isinstance(part, str):
            kind, name = "sweeps" if part.startswith(LIDAR_PREFIX) else "images", part
        # Detectors for pictures have a default score, and their `detect` takes one frame.
        elif (
            callable(detect)
            and not hasattr(part, "default_min_score")
            and not find_call_defect(detect, DETECT_IN_CLOUD)
        ):
            sweeps = CheckedLidarDetector(part, label)
            kind, name = "sweeps", f"{LIDAR_PREFIX}{GIVEN_PREFIX}{sweeps.name}"
        else:
            if hasattr(part, "detect"):
                images = CheckedDetector(part, label)
            elif callable(part):
                of_function = str(getattr(part, "__name__", type(part).__name__)).strip("<>")
                searching = FunctionDetector(part, config.detect.min_score, of_function)
                images = CheckedDetector(searching, f"detector '{of_function}'")
            else:
                raise TypeError(f"detector: a {type(part).__name__}, expected {EXPECTED}")
            kind, name = "images", f"{GIVEN_PREFIX}{images.name}"
        if kind in names:
            raise TypeError(f"detector: two for {kind}, {names[kind]} and {name}; expected {EXPECTED}")
        names[kind] = name
    if not names:
        raise TypeError(f"detector: an empty list, expected {EXPECTED}")
    joined = "+".join(names[kind] for kind in ("images", "sweeps") if kind in names)
    return GivenDetectors(config.changed(detect={"name": joined}), images, sweeps)


@dataclass(frozen=True, eq=False)
class Detectors:
    """The detectors of a run."""

    images: Detector | None  # searches the frames of all cameras
    sweeps: LidarDetector | None  # searches the clouds
    cache: FirstPassCache | None = None  # the first pass of earlier runs with these detectors

    @property
    def own(self) -> bool:
        """Whether both are detectors of log2sim itself."""
        return not isinstance(self.images, CheckedDetector) and not isinstance(self.sweeps, CheckedLidarDetector)

    def search_tiles(self, cameras: Iterable[Camera]) -> bool:
        """Whether several tiles of the pictures of one of the cameras are searched besides the whole picture."""
        images = self.images
        return isinstance(images, OnnxDetector) and any(
            len(images.tiles_of(c.width_px, c.height_px)) > 2 for c in cameras
        )

    @property
    def name(self) -> str:
        """Names of both, joined by +."""
        return "+".join(detector.name for detector in (self.images, self.sweeps) if detector is not None)


def create_detectors(log: Log, config: Config, given: GivenDetectors, *, store: DiskCache | None = None) -> Detectors:
    """Create the detectors that the settings name, but for those that were given.

    `store`: where what earlier runs of the first pass found is taken from, and kept.
    """
    images = given.images or create_image_detector(log, config) if config.detect.in_images else None
    sweeps = create_for_ends(log, config, given.sweeps) if config.detect.in_sweeps else None
    return Detectors(images, sweeps, open_cache(store, images, sweeps))


def create_image_detector(log: Log, config: Config) -> Detector:
    """Create the detector in images that the settings name."""
    return create_detector(
        config.detect.in_images,
        log,
        min_score=config.detect.min_score or None,
        tiles=config.detect.tiles or "auto",
        layout=config.detect.layout or None,
        input_px=config.detect.input_px or None,
    )


def check_detectors(config: Config) -> None:
    """Refuse detectors that could search no log: unknown ones, missing or unusable files, settings that do not fit them.

    Those of other packages are imported but not made, since they may look at the log.

    Raises `ConfigError`, `MissingExtra`, `PluginError` as the run of a log would.
    """
    # A log without sensors and with no box in its labels, so that `labels` takes it.
    none, words = np.zeros(0), np.zeros(0, np.str_)
    labels = Labels(np.zeros(0, np.int64), words, words, np.zeros((0, 3)), np.zeros((0, 3)), none)
    log = Log("none", "none", {}, {}, {}, labels=labels)
    images, sweeps = config.detect.in_images, {config.detect.in_sweeps, config.cooperation.road_detector}
    if images not in ("", AUTO):
        if _is_of_another_package("detector", images):
            plugins.load("detector", images)
        else:
            create_image_detector(log, config)
    for name in sorted(sweeps - {"", AUTO}):
        plain = name.removeprefix(LIDAR_PREFIX)
        if plain != name and _is_of_another_package("lidar_detector", plain):
            plugins.load("lidar_detector", plain)
        else:
            create_lidar_detector(name, log, config.lidar)


def _is_of_another_package(kind: str, name: str) -> bool:
    return not plugins.is_built_in(kind, name) and name in plugins.names(kind)
