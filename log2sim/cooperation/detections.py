"""Boxes of road users that each end detects alone, at a few moments around those at which the vehicle is nearest to a pole."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.config_sections import AUTO, GIVEN_PREFIX, LIDAR_PREFIX
from log2sim.datatypes import Boxes3D, Log, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.detect3d.detectors import LidarDetector, create_lidar_detector
from log2sim.perception.lidar.viewpoints import assemble_cloud

SPACING_S = 0.2
# Farther from a pole, boxes have too few points.
MAX_AWAY_M = 70.0
REACH_M = 60.0
MIN_SCORE = 0.4
NO_DETECTIONS = "lidar:labels"
GIVEN = LIDAR_PREFIX + GIVEN_PREFIX


def choose_moments(log: Log, site_m: Array, during_ns: tuple[int, int] | None, count: int) -> NDArray[np.int64]:
    """Choose `count` stamps (K,) or fewer at which the vehicle is near a site (3,), evenly spaced around the nearest."""
    if log.ego is None:
        return np.zeros(0, dtype=np.int64)
    first, last = int(log.ego.t_ns[0]), int(log.ego.t_ns[-1])
    if during_ns is not None:
        first, last = max(first, during_ns[0]), min(last, during_ns[1])
    t_ns = np.arange(first, last + 1, round(SPACING_S * NS_PER_S), dtype=np.int64)
    pose, known = log.ego.at(t_ns)
    away = np.hypot(*(pose[:, :2, 3] - site_m[:2]).T)
    usable = np.flatnonzero(known & (away < MAX_AWAY_M))
    if len(usable) > count:
        nearest = int(np.argmin(away[usable]))
        begin = int(np.clip(nearest - count // 2, 0, len(usable) - count))
        usable = usable[begin : begin + count]
    return np.asarray(t_ns[usable])


def detect_boxes(
    log: Log, lidars: Sequence[str], detector: LidarDetector, moments_ns: NDArray[np.int64], floor_m: Array
) -> list[Boxes3D]:
    """Detect road users in the clouds of some LiDARs nearest to moments (K,).

    Parameters
    ----------
    floor_m : (K, 3) float64, m
        Where clouds begin: a place on the ground, map frame.
    """
    out, before = [], None
    for moment, floor in zip(moments_ns.tolist(), floor_m):
        index = {name: _nearest(log.streams[name].t_ns, moment) for name in lidars}
        if index == before:
            continue
        before = index
        sweeps = {name: sweep for name, i in index.items() if (sweep := _read(log, name, i)) is not None}
        cloud = (
            assemble_cloud(log, sweeps, origin=floor, ground_z=float(floor[2]), max_range_m=REACH_M) if sweeps else None
        )
        if cloud is not None:
            boxes = detector.detect(cloud)
            out.append(boxes.take(boxes.score >= MIN_SCORE))
    return out


def _nearest(t_ns: NDArray[np.int64], moment: int) -> int:
    return int(np.argmin(np.abs(t_ns - moment)))


def _read(log: Log, lidar: str, index: int) -> Sweep | None:
    try:
        sweep: Sweep = log.streams[lidar].read(index)
    except RecordError:
        return None
    return sweep


def detectors_of(log: Log, config: Config) -> tuple[LidarDetector, LidarDetector]:
    """Make the detectors for the clouds of the vehicle and of the road.

    Labels are no detections: they are where they are, whatever a sensor's pose.
    """
    vehicle, road = config.detect.in_sweeps, config.cooperation.road_detector
    names = (
        vehicle if vehicle not in ("", NO_DETECTIONS) and not vehicle.startswith(GIVEN) else "lidar:vehicle",
        road if road not in (AUTO, NO_DETECTIONS) else "lidar:roadside",
    )
    first, second = (create_lidar_detector(name, log, config.lidar) for name in names)
    return first, second
