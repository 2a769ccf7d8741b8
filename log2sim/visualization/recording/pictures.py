"""Pictures of a log as small JPEGs whose width and rate fit into a budget."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import NS_PER_S, Camera
from log2sim.perception.frames import RecordReader
from log2sim.perception.picture_pass import look_again
from log2sim.visualization.recording.choice import records_within, take_at_rate, take_evenly
from log2sim.visualization.recording.outlines import OutlineProjector

QUALITY = 72
"""Of JPEGs, of 100: at the sizes of a page, blocks are hardly seen."""


class PictureSize(NamedTuple):
    """Width of pictures, px, and how many a second are taken of each camera."""

    width_px: int
    rate_hz: float


SIZES = tuple(
    PictureSize(*size)
    for size in (
        (960, 10), (800, 10), (640, 10), (640, 5), (480, 5), (400, 5), (400, 2), (320, 2), (320, 1), (240, 1), (240, 0.5), (160, 0.5),
        (160, 0.2),
    )
)  # fmt: skip
"""From the best down; the first that fits is taken. Motion is followed at 5 a second, and people are seen at 400 px."""

PROBES = 3
"""Pictures of each camera that are encoded in all sizes, to estimate how many bytes the others will have."""

SAFETY = 1.1
"""By how much a scene may have more bytes than its probes tell; what is still too much is thinned out."""

OUTLINE_BYTES = 100
"""Of an outline in the page: sixteen numbers of up to four digits, mostly."""


@dataclass(eq=False)
class ShrunkPictures:
    """Takes pictures of a log as JPEGs; a `PictureConsumer`.

    Attributes
    ----------
    chosen : mapping of str to (n,) int64
        Indices of the frames by camera.
    width_px : int
        Pictures that are wider are made as wide as this.
    jpeg : dict of str to dict of int to bytes
        Pictures taken so far, by camera and index.
    """

    chosen: Mapping[str, NDArray[np.int64]]
    width_px: int
    jpeg: dict[str, dict[int, bytes]] = field(default_factory=dict)

    def frames(self) -> Mapping[str, NDArray[np.int64]]:
        """Return the indices of the frames that are wanted, by camera."""
        return self.chosen

    def add(self, camera: str, index: int, image_bgr: NDArray[np.uint8]) -> None:
        """Take a picture (H, W, 3)."""
        self.jpeg.setdefault(camera, {})[index] = encode_small(image_bgr, self.width_px)


def encode_small(image_bgr: NDArray[np.uint8], width_px: int) -> bytes:
    """Encode a picture as a JPEG that is at most `width_px` wide."""
    shrink = min(width_px / image_bgr.shape[1], 1.0)
    if shrink < 1:
        height_px = max(round(image_bgr.shape[0] * shrink), 1)
        image_bgr = np.asarray(cv2.resize(image_bgr, (width_px, height_px), interpolation=cv2.INTER_AREA), np.uint8)
    done, data = cv2.imencode(".jpg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1])
    return bytes(data.tobytes()) if done else b""


def text_bytes(count: int) -> int:
    """Return how many bytes of base64 text `count` bytes become."""
    return 4 * -(-count // 3)


def picture_document(
    log: Log,
    scenario: Scenario,
    cameras: tuple[str, ...],
    budget_bytes: int,
    reader: RecordReader,
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Return the pictures of cameras within a budget, with the outlines of the agents in them.

    Parameters
    ----------
    budget_bytes : int
        Of the pictures and outlines as text in a page.

    Returns
    -------
    dict
        "cameras": for each name, size in px, times in s, JPEGs as base64 and outlines; "ahead": which of them looks ahead;
        "agents": ids that outlines refer to;
        "width_px", "rate_hz" and "bytes" as chosen. Cameras without a picture during the scenario are left out.

    Raises
    ------
    ConfigError
        When not even one small picture of each camera fits.
    """
    projector = OutlineProjector(log, scenario)
    within = {name: records_within(log.streams[name].t_ns, scenario) for name in cameras if name in log.streams}
    within = {name: index for name, index in within.items() if len(index)}
    probes = _probe(log, within, projector, reader)
    size, chosen = _fit(log, scenario.t0_ns, {name: within[name] for name in probes}, probes, budget_bytes)
    pictures = ShrunkPictures(chosen, size.width_px)
    look_again(log, reader, [pictures], progress)
    entries = {name: _entry(log, scenario, projector, name, pictures.jpeg.get(name, {})) for name in chosen}
    entries = {name: entry for name, entry in entries.items() if entry["t_s"]}
    _thin_out(entries, budget_bytes)
    return {
        "cameras": list(entries.values()),
        "ahead": _ahead([log.cameras[name] for name in entries]),
        "agents": [agent.id for agent in projector.agents],
        "width_px": min(size.width_px, max((log.cameras[name].width_px for name in entries), default=0)),
        "rate_hz": size.rate_hz,
        "bytes": sum(map(_bytes_of, entries.values())),
    }


