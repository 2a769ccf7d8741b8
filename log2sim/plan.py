"""What a run needs: a decision with its reason for every optional part, made once before the run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import Log
from log2sim.fusion_level import FusionLevel, fusion_level
from log2sim.geometry import NS_PER_S, Array, period_of
from log2sim.sensors import MAX_LIDAR_RANGE_M, Sensors
from log2sim.tracking.tracker import min_hits

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


DESCRIBING = (Stage.LANES, Stage.COLORS, Stage.SIGNALS)
"""Stages that describe a scenario once its agents are known, see `log2sim.describe`."""


class HomographyScope(Enum):
    """Cameras that get a homography."""

    NONE = "none"
    CAMERAS_IN_NEED = "cameras with detections that no LiDAR point places"
    ALL_CAMERAS = "all cameras"


@dataclass(frozen=True)
class Decision:
    """Whether a stage runs, and why.

    Attributes
    ----------
    stage : Stage
    kept : bool
    reason : str
        For people; nothing is decided by it.
    """

    stage: Stage
    kept: bool
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """Return the decision as scenario.json and report.json hold it."""
        return {"stage": str(self.stage), "kept": self.kept, "reason": self.reason}


@dataclass(frozen=True)
class Plan:
    """The decisions of a run.

    Attributes
    ----------
    cameras : tuple of str
        Cameras to use.
    decisions : tuple of Decision
        One for every stage; the stages of a detector in LiDAR sweeps only with one.
    homography : HomographyScope
        Which cameras get a homography.
    detector_stride : int
        Ticks from one detection in all cameras to the next, see `log2sim.perception.frames`.
    fusion : FusionLevel, optional
        What of the two ends is joined; None where not both have LiDARs.
    picture_stride : int
        Ticks from one search of a camera's frames to the next, where LiDAR sweeps are searched at every tick.
    """

    cameras: tuple[str, ...]
    decisions: tuple[Decision, ...]
    homography: HomographyScope = HomographyScope.CAMERAS_IN_NEED
    detector_stride: int = 1
    fusion: FusionLevel | None = None
    picture_stride: int = 1

    def decision(self, stage: Stage) -> Decision:
        """Return the decision about a stage."""
        return next(d for d in self.decisions if d.stage is stage)

    def keeps(self, stage: Stage) -> bool:
        """Return whether a stage runs."""
        return any(d.kept for d in self.decisions if d.stage is stage)

    def variant(self, decision: Decision) -> Plan:
        """Return a plan with another decision about one stage, for benchmarks that compare plans."""
        return replace(self, decisions=tuple(decision if d.stage is decision.stage else d for d in self.decisions))


def make_plan(log: Log, config: Config, sensors: Sensors, t_ns: NDArray[np.int64]) -> Plan:
    """Decide what to run at the ticks (T,) of a log."""
    decodes = _image_decoding(config)
    every = picture_stride(config, t_ns) if decodes.kept else 1
    stride = min_hits(t_ns, config.track.min_life_s) if decodes.kept and every == 1 else 1
    scope, homography = _homography(log, config)
    smooth, ends = config.smooth.enabled, fusion_level(sensors.only(log), config)
    decisions = (
        _lidar_use(log, sensors),
        _motion_compensation(log, sensors, t_ns),
        decodes,
        _detection_in_every_frame(config, decodes.kept, stride, every),
        *_detection_in_sweeps(config),
        homography,
        _fusion(sensors.cameras),
        *_fusion_with_lidar(config),
        *([Decision(Stage.FUSION_OF_ENDS, ends.level is not None, ends.reason)] if ends.reason else []),
        Decision(Stage.TRACKING, True, "identities over time are the result"),
        Decision(Stage.SMOOTHING, smooth, "measured positions are noisy" if smooth else "smooth.enabled=false"),
        Decision(Stage.SMOOTHING_OF_STATIC_AGENTS, False, "a static agent has one pose"),
        Decision(Stage.WAYPOINT_AT_EVERY_TICK, False, "waypoints that interpolation gives back are left out"),
        _lanes(log, config, sensors),
        _colors(config, sensors),
        _signals(config, sensors),
    )
    return Plan(sensors.cameras, decisions, scope, max(stride, 1), ends.level, every)


def picture_stride(config: Config, t_ns: NDArray[np.int64]) -> int:
    """Return how many of the ticks (T,) lie from one search of a camera's frames to the next by `detect.period_s`, 1 or more."""
    if not config.detect.in_sweeps or len(t_ns) < 2:
        return 1
    return max(round(config.detect.period_s / period_of(t_ns)), 1)


def _lidar_use(log: Log, sensors: Sensors) -> Decision:
    if not log.lidars:
        return Decision(Stage.ALL_LIDARS, False, "the log has no LiDAR")
    if sensors.lidars_out_of_range:
        names = ", ".join(sensors.lidars_out_of_range)
        reason = f"never within {MAX_LIDAR_RANGE_M:.0f} m of the measured area: {names}"
        return Decision(Stage.ALL_LIDARS, False, reason)
    return Decision(Stage.ALL_LIDARS, True, f"{len(sensors.lidars)} within range")


