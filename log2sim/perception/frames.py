"""Camera frames: detections in every frame, traffic lights cut out of them, and a second look at pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections, Frame, Log, Turn
from log2sim.errors import RecordError
from log2sim.files.stages import StageClock
from log2sim.geometry import Array
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.detect.onnx_detector import OnnxDetector
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.projection import View, project_points
from log2sim.perception.records import RecordSource, Thumbnail, shrink
from log2sim.perception.sync import Schedule
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
    """A traffic light in one frame."""

    camera: str
    t_ns: int  # stamp of the frame
    box_px: Array  # (4,): u0, v0, u1, v1
    score: float
    crop: NDArray[np.uint8]  # (h, w, 3): the picture there, BGR
    range_m: float = float("nan")  # distance of LiDAR points in the box from the camera, NaN without any


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
        others = np.array([light.box_px for light in out]).reshape(-1, 4)
        common = np.clip(np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2]), 0, None).prod(axis=1)
        smaller = np.minimum((box[2:] - box[:2]).prod(), (others[:, 2:] - others[:, :2]).prod(axis=1))
        if (common / smaller > MAX_OVERLAP).any():
            continue
        du, dv = MARGIN * (u1 - u0), MARGIN * (v1 - v0)
        left, top, right, bottom = round(u0 - du), round(v0 - dv), round(u1 + du) + 1, round(v1 + dv) + 1
        crop = image_bgr[max(top, 0) : bottom, max(left, 0) : right]
        scale = min(1.0, MAX_CROP_PX / max(crop.shape[:2]))
        small = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else crop.copy()
        out.append(LightBox(camera, t_ns, box, score, np.asarray(small, np.uint8)))
    return out


def add_ranges(lights: Sequence[LightBox], view: View, cloud: Cloud) -> list[LightBox]:
    """Return the traffic lights of a frame with the distance of the points in the middle of each, if there are some of a housing."""
    if not lights:
        return []
    high = np.flatnonzero(cloud.height > MIN_HEIGHT_M)
    visible = project_points(view, cloud.origin, cloud.columns.take(high, axis=1))
    out = []
    for light in lights:
        middle, reach = (light.box_px[:2] + light.box_px[2:]) / 2, (light.box_px[2:] - light.box_px[:2]) * MIDDLE / 2
        inside = (np.abs(visible.u - middle[0]) <= reach[0]) & (np.abs(visible.v - middle[1]) <= reach[1])
        points = cloud.xyz[high[visible.index[inside]]] + cloud.origin - view.map_T_cam[:3, 3]
        away = np.linalg.norm(points, axis=1)
        front = away[away < away.min(initial=np.inf) + HOUSING_DEPTH_M]
        out.append(replace(light, range_m=float(np.median(front))) if len(front) >= MIN_POINTS else light)
    return out


# Of a picture: objects, the copy (h, w) by which it is compared with others, None where it was not decoded, and lights.
PictureFindings = tuple[Detections, Thumbnail | None, tuple[LightBox, ...]]


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

    def search(
        self, tick: int, reader: RecordSource, clock: StageClock, watched_px: Mapping[str, Array]
    ) -> dict[str, PictureFindings | None]:
        """Search the frames of a tick by camera; None for one that is skipped.

        Ticks come in order, from one that a stride divides. `watched_px`: boxes (K, 4) by camera whose tiles are searched at
        every tick. A camera is left out where it has no frame or its frame cannot be read.
        """
        plan, last = self._plan, len(self._schedule) - 1
        look = partial(self._look, reader=reader, clock=clock, watched_px=watched_px)
        self._known = {key: found for key, found in self._known.items() if key[1] >= tick}
        recorded = [camera for camera in plan.cameras if self._schedule.frames[camera][tick] >= 0]
        if plan.picture_stride > 1:  # cameras take turns, so that each tick takes as long
            turn = (tick + np.arange(len(plan.cameras))) % plan.picture_stride == 0
            self._empty = {camera for camera, due in zip(plan.cameras, turn) if not due}
        elif plan.detector_stride > 1 and tick % plan.detector_stride == 0:
            empty = [c for c, found in look(tick, recorded).items() if not len(found[0])]
            ahead = min(tick + plan.detector_stride, last)
            seen = look(ahead, empty) if ahead > tick + 1 else {}
            self._empty = {camera for camera, found in seen.items() if not len(found[0])}
        starts = plan.picture_stride == 1 and (tick % plan.detector_stride == 0 or tick == last)
        skipped = [] if starts else [camera for camera in recorded if camera in self._empty]
        found = look(tick, [camera for camera in recorded if camera not in skipped])
        return {camera: found.get(camera) for camera in recorded if camera in found or camera in skipped}

    def _look(
        self,
        tick: int,
        cameras: Iterable[str],
        *,
        reader: RecordSource,
        clock: StageClock,
        watched_px: Mapping[str, Array],
    ) -> dict[str, PictureFindings]:
        """Search a tick's frames of some cameras, each once; those that have none or cannot be read are left out."""
        frames, thumbnails = dict[str, Frame](), dict[str, Thumbnail]()
        # Where the stride is even, its multiples take turns, too: between them frames may be skipped.
        stride = self._plan.detector_stride
        number = tick if stride % 2 else tick + tick // stride
        for name in cameras:
            index, stream = int(self._schedule.frames[name][tick]), self._log.streams[name]
            if index >= 0 and (name, tick) not in self._known:
                encoded = None if stream.encoded is None else partial(stream.encoded, index)
                image = cache(partial(reader.require, name, index))  # decoded at the first call
                watched = watched_px.get(name, np.zeros((0, 4)))
                turn = Turn(number, watched) if self._plan.tiles_by_turns else None
                frames[name] = Frame(self._log.cameras[name], int(stream.t_ns[index]), image, encoded, turn)
        if self._plan.keeps(Stage.IMAGE_DECODING):
            with clock.stage("decode"):
                for name, frame in frames.items():
                    with suppress(RecordError):
                        thumbnails[name] = shrink(frame.image())
            self._known |= {(name, tick): None for name in frames if name not in thumbnails}
            frames = {name: frame for name, frame in frames.items() if name in thumbnails}
        with clock.stage("detect"):
            detector, wanted = self._detector, list(frames.values())
            if isinstance(detector, OnnxDetector):  # at once, in less time than one after the other
                searched = detector.detect_many(wanted)
            else:
                searched = [detector.detect(frame) for frame in wanted]
            for (name, frame), boxes in zip(frames.items(), searched, strict=True):
                lights = boxes.traffic_lights
                cut = crop_lights(name, frame.t_ns, frame.image(), lights) if len(lights) else []
                self._known[name, tick] = (boxes, thumbnails.get(name), tuple(cut))
        return {name: found for name in cameras if (found := self._known.get((name, tick))) is not None}


def read_pictures(
    records: RecordSource,
    wanted: Mapping[str, NDArray[np.int64]],
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    least_px: int = MAX_WIDTH_PX,
) -> Iterator[tuple[str, int, NDArray[np.uint8]]]:
    """Yield camera, index and picture (H, W, 3) of the wanted frames, indices by camera, each once and in the order of the stamps.

    Pictures that cannot be read, that are black, or that repeat an earlier one are left out, as they were judged before, or
    else now. They are decoded a few ahead in threads, see `RecordSource.picture` for `least_px`.
    """
    streams = records.log.streams
    order = [(name, index) for name, indices in wanted.items() for index in np.unique(indices).tolist()]
    order.sort(key=lambda key: (int(streams[key[0]].t_ns[key[1]]), key[0]))
    images = work_ahead(lambda key: records.picture(*key, least_px), order)
    for done, ((camera, index), image) in enumerate(zip(order, images, strict=True)):
        if image is not None and records.watch.is_live(camera, int(streams[camera].t_ns[index]), image):
            yield camera, index, image
        progress(done + 1, len(order))
