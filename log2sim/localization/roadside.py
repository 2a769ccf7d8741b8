"""Roadside units registered to the map and the clock of the ego."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import erf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import Finding, Log
from log2sim.geometry import NS_PER_S, Array, PoseTrack, apply, inverse, transform, yaw_of
from log2sim.localization.choice import Progress, during_ns
from log2sim.localization.odometry import lidars_on_ego
from log2sim.localization.replaced import shift_stream
from log2sim.localization.roadside_fit import (
    DELAY,
    PRIOR_SIGMA,
    CommonGround,
    CommonObjects,
    Matched,
    MatchedStructure,
    RoadView,
    Surfaces,
    VehicleView,
    Visibility,
    choose_moments,
    common_ground,
    compare_visibility,
    detect_boxes,
    detectors_of,
    ground_below,
    independent_parts,
    link_boxes,
    match_ground,
    match_objects,
    match_structure,
    solve,
    surfaces_of,
    track_of,
    upright_points,
    view_from_road,
    view_from_vehicle,
)
from log2sim.localization.surfaces import adjoint_of, exp_of, log_of
from log2sim.plan import Sensors

# Sensors of one pole are not farther apart in the plane.
MAX_UNIT_M = 3.0


@dataclass(frozen=True, eq=False)
class Unit:
    """Sensors at one place of the roadside."""

    lidars: tuple[str, ...]
    cameras: tuple[str, ...]
    site_m: Array  # (3,): mean place of its LiDARs in the map

    @property
    def sensors(self) -> tuple[str, ...]:
        """All of them, LiDARs first."""
        return (*self.lidars, *self.cameras)


def units_of(log: Log, lidars: Sequence[str]) -> list[Unit]:
    """Group LiDARs of the roadside, and the cameras beside them, by their places."""
    groups: list[list[str]] = []
    place = {name: log.lidars[name].mount_T_lidar[:2, 3] for name in lidars}
    for name in lidars:
        near = [group for group in groups if any(np.hypot(*(place[name] - place[k])) < MAX_UNIT_M for k in group)]
        groups = [group for group in groups if group not in near] + [[*(n for group in near for n in group), name]]
    units = []
    for group in groups:
        site = np.mean([log.lidars[name].mount_T_lidar[:3, 3] for name in group], axis=0)
        beside = [
            n
            for n, c in log.cameras.items()
            if c.mount == "map" and np.hypot(*(c.mount_T_cam[:2, 3] - site[:2])) < MAX_UNIT_M
        ]
        units.append(Unit(tuple(group), tuple(beside), site))
    return units


def correct_unit(log: Log, unit: Unit, correction: Array, delay_s: float) -> Log:
    """Return the log with a unit's sensors moved and its stamps, which are late by `delay_s`, put right.

    `correction` (4, 4) takes places by the unit's poses to right ones, both in the frame of the site: map axes, origin at `site_m`.
    """
    shift = transform(np.eye(3), unit.site_m)
    moved = shift @ correction @ inverse(shift)
    lidars, cameras, streams = dict(log.lidars), dict(log.cameras), dict(log.streams)
    for name in unit.lidars:
        lidars[name] = replace(lidars[name], mount_T_lidar=moved @ lidars[name].mount_T_lidar)
    for name in unit.cameras:
        cameras[name] = replace(cameras[name], mount_T_cam=moved @ cameras[name].mount_T_cam)
    for name in unit.sensors:
        if name in streams:
            streams[name] = shift_stream(streams[name], -round(delay_s * NS_PER_S), moved)
    return log.changed(lidars=lidars, cameras=cameras, streams=streams)


# An error of 0.5 m and 2 degrees moves what is 40 m away by 1.9 m; then within what noise and edges leave.
SURFACE_WITHIN_M = (2.0, 1.5, 1.0, 0.7, 0.5, 0.4, 0.3, 0.3, 0.3)
OBJECT_WITHIN_M = (2.5, 2.0, 1.5, 1.2, 1.0, 1.0, 1.0, 1.0, 1.0)
# Delays that are tried; stamps of a sweep's begin instead of its end are early by a period.
TRIED_DELAYS_S = np.arange(-0.2, 0.51, 0.1)
JUDGED_WITHIN_M = 0.5
# Of the vehicle's way, to see how far its poses drift.
PARTS, HELD_SHARE = 3, 0.3
# Of the sides of the ego's box and its yaw, which GNSS with an IMU gives.
OWN_SIGMA_M, OWN_SIGMA_RAD = 0.05, 0.005
# Where structure holds the pose in the plane, objects are needed for the delay alone, for which fewer moments do.
HELD_M, FEW_MOMENTS, MANY_MOMENTS = 0.1, 15, 30


@dataclass(frozen=True, eq=False)
class Sight:
    """What both ends see around a unit, in the frame of its site: map axes, origin at `Unit.site_m`."""

    view: VehicleView | None  # of the vehicle; None where it never comes near
    road: RoadView  # what stands still by the unit's LiDARs
    surfaces: Surfaces | None
    ground: CommonGround | None
    objects: CommonObjects
    # (7, 7): of what the unit's pose seems to lack because the ego's poses err
    of_poses: Array = field(default_factory=lambda: np.zeros((7, 7)))

    def near(self, values: Array, within_m: float) -> MatchedStructure | None:
        """Match structure as values (7,) move it."""
        if self.surfaces is None:
            return None
        return match_structure(self.surfaces, self.road.xyz_m, exp_of(values[:DELAY]), within_m)

    def objects_near(self, values: Array, within_m: float) -> Matched | None:
        """Match road users as values (7,) move them."""
        return match_objects(self.objects, exp_of(values[:DELAY]), float(values[DELAY]), within_m)

    def gain(self, values: Array, within_m: float) -> float:
        """Tell how well road users fit together."""
        found = self.objects_near(values, within_m)
        return 0.0 if found is None else found.gain


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a unit's pose and clock lack."""

    values: Array  # (7,): twist (m, rad) of the site that corrects it, and the delay of its stamps, s
    covariance: Array  # (7, 7)
    # `structure`, `objects`: without and with the correction, by the same limit
    structure: tuple[MatchedStructure | None, MatchedStructure | None]
    objects: tuple[Matched | None, Matched | None]


