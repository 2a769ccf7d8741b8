"""Detections found once and used by every run: each frame is decoded once and goes through all detectors in turn."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections, Frame, Log
from log2sim.errors import RecordError
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.frames import RecordReader
from log2sim.perception.sync import Schedule


@dataclass(frozen=True, eq=False)
class Remembered:
    """A `Detector` that answers from what another has found; what was never asked or could not be read is empty.

    `seconds` is what the other needed for all of it.
    """

    name: str
    default_min_score: float
    found: dict[tuple[str, int], Detections] = field(default_factory=dict)
    spent_s: list[float] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Time that the detector took for all frames, s."""
        return sum(self.spent_s)

    def remember(self, detector: Detector, frame: Frame) -> None:
        """Ask a detector for the boxes of one frame."""
        begin = time.perf_counter()
        boxes = detector.detect(frame)
        self.spent_s.append(time.perf_counter() - begin)
        self.found[frame.camera.name, frame.t_ns] = boxes

    def detect(self, frame: Frame) -> Detections:
        """Boxes of one frame, from memory."""
        return self.found.get((frame.camera.name, frame.t_ns), Detections.empty())


def detect_once(
    log: Log,
    schedule: Schedule,
    detectors: Mapping[str, Detector],
    *,
    decode: bool,
    progress: Callable[[int, int], None],
) -> tuple[dict[str, Remembered], float]:
    """Run every detector on every frame of a schedule once.

    Detectors take turns on each frame, so that a machine that slows down slows all of them.

    Returns
    -------
    dict, float
        What each found, by the same names, and the seconds that decoding took.

    Raises
    ------
    LogError
        When no frame of a camera can be read.
    """
    memory = {key: Remembered(d.name, d.default_min_score) for key, d in detectors.items()}
    records, decoding_s = RecordReader(log), 0.0
    for tick in range(len(schedule)):
        for camera, index in schedule.frames.items():
            if index[tick] < 0:
                continue
            begin = time.perf_counter()
            image = records.get(camera, int(index[tick])) if decode else None
            decoding_s += time.perf_counter() - begin
            if decode and image is None:
                continue
            frame = Frame(log.cameras[camera], int(log.streams[camera].t_ns[index[tick]]), partial(_decoded, image))
            for key, detector in detectors.items():
                memory[key].remember(detector, frame)
        progress(tick + 1, len(schedule))
    records.require_some()
    return memory, decoding_s


def _decoded(image: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    if image is None:
        raise RecordError("a detector asked for an image that was not decoded, since no detector was known to need one")
    return image
