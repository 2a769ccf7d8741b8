"""The detectors of a run, from its settings or handed over by a program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.config import AUTO, GIVEN_PREFIX, LIDAR_PREFIX, Config
from log2sim.datatypes import Labels, Log
from log2sim.files import plugins
from log2sim.files.cache import DiskCache
from log2sim.files.plugins import DETECT_IN_CLOUD, find_call_defect
from log2sim.perception.cooperative import create_for_ends
from log2sim.perception.detect.detectors import CheckedDetector, Detector, FunctionDetector, create_detector
from log2sim.perception.detect3d.detectors import PREFIX, CheckedLidarDetector, LidarDetector, create_lidar_detector
from log2sim.perception.run_cache import FirstPassCache, open_cache

EXPECTED = (
    "a function of a picture that returns rows, an object with name, default_min_score and detect(frame) or, for LiDAR "
    "sweeps, with name and detect(cloud, earlier), a name such as 'lidar:vehicle', or a list of one for pictures and one for sweeps"
)

GivenDetector = Callable[..., Any] | Detector | LidarDetector | str


@dataclass(frozen=True, eq=False)
class GivenDetectors:
    """Detectors that were handed over, and the settings that name them."""

    config: Config
    images: Detector | None = None  # searches pictures in place of the one that the settings name
    sweeps: LidarDetector | None = None  # searches clouds in place of the one that the settings name


def sort_detectors(
    given: GivenDetector | list[GivenDetector] | tuple[GivenDetector, ...] | None, config: Config
) -> GivenDetectors:
    """Tell apart what was handed over; it takes the place of `detect.name` in the settings.

    `given`: see `log2sim.reconstruct`.

    Raises `TypeError` when it is none of these, or two are for the same sensors; `PluginError` when a detector lacks
    something.
    """
    if given is None:
        return GivenDetectors(config)
    parts = list(given) if isinstance(given, (list, tuple)) else [given]
    names: dict[str, str] = {}
    images: Detector | None = None
    sweeps: LidarDetector | None = None
    for part in parts:
        detect, label = getattr(part, "detect", None), f"detector '{getattr(part, 'name', type(part).__name__)}'"
        if isinstance(part, str):
            kind, name = "sweeps" if part.startswith(LIDAR_PREFIX) else "images", part
        # Detectors for pictures have a default score, and their `detect` takes one frame.
        elif (
            callable(detect)
            and not hasattr(part, "default_min_score")
            and not find_call_defect(detect, DETECT_IN_CLOUD)
        ):
            sweeps = CheckedLidarDetector(part, label)
            kind, name = "sweeps", f"{LIDAR_PREFIX}{GIVEN_PREFIX}{sweeps.name}"
        else:
            if hasattr(part, "detect"):
                images = CheckedDetector(part, label)
            elif callable(part):
                of_function = str(getattr(part, "__name__", type(part).__name__)).strip("<>")
                searching = FunctionDetector(part, config.detect.min_score, of_function)
                images = CheckedDetector(searching, f"detector '{of_function}'")
            else:
                raise TypeError(f"detector: a {type(part).__name__}, expected {EXPECTED}")
            kind, name = "images", f"{GIVEN_PREFIX}{images.name}"
        if kind in names:
            raise TypeError(f"detector: two for {kind}, {names[kind]} and {name}; expected {EXPECTED}")
        names[kind] = name
    if not names:
        raise TypeError(f"detector: an empty list, expected {EXPECTED}")
    joined = "+".join(names[kind] for kind in ("images", "sweeps") if kind in names)
    return GivenDetectors(config.changed(detect={"name": joined}), images, sweeps)


@dataclass(frozen=True, eq=False)
class Detectors:
    """The detectors of a run."""

    images: Detector | None  # searches the frames of all cameras
    sweeps: LidarDetector | None  # searches the clouds
    cache: FirstPassCache | None = None  # the first pass of earlier runs with these detectors

    @property
    def own(self) -> bool:
        """Whether both are detectors of log2sim itself."""
        return not isinstance(self.images, CheckedDetector) and not isinstance(self.sweeps, CheckedLidarDetector)

    @property
    def name(self) -> str:
        """Names of both, joined by +."""
        return "+".join(detector.name for detector in (self.images, self.sweeps) if detector is not None)


def create_detectors(log: Log, config: Config, given: GivenDetectors, *, store: DiskCache | None = None) -> Detectors:
    """Create the detectors that the settings name, but for those that were given.

    `store`: where what earlier runs of the first pass found is taken from, and kept.
    """
    images = given.images or create_image_detector(log, config) if config.detect.in_images else None
    sweeps = create_for_ends(log, config, given.sweeps) if config.detect.in_sweeps else None
    return Detectors(images, sweeps, open_cache(store, images, sweeps))


def create_image_detector(log: Log, config: Config) -> Detector:
    """Create the detector in images that the settings name."""
    return create_detector(
        config.detect.in_images,
        log,
        min_score=config.detect.min_score or None,
        tiles=config.detect.tiles or "auto",
        layout=config.detect.layout or None,
        input_px=config.detect.input_px or None,
    )


def check_detectors(config: Config) -> None:
    """Refuse detectors that could search no log: unknown ones, missing or unusable files, settings that do not fit them.

    Those of other packages are imported but not made, since they may look at the log.

    Raises `ConfigError`, `MissingExtra`, `PluginError` as the run of a log would.
    """
    # A log without sensors and with no box in its labels, so that `labels` takes it.
    none, words = np.zeros(0), np.zeros(0, np.str_)
    labels = Labels(np.zeros(0, np.int64), words, words, np.zeros((0, 3)), np.zeros((0, 3)), none)
    log = Log("none", "none", {}, {}, {}, labels=labels)
    images, sweeps = config.detect.in_images, {config.detect.in_sweeps, config.cooperation.road_detector}
    if images not in ("", AUTO):
        if _is_of_another_package("detector", images):
            plugins.load("detector", images)
        else:
            create_image_detector(log, config)
    for name in sorted(sweeps - {"", AUTO}):
        plain = name.removeprefix(PREFIX)
        if plain != name and _is_of_another_package("lidar_detector", plain):
            plugins.load("lidar_detector", plain)
        else:
            create_lidar_detector(name, log, config.lidar)


def _is_of_another_package(kind: str, name: str) -> bool:
    return not plugins.is_built_in(kind, name) and name in plugins.names(kind)