def _motion_compensation(log: Log, sensors: Sensors, t_ns: NDArray[np.int64]) -> Decision:
    reason = ""
    if not sensors.lidars:
        reason = "no LiDAR is within range" if log.lidars else "the log has no LiDAR"
    elif all(log.lidars[n].mount == "map" for n in sensors.lidars):
        reason = "the LiDARs are fixed in the map"
    elif log.ego is None:
        reason = "no ego poses: sensors are assumed to stand still"
    if reason or log.ego is None:
        return Decision(Stage.MOTION_COMPENSATION, False, reason)
    margin_ns = round(log.ego.extrapolate_s * NS_PER_S)
    during = (log.ego.t_ns >= t_ns[0] - margin_ns) & (log.ego.t_ns <= t_ns[-1] + margin_ns)
    moved_m, turned_rad = _motion(log.ego.map_T_ego[during] if during.sum() > 1 else log.ego.map_T_ego)
    if moved_m < MAX_STATIC_EGO_MOTION_M and turned_rad < MAX_STATIC_EGO_TURN_RAD:
        reason = f"the ego stands still (moves {moved_m * 100:.1f} cm, turns {np.rad2deg(turned_rad):.2f} degrees)"
        return Decision(Stage.MOTION_COMPENSATION, False, reason)
    return Decision(Stage.MOTION_COMPENSATION, True, f"the ego moves {moved_m:.1f} m while sweeps are taken")


def _motion(map_T_ego: Array) -> tuple[float, float]:
    """Return how far poses (P, 4, 4) spread, m, and the largest angle between the first and any other, rad."""
    positions, rotations = map_T_ego[:, :3, 3], map_T_ego[:, :3, :3]
    cosine = (np.einsum("ij,nij->n", rotations[0], rotations) - 1) / 2
    return float((positions.max(axis=0) - positions.min(axis=0)).max()), float(np.arccos(np.clip(cosine, -1, 1)).max())


def _image_decoding(config: Config) -> Decision:
    if not config.detect.in_images:
        return Decision(Stage.IMAGE_DECODING, False, NO_CAMERA)
    if config.detect.in_images != LABELS:
        return Decision(Stage.IMAGE_DECODING, True, "the detector needs images")
    return Decision(Stage.IMAGE_DECODING, False, "boxes come from the log; detection needs no image")


def _detection_in_every_frame(config: Config, decodes: bool, stride: int, every: int) -> Decision:
    """Decide whether frames may be skipped.

    Where sweeps are searched at every tick, the frames of a camera are searched at one of `every` ticks.

    A track needs `min_hits` measurements. An object that is visible for fewer ticks is not confirmed, so between two
    frames that many ticks apart in which the detector found nothing, the others need not be decoded.
    """
    stage = Stage.DETECTION_IN_EVERY_FRAME
    if not config.detect.in_images:
        return Decision(stage, False, NO_CAMERA)
    if not decodes:
        return Decision(stage, True, "without decoding a frame costs nothing")
    if every > 1:
        return Decision(stage, False, f"sweeps show the same objects: each camera is searched at one of {every} ticks")
    if stride < 2:
        return Decision(stage, True, "the log has too few ticks for its tracks to skip any")
    return Decision(stage, False, f"frames between two empty ones {stride} ticks apart are skipped")


def _homography(log: Log, config: Config) -> tuple[HomographyScope, Decision]:
    stage = Stage.HOMOGRAPHY
    if not config.detect.in_images:
        return HomographyScope.NONE, Decision(stage, False, NO_CAMERA)
    if config.topdown.method == "off":
        return HomographyScope.NONE, Decision(stage, False, "topdown.method=off")
    reason = "detections without LiDAR points may need it" if log.lidars else "without LiDAR it alone gives depth"
    return HomographyScope.CAMERAS_IN_NEED, Decision(stage, True, reason)


def _detection_in_sweeps(config: Config) -> tuple[Decision, ...]:
    """Decide about the detector in LiDAR sweeps; nothing is stated without one."""
    name = config.detect.in_sweeps
    return (Decision(Stage.DETECTION_IN_SWEEPS, True, f"detector '{name}'"),) if name else ()


def _fusion_with_lidar(config: Config) -> tuple[Decision, ...]:
    """Decide whether detections of images and of sweeps are joined; nothing is stated without a detector in sweeps."""
    stage = Stage.FUSION_WITH_LIDAR
    if not config.detect.in_sweeps:
        return ()
    if not config.detect.in_images:
        return (Decision(stage, False, NO_CAMERA),)
    return (Decision(stage, True, "boxes of images and of sweeps are evidence for the same objects"),)


def _fusion(cameras: tuple[str, ...]) -> Decision:
    if not cameras:
        return Decision(Stage.FUSION, False, NO_CAMERA)
    if len(cameras) > 1:
        return Decision(Stage.FUSION, True, f"{len(cameras)} cameras")
    return Decision(Stage.FUSION, False, "one camera; only duplicates of its detector are dropped")


def _lanes(log: Log, config: Config, sensors: Sensors) -> Decision:
    stage, lidars = Stage.LANES, [name for name in sensors.lidars if name in log.lidars]
    if not config.map.lanes:
        return Decision(stage, False, "map.lanes=false")
    if not (sensors.cameras or lidars):
        return Decision(stage, False, "no sensor is used that shows the ground")
    seen = " and ".join([*(["pictures"] if sensors.cameras else []), *(["sweeps"] if lidars else [])])
    return Decision(stage, True, f"{seen} show the ground")


def _colors(config: Config, sensors: Sensors) -> Decision:
    if not config.appearance.colors:
        return Decision(Stage.COLORS, False, "appearance.colors=false")
    if not sensors.cameras:
        return Decision(Stage.COLORS, False, NO_CAMERA)
    return Decision(Stage.COLORS, True, "pictures show the vehicles")


def _signals(config: Config, sensors: Sensors) -> Decision:
    if not config.appearance.signals:
        return Decision(Stage.SIGNALS, False, "appearance.signals=false")
    if not sensors.cameras or not config.detect.in_images:
        return Decision(Stage.SIGNALS, False, NO_CAMERA)
    if config.detect.in_images == LABELS:
        return Decision(Stage.SIGNALS, False, "labels of road users take the place of a detector")
    return Decision(Stage.SIGNALS, True, "detectors with the classes of COCO know them")
