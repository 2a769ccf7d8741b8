"""Camera frames: detections in every frame, and a second look at pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections, Frame, Log
from log2sim.errors import RecordError
from log2sim.files.stages import StageClock
from log2sim.perception.detect.detectors import Detector, detect_all
from log2sim.perception.records import RecordSource, Thumbnail, shrink
from log2sim.perception.sync import Schedule
from log2sim.perception.traffic_light_boxes import LightBox, crop_lights
from log2sim.plan import Plan, Stage

Item = TypeVar("Item")
Out = TypeVar("Out")

BACKGROUND_THREADS = 2
# More than any picture has, for whole ones.
MAX_WIDTH_PX = 1 << 16
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


@dataclass(frozen=True, eq=False)
class PictureFindings:
    """What a run takes from a picture."""

    detections: Detections
    thumbnail: Thumbnail | None  # (h, w): by which it is compared with other pictures; None where it was not decoded
    lights: tuple[LightBox, ...] = ()  # traffic lights, cut out


class FrameDetector:
    """Detect objects in the camera frames of successive ticks.

    With a `stride` above 1 the detector first runs at every `stride`-th tick; frames between two such ticks are skipped
    for cameras in which both found nothing. An object visible for less than a stride, and only there, is missed. With a
    `picture_stride` above 1 the frames of each camera are searched at every so many ticks, and what is found nowhere else is
    measured as often.
    """

    def __init__(self, log: Log, schedule: Schedule, detector: Detector, plan: Plan) -> None:
        self._log, self._schedule, self._detector, self._plan = log, schedule, detector, plan
        self._empty = set[str]()
        self._known: dict[tuple[str, int], PictureFindings | None] = {}

    def search(self, tick: int, reader: RecordSource, clock: StageClock) -> dict[str, PictureFindings | None]:
        """Search the frames of a tick by camera; None for one that is skipped.

        Ticks come in order, from one that a stride divides. A camera is left out where it has no frame or its frame cannot be
        read.
        """
        plan, last = self._plan, len(self._schedule) - 1
        self._known = {key: found for key, found in self._known.items() if key[1] >= tick}
        recorded = [camera for camera in plan.cameras if self._schedule.frames[camera][tick] >= 0]
        if plan.picture_stride > 1:  # cameras take turns, so that each tick takes as long
            turn = (tick + np.arange(len(plan.cameras))) % plan.picture_stride == 0
            self._empty = {camera for camera, due in zip(plan.cameras, turn) if not due}
        elif plan.detector_stride > 1 and tick % plan.detector_stride == 0:
            empty = [c for c, found in self._look(tick, recorded, reader, clock).items() if not len(found.detections)]
            ahead = min(tick + plan.detector_stride, last)
            seen = self._look(ahead, empty, reader, clock) if ahead > tick + 1 else {}
            self._empty = {camera for camera, found in seen.items() if not len(found.detections)}
        starts = plan.picture_stride == 1 and (tick % plan.detector_stride == 0 or tick == last)
        skipped = [] if starts else [camera for camera in recorded if camera in self._empty]
        found = self._look(tick, [camera for camera in recorded if camera not in skipped], reader, clock)
        return {camera: found.get(camera) for camera in recorded if camera in found or camera in skipped}

    def _look(
        self, tick: int, cameras: Iterable[str], reader: RecordSource, clock: StageClock
    ) -> dict[str, PictureFindings]:
        """Search a tick's frames of some cameras, each once; those that have none or cannot be read are left out."""
        frames, thumbnails = dict[str, Frame](), dict[str, Thumbnail]()
        for name in cameras:
            index, stream = int(self._schedule.frames[name][tick]), self._log.streams[name]
            if index >= 0 and (name, tick) not in self._known:
                encoded = None if stream.encoded is None else partial(stream.encoded, index)
                image = cache(partial(reader.require, name, index))  # decoded at the first call
                frames[name] = Frame(self._log.cameras[name], int(stream.t_ns[index]), image, encoded)
        if self._plan.keeps(Stage.IMAGE_DECODING):
            with clock.stage("decode"):
                for name, frame in frames.items():
                    with suppress(RecordError):
                        thumbnails[name] = shrink(frame.image())
            self._known |= {(name, tick): None for name in frames if name not in thumbnails}
            frames = {name: frame for name, frame in frames.items() if name in thumbnails}
        with clock.stage("detect"):
            searched = detect_all(self._detector, list(frames.values()))
            for (name, frame), boxes in zip(frames.items(), searched, strict=True):
                lights = boxes.traffic_lights
                cut = crop_lights(name, frame.t_ns, frame.image(), lights) if len(lights) else []
                self._known[name, tick] = PictureFindings(boxes, thumbnails.get(name), tuple(cut))
        return {name: found for name in cameras if (found := self._known.get((name, tick))) is not None}


class PictureConsumer(Protocol):
    """Something that is read from pictures."""

    def frames(self) -> Mapping[str, NDArray[np.int64]]:
        """Return the indices of the frames that it wants, by camera."""
        ...

    def add(self, camera: str, index: int, image_bgr: NDArray[np.uint8]) -> None:
        """Take a picture (H, W, 3); pictures come in the order of their stamps and are not to be changed."""
        ...


def give_pictures(
    records: RecordSource,
    consumers: Sequence[PictureConsumer],
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    least_px: int = MAX_WIDTH_PX,
) -> int:
    """Give every consumer the pictures that it wants; return how many were decoded.

    Pictures that cannot be read, that are black, or that repeat an earlier one are left out, as they were judged before, or
    else now. They are decoded a few ahead in threads, see `RecordSource.picture` for `least_px`.
    """
    takers: dict[tuple[str, int], list[PictureConsumer]] = {}
    for consumer in consumers:
        for camera, indices in consumer.frames().items():
            for index in np.unique(indices).tolist():
                takers.setdefault((camera, index), []).append(consumer)
    streams = records.log.streams
    order = sorted(takers, key=lambda key: (int(streams[key[0]].t_ns[key[1]]), key[0]))
    images = work_ahead(lambda key: records.picture(*key, least_px), order)
    for done, ((camera, index), image) in enumerate(zip(order, images, strict=True)):
        if image is not None and records.watch.is_live(camera, int(streams[camera].t_ns[index]), image):
            for consumer in takers[camera, index]:
                consumer.add(camera, index, image)
        progress(done + 1, len(order))
    return len(order)
