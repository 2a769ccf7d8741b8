"""Detections shared by all runs: each frame is decoded once and passed to all detectors in turn."""

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
class RecordedDetections:
    """A `Detector` that returns recorded detections; none for a frame that was not recorded.

    Attributes
    ----------
    name : str
    default_min_score : float
    found : dict of (str, int) to Detections
        By camera and stamp.
    spent_s : list of float, s
        Time of the recorded detector for each frame.
    """

    name: str
    default_min_score: float
    found: dict[tuple[str, int], Detections] = field(default_factory=dict)
    spent_s: list[float] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Return the time of the recorded detector for all frames, s."""
        return sum(self.spent_s)

    def record(self, detector: Detector, frame: Frame) -> None:
        """Run a detector on one frame and record the result and its time."""
        begin = time.perf_counter()
        boxes = detector.detect(frame)
        self.spent_s.append(time.perf_counter() - begin)
        self.found[frame.camera.name, frame.t_ns] = boxes

    def detect(self, frame: Frame) -> Detections:
        """Return the recorded boxes of one frame."""
        return self.found.get((frame.camera.name, frame.t_ns), Detections.empty())


def detect_once(
    log: Log,
    schedule: Schedule,
    detectors: Mapping[str, Detector],
    *,
    decode: bool,
    progress: Callable[[int, int], None],
) -> tuple[dict[str, RecordedDetections], float]:
    """Run every detector on every frame of a schedule once.

    Detectors take turns on each frame, so that a change of the machine's speed affects all of them.

    Returns
    -------
    dict, float
        Recorded detections by the same names, and the seconds of decoding.

    Raises
    ------
    LogError
        When no frame of a camera can be read.
    """
    recorded = {key: RecordedDetections(d.name, d.default_min_score) for key, d in detectors.items()}
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
                recorded[key].record(detector, frame)
        progress(tick + 1, len(schedule))
    records.require_some()
    return recorded, decoding_s


def _decoded(image: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    if image is None:
        raise RecordError(
            "a detector needs the image, but no image was decoded because all detectors were expected to need none"
        )
    return image
