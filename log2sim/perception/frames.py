"""What the cameras show: records read, images decoded and detected in, and frames left out between two empty looks."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections, Frame, Log, Sweep
from log2sim.errors import LogError, RecordError
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.sync import Schedule
from log2sim.plan import Plan
from log2sim.stage_clock import StageClock


class Records:
    """Reads records of a log and counts what cannot be read; a stream with nothing readable is an error."""

    def __init__(self, log: Log) -> None:
        self.log = log
        self.read: dict[str, int] = {}
        self.failed: dict[str, list[str]] = {}
        self._lock = threading.Lock()

    def get(self, stream: str, index: int) -> Any | None:
        """The record, or None when it cannot be read."""
        try:
            record = self.log.streams[stream].read(index)
            if isinstance(record, Sweep) and not len(record.xyz_m):
                raise RecordError(f"sweep at stamp {record.stamp_ns} has no finite point")
        except RecordError as error:
            with self._lock:
                self.failed.setdefault(stream, []).append(str(error))
            return None
        with self._lock:
            self.read[stream] = self.read.get(stream, 0) + 1
        return record

    def require_some(self) -> None:
        """Raise `LogError` for a stream of which nothing that was asked for could be read."""
        for stream, problems in self.failed.items():
            if not self.read.get(stream):
                raise LogError(
                    f"stream '{stream}': none of the {len(problems)} records asked for can be read, "
                    f"the first because {problems[0]}. Mend or remove the stream; `log2sim validate` lists all problems"
                )

    def summary(self) -> dict[str, Any]:
        return {s: {"count": len(p), "first": p[0]} for s, p in sorted(self.failed.items())}


class Looker:
    """Detections of every tick, in their order.

    With a `stride` above 1 every camera is looked at every so many ticks; the frames between two looks that both found
    nothing are left out, all others are looked at. What shows for shorter than a stride, and only there, is missed.
    `looked` counts the frames looked at, `left_out` those left out by camera.
    """

    def __init__(
        self, log: Log, schedule: Schedule, detector: Detector, plan: Plan, records: Records,
        pool: ThreadPoolExecutor, clock: StageClock,
    ) -> None:  # fmt: skip
        self._log, self._schedule, self._detector, self._plan = log, schedule, detector, plan
        self._records, self._pool, self._clock = records, pool, clock
        self._found: dict[int, dict[str, Detections]] = {}
        self.looked = 0
        self.left_out: dict[str, int] = {}

    def at(self, tick: int) -> dict[str, Detections]:
        """Detections by camera at a tick; to be called for every tick, in order."""
        last, stride = len(self._schedule) - 1, self._plan.stride
        if tick not in self._found:
            self._found[tick] = self._look(tick, self._plan.cameras)
        if stride > 1 and tick < last and tick % stride == 0:
            self._look_between(tick, min(tick + stride, last))
        return self._found.pop(tick)

    def _look_between(self, start: int, end: int) -> None:
        self._found[end] = self._look(end, self._plan.cameras)
        ends = self._found[start], self._found[end]
        quiet = {c for c in self._plan.cameras if all(c in found and not len(found[c]) for found in ends)}
        for tick in range(start + 1, end):
            self._found[tick] = self._look(tick, [c for c in self._plan.cameras if c not in quiet])
            for camera in sorted(quiet):
                if self._schedule.frames[camera][tick] >= 0:
                    self._found[tick][camera] = Detections.empty()
                    self.left_out[camera] = self.left_out.get(camera, 0) + 1

    def _look(self, tick: int, cameras: Iterable[str]) -> dict[str, Detections]:
        """Detections of a tick's frames; a frame that cannot be read has none. All frames decode at once, ahead."""
        frames = self._frames(tick, cameras)
        if self._plan.keeps("decode images"):
            with self._clock.stage("decode"):
                readable = dict(zip(frames, self._pool.map(_decodes, frames.values())))
            frames = {name: frame for name, frame in frames.items() if readable[name]}
        with self._clock.stage("detect"):
            self.looked += len(frames)
            return {name: self._detector.detect(frame) for name, frame in frames.items()}

    def _frames(self, tick: int, cameras: Iterable[str]) -> dict[str, Frame]:
        """The camera frames of a tick; each decodes its image once, when somebody asks."""
        frames = {}
        for name in cameras:
            index = int(self._schedule.frames[name][tick])
            if index >= 0:
                stamp = int(self._log.streams[name].t_ns[index])
                frames[name] = Frame(self._log.cameras[name], stamp, _Once(self._records, name, index))
        return frames


class _Once:
    """An image that is decoded when first asked for."""

    def __init__(self, records: Records, stream: str, index: int) -> None:
        self._records, self._stream, self._index = records, stream, index
        self._image: NDArray[np.uint8] | None = None

    def __call__(self) -> NDArray[np.uint8]:
        if self._image is None:
            image = self._records.get(self._stream, self._index)
            if image is None:
                raise RecordError(f"{self._stream}: frame {self._index} cannot be read")
            self._image = image
        return self._image


def _decodes(frame: Frame) -> bool:
    try:
        frame.image()
    except RecordError:
        return False
    return True
