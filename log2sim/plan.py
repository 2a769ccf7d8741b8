"""What this log needs: decided once, as plain data with a reason for every stage kept or left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from log2sim.config import Config
from log2sim.errors import ConfigError, LogError
from log2sim.registry import nearest
from log2sim.types import Log

LABELS = "labels"
# An ego that moves less than this while the log lasts blurs no sweep by a centimeter.
STATIC_EGO_M = 0.05


@dataclass(frozen=True)
class Step:
    """One stage, whether it runs, and why."""

    stage: str
    kept: bool
    reason: str


@dataclass(frozen=True)
class Plan:
    """The cameras to use and every decision about stages."""

    cameras: tuple[str, ...]
    steps: tuple[Step, ...]

    def keeps(self, stage: str) -> bool:
        return next(s.kept for s in self.steps if s.stage == stage)

    def decided(self, stage: str, kept: bool, reason: str) -> Plan:
        """The plan with one decision changed, for what only the data can tell."""
        return replace(self, steps=tuple(Step(stage, kept, reason) if s.stage == stage else s for s in self.steps))

    def to_list(self) -> list[Mapping[str, Any]]:
        return [{"stage": s.stage, "kept": s.kept, "reason": s.reason} for s in self.steps]


def make_plan(log: Log, config: Config, *, picture: bool = False) -> Plan:
    """Decide what to run.

    Raises
    ------
    ConfigError
        For a camera that the log does not have.
    LogError
        For a log without any camera.
    """
    if not log.cameras:
        raise LogError(f"{log.name}: the log has no camera; log2sim runs at camera rate and needs at least one")
    for name in config.cameras:
        if name not in log.cameras:
            known = list(log.cameras)
            raise ConfigError(f"--cameras: no camera '{name}'{nearest(name, known)}; the log has {', '.join(known)}")
    cameras = config.cameras or tuple(log.cameras)
    return Plan(
        cameras,
        (
            _compensation(log),
            _decoding(config, picture),
            _homography(log, config, picture),
            Step(
                "fuse",
                len(cameras) > 1,
                f"{len(cameras)} cameras" if len(cameras) > 1 else "one camera sees no object twice",
            ),
            Step("track", True, "identities over time are the result"),
            Step(
                "smooth",
                config.smooth.enabled,
                "measured positions jitter" if config.smooth.enabled else "smooth.enabled=false",
            ),
        ),
    )


def _compensation(log: Log) -> Step:
    if not log.lidars:
        return Step("compensate", False, "the log has no LiDAR")
    if log.ego is None:
        return Step("compensate", False, "no ego poses: sensors are taken to stand still")
    positions = log.ego.map_T_ego[:, :3, 3]
    moved = float((positions.max(axis=0) - positions.min(axis=0)).max())
    if moved < STATIC_EGO_M:
        return Step("compensate", False, f"the ego stands still (moves {moved * 100:.1f} cm)")
    return Step("compensate", True, f"the ego moves {moved:.1f} m while sweeps are taken")


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
