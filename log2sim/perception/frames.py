"""Camera frames: records read, images decoded, detections in every frame, and a second look at pictures."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections, Frame, Log, Sweep
from log2sim.errors import LogError, RecordError
from log2sim.files.arrays import ArrayFile, ArrayList
from log2sim.files.stages import StageClock
from log2sim.perception.detect.detectors import Detector, detect_all
from log2sim.perception.detection_cache import MAX_CROPS, DetectionCache, LightBox, PictureFindings, crop_lights
from log2sim.perception.records import RecordWatch, Thumbnail, shrink
from log2sim.perception.sync import Schedule
from log2sim.plan import Plan, Stage

Item = TypeVar("Item")
Out = TypeVar("Out")

BACKGROUND_THREADS = 2
# Results that are made ahead of the one in use, which bounds the memory.
AHEAD = 6


def work_ahead(work: Callable[[Item], Out], items: Iterable[Item], ahead: int = AHEAD) -> Iterator[Out]:
    """Yield what `work` makes of each item, in their order, made a few ahead by threads.

    Reading, decompressing and arithmetic on arrays leave the interpreter to others meanwhile.
    """
    waiting: deque[Future[Out]] = deque()
    pool = ThreadPoolExecutor(BACKGROUND_THREADS)
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        # Without waiting: an iterator that is left early may be closed by the garbage collector, in any thread, while that
        # thread holds a lock that ending threads need.
        pool.shutdown(wait=False, cancel_futures=True)


# Of a frame that is not decoded.
EMPTY: Thumbnail = np.zeros((0, 0), np.float32)


class RecordReader:
    """Read records of a log and count those that cannot be read; safe to share between threads.

    Attributes
    ----------
    log : Log
    read : dict of str to int
        How many records of each stream were read.
    failed : dict of str to list of str
        Messages of the records that could not be read, by stream.
    watch : RecordWatch
        Which of them repeat others or show nothing.
    """

    def __init__(self, log: Log) -> None:
        self.log = log
        self.read: dict[str, int] = {}
        self.failed: dict[str, list[str]] = {}
        self.watch = RecordWatch(log)
        self._lock = threading.Lock()

    def get(self, stream: str, index: int) -> Any | None:
        """Read a record; None when it cannot be read."""
        try:
            record = self.log.streams[stream].read(index)
            if isinstance(record, Sweep) and not len(record.xyz_m):
                raise RecordError(f"sweep at stamp {record.stamp_ns} has no finite point")
        except RecordError as error:
            with self._lock:
                problems = self.failed.setdefault(stream, [])
                if str(error) not in problems:  # a record that is asked for again fails again
                    problems.append(str(error))
            return None
        self.count(stream)
        return record

    def count(self, stream: str) -> None:
        """Count a record of a stream as read, also one whose content is known already."""
        with self._lock:
            self.read[stream] = self.read.get(stream, 0) + 1

    def require_some(self) -> None:
        """Require that every stream of which records were requested gave at least one.

        Raises
        ------
        LogError
            For a stream of which no requested record could be read.
        """
        for stream, problems in self.failed.items():
            if not self.read.get(stream):
                raise LogError(
                    f"stream '{stream}': none of the {len(problems)} records asked for can be read, "
                    f"the first because {problems[0]}. Mend or remove the stream; `log2sim validate` lists all problems"
                )

    def summary(self) -> dict[str, Any]:
        """Summarize the unreadable records for the report: count and first message by stream."""
        return {s: {"count": len(p), "first": p[0]} for s, p in sorted(self.failed.items())}


class FrameDetector:
    """Detect objects in the camera frames of every tick, tick by tick in order.

    With a `stride` above 1 the detector first runs at every `stride`-th tick; frames between two such ticks are skipped
    for cameras in which both found nothing. An object visible for less than a stride, and only there, is missed. With a
    `picture_stride` above 1 the frames of each camera are searched at every so many ticks, and what is found nowhere else is
    measured as often.

    Attributes
    ----------
    detected : int
        Number of frames in which the detector ran, now or in an earlier run.
    skipped : dict of str to int
        Number of frames skipped, by camera.
    lights : list of LightBox
        Traffic lights in the frames, in the order of the ticks.
    """

    def __init__(
        self, log: Log, schedule: Schedule, detector: Detector, plan: Plan, reader: RecordReader,
        pool: ThreadPoolExecutor, clock: StageClock, cache: DetectionCache | None = None,
    ) -> None:  # fmt: skip
        self._log, self._schedule, self._detector, self._plan = log, schedule, detector, plan
        self._reader, self._pool, self._clock, self._cache = reader, pool, clock, cache
        self._pending: dict[int, dict[str, Detections]] = {}
        self._thumbnails: dict[tuple[str, int], Thumbnail] = {}
        self._lights: dict[tuple[str, int], list[LightBox]] = {}
        self.lights: list[LightBox] = []
        self.detected = 0
        self.skipped: dict[str, int] = {}

    def detections_at(self, tick: int) -> dict[str, Detections]:
        """Return the detections of a tick by camera; must be called for every tick in order.

        A camera is left out where its frame cannot be read, repeats an earlier one, shows nothing, or is not searched: what it
        does not show may be there.
        """
        last, stride = len(self._schedule) - 1, self._plan.detector_stride
        if self._plan.picture_stride > 1:
            self._pending[tick] = self._detect(tick, self._cameras_due(tick))
        elif tick not in self._pending:
            self._pending[tick] = self._detect(tick, self._plan.cameras)
        if stride > 1 and tick < last and tick % stride == 0:
            self._detect_between(tick, min(tick + stride, last))
        found = self._pending.pop(tick)
        live = {camera: boxes for camera, boxes in found.items() if self._is_live(camera, tick, boxes)}
        for camera in found:
            lights = self._lights.pop((camera, tick), [])
            if camera in live and len(self.lights) < MAX_CROPS:
                self.lights += lights
        return live

    def _cameras_due(self, tick: int) -> list[str]:
        """Return the cameras whose frames are searched at a tick: they take turns, so that each tick takes as long."""
        stride, due = self._plan.picture_stride, list[str]()
        for k, camera in enumerate(self._plan.cameras):
            if (tick + k) % stride == 0:
                due.append(camera)
            elif self._schedule.frames[camera][tick] >= 0:
                self.skipped[camera] = self.skipped.get(camera, 0) + 1
        return due

    def _is_live(self, camera: str, tick: int, found: Detections) -> bool:
        """Return whether a frame shows what is there; nothing is said of frames that are not decoded."""
        if not self._plan.keeps(Stage.IMAGE_DECODING):
            return True
        watch, thumbnail = self._reader.watch.cameras[camera], self._thumbnails.pop((camera, tick), None)
        t_ns = int(self._log.streams[camera].t_ns[self._schedule.frames[camera][tick]])
        state = (
            watch.assume_unchanged(t_ns) if thumbnail is None else watch.judge(t_ns, thumbnail, found=len(found) > 0)
        )
        return state == "live"

    def _detect_between(self, start: int, end: int) -> None:
        """Detect at the tick `end` and at those before it, except in cameras that are empty at `start` and `end`."""
        self._pending[end] = self._detect(end, self._plan.cameras)
        ends = self._pending[start], self._pending[end]
        empty = {c for c in self._plan.cameras if all(c in found and not len(found[c]) for found in ends)}
        for tick in range(start + 1, end):
            self._pending[tick] = self._detect(tick, [c for c in self._plan.cameras if c not in empty])
            for camera in sorted(empty):
                if self._schedule.frames[camera][tick] >= 0:
                    self._pending[tick][camera] = Detections.empty()
                    self.skipped[camera] = self.skipped.get(camera, 0) + 1

    def _detect(self, tick: int, cameras: Iterable[str]) -> dict[str, Detections]:
        """Search a tick's frames by camera; unreadable frames are left out."""
        frames, found = self._frames(tick, cameras), dict[str, PictureFindings]()
        with self._clock.stage("detect"):
            keys = self._recall(frames, found)
        self._search({name: frame for name, frame in frames.items() if name not in found}, keys, found)
        self.detected += len(found)
        for name in frames:
            if name in found:
                if found[name].thumbnail.size:
                    self._thumbnails[name, tick] = found[name].thumbnail
                self._lights[name, tick] = list(found[name].lights)
        return {name: found[name].detections for name in frames if name in found}

    def _recall(self, frames: dict[str, Frame], found: dict[str, PictureFindings]) -> dict[str, bytes | None]:
        """Add what the cache knows of frames to `found`; returns the keys of all frames."""
        cache = self._cache
        if cache is None:
            return {}
        keys = dict(zip(frames, self._pool.map(cache.key_of, frames.values())))
        for name, key in keys.items():
            findings = None if key is None else cache.get(key, frames[name])
            if findings is not None:
                found[name] = findings
                self._reader.count(name)
        cache.found += sum(name in found for name in keys)
        return keys

    def _search(
        self, frames: dict[str, Frame], keys: dict[str, bytes | None], found: dict[str, PictureFindings]
    ) -> None:
        """Run the detector on frames, all of which decode in parallel, and add to `found` what it finds."""
        thumbnails: dict[str, Thumbnail | None] = dict.fromkeys(frames, EMPTY)
        if self._plan.keeps(Stage.IMAGE_DECODING):
            with self._clock.stage("decode"):
                thumbnails = dict(zip(frames, self._pool.map(_thumbnail_of, frames.values())))
        with self._clock.stage("detect"):
            readable = {name: frame for name, frame in frames.items() if thumbnails[name] is not None}
            searched = detect_all(self._detector, list(readable.values()))
            for (name, frame), boxes in zip(readable.items(), searched, strict=True):
                lights, thumbnail = boxes.traffic_lights, thumbnails[name]
                cut = crop_lights(name, frame.t_ns, frame.image(), lights) if len(lights) else []
                found[name] = PictureFindings(boxes, EMPTY if thumbnail is None else thumbnail, tuple(cut))
                key = keys.get(name)
                if self._cache is not None and key is not None:
                    self._cache.put(key, found[name])

    def _frames(self, tick: int, cameras: Iterable[str]) -> dict[str, Frame]:
        frames = {}
        for name in cameras:
            index, stream = int(self._schedule.frames[name][tick]), self._log.streams[name]
            if index >= 0:
                encoded = None if stream.encoded is None else partial(stream.encoded, index)
                image = _LazyImage(self._reader, name, index)
                frames[name] = Frame(self._log.cameras[name], int(stream.t_ns[index]), image, encoded)
        return frames


