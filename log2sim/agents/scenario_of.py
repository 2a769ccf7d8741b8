"""The scenario of a run: agents, cameras, plan and provenance in one record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from log2sim.config import Config
from log2sim.datatypes import Agent, Log, Scenario
from log2sim.geometry import NS_PER_S
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.sync import Schedule
from log2sim.plan import Plan
from log2sim.version import __version__


def scenario_of(
    log: Log,
    schedule: Schedule,
    config: Config,
    plan: Plan,
    detector: Detector,
    homographies: Mapping[str, CameraHomography],
    ego: Agent | None,
    agents: Sequence[Agent],
) -> Scenario:
    """Assemble the record that `scenario.json` holds; the ego, if any, is its first agent."""
    return Scenario(
        name=log.name,
        t0_ns=int(schedule.t_ns[0]),
        duration_s=float((schedule.t_ns[-1] - schedule.t_ns[0]) / NS_PER_S),
        agents=(*((ego,) if ego is not None else ()), *agents),
        map=log.map,
        cameras=tuple(_camera_entry(name, homographies.get(name), name in plan.cameras) for name in log.cameras),
        plan=tuple(plan.to_list()),
        provenance={
            "log": {"name": log.name, "format": log.format, "digest": log.digest},
            "log2sim_version": __version__,
            "detector": detector.name,
            "config": config.to_dict(),
            "seed": config.seed,
            "history": ["reconstruct"],
        },
    )


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
        },
    }
