"""Error of a roadside unit's pose and clock: what both ends see of it, brought together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.calibration.twists import exp_of, log_of
from log2sim.config import Config
from log2sim.cooperation.common_objects import CommonObjects, Matched, link_boxes, match_objects, track_of
from log2sim.cooperation.detections import choose_moments, detect_boxes, detectors_of
from log2sim.cooperation.ground_match import CommonGround, common_ground, ground_below, match_ground
from log2sim.cooperation.pose_fit import DELAY, PRIOR_SIGMA, MatchedStructure, match_structure, solve
from log2sim.cooperation.structure import (
    RoadView,
    Surfaces,
    VehicleView,
    surfaces_of,
    view_from_road,
    view_from_vehicle,
)
from log2sim.cooperation.units import Unit
from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S, Array, PoseTrack
from log2sim.localization.choice import during_ns
from log2sim.localization.ego_sweeps import lidars_on_ego

# An error of 0.5 m and 2 degrees moves what is 40 m away by 1.9 m; then within what noise and edges leave.
SURFACE_WITHIN_M = (2.0, 1.5, 1.0, 0.7, 0.5, 0.4, 0.3, 0.3, 0.3)
OBJECT_WITHIN_M = (2.5, 2.0, 1.5, 1.2, 1.0, 1.0, 1.0, 1.0, 1.0)
# Delays that are tried; stamps of a sweep's begin instead of its end are early by a period.
TRIED_DELAYS_S = np.arange(-0.2, 0.51, 0.1)
JUDGED_WITHIN_M = 0.5
# Of the vehicle's way, to see how far its poses err.
PARTS, HELD_SHARE = 3, 0.3
# Where structure holds the pose in the plane, objects are needed for the delay alone, for which fewer moments do.
HELD_M, FEW_MOMENTS, MANY_MOMENTS = 0.1, 15, 30


@dataclass(frozen=True, eq=False)
class Sight:
    """What both ends see around a unit, in the frame of its site: map axes, origin at `Unit.site_m`.

    Attributes
    ----------
    view : VehicleView or None
        Of the vehicle; None where it never comes near.
    road : RoadView
        What stands still by the unit's LiDARs.
    surfaces : Surfaces or None
    ground : CommonGround or None
    objects : CommonObjects
    """

    view: VehicleView | None
    road: RoadView
    surfaces: Surfaces | None
    ground: CommonGround | None
    objects: CommonObjects


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a unit's pose and clock lack.

    Attributes
    ----------
    values : (7,) float64
        Twist (m, rad) of the site that corrects it, and the delay of its stamps, s.
    covariance : (7, 7) float64
    structure, objects : pair of MatchedStructure or None, pair of Matched or None
        Without and with the correction, by the same limit.
    """

    values: Array
    covariance: Array
    structure: tuple[MatchedStructure | None, MatchedStructure | None]
    objects: tuple[Matched | None, Matched | None]

    @property
    def correction(self) -> Array:
        """The twist as a transform (4, 4)."""
        return exp_of(self.values[:DELAY])


def look_around(log: Log, config: Config, unit: Unit, report: Callable[[int, int], None]) -> Sight:
    """Collect what both ends see around a unit."""
    during = during_ns(log, config)
    report(0, 3)
    view = view_from_vehicle(log, unit.site_m, during)
    road = view_from_road(log, unit.lidars, unit.site_m, during)
    report(1, 3)
    surfaces = None if view is None else surfaces_of(view, road.xyz_m)
    report(2, 3)
    ground = None if view is None else common_ground(view, road.xyz_m)
    sight = Sight(view, road, surfaces, ground, CommonObjects(()))
    covariance = _refine(sight, np.zeros(7), with_objects=False)[1]
    held = np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]) < HELD_M
    moments = choose_moments(log, unit.site_m, during, FEW_MOMENTS if held else MANY_MOMENTS)
    return replace(sight, objects=_objects_around(log, config, unit, road.xyz_m, moments))


def _objects_around(log: Log, config: Config, unit: Unit, road_m: Array, moments: NDArray[np.int64]) -> CommonObjects:
    if log.ego is None or len(moments) == 0:
        return CommonObjects(())
    of_vehicle, of_road = detectors_of(log, config)
    pose, _ = log.ego.at(moments)
    floor = pose[:, :3, 3] + pose[:, :3, 2] * log.ground_z_ego_m
    at_pole = np.repeat((unit.site_m + np.array([0.0, 0.0, ground_below(road_m)]))[None], len(moments), axis=0)
    start = int(moments[0])
    places = log.ego_centers(pose) - unit.site_m
    known = np.ones((len(moments), 1))
    own = np.hstack([(moments - start)[:, None] / NS_PER_S, places, 0 * known, np.inf * known])
    seen = link_boxes(detect_boxes(log, lidars_on_ego(log), of_vehicle, moments, floor), unit.site_m, start)
    road = link_boxes(detect_boxes(log, unit.lidars, of_road, moments, at_pole), unit.site_m, start)
    return CommonObjects.of((track_of(own), *seen), road)