class _LazyImage:
    """An image that is decoded at the first call and kept."""

    def __init__(self, reader: RecordReader, stream: str, index: int) -> None:
        self._reader, self._stream, self._index = reader, stream, index
        self._image: NDArray[np.uint8] | None = None

    def __call__(self) -> NDArray[np.uint8]:
        if self._image is None:
            image = self._reader.get(self._stream, self._index)
            if image is None:
                raise RecordError(f"{self._stream}: frame {self._index} cannot be read")
            self._image = image
        return self._image


def _thumbnail_of(frame: Frame) -> Thumbnail | None:
    """Decode a frame and return a small copy; None where it cannot be read."""
    try:
        return shrink(frame.image())
    except RecordError:
        return None


# Columns of a sweep with a row a point.
COLUMNS = ("xyz_m", "t_ns", "intensity")


class KeepingReader(RecordReader):
    """Read records; the first `most` sweeps are kept in an `ArrayFile`, from where they come in milliseconds."""

    def __init__(self, log: Log, most: int) -> None:
        super().__init__(log)
        self._most = most
        self._kept: dict[tuple[str, int], tuple[Sweep, list[str], ArrayList]] = {}
        self._file = ArrayFile()

    def get(self, stream: str, index: int) -> Any | None:
        """Read a record, or take it from those that are kept; None when it cannot be read."""
        kept = self._kept.get((stream, index))
        if kept is not None:
            head, names, columns = kept
            read: dict[str, Any] = dict(zip(names, columns, strict=True))
            return replace(head, **read)
        record = super().get(stream, index)
        if isinstance(record, Sweep) and len(self._kept) < self._most:
            self._keep((stream, index), record)
        return record

    def forget(self) -> None:
        """Let go of all sweeps, and keep no more."""
        self._most = 0
        self._kept.clear()
        self._file = ArrayFile()

    def _keep(self, key: tuple[str, int], sweep: Sweep) -> None:
        names = [name for name in COLUMNS if getattr(sweep, name) is not None]
        columns = ArrayList([self._file.keep(getattr(sweep, name)) for name in names])
        empty: dict[str, Any] = {name: getattr(sweep, name)[:0].copy() for name in names}
        head = replace(sweep, **empty)
        self._kept[key] = head, names, columns