def collect_sight(log: Log, config: Config, unit: Unit, report: Callable[[int, int], None]) -> Sight:
    """Collect what both ends see around a unit."""
    during = during_ns(log, config)
    report(0, 3)
    view = view_from_vehicle(log, unit.site_m, during)
    road = view_from_road(log, unit.lidars, unit.site_m, during)
    report(1, 3)
    surfaces = None if view is None else surfaces_of(view, road.xyz_m)
    report(2, 3)
    ground = None if view is None else common_ground(view, road.xyz_m)
    of_poses = np.zeros((7, 7)) if view is None or log.ego is None else covariance_of_poses(log.ego, view)
    sight = Sight(view, road, surfaces, ground, CommonObjects(()), of_poses)
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
    half = np.array(log.ego_vehicle.size_m[:2]) / 2
    of_box = np.tile([*half, *[OWN_SIGMA_M] * 4], (len(moments), 1))
    own = np.column_stack(
        [0 * moments, (moments - start) / NS_PER_S, places, of_box, yaw_of(pose), 0 * moments + OWN_SIGMA_RAD]
    )
    seen = link_boxes(detect_boxes(log, lidars_on_ego(log), of_vehicle, moments, floor), unit.site_m, start)
    road = link_boxes(detect_boxes(log, unit.lidars, of_road, moments, at_pole), unit.site_m, start)
    return CommonObjects.of((track_of(own), *seen), road)


def estimate_error(sight: Sight) -> Estimate:
    """Estimate what a unit's pose and clock lack.

    Structure first, with limits that become tighter; then the delay with which most common objects fall onto each other; then
    all together by Gauss and Newton's method.
    """
    by_structure, _ = _refine(sight, np.zeros(7), with_objects=False)
    tried = [_refine(sight, start, with_objects=True) for start in _starts(sight, by_structure)]
    values, covariance = max(tried, key=lambda found: sight.gain(found[0], OBJECT_WITHIN_M[-1]))
    without, near_m, far_m = np.zeros(7), JUDGED_WITHIN_M, OBJECT_WITHIN_M[0]
    return Estimate(
        values, covariance + sight.of_poses, (sight.near(without, near_m), sight.near(values, near_m)),
        (sight.objects_near(without, far_m), sight.objects_near(values, far_m)),
    )  # fmt: skip


