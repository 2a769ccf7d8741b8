"""A LiDAR detector that searches the clouds of each end on its own and joins what it finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from log2sim.config import Config
from log2sim.datatypes import ROAD, Boxes3D, Log, end_of, seen_from
from log2sim.fusion_level import FusionLevel, fusion_level
from log2sim.geometry import Array
from log2sim.perception.cooperative.matching import SeenBoxes
from log2sim.perception.cooperative.merging import METHODS, Method, fuse_boxes, join
from log2sim.perception.cooperative.refinement import refine_boxes
from log2sim.perception.detect3d.detectors import LidarDetector, create_lidar_detector
from log2sim.perception.lidar.cloud import Cloud
from log2sim.sensors import ROADSIDE_NETWORK, VEHICLE_NETWORK, network_for

AUTO = "auto"


@dataclass(frozen=True, eq=False)
class EndsDetector:
    """Detector of road users in the clouds of both ends.

    Attributes
    ----------
    vehicle, road : LidarDetector
        For the clouds of each end.
    method : Method, optional
        How boxes of the ends are joined; without it each end keeps its own.
    """

    vehicle: LidarDetector
    road: LidarDetector
    method: Method | None

    @property
    def name(self) -> str:
        """Names of both detectors, the vehicle's first; one where they are the same."""
        names = dict.fromkeys((self.vehicle.name, self.road.name))
        return "|".join(names)

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        """Detect road users in the cloud of each viewpoint and join them; `earlier` clouds are those of the same viewpoint."""
        parts = [self._search(view, earlier) for view in cloud.views]
        if self.method is None:
            out = join(parts).boxes
        else:
            method = self.method
            out = reduce(lambda a, b: fuse_boxes(a, b, method), parts).boxes
        return out.take(np.argsort(-out.score, kind="stable"))

    def _search(self, view: Cloud, earlier: Sequence[Cloud]) -> SeenBoxes:
        """Search the cloud of one viewpoint."""
        detector = self.road if view.end == ROAD else self.vehicle
        before = [other for cloud in earlier for other in cloud.views if _is_same_view(view, other)]
        found = detector.detect(view, before)
        if self.method is not None and self.method.refines:
            found = refine_boxes(found, view)
        found = replace(found, seen_by=seen_from(view.end, len(found)))
        return SeenBoxes.of(found, view.sensor.astype(np.float64) + view.origin)


def _is_same_view(one: Cloud, other: Cloud) -> bool:
    """Return whether two clouds are of the same end and, at the road, of the same place."""
    moved: Array = one.sensor + one.origin - other.sensor - other.origin
    return one.end == other.end and (one.end != ROAD or float(np.linalg.norm(moved)) < 1.0)


def create_for_ends(log: Log, config: Config, given: LidarDetector | None = None) -> LidarDetector:
    """Make the detector in LiDAR sweeps of a log, one for each end where these are searched apart.

    Parameters
    ----------
    given : LidarDetector, optional
        Takes the place of the one that the settings name.

    Raises
    ------
    ConfigError, MissingExtra
        See `create_lidar_detector`.
    """
    name, level = config.detect.in_sweeps, fusion_level(log, config).level
    vehicle = given or create_lidar_detector(name, log, config.lidar)
    if level in (None, FusionLevel.POINTS):
        return vehicle
    chosen = config.cooperation.road_detector
    road_name = detector_by_mounting(log, name) if chosen == AUTO else chosen
    road = vehicle if road_name == name else create_lidar_detector(road_name, log, config.lidar)
    return EndsDetector(vehicle, road, METHODS[config.cooperation.matching] if level is FusionLevel.BOXES else None)


def detector_by_mounting(log: Log, name: str) -> str:
    """Return the shipped detector that fits how the road's LiDARs look down; a detector of the user's own is for both ends."""
    if name not in (VEHICLE_NETWORK, ROADSIDE_NETWORK):
        return name
    return network_for(lidar for lidar in log.lidars.values() if end_of(lidar) == ROAD)
