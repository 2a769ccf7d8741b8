"""A second look at pictures, once the agents are known: each picture is decoded once for all that want it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.perception.background import work_ahead
from log2sim.perception.frames import RecordReader
from log2sim.perception.record_checks.thumbnails import Thumbnail, shrink


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
