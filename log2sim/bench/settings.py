"""What is compared: for every stage the present setting and its alternatives, taken from the settings that exist."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from log2sim.config import Config
from log2sim.detect import Detector
from log2sim.detect.onnx_detector import OnnxDetector
from log2sim.detect.tiling import plan_tiles
from log2sim.pipeline import detector_of
from log2sim.types import Log

TILES = (0, 1, 2, 3, 5)
"""Tiles to try beside the present setting; 0 is "auto"."""

HYPOTHESES = (10, 30, 100, 300, 1000, 3000)
"""Hypotheses to try beside the present number, for methods that draw them."""

NO_METHOD = "off"


@dataclass(frozen=True)
class Setting:
    """One way to run a stage: a name within the stage, the settings of the whole run, whether it is the present one."""

    stage: str
    name: str
    config: Config
    present: bool

    @property
    def key(self) -> str:
        """Its name among the settings of all stages."""
        return f"{self.stage}: {self.name}"


@dataclass(frozen=True)
class Grid:
    """The settings of every stage; the first of each is the present one, which the others leave everywhere else."""

    detect: tuple[Setting, ...]
    measure: tuple[Setting, ...]
    homography: tuple[Setting, ...]
    smooth: tuple[Setting, ...]

    @property
    def present(self) -> Setting:
        """The present settings as those of a detector."""
        return self.detect[0]


def make_grid(log: Log, config: Config, detectors: Sequence[str] = ()) -> Grid:
    """The settings to compare on a log, each differing from the present ones in one stage.

    Parameters
    ----------
    config : Config
        The present settings. `topdown.method` "off" is taken as the first method that there is.
    detectors : sequence of str
        Detectors to compare with the present one: names, or paths of ONNX files.

    Raises
    ------
    ConfigError, MissingExtra
        For a detector that cannot be made.
    """
    if config.topdown.method == NO_METHOD:
        config = changed(config, "topdown", method=choices(config.topdown, "method")[0])
    return Grid(
        detect=tuple(_detector_settings(log, config, detectors)),
        measure=_choices("measure", config, "measure", "mode"),
        homography=_choices("homography", config, "topdown", "method"),
        smooth=tuple(_smooth_settings(config)),
    )


def changed(config: Config, section: str, **changes: Any) -> Config:
    """The settings with some of a section's changed."""
    return dataclasses.replace(config, **{section: dataclasses.replace(getattr(config, section), **changes)})


def choices(section: Any, key: str) -> list[str]:
    """What a setting may be, the present value first, without the one that leaves the stage out."""
    present = getattr(section, key)
    allowed = next(f.metadata["allowed"] for f in dataclasses.fields(section) if f.name == key)
    return [present, *(a for a in allowed if a not in (present, NO_METHOD))]


def _choices(stage: str, config: Config, section: str, key: str) -> tuple[Setting, ...]:
    names = choices(getattr(config, section), key)
    return tuple(Setting(stage, name, changed(config, section, **{key: name}), k == 0) for k, name in enumerate(names))


def _smooth_settings(config: Config) -> list[Setting]:
    """Smoothing on and off, and every choice that its settings offer."""
    fields = dataclasses.fields(config.smooth)
    switches = [f.name for f in fields if isinstance(getattr(config.smooth, f.name), bool)]
    named = [f.name for f in fields if "allowed" in f.metadata]
    out = [Setting("smooth", _smooth_name(config, switches, named), config, True)]
    for key in switches:
        other = changed(config, "smooth", **{key: not getattr(config.smooth, key)})
        out.append(Setting("smooth", _smooth_name(other, [key], []), other, False))
    for key in named:
        for value in choices(config.smooth, key)[1:]:
            other = changed(config, "smooth", **{key: value})
            out.append(Setting("smooth", value, other, False))
    return out


def _smooth_name(config: Config, switches: Sequence[str], named: Sequence[str]) -> str:
    values = [str(getattr(config.smooth, key)) for key in named]
    if "enabled" in switches and (not config.smooth.enabled or not values):
        return "on" if config.smooth.enabled else "off"
    return " ".join(values) or f"{switches[0]}={str(getattr(config.smooth, switches[0])).lower()}"


def _detector_settings(log: Log, config: Config, detectors: Sequence[str]) -> list[Setting]:
    """Every detector with the tiles that change what it looks at."""
    names = list(dict.fromkeys([config.detect.name, *detectors]))
    out: list[Setting] = []
    for name in names:
        own = config if name == config.detect.name else changed(config, "detect", name=name, layout="")
        detector, seen = detector_of(log, own), set()
        for tiles in dict.fromkeys([own.detect.tiles, *(TILES if isinstance(detector, OnnxDetector) else ())]):
            plan = _tile_plan(log, config, detector, tiles)
            if plan not in seen:
                seen.add(plan)
                label = f"{name.rsplit('/', 1)[-1]} " if len(names) > 1 else ""
                text = f"{label}{_tiles_name(detector, tiles)}".strip()
                out.append(Setting("detect", text or name, changed(own, "detect", tiles=tiles), not out))
    return out


def _tile_plan(log: Log, config: Config, detector: Detector, tiles: int) -> tuple[int, ...]:
    """How many pictures a detector looks at for a frame of each camera."""
    if not isinstance(detector, OnnxDetector):
        return ()
    side = detector.model.spec.width_px or detector.layout.preparation.default_px
    cameras = [log.cameras[name] for name in config.cameras or log.cameras]
    return tuple(len(plan_tiles(c.width_px, c.height_px, tiles or "auto", side)) for c in cameras)


def _tiles_name(detector: Detector, tiles: int) -> str:
    if not isinstance(detector, OnnxDetector):
        return ""
    return "auto tiles" if tiles == 0 else "no tiles" if tiles == 1 else f"{tiles} tiles"
