"""What is compared: for every stage the present setting and its alternatives, taken from the settings that exist."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from log2sim.config import Config
from log2sim.datatypes import Log
from log2sim.perception.detect.onnx_detector import OnnxDetector
from log2sim.perception.detect.tiling import plan_tiles
from log2sim.pipeline import detector_of

TILES = (0, 1, 2, 3, 5)
"""Tiles to try beside the present setting; 0 is "auto"."""

SIDES_PX = (320, 416, 640, 960)
"""Sides of the input to try with models that take any."""

HYPOTHESES = (8, 30, 100, 300, 1000, 3000)
"""Numbers of hypotheses to try beside the present one."""

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
    hypotheses: tuple[Setting, ...]
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
        hypotheses=tuple(_hypotheses(config)),
        smooth=tuple(_smooth_settings(config)),
    )


def _hypotheses(config: Config) -> list[Setting]:
    """Other numbers of hypotheses for the present method; only the homographies of these are judged, no whole runs."""
    return [
        Setting("homography", f"{n} hypotheses", changed(config, "topdown", hypotheses=n), False)
        for n in HYPOTHESES
        if n != config.topdown.hypotheses
    ]


def changed(config: Config, section: str, **changes: Any) -> Config:
    """The settings with some of a section's changed."""
    return dataclasses.replace(config, **{section: dataclasses.replace(getattr(config, section), **changes)})


def choices(section: Any, key: str) -> list[str]:
    """What a setting may be, the present value first, without the one that leaves the stage out."""
    present = getattr(section, key)
    allowed = next(f.metadata["allowed"] for f in dataclasses.fields(section) if f.name == key)
    return [value for value in dict.fromkeys([present, *allowed]) if value != NO_METHOD]


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
    """Every detector with the tiles that change what it looks at, and with other sizes of its input where it takes them."""
    names = list(dict.fromkeys([config.detect.name, *detectors]))
    out: list[Setting] = []
    for name in names:
        own = config if name == config.detect.name else changed(config, "detect", name=name, layout="", input_px=0)
        label = f"{_short(name, names)} " if len(names) > 1 else ""
        detector = detector_of(log, own)
        if not isinstance(detector, OnnxDetector):
            out.append(Setting("detect", name, own, not out))
            continue
        for key, value in _looks(log, own, detector):
            other = changed(own, "detect", **{key: value})
            out.append(Setting("detect", f"{label}{_look_name(key, value)}", other, not out))
    return out


def _short(name: str, names: Sequence[str]) -> str:
    """A detector's name without folder and suffix, where that still tells it from the others."""
    stems = [Path(n).stem if n.endswith(".onnx") else n for n in names]
    stem = stems[list(names).index(name)]
    return stem if stems.count(stem) == 1 else name


def _looks(log: Log, config: Config, detector: OnnxDetector) -> list[tuple[str, int]]:
    """Settings of a detector that differ in what it looks at, the present one first."""
    looks, seen = [], set()
    for tiles in dict.fromkeys([config.detect.tiles, *TILES]):
        plan = _tile_plan(log, config, detector, tiles)
        if plan not in seen:
            seen.add(plan)
            looks.append(("tiles", tiles))
    if detector.model.spec.width_px is None and detector.model.spec.height_px is None:
        looks += [("input_px", side) for side in SIDES_PX if side != detector.layout.preprocessing.default_px]
    return looks


def _tile_plan(log: Log, config: Config, detector: OnnxDetector, tiles: int) -> tuple[int, ...]:
    """How many pictures a detector looks at for a frame of each camera."""
    side = detector.model.spec.width_px or detector.layout.preprocessing.default_px
    cameras = [log.cameras[name] for name in config.cameras or log.cameras]
    return tuple(len(plan_tiles(c.width_px, c.height_px, tiles or "auto", side)) for c in cameras)


def _look_name(key: str, value: int) -> str:
    if key == "input_px":
        return f"input {value} px"
    return "auto tiles" if value == 0 else "no tiles" if value == 1 else f"{value} tiles"