def covariance_of_poses(track: PoseTrack, view: VehicleView) -> Array:
    """Compute how far the errors of the ego's poses move a unit: the covariance (7, 7) of what it seems to lack.

    The poses err for seconds, so that the mean over the ego's way errs less the longer it takes. What is turned where the ego is, at
    the middle of its sweeps, moves the site by its distance from there too.
    """
    sigma_m, sigma_rad = track.sigmas_at(view.t_ns).mean(axis=0)
    site_T_ego = adjoint_of(transform(np.eye(3), view.sensor_m.mean(axis=0)))
    out, count = np.zeros((7, 7)), independent_parts(float(np.ptp(view.t_ns)) / NS_PER_S)
    out[:DELAY, :DELAY] = site_T_ego @ np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3) @ site_T_ego.T / count
    return out


def add_drift(sight: Sight, found: Estimate) -> Estimate:
    """Return the estimate with the drift of the ego's poses that is seen in its covariance.

    What parts of the ego's way say about the unit's pose differs by the errors of its poses, and the mean of them all
    errs by the square root of their number less. Of each kind, translation and rotation, one variance is taken for all axes.
    """
    if sight.view is None:
        return found
    road, fits = sight.road.xyz_m, []
    for part in (part for part in sight.view.parts(PARTS) if len(part.xyz_m)):
        of_part = replace(sight, view=part, surfaces=surfaces_of(part, road), ground=common_ground(part, road))
        fits.append(_refine(of_part, np.zeros(7), with_objects=False))
    if len(fits) < PARTS:
        return found
    values, variance = np.array([value for value, _ in fits]), np.zeros(7)
    # What structure does not hold scatters by the noise of surfaces alone.
    held = np.max([np.diag(covariance) for _, covariance in fits], axis=0) < (HELD_SHARE * PRIOR_SIGMA) ** 2
    for rows in (np.arange(3), np.arange(3, DELAY)):
        if held[rows].any():
            variance[rows] = values[:, rows[held[rows]]].var(axis=0, ddof=1).mean() / PARTS
    return replace(found, covariance=found.covariance + np.diag(variance))


def _starts(sight: Sight, by_structure: Array) -> list[Array]:
    """Choose delays, and the pose by structure or that of the calibration, by which objects fit best: within a wide and a narrow limit."""
    nearest_first = TRIED_DELAYS_S[np.argsort(np.abs(TRIED_DELAYS_S), kind="stable")]
    tried = [np.append(pose[:DELAY], delay_s) for pose in (by_structure, np.zeros(7)) for delay_s in nearest_first]
    limits = (OBJECT_WITHIN_M[0], OBJECT_WITHIN_M[-1])
    chosen = {int(np.argmax([sight.gain(values, within_m) for values in tried])) for within_m in limits}
    return [tried[k] for k in sorted(chosen)]


def _refine(sight: Sight, start: Array, *, with_objects: bool) -> tuple[Array, Array]:
    """Improve values (7,) step by step; return them with their covariance (7, 7)."""
    values, covariance = start, np.diag(PRIOR_SIGMA**2)
    for near_surface, near_object in zip(SURFACE_WITHIN_M, OBJECT_WITHIN_M):
        structure = sight.near(values, near_surface)
        objects = sight.objects_near(values, near_object) if with_objects else None
        parts = [part.evidence for part in (structure, objects) if part is not None]
        ground = None if sight.ground is None else match_ground(sight.ground, exp_of(values[:DELAY]), near_surface)
        parts += [] if ground is None else [ground]
        step, covariance = solve(parts, values)
        pose = exp_of(step[:DELAY]) @ exp_of(values[:DELAY])
        values = np.append(log_of(pose), values[DELAY] + step[DELAY])
    return values, covariance


