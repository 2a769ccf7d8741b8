"""What this log needs: decided once, as plain data with a reason for every stage kept or left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import Log
from log2sim.errors import ConfigError, LogError
from log2sim.geometry import NS_PER_S, Array
from log2sim.registry import nearest
from log2sim.tracking.tracker import least_hits

LABELS = "labels"
# An ego that moves less than this while the log lasts blurs no sweep by more; it turns less than this at 30 m.
STATIC_EGO_M = 0.05
STATIC_EGO_RAD = STATIC_EGO_M / 30.0
# Largest departure of R R^T from 1: calibration files round to five digits or more.
LARGEST_SKEW = 1e-3
# No LiDAR for vehicles or roadsides measures farther.
LIDAR_REACH_M = 300.0


@dataclass(frozen=True)
class Step:
    """One stage, whether it runs, and why; what leaving it out saved, in s, where that is known, and how it is known."""

    stage: str
    kept: bool
    reason: str
    saved_s: float | None = None
    saved_how: str = ""


@dataclass(frozen=True)
class Plan:
    """The sensors to use and every decision about stages.

    `lidars` are those within reach; detectors look at every frame at each `stride`-th tick, see `log2sim.perception.frames`.
    """

    cameras: tuple[str, ...]
    steps: tuple[Step, ...]
    lidars: tuple[str, ...] = ()
    stride: int = 1

    def keeps(self, stage: str) -> bool:
        return next(s.kept for s in self.steps if s.stage == stage)

    def decided(self, stage: str, kept: bool, reason: str) -> Plan:
        """The plan with one decision changed, for what only the data can tell."""
        return replace(self, steps=tuple(Step(stage, kept, reason) if s.stage == stage else s for s in self.steps))

    def saved(self, stage: str, seconds: float, how: str) -> Plan:
        """The plan with the time that leaving out (a part of) a stage saved."""
        saved_s = round(max(seconds, 0.0), 4)
        steps = tuple(replace(s, saved_s=saved_s, saved_how=how) if s.stage == stage else s for s in self.steps)
        return replace(self, steps=steps)

    def to_list(self) -> list[Mapping[str, Any]]:
        """The decisions as a scenario states them: the same for the same log and settings."""
        return [{"stage": s.stage, "kept": s.kept, "reason": s.reason} for s in self.steps]

    def to_report(self) -> list[Mapping[str, Any]]:
        """The decisions with the seconds that they saved, for the report of this run."""
        timed = [{"saved_s": s.saved_s, "saved_how": s.saved_how or None} for s in self.steps]
        return [{**entry, **time} for entry, time in zip(self.to_list(), timed)]

    def narrowed(self, log: Log) -> Log:
        """The log without the LiDARs that are out of reach."""
        return (
            log if len(self.lidars) == len(log.lidars) else replace(log, lidars={n: log.lidars[n] for n in self.lidars})
        )


def make_plan(log: Log, config: Config, *, picture: bool = False) -> Plan:
    """Decide what to run.

    Raises
    ------
    ConfigError
        For a camera that the log does not have.
    LogError
        For a log without any camera, or with a calibration that no sensor can have.
    """
    if not log.cameras:
        raise LogError(f"{log.name}: the log has no camera; log2sim runs at camera rate and needs at least one")
    for name in config.cameras:
        if name not in log.cameras:
            known = list(log.cameras)
            raise ConfigError(f"--cameras: no camera '{name}'{nearest(name, known)}; the log has {', '.join(known)}")
    cameras = config.cameras or tuple(log.cameras)
    _check_calibration(log, cameras)
    far = _far_lidars(log, config.measure.max_range_m)
    lidars = tuple(n for n in log.lidars if n not in far)
    steps = (
        _lidars(log, far),
        _compensation(log, lidars),
        _decoding(config, picture),
        Step("every frame", True, "too few ticks to leave any out"),
        _homography(log, config, picture),
        _fusion(cameras),
        Step("track", True, "identities over time are the result"),
        Step(
            "smooth", config.smooth.enabled, "measured positions jitter" if config.smooth.enabled else "smooth.enabled=false"
        ),
        Step("smooth parked agents", True, "no agent stands still"),
        Step("every waypoint", True, "no agent moves straight at constant speed"),
    )  # fmt: skip
    return Plan(cameras, steps, lidars)


def _check_calibration(log: Log, cameras: tuple[str, ...]) -> None:
    """Raise `LogError` for a mounting that is no rigid motion and for intrinsics that project nothing."""
    mounts = {n: log.cameras[n].mount_T_cam for n in cameras} | {n: s.mount_T_lidar for n, s in log.lidars.items()}
    for name, mount_T_sensor in mounts.items():
        rotation = mount_T_sensor[:3, :3]
        skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not np.isfinite(mount_T_sensor).all() or not skew < LARGEST_SKEW or np.linalg.det(rotation) < 0:
            raise LogError(
                f"sensor '{name}': its mounting is not a rotation and a translation (R R^T departs from 1 by {skew:.2g}, "
                f"det R is {np.linalg.det(rotation):.2g}); expected a right-handed rotation, so check the calibration"
            )
    for name in cameras:
        k = log.cameras[name].K
        if not np.isfinite(k).all() or k[0, 0] <= 0 or k[1, 1] <= 0 or k[2].tolist() != [0, 0, 1]:
            raise LogError(
                f"camera '{name}': its intrinsics K are {k.tolist()}; expected finite numbers, positive focal lengths and "
                "0, 0, 1 in the last row"
            )


def plan_ticks(plan: Plan, log: Log, t_ns: NDArray[np.int64], *, min_life_s: float) -> Plan:
    """Decide what depends on the ticks (T,): whether the ego moves during them, and how often to look.

    A track needs `least_hits` measurements. What is seen less often between two looks that find nothing would be taken for
    a false alarm, so that long a camera need not be looked at.
    """
    if plan.keeps("compensate") and log.ego is not None:
        margin = round(log.ego.extrapolate_s * NS_PER_S)
        during = (log.ego.t_ns >= t_ns[0] - margin) & (log.ego.t_ns <= t_ns[-1] + margin)
        still = _stillness(log.ego.map_T_ego[during]) if during.sum() > 1 else ""
        if still:
            plan = plan.decided("compensate", False, still)
    if not plan.keeps("decode images"):
        return plan.decided("every frame", True, "looking costs nothing, for no image is decoded")
    stride = least_hits(t_ns, min_life_s)
    if stride < 2:
        return plan
    plan = plan.decided("every frame", True, f"no camera sees nothing at two looks {stride} ticks apart")
    return replace(plan, stride=stride)


def _far_lidars(log: Log, max_range_m: float) -> set[str]:
    """LiDARs fixed in the map that are too far from the ego's whole way to measure anything that counts."""
    if log.ego is None:
        return set()
    way, limit = log.ego.map_T_ego[:, :2, 3], max_range_m * np.sqrt(2) + LIDAR_REACH_M
    fixed = {name: lidar.mount_T_lidar[:2, 3] for name, lidar in log.lidars.items() if lidar.mount == "map"}
    return {name for name, place in fixed.items() if np.hypot(*(way - place).T).min() > limit}


