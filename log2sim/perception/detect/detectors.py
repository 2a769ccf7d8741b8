"""2D boxes of road users in camera frames: from an ONNX model through ONNX Runtime, or from boxes in the log."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from log2sim import registry
from log2sim.datatypes import Detections, Frame, Log
from log2sim.errors import ConfigError, PluginError
from log2sim.perception.detect.checked_detector import checked

__all__ = ["BatchDetector", "Detector", "create_detector", "detect_all"]

MAX_OVERLAP = 0.5
MAX_TILES = 64


class Detector(Protocol):
    """Detector of road users in one camera frame.

    One that also has a text `cache_key`, which states all that its boxes depend on besides the picture (weights, settings,
    versions), is not asked twice about one picture: they are kept in the user's cache.
    """

    @property
    def name(self) -> str:
        """Name in the provenance of a scenario."""
        ...

    @property
    def default_min_score(self) -> float:
        """Score in [0, 1] below which boxes of this detector are more often wrong than useful."""
        ...

    def detect(self, frame: Frame) -> Detections:
        """Detect road users in one frame, best score first; deterministic, and may be called from threads."""
        ...


@runtime_checkable
class BatchDetector(Protocol):
    """Detector that can search several frames at once, in less time than one after the other."""

    def detect_many(self, frames: Sequence[Frame]) -> list[Detections]:
        """Detect road users in each of several frames, as `Detector.detect` does."""
        ...


def detect_all(detector: Detector, frames: Sequence[Frame]) -> list[Detections]:
    """Detect road users in several frames, at once where the detector can."""
    if isinstance(detector, BatchDetector):
        return detector.detect_many(frames)
    return [detector.detect(frame) for frame in frames]


def create_detector(
    name_or_path: str,
    log: Log,
    *,
    min_score: float | None = None,
    max_overlap: float = MAX_OVERLAP,
    tiles: Literal["auto"] | int = "auto",
    layout: str | None = None,
    input_px: int | None = None,
) -> Detector:
    """Make a detector for a log.

    Parameters
    ----------
    name_or_path
        A registered name ("ssd-mobilenet-v2", "labels", plug-ins of others) or the path of an `.onnx` file.
    log
        The log whose frames it will see; `labels` takes its boxes from there.
    min_score
        Least score in [0, 1] of a box, None for the detector's own default.
    max_overlap
        IoU in (0, 1] above which two boxes of one group of categories are the same object.
    tiles
        1: the whole image only; N > 1: also N overlapping tiles; "auto": what the image's size asks for.
    layout
        Output layout of an ONNX file, where it cannot be recognized.
    input_px
        Side of the input of an ONNX file that takes any size, None for what its family takes.

    Raises
    ------
    ConfigError
        An unknown name, a file that is no usable model, or a setting out of range.
    MissingExtra
        The detector's package is not installed.
    """
    check_settings(min_score, max_overlap, tiles)
    if name_or_path.lower().endswith(".onnx"):
        from log2sim.perception.detect.onnx_detector import open_onnx

        return open_onnx(
            Path(name_or_path),
            min_score=min_score,
            max_overlap=max_overlap,
            tiles=tiles,
            layout_name=layout,
            input_px=input_px,
        )
    if layout is not None:
        raise ConfigError(f"layout '{layout}': only a detector given as the path of an ONNX file takes a layout")
    if input_px is not None:
        raise ConfigError(f"input_px {input_px}: only a detector given as the path of an ONNX file takes another size")
    try:
        create = registry.load("detector", name_or_path)
    except PluginError:
        raise
    except ConfigError as error:
        in_sweeps = ", ".join(f"lidar:{name}" for name in registry.names("lidar_detector"))
        raise ConfigError(f"{error}; in sweeps: {in_sweeps}; or the path of an ONNX file (ending in .onnx)") from None
    with registry.blaming("detector", name_or_path):
        detector: Detector = create(log, min_score=min_score, max_overlap=max_overlap, tiles=tiles)
    if registry.is_built_in("detector", name_or_path):
        return detector
    return checked(detector, registry.say_plugin("detector", name_or_path))


def check_settings(min_score: float | None, max_overlap: float, tiles: str | int) -> None:
    """Raise `ConfigError` for a setting that is out of its range."""
    if min_score is not None and not 0 <= min_score <= 1:
        raise ConfigError(f"min_score {min_score}: expected a number from 0 to 1")
    if not 0 < max_overlap <= 1:
        raise ConfigError(f"max_overlap {max_overlap}: expected a number above 0 and up to 1")
    counted = isinstance(tiles, int) and not isinstance(tiles, bool)
    if tiles != "auto" and not (counted and 1 <= int(tiles) <= MAX_TILES):
        raise ConfigError(f"tiles {tiles!r}: expected 'auto' or a whole number from 1 to {MAX_TILES}")
