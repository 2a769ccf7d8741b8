"""The detectors of a run, made from its settings."""

from __future__ import annotations

from dataclasses import dataclass

from log2sim.config import Config
from log2sim.datatypes import Log
from log2sim.perception.cooperative.detector import create_for_ends
from log2sim.perception.detect.detectors import Detector, create_detector
from log2sim.perception.detect3d.detectors import LidarDetector
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