# What is certain is corrected if it matters: as much as agents are misplaced anyway, near the unit and 20 to 40 m away; stamps
# by as much at city speeds.
MIN_SHIFT_M, MIN_TURN_RAD, MIN_DELAY_S = 0.1, np.radians(0.3), 0.02
# What is left of a delay is within that with this probability where nothing is said.
MIN_CERTAINTY = 0.9
# Chance explains as much in one of 100 checks of six normal variables, or of the three in the plane (chi-square), and in one of
# 300 of one. The sigmas of poses are bounds by what points have in common: on streets with houses, estimates are within a third.
MAX_CHANCE_CHI2, MAX_CHANCE_PLANE_CHI2, MIN_SIGMAS = 16.8, 11.3, 3.0
# Nothing is corrected by what could be off by more than objects are apart.
MAX_SIGMA_M, MAX_SIGMA_RAD = 0.25, np.radians(1.0)
# Of upright points that the vehicle looked at, the share that it saw through: in synthetic streets up to 3 % with a right pose,
# 7 % with an error of 0.5 m and 2 degrees, 17 to 77 % with larger ones.
MAX_CONTRADICTING, MAX_LEFT, MIN_LOOKED_AT = 0.2, 0.1, 50
# Of matched points, where both ends show one place; in synthetic streets 66 to 96 % of them lie on surfaces, of wrong ones 20 to 36 %.
MIN_ON_SURFACE = 0.5
HEIGHT_AND_TILT, PLANE = [2, 3, 4], [0, 1, 5]


