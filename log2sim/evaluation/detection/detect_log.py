"""Run a LiDAR detector over the sweeps of a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.moving import turn_to_courses
from log2sim.config import Config
from log2sim.datatypes import ROAD, Boxes3D, Finding, Log, end_of
from log2sim.errors import ConfigError, LogError
from log2sim.evaluation.detection.boxes import DetectedBoxes
from log2sim.localization.choice import PoseChoice
from log2sim.perception.detect3d.detectors import LidarDetector
from log2sim.perception.first_pass import CloudMaker
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.measure import outside_ego
from log2sim.perception.records import RecordSource
from log2sim.perception.sync import Schedule, sweep_middle_ns
from log2sim.pipeline import start
from log2sim.report import Run, unreadable_records


def clouds(
    run: Run, records: RecordSource, detector: LidarDetector | None
) -> Iterator[tuple[int, Cloud | None, Boxes3D]]:
    """Yield all ticks of a run without cameras: the cloud, None where the sweep cannot be read or has no pose, and what a detector finds."""
    maker = CloudMaker(run.log, run.schedule, run.plan, run.config, detector)
    for tick in range(len(run.schedule)):
        (cloud,) = maker.clouds(tick, records)
        yield tick, cloud, Boxes3D.empty() if detector is None else maker.boxes(tick)


def middle_ns(run: Run) -> int:
    """Return the time from the stamp of a sweep to its middle, ns."""
    return sweep_middle_ns(run.log, run.schedule.reference)


def take_ticks(schedule: Schedule, ticks: NDArray[np.int64] | slice) -> Schedule:
    """Return a schedule of the ticks at an index (K,)."""
    return replace(
        schedule,
        t_ns=schedule.t_ns[ticks],
        frames={name: index[ticks] for name, index in schedule.frames.items()},
        sweeps={name: index[:, ticks] for name, index in schedule.sweeps.items()},
        residuals_s={name: residual[ticks] for name, residual in schedule.residuals_s.items()},
    )


@dataclass(frozen=True, eq=False)
class LogDetections:
    """Boxes of a log, and what could not be searched."""

    found: DetectedBoxes
    left_out: int  # sweeps that cannot be read or have no pose
    findings: tuple[Finding, ...]  # of poses, sensors and records
    poses: PoseChoice  # where the poses come from that place the boxes in the map


def detect_log(
    log: Log, config: Config | None = None, *, progress: Callable[[int, int], None] | None = None
) -> LogDetections:
    """Detect road users in the sweeps of a log; the boxes of those that move point where they go.

    Raises `ConfigError` for a detector that is none for LiDARs, or when no sweep is left. Raises `LogError` for a log
    without LiDAR, or when no sweep can be searched.

    `config`: `detect.name` is a LiDAR detector, "lidar:vehicle" by default; its settings are in the section `lidar`. `progress`:
    called with (sweeps done, all sweeps).
    """
    config = config or Config(detect="lidar:vehicle")
    if config.detect.in_images or not config.detect.in_sweeps:
        raise ConfigError(
            f"detector '{config.detect.name}': 3D boxes are detected in LiDAR sweeps alone; expected a name that begins with "
            "'lidar:', such as lidar:vehicle"
        )
    run = start(log, config)
    records, detector = RecordSource(run.log), run.detectors.sweeps
    of_sweeps, stamps, boxes = run.schedule.t_ns - middle_ns(run), [], []
    for tick, cloud, of_tick in clouds(run, records, detector):
        if cloud is not None:
            stamps.append(of_sweeps[tick])
            boxes.append(drop_ego(run.log, of_tick))
        if progress is not None:
            progress(tick + 1, len(run.schedule))
    records.require_some()
    if not stamps:
        raise LogError(f"{log.name}: none of the {len(run.schedule)} sweeps has a known pose and points")
    t_ns = np.array(stamps, dtype=np.int64)
    turned = turn_to_courses(boxes, t_ns, config.track)
    found = DetectedBoxes(log.name, run.detectors.name, t_ns, tuple(turned), run.poses.to_provenance())
    findings = (*run.poses.findings, *run.faults, *unreadable_records(records.summary()))
    return LogDetections(found, len(run.schedule) - len(stamps), findings, run.poses)


def drop_ego(log: Log, boxes: Boxes3D) -> Boxes3D:
    """Leave out the boxes on the ego where the road's LiDARs see it: it is no other road user, and no label is on it."""
    return outside_ego(log, boxes) if any(end_of(lidar) == ROAD for lidar in log.lidars.values()) else boxes
