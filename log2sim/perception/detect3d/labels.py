"""The 3D labels of a log instead of a detector, without their track ids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from log2sim import registry
from log2sim.config_sections import LidarConfig
from log2sim.datatypes import CATEGORIES, Boxes3D, Log
from log2sim.errors import ConfigError
from log2sim.perception.detect.label_motion import LabelBoxes, interpolate_boxes, window_ns
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.lidar.cloud import Cloud


@dataclass(frozen=True, eq=False)
class LabelBoxDetector:
    """LiDAR detector that returns the labels of a log in which the cloud has points.

    Attributes
    ----------
    log : Log
    max_range_m : float
        Largest distance from the sensor along an axis, m; infinite without a limit.
    name : str
    """

    log: Log
    max_range_m: float = np.inf
    name: str = "lidar:labels"

    def detect(self, cloud: Cloud, earlier: Sequence[Cloud] = ()) -> Boxes3D:
        """Return the labels at the cloud's stamp with score 1, most points first, then nearest; `earlier` has no effect."""
        labels, window = self._labels
        if not len(labels.t_ns):
            return Boxes3D.empty()
        found = interpolate_boxes(labels, cloud.stamp_ns, window)
        local = found.center_m - cloud.origin
        away = np.abs(local[:, :2] - cloud.sensor[:2])
        near = np.all(away <= self.max_range_m, axis=1)
        found, local = found.take(np.flatnonzero(near)), local[near]
        # Points on the ground count for no box: a box whose lower face is 5 cm too low would gain hundreds.
        points = points_of_boxes(cloud.xyz, local, found.size_m, found.yaw_rad, ~cloud.ground).count
        seen = np.flatnonzero(points > 0)
        seen = seen[np.lexsort((np.hypot(*away[near][seen].T), -points[seen]))]
        found, one = found.take(seen), np.ones(len(seen))
        return Boxes3D(
            found.t_ns,
            found.center_m,
            found.size_m,
            found.yaw_rad,
            one,
            found.category.astype("<U16"),
            one,
            points[seen],
        )

    @cached_property
    def _labels(self) -> tuple[LabelBoxes, int]:
        """Labels of road users in the order of their stamps, and the time around a cloud in which to search them, ns."""
        labels = self.log.labels
        assert labels is not None
        rows = np.flatnonzero(np.isin(labels.category, CATEGORIES))
        rows = rows[np.argsort(labels.t_ns[rows], kind="stable")]
        everything = LabelBoxes(labels.t_ns, labels.category, labels.center_m, labels.size_m, labels.yaw_rad)
        return everything.take(rows), window_ns(labels.t_ns)


def create(log: Log, settings: LidarConfig) -> LabelBoxDetector:
    """Make the detector `lidar:labels`.

    Raises
    ------
    ConfigError
        When the log has no 3D labels.
    """
    if log.labels is None:
        others = ", ".join(f"lidar:{name}" for name in registry.names("lidar_detector") if name != "labels")
        raise ConfigError(
            f"detector 'lidar:labels': log '{log.name}' ({log.format}) has no labeled 3D boxes; "
            f"choose another detector: {others}, or lidar: and the path of an ONNX file"
        )
    return LabelBoxDetector(log, settings.range_m or np.inf)
