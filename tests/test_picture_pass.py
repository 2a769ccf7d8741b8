"""The second look at pictures: each one decoded once, in order of time, and only those that show something."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Lidar, Log, Stream, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import Camera
from log2sim.perception.frames import KeepingReader, RecordReader, look_again

SIZE = (64, 48)
K = np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1.0]])


class Wants:
    """Takes note of what comes."""

    def __init__(self, **frames: list[int]) -> None:
        self.wanted = {name: np.array(index, dtype=np.int64) for name, index in frames.items()}
        self.got: list[tuple[str, int, int]] = []

    def frames(self) -> dict[str, NDArray[np.int64]]:
        return self.wanted

    def add(self, camera: str, index: int, image_bgr: NDArray[np.uint8]) -> None:
        self.got.append((camera, index, int(image_bgr[0, 0, 0])))


def log_of(reads: list[tuple[str, int]], *, black: int = -1, broken: int = -1) -> Log:
    """Two cameras with 5 frames each, the second 50 ms later; the first pixel of a frame is its index."""

    def read(name: str, i: int) -> NDArray[np.uint8]:
        reads.append((name, i))
        if i == broken:
            raise RecordError("broken")
        blocks = np.random.default_rng([i, len(name)]).integers(0, 255, (6, 8, 3)).astype(np.uint8)
        image = blocks.repeat(8, axis=0).repeat(8, axis=1)
        image[0, 0] = i
        return np.zeros_like(image) if i == black else image

    cameras = {n: Camera(n, *SIZE, K, "map", np.eye(4)) for n in ("left", "right2")}
    streams = {
        name: Stream(name, np.arange(5, dtype=np.int64) * 10**8 + k * 5 * 10**7, lambda i, n=name: read(n, i))
        for k, name in enumerate(cameras)
    }
    return Log("l", "synthetic", cameras, {}, streams)


def test_each_is_decoded_once_and_comes_in_order_of_time() -> None:
    reads: list[tuple[str, int]] = []
    log = log_of(reads)
    first, second = Wants(left=[3, 1, 1], right2=[1]), Wants(left=[3, 4])
    steps: list[tuple[int, int]] = []
    assert look_again(log, RecordReader(log), [first, second], lambda *step: steps.append(step)) == 4
    assert first.got == [("left", 1, 1), ("right2", 1, 1), ("left", 3, 3)]
    assert second.got == [("left", 3, 3), ("left", 4, 4)]
    assert sorted(reads) == [("left", 1), ("left", 3), ("left", 4), ("right2", 1)]
    assert steps == [(k + 1, 4) for k in range(4)]


def test_kept_sweeps_are_read_once_and_stay_as_they_are() -> None:
    reads: list[int] = []

    def read(i: int) -> Sweep:
        reads.append(i)
        return Sweep(
            i, np.full((4, 3), i, np.float32), t_ns=np.arange(4) + i, intensity=None if i else np.ones(4, np.float32)
        )

    lidar = Lidar("top", "map", np.eye(4))
    log = Log("l", "synthetic", {}, {"top": lidar}, {"top": Stream("top", np.arange(5, dtype=np.int64), read)})
    reader = KeepingReader(log, 2)
    for _ in range(2):
        for i in (0, 1, 2):
            sweep = reader.get("top", i)
            assert (sweep.stamp_ns, sweep.xyz_m.tolist(), sweep.t_ns.tolist()) == (
                i,
                [[i] * 3] * 4,
                [i, i + 1, i + 2, i + 3],
            )
            assert (sweep.intensity is None) == (i > 0)
    assert reads == [0, 1, 2, 2]
    reader.forget()
    reader.get("top", 0)
    assert reads[-1] == 0
