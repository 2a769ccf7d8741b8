"""The detectors of a run, made from its settings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim import registry
from log2sim.config import Config
from log2sim.config_sections import AUTO
from log2sim.datatypes import Labels, Log
from log2sim.perception.cooperative.detector import create_for_ends
from log2sim.perception.detect.detectors import Detector, create_detector
from log2sim.perception.detect3d.detectors import PREFIX, LidarDetector, create_lidar_detector
from log2sim.perception.detection_cache import DetectionCache, open_cache
from log2sim.perception.given_detectors import GivenDetectors


@dataclass(frozen=True, eq=False)
class Detectors:
    """The detectors of a run.

    Attributes
    ----------
    images : Detector, optional
        Searches the frames of all cameras.
    sweeps : LidarDetector, optional
        Searches the clouds.
    cache : DetectionCache, optional
        What the detector in images found in earlier runs.
    """

    images: Detector | None
    sweeps: LidarDetector | None
    cache: DetectionCache | None = None

    @property
    def name(self) -> str:
        """Names of both, joined by +."""
        return "+".join(detector.name for detector in (self.images, self.sweeps) if detector is not None)


def create_detectors(log: Log, config: Config, given: GivenDetectors, *, cache: bool = True) -> Detectors:
    """Create the detectors that the settings name, but for those that were given.

    Parameters
    ----------
    cache : bool
        Whether what the detector finds in images is taken from the user's cache, and kept there.
    """
    images = given.images or create_image_detector(log, config) if config.detect.in_images else None
    sweeps = create_for_ends(log, config, given.sweeps) if config.detect.in_sweeps else None
    return Detectors(images, sweeps, open_cache(images) if cache and images is not None else None)


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

    Raises
    ------
    ConfigError, MissingExtra, PluginError
        As the run of a log would.
    """
    log = _log_without_records()
    images, sweeps = config.detect.in_images, {config.detect.in_sweeps, config.cooperation.road_detector}
    if images not in ("", AUTO):
        if _is_of_another_package("detector", images):
            registry.load("detector", images)
        else:
            create_image_detector(log, config)
    for name in sorted(sweeps - {"", AUTO}):
        plain = name.removeprefix(PREFIX)
        if plain != name and _is_of_another_package("lidar_detector", plain):
            registry.load("lidar_detector", plain)
        else:
            create_lidar_detector(name, log, config.lidar)


def _is_of_another_package(kind: str, name: str) -> bool:
    return not registry.is_built_in(kind, name) and name in registry.names(kind)


def _log_without_records() -> Log:
    """Return a log without sensors and with no box in its labels, so that `labels` takes it."""
    none, words = np.zeros(0), np.zeros(0, np.str_)
    labels = Labels(np.zeros(0, np.int64), words, words, np.zeros((0, 3)), np.zeros((0, 3)), none)
    return Log("none", "none", {}, {}, {}, labels=labels)
