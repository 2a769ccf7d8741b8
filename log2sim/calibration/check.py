"""Check the clocks and mounts of a log against the motion of the ego, and correct them where the settings ask for it."""

from __future__ import annotations

from collections.abc import Callable

from log2sim.calibration.cameras import check_cameras
from log2sim.calibration.lidar import check_lidars
from log2sim.config import Config
from log2sim.datatypes import Fault, Log
from log2sim.sensors import Sensors

Progress = Callable[[str, int, int], None]


def check_calibration(
    log: Log, config: Config, sensors: Sensors, *, progress: Progress
) -> tuple[Log, tuple[Fault, ...]]:
    """Estimate offsets of clocks and rotations of mounts from a log.

    Parameters
    ----------
    log : Log
        With the poses that the run uses.
    config : Config
        `calibration`: whether to check, and what to correct; `start_s`, `stop_s`: what is looked at.
    sensors : Sensors
        Those that the run uses; others are not checked.
    progress : callable
        Called as `progress(stage, done, total)`.

    Returns
    -------
    log : Log
        With the corrections that the settings ask for.
    faults : tuple of Fault
    """
    if not config.calibration.check:
        return log, ()
    log, of_lidars = check_lidars(log, config, sensors, progress=progress)
    log, of_cameras = check_cameras(log, config, sensors, of_lidars=of_lidars, progress=progress)
    return log, (*of_lidars, *of_cameras)