@dataclass(frozen=True, eq=False)
class Findings:
    """What a unit is found to lack."""

    unit: Unit
    found: Estimate
    visibility: tuple[Visibility | None, Visibility | None]  # without and with the correction

    @property
    def sigma(self) -> Array:
        """Standard deviations (7,) of the estimate."""
        return np.asarray(np.sqrt(np.diag(self.found.covariance)))

    @cached_property
    def _looked_rows(self) -> list[int]:
        """The rows of the pose that both ends show: all, or height, roll and pitch where the ground alone ties them."""
        # One common object alone may be matched by mistake.
        before, after = self.found.objects
        agree = after is not None and after.pairs > 1 and after.gain > (0.0 if before is None else before.gain)
        certain = agree and self._chi2(PLANE) > MAX_CHANCE_PLANE_CHI2
        return list(range(DELAY)) if self._known_to(MAX_SIGMA_M, MAX_SIGMA_RAD) or certain else HEIGHT_AND_TILT

    def _chi2(self, rows: list[int]) -> float:
        """How far some values are from 0, squared, in units of their covariance."""
        values = self.found.values[rows]
        return float(values @ np.linalg.solve(self.found.covariance[np.ix_(rows, rows)], values))

    def _likeliest(self, rows: list[int]) -> tuple[Array, Array]:
        """Return values (7,) of some rows and their covariance, if the others are right and so 0."""
        values, covariance, out = self.found.values, self.found.covariance, np.zeros(7)
        others = [k for k in range(7) if k not in rows]
        share = covariance[np.ix_(rows, others)] @ np.linalg.inv(covariance[np.ix_(others, others)])
        out[rows] = values[rows] - share @ values[others]
        return out, covariance[np.ix_(rows, rows)] - share @ covariance[np.ix_(others, rows)]

    @cached_property
    def moved(self) -> bool:
        """Whether the pose is off for certain, by enough to matter, and both ends fit better with another."""
        rows, values = self._looked_rows, self.found.values
        chi2 = self._chi2(rows)
        if len(rows) < DELAY:
            values, covariance = self._likeliest(rows)
            chi2 = float(values[rows] @ np.linalg.solve(covariance, values[rows]))
        large = np.linalg.norm(values[:3]) > MIN_SHIFT_M or np.linalg.norm(values[3:DELAY]) > MIN_TURN_RAD
        structure = [0 if part is None else part.on_surface for part in self.found.structure]
        objects = [0.0 if part is None else part.gain for part in self.found.objects]
        better = structure[1] + objects[1] > structure[0] + objects[0]
        return bool(large and chi2 > MAX_CHANCE_CHI2 and self._fits and better and self._is_free(1, MAX_LEFT))

    @property
    def _sees_movers(self) -> bool:
        """Whether both ends see something that moves."""
        objects = self.found.objects[1]
        return objects is not None and objects.moving > 0

    @cached_property
    def late(self) -> bool:
        """Whether the stamps are off for certain and by enough to matter."""
        delay_s = abs(float(self.found.values[DELAY]))
        return self._sees_movers and delay_s > max(MIN_DELAY_S, MIN_SIGMAS * self.sigma[DELAY])

    @property
    def clock_verified(self) -> bool:
        """Whether the clock is known to what matters, with what was found and is not corrected, nearly as surely as a pose is."""
        left_s, sigma_s = self.found.values[DELAY] - self.applied[DELAY], self.sigma[DELAY] * np.sqrt(2.0)
        likely = (erf((MIN_DELAY_S - left_s) / sigma_s) + erf((MIN_DELAY_S + left_s) / sigma_s)) / 2
        return self._sees_movers and likely > MIN_CERTAINTY

    @property
    def _fits(self) -> bool:
        """Whether what is matched lies on each other."""
        structure = self.found.structure[1]
        return structure is None or structure.on_surface > MIN_ON_SURFACE * structure.points

    @cached_property
    def verified(self) -> bool:
        """Whether the pose is known in the plane, in which agents are placed, to what matters: by two sigmas, so in 19 of 20 cases."""
        return self._known_to(MIN_SHIFT_M / 2, MIN_TURN_RAD / 2)

    def _known_to(self, sigma_m: float, sigma_rad: float) -> bool:
        plane = np.linalg.eigvalsh(self.found.covariance[:2, :2])[-1]
        return bool(self._fits and np.sqrt(plane) < sigma_m and self.sigma[5] < sigma_rad)

    @cached_property
    def contradicted(self) -> bool:
        """Whether the vehicle saw through most of what the unit sees upright, with and without the correction."""
        return not self._is_free(1 if self.moved else 0, MAX_CONTRADICTING)

    def _is_free(self, row: int, limit: float) -> bool:
        """Whether the vehicle saw through few of the unit's points without (0) or with (1) the correction."""
        looked = self.visibility[row]
        if looked is None or looked.seen + looked.seen_through < MIN_LOOKED_AT:
            return True
        return looked.contradicting <= limit

    @cached_property
    def applied(self) -> Array:
        """What is corrected (7,): the whole pose as it was found, or what is likeliest of a part where the rest is taken to be right."""
        rows = [*(self._looked_rows if self.moved else []), *([DELAY] if self.late else [])]
        if self.contradicted or not rows:
            return np.zeros(7)
        if rows[:DELAY] != list(range(DELAY)):
            return self._likeliest(rows)[0]
        # A delay that is not certain is not applied, but may well be there: the pose is not what it would be without.
        return self.found.values * np.isin(np.arange(7), rows)

    def faults(self) -> list[Finding]:
        """Describe what is wrong, and what cannot be said."""
        if self.contradicted:
            share = 0.0 if self.visibility[0] is None else self.visibility[0].contradicting
            values = {"through_share": float(share)}
            return [Finding("wrong_road_pose", name, "left_out", values=values) for name in self.unit.sensors]
        faults, lidar, values = [], self.unit.lidars[0], self._values()
        if self.moved:
            case = "all" if len(self._looked_rows) == DELAY else "height_and_tilt"
            structure, objects = self.found.structure[1], self.found.objects[1]
            of_pose = values | {
                "shift_m": float(np.linalg.norm(self.applied[:3])),
                "turn_deg": float(np.degrees(np.linalg.norm(self.applied[3:DELAY]))),
                "points": 0.0 if structure is None else float(structure.points),
                "pairs": 0.0 if objects is None else float(objects.pairs),
            }
            faults.append(Finding("road_pose", lidar, "corrected", values=of_pose, case=case))
        if self.late:
            faults.append(Finding("road_clock", lidar, "corrected", values=values))
        if not self.verified:
            faults.append(Finding("unknown_road_pose", lidar, values=values))
        if not self.clock_verified:
            faults.append(Finding("unknown_road_clock", lidar, values=values))
        return faults

    def _values(self) -> dict[str, float]:
        values, sigma = self.found.values, self.sigma
        return {
            **{f"{name}_m": float(values[k]) for k, name in enumerate("xyz")},
            **{f"{name}_sigma_m": float(sigma[k]) for k, name in enumerate("xyz")},
            **{f"{name}_deg": float(np.degrees(values[3 + k])) for k, name in enumerate(("roll", "pitch", "yaw"))},
            **{f"{name}_sigma_deg": float(np.degrees(sigma[3 + k])) for k, name in enumerate(("roll", "pitch", "yaw"))},
            "delay_s": float(values[DELAY]),
            "delay_sigma_s": float(sigma[DELAY]),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the figures of the report: the estimate, what was done, and how well both ends fit before and after."""
        names = ("before", "after")
        return {
            "sensors": list(self.unit.sensors),
            "treatment": "left_out" if self.contradicted else "corrected" if self.applied.any() else "kept",
            "verified": self.verified,
            "clock_verified": self.clock_verified,
            **self._values(),
            "structure": {
                n: None
                if s is None
                else {"points": s.points, "on_surface": s.on_surface / s.points, "residual_m": s.rms_m}
                for n, s in zip(names, self.found.structure)
            },
            "objects": {
                n: None if o is None else {"pairs": o.pairs, "moving": o.moving, "residual_m": o.rms_m}
                for n, o in zip(names, self.found.objects)
            },
            "seen_through": {n: None if v is None else v.contradicting for n, v in zip(names, self.visibility)},
        }


# GNSS with an IMU errs by less; a larger error is the unit's.
MAX_POSE_ERROR_M, MAX_POSE_ERROR_RAD = 0.4, np.radians(1.5)


@dataclass(frozen=True, eq=False)
class RoadRegistration:
    """What came of the registration of the road's sensors."""

    log: Log  # with the corrected mounts and stamps
    units: tuple[Findings, ...] = ()

    @property
    def faults(self) -> tuple[Finding, ...]:
        """What is wrong, and what cannot be said."""
        return tuple(fault for unit in self.units for fault in unit.faults())

    @property
    def figures(self) -> list[dict[str, Any]]:
        """For the report, one entry for each roadside unit."""
        return [unit.to_dict() for unit in self.units]


def register_road(log: Log, config: Config, sensors: Sensors, *, progress: Progress) -> RoadRegistration:
    """Estimate poses and clocks of the road's sensors against what the vehicle's sensors see, if `cooperation.register_road` says so.

    The ego's poses and its clock are the reference. Nothing is read of a log without LiDARs at both ends.
    """
    used = sensors.restrict(log)
    at_road = [n for n, lidar in used.lidars.items() if lidar.mount == "map" and len(log.streams[n].t_ns)]
    if not config.cooperation.register_road or log.ego is None or not at_road or not lidars_on_ego(used):
        return RoadRegistration(log)
    units = []
    for unit in units_of(used, at_road):
        sight = collect_sight(used, config, unit, partial(progress, f"register {unit.lidars[0]}"))
        found, upright = estimate_error(sight), upright_points(sight.road.steady_m)
        before, after = (
            None if sight.view is None else compare_visibility(sight.view, apply(correction, upright))
            for correction in (np.eye(4), exp_of(found.values[:DELAY]))
        )
        findings = Findings(unit, found, (before, after))
        shift_m, turn_rad = np.linalg.norm(found.values[:3]), np.linalg.norm(found.values[3:DELAY])
        if findings.moved and shift_m < MAX_POSE_ERROR_M and turn_rad < MAX_POSE_ERROR_RAD:
            # It may be an error of the ego's poses.
            findings = replace(findings, found=add_drift(sight, found))
        if findings.applied.any():
            log = correct_unit(log, unit, exp_of(findings.applied[:DELAY]), float(findings.applied[DELAY]))
        units.append(findings)
    return RoadRegistration(log, tuple(units))
