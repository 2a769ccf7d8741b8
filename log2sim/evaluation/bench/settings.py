"""Settings to compare: for every stage the present one and its alternatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from log2sim.config import Config
from log2sim.config_sections import AUTO, Section
from log2sim.datatypes import Log
from log2sim.errors import ConfigError
from log2sim.perception.detect.onnx_detector import OnnxDetector
from log2sim.perception.detect.tiling import plan_tiles
from log2sim.run_detectors import create_image_detector
from log2sim.sensors import IMAGE_DETECTOR, choose_detector

TILES = (0, 1, 2, 3, 5)
"""Numbers of tiles to try besides the present one; 0 is "auto"."""

SIDES_PX = (320, 416, 640, 960)
"""Input sizes to try with models that accept any."""

HYPOTHESES = (8, 30, 100, 300, 1000, 3000)
"""Numbers of RANSAC hypotheses to try besides the present one."""

NO_METHOD = "off"


@dataclass(frozen=True)
class Setting:
    """One setting of a stage.

    Attributes
    ----------
    stage : str
    name : str
        Within the stage.
    config : Config
        Of the whole run.
    present : bool
        Whether it is the present setting.
    """

    stage: str
    name: str
    config: Config
    present: bool

    @property
    def key(self) -> str:
        """Return its name among the settings of all stages."""
        return f"{self.stage}: {self.name}"


@dataclass(frozen=True)
class Grid:
    """The settings of every stage, the present one first; each other differs from it in one stage only."""

    detect: tuple[Setting, ...]
    measure: tuple[Setting, ...]
    homography: tuple[Setting, ...]
    hypotheses: tuple[Setting, ...]
    smooth: tuple[Setting, ...]

    @property
    def present(self) -> Setting:
        """Return the present setting of the detector in images."""
        return self.detect[0]


def make_grid(log: Log, config: Config, detectors: Sequence[str] = ()) -> Grid:
    """List the settings to compare on a log, each differing from the present ones in one stage.

    Parameters
    ----------
    config : Config
        The present settings. `topdown.method` "off" is replaced by the first method.
    detectors : sequence of str
        Detectors to compare with the present one: names, or paths of ONNX files.

    Raises
    ------
    ConfigError, MissingExtra
        For a detector that cannot be loaded.
    """
    if config.detect.name == AUTO:
        config = with_changes(config, "detect", name=IMAGE_DETECTOR)
    if config.topdown.method == NO_METHOD:
        config = with_changes(config, "topdown", method=choices(config.topdown, "method")[0])
    return Grid(
        detect=tuple(_detector_settings(log, config, detectors)),
        measure=_choices("measure", config, "measure", "mode"),
        homography=(*_methods_apart(config), *_rig_settings(log, config)),
        hypotheses=tuple(_hypotheses(config)),
        smooth=tuple(_smooth_settings(config)),
    )


def default_settings(log: Log, config: Config) -> tuple[Setting, ...]:
    """Return what `reconstruct` does with a log by these settings where it does more than search images, else nothing."""
    chosen = choose_detector(log, config)
    if config.detect.name != AUTO or not chosen.detect.in_sweeps:
        return ()
    return (Setting("whole run", f"reconstruct's default, {chosen.detect.name}", chosen, True),)


def _methods_apart(config: Config) -> list[Setting]:
    """List the methods, the present one as it is and the others for each camera alone."""
    present, *others = _choices("homography", config, "topdown", "method")
    return [present, *(replace(s, config=with_changes(s.config, "topdown", rig="apart")) for s in others)]


def _rig_settings(log: Log, config: Config) -> list[Setting]:
    """List the other way to fit several cameras: all together, or each apart."""
    if len(config.cameras or log.cameras) < 2:
        return []
    other = choices(config.topdown, "rig")[1]
    return [Setting("homography", f"cameras {other}", with_changes(config, "topdown", rig=other), False)]


def _hypotheses(config: Config) -> list[Setting]:
    """List other numbers of hypotheses for the present method, for which only homographies are scored, no whole runs."""
    return [
        Setting("homography", f"{n} hypotheses", with_changes(config, "topdown", hypotheses=n), False)
        for n in HYPOTHESES
        if n != config.topdown.hypotheses
    ]


def with_changes(config: Config, section: str, **changes: Any) -> Config:
    """Return a copy of the settings with changes in one section."""
    return config.changed(**{section: changes})


def choices(section: Section, key: str) -> list[str]:
    """List the allowed values of a setting, the present one first, without the one that leaves the stage out."""
    present = getattr(section, key)
    return [value for value in dict.fromkeys([present, *section.choices(key)]) if value != NO_METHOD]


def _choices(stage: str, config: Config, section: str, key: str) -> tuple[Setting, ...]:
    names = choices(getattr(config, section), key)
    return tuple(
        Setting(stage, name, with_changes(config, section, **{key: name}), k == 0) for k, name in enumerate(names)
    )


def _smooth_settings(config: Config) -> list[Setting]:
    """List smoothing on and off, and all values of its other settings."""
    keys = type(config.smooth).model_fields
    switches = [key for key in keys if isinstance(getattr(config.smooth, key), bool)]
    named = [key for key in keys if config.smooth.choices(key)]
    out = [Setting("smooth", _smooth_name(config, switches, named), config, True)]
    for key in switches:
        other = with_changes(config, "smooth", **{key: not getattr(config.smooth, key)})
        out.append(Setting("smooth", _smooth_name(other, [key], []), other, False))
    for key in named:
        for value in choices(config.smooth, key)[1:]:
            other = with_changes(config, "smooth", **{key: value})
            out.append(Setting("smooth", value, other, False))
    return out


def _smooth_name(config: Config, switches: Sequence[str], named: Sequence[str]) -> str:
    values = [str(getattr(config.smooth, key)) for key in named]
    if "enabled" in switches and (not config.smooth.enabled or not values):
        return "on" if config.smooth.enabled else "off"
    return " ".join(values) or f"{switches[0]}={str(getattr(config.smooth, switches[0])).lower()}"


def _detector_settings(log: Log, config: Config, detectors: Sequence[str]) -> list[Setting]:
    """List every detector with all distinct numbers of tiles, and with other input sizes where the model accepts them."""
    names = list(dict.fromkeys([config.detect.name, *detectors]))
    for name in names:
        if with_changes(config, "detect", name=name).detect.in_sweeps:
            raise ConfigError(
                f"bench: compares detectors in images, and '{name}' searches LiDAR sweeps; see log2sim detect"
            )
    out: list[Setting] = []
    for name in names:
        own = config if name == config.detect.name else with_changes(config, "detect", name=name, layout="", input_px=0)
        label = f"{_short(name, names)} " if len(names) > 1 else ""
        detector = create_image_detector(log, own)
        if not isinstance(detector, OnnxDetector):
            out.append(Setting("detect", name, own, not out))
            continue
        for key, value in _inputs(log, own, detector):
            other = with_changes(own, "detect", **{key: value})
            out.append(Setting("detect", f"{label}{_input_name(key, value)}", other, not out))
    return out


def _short(name: str, names: Sequence[str]) -> str:
    """Shorten a detector's name to its stem unless another one has the same."""
    stems = [Path(n).stem if n.endswith(".onnx") else n for n in names]
    stem = stems[list(names).index(name)]
    return stem if stems.count(stem) == 1 else name


def _inputs(log: Log, config: Config, detector: OnnxDetector) -> list[tuple[str, int]]:
    """List settings of a detector with different inputs, the present one first."""
    inputs, seen = [], set()
    for tiles in dict.fromkeys([config.detect.tiles, *TILES]):
        plan = _tile_plan(log, config, detector, tiles)
        if plan not in seen:
            seen.add(plan)
            inputs.append(("tiles", tiles))
    if detector.model.spec.width_px is None and detector.model.spec.height_px is None:
        inputs += [("input_px", side) for side in SIDES_PX if side != detector.layout.preprocessing.default_px]
    return inputs


def _tile_plan(log: Log, config: Config, detector: OnnxDetector, tiles: int) -> tuple[int, ...]:
    """Count the tiles of a frame of each camera."""
    side = detector.model.spec.width_px or detector.layout.preprocessing.default_px
    cameras = [log.cameras[name] for name in config.cameras or log.cameras]
    return tuple(len(plan_tiles(c.width_px, c.height_px, tiles or "auto", side)) for c in cameras)


def _input_name(key: str, value: int) -> str:
    if key == "input_px":
        return f"input {value} px"
    return "auto tiles" if value == 0 else "no tiles" if value == 1 else f"{value} tiles"