def estimate_error(sight: Sight) -> Estimate:
    """Estimate what a unit's pose and clock lack.

    Notes
    -----
    Structure first, with limits that become tighter; then the delay with which most common objects fall onto each other; then
    all together by Gauss and Newton's method.
    """
    by_structure, _ = _refine(sight, np.zeros(7), with_objects=False)
    tried = [_refine(sight, start, with_objects=True) for start in _starts(sight, by_structure)]
    values, covariance = max(tried, key=lambda found: _gain(sight, found[0], OBJECT_WITHIN_M[-1]))
    return Estimate(
        values,
        covariance,
        (_structure(sight, np.zeros(7), JUDGED_WITHIN_M), _structure(sight, values, JUDGED_WITHIN_M)),
        (_objects(sight, np.zeros(7), OBJECT_WITHIN_M[0]), _objects(sight, values, OBJECT_WITHIN_M[0])),
    )


def add_pose_errors(sight: Sight, found: Estimate, track: PoseTrack) -> Estimate:
    """Return the estimate with the errors of the ego's poses in its covariance: those that the track states, and those seen.

    Notes
    -----
    The ego's poses err for seconds. What parts of its way say about the unit's pose differs by that, and the mean of them all
    errs by the square root of their number less. Of each kind, translation and rotation, one variance is taken for all axes.
    """
    if sight.view is None:
        return found
    parts = [_sight_of_part(sight, part) for part in sight.view.parts(PARTS) if len(part.xyz_m)]
    fits = [_refine(part, np.zeros(7), with_objects=False) for part in parts]
    variance = np.zeros(7)
    if len(fits) == PARTS:
        values = np.array([value for value, _ in fits])
        # What structure does not hold scatters by the noise of surfaces alone.
        held = np.max([np.diag(covariance) for _, covariance in fits], axis=0) < (HELD_SHARE * PRIOR_SIGMA) ** 2
        for rows in (np.arange(3), np.arange(3, DELAY)):
            if held[rows].any():
                variance[rows] = values[:, rows[held[rows]]].var(axis=0, ddof=1).mean() / PARTS
    sigma_m, sigma_rad = track.sigmas_at(sight.view.t_ns, (0.0, 0.0)).mean(axis=0)
    variance[:3] += sigma_m**2
    variance[5] += sigma_rad**2
    return replace(found, covariance=found.covariance + np.diag(variance))


def _sight_of_part(sight: Sight, part: VehicleView) -> Sight:
    road = sight.road.xyz_m
    return replace(sight, view=part, surfaces=surfaces_of(part, road), ground=common_ground(part, road))


def _starts(sight: Sight, by_structure: Array) -> list[Array]:
    """Choose delays, and the pose by structure or that of the calibration, by which objects fit best: within a wide and a narrow limit."""
    nearest_first = TRIED_DELAYS_S[np.argsort(np.abs(TRIED_DELAYS_S), kind="stable")]
    tried = [np.append(pose[:DELAY], delay_s) for pose in (by_structure, np.zeros(7)) for delay_s in nearest_first]
    limits = (OBJECT_WITHIN_M[0], OBJECT_WITHIN_M[-1])
    chosen = {int(np.argmax([_gain(sight, values, within_m) for values in tried])) for within_m in limits}
    return [tried[k] for k in sorted(chosen)]


def _gain(sight: Sight, values: Array, within_m: float) -> float:
    found = _objects(sight, values, within_m)
    return 0.0 if found is None else found.gain


def _refine(sight: Sight, start: Array, *, with_objects: bool) -> tuple[Array, Array]:
    """Improve values (7,) step by step; return them with their covariance (7, 7)."""
    values, covariance = start, np.diag(PRIOR_SIGMA**2)
    for near_surface, near_object in zip(SURFACE_WITHIN_M, OBJECT_WITHIN_M):
        structure = _structure(sight, values, near_surface)
        objects = _objects(sight, values, near_object) if with_objects else None
        parts = [part.evidence for part in (structure, objects) if part is not None]
        ground = None if sight.ground is None else match_ground(sight.ground, exp_of(values[:DELAY]), near_surface)
        parts += [] if ground is None else [ground]
        step, covariance = solve(parts, values)
        pose = exp_of(step[:DELAY]) @ exp_of(values[:DELAY])
        values = np.append(log_of(pose), values[DELAY] + step[DELAY])
    return values, covariance


def _structure(sight: Sight, values: Array, within_m: float) -> MatchedStructure | None:
    if sight.surfaces is None:
        return None
    return match_structure(sight.surfaces, sight.road.xyz_m, exp_of(values[:DELAY]), within_m)


def _objects(sight: Sight, values: Array, within_m: float) -> Matched | None:
    return match_objects(sight.objects, exp_of(values[:DELAY]), float(values[DELAY]), within_m)
