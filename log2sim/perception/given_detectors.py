"""Detectors that a program hands over instead of naming them in the settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from log2sim.config import Config
from log2sim.config_sections import GIVEN_PREFIX, LIDAR_PREFIX
from log2sim.perception.detect.checked_detector import FunctionDetector, checked
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.detect3d.detectors import LidarDetector
from log2sim.perception.detect3d.detectors import checked as checked_lidar
from log2sim.plugin_checks import DETECT_IN_CLOUD, find_call_defect

EXPECTED = (
    "a function of a picture that returns rows, an object with name, default_min_score and detect(frame) or, for LiDAR "
    "sweeps, with name and detect(cloud, earlier), a name such as 'lidar:vehicle', or a list of one for pictures and one for sweeps"
)

GivenDetector = Callable[..., Any] | Detector | LidarDetector | str


@dataclass(frozen=True, eq=False)
class GivenDetectors:
    """Detectors that were handed over, and the settings that name them.

    Attributes
    ----------
    config : Config
    images : Detector, optional
        Searches pictures in place of the one that the settings name.
    sweeps : LidarDetector, optional
        Searches clouds in place of the one that the settings name.
    """

    config: Config
    images: Detector | None = None
    sweeps: LidarDetector | None = None


def sort_detectors(
    given: GivenDetector | list[GivenDetector] | tuple[GivenDetector, ...] | None, config: Config
) -> GivenDetectors:
    """Tell apart what was handed over; it takes the place of `detect.name` in the settings.

    Parameters
    ----------
    given : callable, Detector, LidarDetector, str or a list of two of them, optional
        See `log2sim.reconstruct`.
    config : Config

    Raises
    ------
    TypeError
        When it is none of these, or two are for the same sensors.
    PluginError
        When a detector lacks something.
    """
    if given is None:
        return GivenDetectors(config)
    parts = list(given) if isinstance(given, (list, tuple)) else [given]
    names: dict[str, str] = {}
    images: Detector | None = None
    sweeps: LidarDetector | None = None
    for part in parts:
        if isinstance(part, str):
            kind, name = "sweeps" if part.startswith(LIDAR_PREFIX) else "images", part
        elif _searches_clouds(part):
            sweeps = checked_lidar(part, _say(part))
            kind, name = "sweeps", f"{LIDAR_PREFIX}{GIVEN_PREFIX}{sweeps.name}"
        else:
            images = _in_images(part, config.detect.min_score)
            kind, name = "images", f"{GIVEN_PREFIX}{images.name}"
        if kind in names:
            raise TypeError(f"detector: two for {kind}, {names[kind]} and {name}; expected {EXPECTED}")
        names[kind] = name
    if not names:
        raise TypeError(f"detector: an empty list, expected {EXPECTED}")
    joined = "+".join(names[kind] for kind in ("images", "sweeps") if kind in names)
    return GivenDetectors(config.changed(detect={"name": joined}), images, sweeps)


def _searches_clouds(given: Any) -> bool:
    """Whether an object is a detector for clouds: those for pictures have a default score, and `detect` takes one frame."""
    detect = getattr(given, "detect", None)
    return (
        callable(detect)
        and not hasattr(given, "default_min_score")
        and find_call_defect(detect, DETECT_IN_CLOUD) is None
    )


def _in_images(given: Any, min_score: float) -> Detector:
    if hasattr(given, "detect"):
        return checked(given, _say(given))
    if not callable(given):
        raise TypeError(f"detector: a {type(given).__name__}, expected {EXPECTED}")
    name = str(getattr(given, "__name__", type(given).__name__)).strip("<>")
    return checked(FunctionDetector(given, min_score, name), f"detector '{name}'")


def _say(given: Any) -> str:
    return f"detector '{getattr(given, 'name', type(given).__name__)}'"
