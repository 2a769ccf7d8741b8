"""Register the road's LiDARs to the map of the ego, and their clocks to its clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from log2sim.config import Config
from log2sim.datatypes import Fault, Log
from log2sim.sensors import Sensors

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class RoadRegistration:
    """What came of the registration of the road's sensors.

    Attributes
    ----------
    log : Log
        With the corrected mounts and stamps.
    faults : tuple of Fault
    figures : list of dict
        For the report, one entry for each roadside unit.
    """

    log: Log
    faults: tuple[Fault, ...] = ()
    figures: list[dict[str, Any]] = field(default_factory=list)


def register_road(log: Log, config: Config, sensors: Sensors, *, progress: Progress) -> RoadRegistration:
    """Estimate poses and clocks of the road's sensors against what the vehicle's sensors see.

    Parameters
    ----------
    log : Log
        With the poses that the run uses.
    config : Config
        `cooperation.register_road`: whether to do so.
    sensors : Sensors
        Those that the run uses.
    progress : callable
        Called as `progress(stage, done, total)`.
    """
    return RoadRegistration(log)