class PictureConsumer(Protocol):
    """Something that is read from pictures."""

    def frames(self) -> Mapping[str, NDArray[np.int64]]:
        """Return the indices of the frames that it wants, by camera."""
        ...

    def add(self, camera: str, index: int, image_bgr: NDArray[np.uint8]) -> None:
        """Take a picture (H, W, 3); pictures come in the order of their stamps and are not to be changed."""
        ...


def look_again(
    log: Log,
    reader: RecordReader,
    consumers: Sequence[PictureConsumer],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Give every consumer the pictures that it wants; return how many were decoded.

    Pictures that cannot be read, that are black, or that repeat an earlier one are left out.
    """
    wanted = [consumer.frames() for consumer in consumers]
    takers: dict[tuple[str, int], list[PictureConsumer]] = {}
    for consumer, frames in zip(consumers, wanted, strict=True):
        for camera, indices in frames.items():
            for index in np.unique(indices).tolist():
                takers.setdefault((camera, index), []).append(consumer)
    order = sorted(takers, key=lambda key: (int(log.streams[key[0]].t_ns[key[1]]), key[0]))
    for done, (camera, index, image, thumbnail) in enumerate(_decoded(reader, order)):
        stamp_ns = int(log.streams[camera].t_ns[index])
        if image is not None and reader.watch.cameras[camera].judge(stamp_ns, thumbnail) == "live":
            for consumer in takers[camera, index]:
                consumer.add(camera, index, image)
        progress(done + 1, len(order))
    return len(order)


def _decoded(
    reader: RecordReader, order: Sequence[tuple[str, int]]
) -> Iterator[tuple[str, int, NDArray[np.uint8] | None, Thumbnail]]:
    """Yield camera, index, picture (None where it cannot be read) and thumbnail, decoded a few ahead in threads."""

    def decode(key: tuple[str, int]) -> tuple[str, int, NDArray[np.uint8] | None, Thumbnail]:
        image = reader.get(*key)
        return *key, image, np.zeros((0, 0), np.float32) if image is None else shrink(image)

    return work_ahead(decode, order)
