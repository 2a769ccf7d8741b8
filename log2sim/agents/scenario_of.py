"""The scenario of a run: agents, cameras, stages and provenance in one record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import Agent, Log, Scenario
from log2sim.geometry import NS_PER_S
from log2sim.perception.homography_stage import CameraHomography
from log2sim.version import __version__


def scenario_of(
    log: Log,
    t_ns: NDArray[np.int64],
    agents: Sequence[Agent],
    *,
    cameras: Sequence[Mapping[str, Any]],
    stages: Sequence[Mapping[str, Any]],
    provenance: Mapping[str, Any],
) -> Scenario:
    """Assemble the record that `scenario.json` holds, of the ticks `t_ns` (T,); the ego, if any, is its first agent."""
    return Scenario(
        name=log.name,
        t0_ns=int(t_ns[0]),
        duration_s=float((t_ns[-1] - t_ns[0]) / NS_PER_S),
        agents=tuple(agents),
        map=log.map,
        cameras=tuple(cameras),
        stages=tuple(stages),
        provenance=provenance,
    )


def provenance_of(log: Log, config: Config, detector: str, poses: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a scenario was made from and how: log, version, name of the detector, source of the poses, settings, seed."""
    return {
        "log": {"name": log.name, "format": log.format, "digest": log.digest},
        "log2sim_version": __version__,
        "detector": detector,
        "poses": dict(poses),
        "config": config.to_dict(),
        "seed": config.seed,
        "history": ["reconstruct"],
    }


def camera_entries(log: Log, used: Sequence[str], homographies: Mapping[str, CameraHomography]) -> list[dict[str, Any]]:
    """Return the cameras of a log with their homographies, as a scenario states them."""
    return [_camera_entry(name, homographies.get(name), name in used) for name in log.cameras]


def _camera_entry(name: str, ground: CameraHomography | None, used: bool) -> dict[str, Any]:
    if ground is None or not ground.fit.ok:
        return {"name": name, "used": used, "homography": None}
    fit = ground.fit
    finite_error = float(fit.error_m) if np.isfinite(fit.error_m) else None
    return {
        "name": name,
        "used": used,
        "homography": {
            "ground_H_image": fit.ground_H_image.tolist(),
            "source": ground.source,
            "inliers": int(fit.inliers.sum()),
            "correspondences": len(fit.inliers),
            "error_m": finite_error,
            "condition": float(fit.condition),
            "pitch_roll": None if fit.pitch_roll is None else fit.pitch_roll.to_dict(),
        },
    }
