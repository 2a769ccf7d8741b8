"""At what level the measurements of the vehicle's and the road's sensors are joined, and why."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from log2sim.config import Config
from log2sim.datatypes import ENDS, Log, end_of


class FusionLevel(StrEnum):
    """What of the vehicle's and the road's LiDARs is joined; the values are those of `cooperation.fusion`."""

    POINTS = "points"
    BOXES = "boxes"
    TRACKS = "tracks"


@dataclass(frozen=True)
class FusionChoice:
    """At what level the ends of a log are joined.

    Attributes
    ----------
    level : FusionLevel, optional
        None where not both ends have LiDARs that are searched or measured.
    reason : str
        "" for a log with one end.
    """

    level: FusionLevel | None
    reason: str


def fusion_level(log: Log, config: Config) -> FusionChoice:
    """Decide at what level the ends of a log, with the sensors that are used, are joined."""
    ends = {end_of(lidar) for lidar in log.lidars.values()} | {end_of(camera) for camera in log.cameras.values()}
    if ends < set(ENDS):
        return FusionChoice(None, "")
    with_lidar, asked = {end_of(lidar) for lidar in log.lidars.values()}, FusionLevel(config.cooperation.fusion)
    if with_lidar < set(ENDS):
        missing = [end for end in ENDS if end not in with_lidar]
        return FusionChoice(
            None, f"no LiDAR of {' and '.join(missing)}: what their cameras measure is joined as of any"
        )
    if not config.detect.in_sweeps and asked is not FusionLevel.POINTS:
        reason = f"points: images alone are searched, so that there are no {asked} of LiDARs to join"
        return FusionChoice(FusionLevel.POINTS, reason)
    return FusionChoice(asked, f"{asked}: cooperation.fusion")
