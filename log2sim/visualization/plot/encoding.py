"""Files of moving pictures, written frame by frame: H.264 and VP9 by PyAV, VP9 by OpenCV, and .gif by Pillow."""

from __future__ import annotations

import itertools
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from log2sim.errors import ConfigError, install_command
from log2sim.visualization.plot.style import PAPER, TAIL_ALPHA, TRACK_ALPHA

Image = NDArray[np.uint8]  # a frame (H, W, 3), RGB
H264, VP9 = "libx264", "libvpx-vp9"
# Options of the encoders: constant quality at which letters of 7 pt keep their edges. Without `mbtree`, since with it
# x264 writes other bytes for the same frames from run to run (measured: 5 files of 12 runs).
QUALITY: dict[str, dict[str, str]] = {
    H264: {"crf": "20", "preset": "medium", "x264-params": "mbtree=0"},
    VP9: {"crf": "32", "b": "0", "deadline": "good", "cpu-used": "4"},
}
# The same frames give the same bytes; and the index stands at the start of an .mp4, so that browsers play it while it
# loads.
CONTAINER: dict[str, dict[str, str]] = {
    H264: {"fflags": "+bitexact", "movflags": "+faststart"},
    VP9: {"fflags": "+bitexact"},
}
MAX_DENOMINATOR = 1001  # of frame rates as fractions; broadcast rates such as 29.97 have it
CLEAR = 255  # palette index of transparent pixels in a .gif; the lower ones are colors
SWATCH_PX = 100  # width of the swatches of agent colors that the palette is chosen with


@dataclass(frozen=True)
class FilmFile:
    """Where a film goes and how it is written."""

    path: Path
    # Takes frames, the path of the file and the frames a second; None for a .gif or a still picture.
    write: Callable[[Iterator[Image], Path, float], None] | None = None
    note: str | None = None  # what is other than it was asked for


def choose_film_file(requested: Path) -> FilmFile:
    """Choose the encoder for an .mp4 or .webm: what is installed of PyAV's, else a .webm by OpenCV."""
    suffix = requested.suffix.lower()
    if suffix == ".mp4" and _can_encode(H264):
        return FilmFile(requested, lambda frames, path, fps: write_with_av(frames, path, fps, H264, "mp4"))
    path = requested if suffix == ".webm" else requested.with_suffix(".webm")
    note = None
    if suffix == ".mp4":
        missing = f"needs the extra 'video' ({install_command('video')})"
        why = "needs H.264, which this PyAV lacks" if find_spec("av") else missing
        note = f"{requested.name} {why}; written as {path.name}"
    if _can_encode(VP9):
        return FilmFile(path, lambda frames, path, fps: write_with_av(frames, path, fps, VP9, "webm"), note)
    return FilmFile(path, write_with_opencv, note)


def write_with_av(frames: Iterator[Image], path: Path, fps: float, codec: str, container: str) -> None:
    """Write a film with PyAV in the colors of BT.709, 4:2:0."""
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    first = next(frames)
    height, width = (n // 2 * 2 for n in first.shape[:2])  # the codecs require even sides
    with av.open(str(path), "w", format=container, container_options=CONTAINER[codec]) as file:
        rate = Fraction(fps).limit_denominator(MAX_DENOMINATOR)
        stream: Any = file.add_stream(codec, rate=rate, options=QUALITY[codec])
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.thread_count = 1  # the bytes depend on it
        context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
        context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
        for frame in itertools.chain([first], frames):
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame[:height, :width]), format="rgb24")
            to: Any = {"dst_colorspace": Colorspace.ITU709, "dst_color_range": ColorRange.MPEG}
            picture = picture.reformat(format="yuv420p", **to)
            file.mux(stream.encode(picture))
        file.mux(stream.encode(None))


def write_with_opencv(frames: Iterator[Image], path: Path, fps: float) -> None:
    """Write a .webm with OpenCV.

    Raises `ConfigError` when this OpenCV has no such encoder.
    """
    import cv2

    first = next(frames)
    height, width = (n // 2 * 2 for n in first.shape[:2])
    path.touch()  # raises when the file cannot be written, which OpenCV would not report
    with _silent_stderr():  # OpenCV complains of the container's name for the codec, and takes it
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP90"), fps, (width, height))
    try:
        if not writer.isOpened():
            raise ConfigError(
                f"{path.suffix}: this OpenCV cannot write films; {install_command('video')}, or choose .gif"
            )
        for frame in itertools.chain([first], frames):
            writer.write(np.ascontiguousarray(frame[:height, :width, ::-1]))
    finally:
        writer.release()
    # The random number by which a Matroska file names its track is replaced, so that the same frames give the same bytes. RFC 9559:
    # TrackUID has the id 73 C5 and TagTrackUID 63 C5, both followed here by 88, a length of 8 bytes. They are written before the
    # first cluster (1F 43 B6 75), so nothing of the film itself can be mistaken for them.
    with path.open("r+b") as file:
        head = file.read(4096).split(b"\x1f\x43\xb6\x75")[0]
        for found in re.finditer(rb"[\x73\x63]\xc5\x88.{8}", head, re.DOTALL):
            file.seek(found.end() - 8)
            file.write((1).to_bytes(8, "big"))


def write_gif(frames: Iterator[Image], path: Path, fps: float, colors: Sequence[str]) -> None:
    """Write a .gif whose palette keeps the colors of agents."""
    from PIL import GifImagePlugin
    from PIL import Image as Pillow

    first = next(frames)
    # A palette is chosen by area, so that the frame is widened by swatches of the agents' colors.
    full = np.array([to_rgb(color) for color in colors])
    mixes = [alpha * full + (1 - alpha) * np.array(to_rgb(PAPER)) for alpha in (1.0, TAIL_ALPHA, TRACK_ALPHA)]
    rgb = np.rint(255 * np.concatenate(mixes)).astype(np.uint8)
    row = np.arange(len(first)) * len(rgb) // len(first)
    wide = np.concatenate([first, np.repeat(rgb[row][:, None], SWATCH_PX, axis=1)], axis=1)
    palette = Pillow.fromarray(wide).quantize(CLEAR, dither=Pillow.Dither.NONE)
    settings = {"loop": 0, "duration": round(1000 / fps), "disposal": 1, "transparency": CLEAR}
    before: NDArray[np.uint8] | None = None
    with path.open("wb") as file:
        for frame in itertools.chain([first], frames):
            now = np.asarray(Pillow.fromarray(frame).quantize(palette=palette, dither=Pillow.Dither.NONE))
            (top, left), shown = (0, 0), now
            # The part that is not as before, its unchanged pixels transparent: several times smaller.
            if before is not None:
                changed = now != before
                rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
                top, bottom = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 1)
                left, right = (int(columns[0]), int(columns[-1]) + 1) if len(columns) else (0, 1)
                part = np.s_[top:bottom, left:right]
                shown = np.where(changed[part], now[part], np.uint8(CLEAR))
            picture = Pillow.fromarray(shown)
            picture.putpalette(palette.getpalette() or ())
            if before is None:
                file.write(b"".join(GifImagePlugin.getheader(picture, info=settings)[0]))
            file.write(b"".join(GifImagePlugin.getdata(picture, (left, top), **settings)))
            before = now
        file.write(b";")


def _can_encode(codec: str) -> bool:
    try:
        import av

        av.codec.Codec(codec, "w")
    except (ImportError, ValueError):  # UnknownCodecError is one
        return False
    return True


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Within the block what libraries write to stderr is dropped."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
