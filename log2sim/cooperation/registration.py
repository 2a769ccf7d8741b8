"""Register the road's LiDARs to the map of the ego, and their clocks to its clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from log2sim.config import Config
from log2sim.cooperation.estimate import Estimate, Sight, add_pose_errors, estimate_error, look_around
from log2sim.cooperation.findings import Findings
from log2sim.cooperation.free_space import Visibility, look_through
from log2sim.cooperation.ground_match import upright_points
from log2sim.cooperation.pose_fit import DELAY
from log2sim.cooperation.units import Unit, correct_unit, units_of
from log2sim.datatypes import Fault, Log
from log2sim.geometry import Array
from log2sim.localization.ego_sweeps import lidars_on_ego
from log2sim.sensors import Sensors

Progress = Callable[[str, int, int], None]

# GNSS with an IMU errs by less; a larger error is the unit's.
MAX_POSE_ERROR_M, MAX_POSE_ERROR_RAD = 0.4, np.radians(1.5)


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

    Notes
    -----
    The ego's poses and its clock are the reference. Nothing is read of a log without LiDARs at both ends.
    """
    used = sensors.restrict(log)
    at_road = [n for n, lidar in used.lidars.items() if lidar.mount == "map" and len(log.streams[n].t_ns)]
    if not config.cooperation.register_road or log.ego is None or not at_road or not lidars_on_ego(used):
        return RoadRegistration(log)
    faults: list[Fault] = []
    figures = []
    for unit in units_of(used, at_road):
        findings = _check_unit(used, config, unit, progress)
        log = (
            correct_unit(log, unit, findings.correction, float(findings.applied[-1])) if findings.applied.any() else log
        )
        faults += findings.faults()
        figures.append(findings.to_dict())
    return RoadRegistration(log, tuple(faults), figures)


def _check_unit(log: Log, config: Config, unit: Unit, progress: Progress) -> Findings:
    """Estimate what a unit lacks, and look whether what it sees can be there."""
    sight = look_around(log, config, unit, lambda done, total: progress(f"register {unit.lidars[0]}", done, total))
    found, upright = estimate_error(sight), upright_points(sight.road.steady_m)
    visibility = (_visibility(sight, upright, np.eye(4)), _visibility(sight, upright, found.correction))
    findings = Findings(unit, found, visibility)
    if log.ego is None or not findings.moved or not _may_be_of_ego(found):
        return findings
    return replace(findings, found=add_pose_errors(sight, found, log.ego))


def _may_be_of_ego(found: Estimate) -> bool:
    """Whether errors of the ego's poses can be as large as what a unit's pose is off by."""
    shift_m, turn_rad = np.linalg.norm(found.values[:3]), np.linalg.norm(found.values[3:DELAY])
    return bool(shift_m < MAX_POSE_ERROR_M and turn_rad < MAX_POSE_ERROR_RAD)


def _visibility(sight: Sight, upright_m: Array, correction: Array) -> Visibility | None:
    if sight.view is None:
        return None
    return look_through(sight.view, upright_m @ correction[:3, :3].T + correction[:3, 3])
