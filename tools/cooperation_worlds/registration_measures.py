"""How well the pole's pose and clock are found again after they were disturbed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cooperation_worlds.runs import settings
from cooperation_worlds.world import ROAD_LIDAR, RoadError, disturb
from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S, inverse
from log2sim.pipeline import start


def row(log: Log, error: RoadError) -> dict[str, Any]:
    """Errors of the pole's end before and after `log2sim` has prepared a run, and what it says about them."""
    disturbed = disturb(log, error)
    run = start(disturbed, settings("points", register=True))
    before, after = _error(log, disturbed), None
    if ROAD_LIDAR in run.log.lidars:
        after = _error(log, run.log)
    return {
        "before": before,
        "after": after,
        "faults": [[fault.kind, fault.treatment] for fault in run.faults if fault.subject == ROAD_LIDAR],
    }


def _error(log: Log, other: Log) -> dict[str, float]:
    true, pose = log.lidars[ROAD_LIDAR].mount_T_lidar, other.lidars[ROAD_LIDAR].mount_T_lidar
    turned = inverse(true)[:3, :3] @ pose[:3, :3]
    angle = np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1))
    late_ns = other.streams[ROAD_LIDAR].t_ns[0] - log.streams[ROAD_LIDAR].t_ns[0]
    return {
        "offset_m": float(np.linalg.norm(pose[:2, 3] - true[:2, 3])),
        "turn_deg": float(np.rad2deg(angle)),
        "delay_s": float(late_ns / NS_PER_S),
    }


def figures(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Medians and 90th percentiles of the errors, of those that are used."""
    out: dict[str, Any] = {}
    for when in ("before", "after"):
        of = [r[when] for r in rows if r[when] is not None]
        for name in ("offset_m", "turn_deg", "delay_s"):
            values = np.abs([e[name] for e in of]) if of else np.array([np.nan])
            out[f"{name}_{when}"] = {"median": float(np.median(values)), "p90": float(np.quantile(values, 0.9))}
    good = [r["after"] is not None and r["after"]["offset_m"] <= 0.1 and r["after"]["turn_deg"] <= 0.3 for r in rows]
    out["within_target"] = float(np.mean(good))
    out["left_out"] = float(np.mean([r["after"] is None for r in rows]))
    return out