def _probe(
    log: Log, within: Mapping[str, NDArray[np.int64]], projector: OutlineProjector, reader: RecordReader
) -> dict[str, dict[int, float]]:
    """Return the mean bytes in a page of a picture of each camera, by width; none for cameras that cannot be read."""
    widths = sorted({size.width_px for size in SIZES})
    out: dict[str, dict[int, float]] = {}
    for name, index in within.items():
        sizes: dict[int, list[int]] = {width: [] for width in widths}
        for i in index[take_evenly(len(index), PROBES)].tolist():
            image = reader.get(name, i)
            if image is None:
                continue
            outlines = OUTLINE_BYTES * len(projector.outlines(name, int(log.streams[name].t_ns[i])))
            for width in widths:
                sizes[width].append(text_bytes(len(encode_small(image, width))) + outlines)
        if sizes[widths[0]]:
            out[name] = {width: float(np.mean(found)) for width, found in sizes.items()}
    return out


def _fit(
    log: Log,
    start_ns: int,
    within: Mapping[str, NDArray[np.int64]],
    probes: Mapping[str, Mapping[int, float]],
    budget_bytes: int,
) -> tuple[PictureSize, dict[str, NDArray[np.int64]]]:
    """Choose the best size that fits, and the frames of each camera."""
    chosen: dict[str, NDArray[np.int64]] = {}
    size = SIZES[-1]
    for size in SIZES:
        chosen = {n: take_at_rate(log.streams[n].t_ns, index, size.rate_hz, start_ns) for n, index in within.items()}
        if SAFETY * sum(len(index) * probes[n][size.width_px] for n, index in chosen.items()) <= budget_bytes:
            return size, chosen
    one_of_each = SAFETY * sum(probe[size.width_px] for probe in probes.values())
    most = int(budget_bytes / one_of_each) if one_of_each else 0
    if most < 1:
        raise ConfigError(
            f"--max-mb: {budget_bytes / 1e6:.2f} MB are left for pictures, and one of each camera has {one_of_each / 1e6:.2f} MB; "
            f"give more, or choose fewer cameras with --cameras"
        )
    return size, {name: index[take_evenly(len(index), most)] for name, index in chosen.items()}


def _entry(
    log: Log, scenario: Scenario, projector: OutlineProjector, name: str, jpeg: Mapping[int, bytes]
) -> dict[str, Any]:
    camera, t_ns = log.cameras[name], log.streams[name].t_ns
    order = sorted(index for index, data in jpeg.items() if data)
    return {
        "name": name,
        "size_px": [camera.width_px, camera.height_px],
        "t_s": [round((int(t_ns[i]) - scenario.t0_ns) / NS_PER_S, 4) for i in order],
        "jpeg": [base64.b64encode(jpeg[i]).decode() for i in order],
        "outlines": [projector.outlines(name, int(t_ns[i])) for i in order],
    }


def _ahead(cameras: Sequence[Camera]) -> int:
    """Return the place of the camera that looks straight ahead most; 0 where none is on the vehicle."""
    forward = [camera.mount_T_cam[0, 2] if camera.mount == "ego" else -2.0 for camera in cameras]
    return int(np.argmax(forward)) if forward else 0


def _thin_out(entries: Mapping[str, dict[str, Any]], budget_bytes: int) -> None:
    """Leave out pictures, evenly over the time, until all fit."""
    while (total := sum(map(_bytes_of, entries.values()))) > budget_bytes:
        for entry in entries.values():
            kept = take_evenly(len(entry["t_s"]), int(0.97 * len(entry["t_s"]) * budget_bytes / total))
            for key in ("t_s", "jpeg", "outlines"):
                entry[key] = [entry[key][k] for k in kept.tolist()]
        if all(len(entry["t_s"]) <= 1 for entry in entries.values()):
            return


def _bytes_of(entry: Mapping[str, Any]) -> int:
    """Return the bytes of the pictures of a camera and their outlines in a page."""
    numbers = sum(len(str(outlines).replace(" ", "")) for outlines in entry["outlines"])
    return sum(map(len, entry["jpeg"])) + numbers + 12 * len(entry["t_s"])