def _lidars(log: Log, far: set[str]) -> Step:
    if not log.lidars:
        return Step("every LiDAR", False, "the log has no LiDAR")
    if far:
        return Step(
            "every LiDAR", False, f"never within {LIDAR_REACH_M:.0f} m of what counts: {', '.join(sorted(far))}"
        )
    return Step("every LiDAR", True, f"{len(log.lidars)} within reach")


def _compensation(log: Log, lidars: tuple[str, ...]) -> Step:
    if not lidars:
        return Step("compensate", False, "the log has no LiDAR" if not log.lidars else "no LiDAR is within reach")
    if all(log.lidars[n].mount == "map" for n in lidars):
        return Step("compensate", False, "the LiDARs stand still in the map")
    if log.ego is None:
        return Step("compensate", False, "no ego poses: sensors are taken to stand still")
    still = _stillness(log.ego.map_T_ego)
    if still:
        return Step("compensate", False, still)
    moved, _ = _motion(log.ego.map_T_ego)
    return Step("compensate", True, f"the ego moves {moved:.1f} m while sweeps are taken")


def _motion(map_T_ego: Array) -> tuple[float, float]:
    """How far poses (P, 4, 4) spread, m, and the largest angle between the first and any other, rad."""
    positions, rotations = map_T_ego[:, :3, 3], map_T_ego[:, :3, :3]
    cosine = (np.einsum("ij,nij->n", rotations[0], rotations) - 1) / 2
    return float((positions.max(axis=0) - positions.min(axis=0)).max()), float(np.arccos(np.clip(cosine, -1, 1)).max())


def _stillness(map_T_ego: Array) -> str:
    """What says that these poses (P, 4, 4) are of an ego that stands still; "" for one that does not."""
    moved, turned = _motion(map_T_ego)
    if moved >= STATIC_EGO_M or turned >= STATIC_EGO_RAD:
        return ""
    return f"the ego stands still (moves {moved * 100:.1f} cm, turns {np.rad2deg(turned):.2f} degrees)"


def _fusion(cameras: tuple[str, ...]) -> Step:
    if len(cameras) > 1:
        return Step("fuse", True, f"{len(cameras)} cameras")
    return Step("fuse", False, "one camera sees no object twice; only doubles of its detector are dropped")


def _decoding(config: Config, picture: bool) -> Step:
    if config.detect.name != LABELS:
        return Step("decode images", True, "the detector looks at every frame")
    if picture:
        return Step("decode images", True, "a top-down picture is asked for")
    return Step("decode images", False, "boxes come from the log; no pixel is needed")


def _homography(log: Log, config: Config, picture: bool) -> Step:
    if config.topdown.method == "off":
        return Step("homography", False, "topdown.method=off")
    if picture:
        return Step("homography", True, "a top-down picture is asked for")
    if not log.lidars:
        return Step("homography", True, "without LiDAR it is the only way to depth")
    return Step("homography", True, "detections without LiDAR points may need it")
