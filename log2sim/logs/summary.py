"""Summary of a log in numbers, without decoding its images and sweeps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.documents import rounded
from log2sim.geometry import NS_PER_S

# A step between two stamps that is longer than this many median steps is a gap.
MIN_GAP_PERIODS = 1.7
MIN_SPEED_STEP_NS = 100_000_000
MAX_EGO_STEP_NS = 100_000_000


def summarize(log: Log) -> dict[str, Any]:
    """Summarize sensors, rates, stamps, gaps, ego, labels and notes of a log as a JSON document."""
    stamps = [s.t_ns for s in log.streams.values()]
    begin, end = min(int(t[0]) for t in stamps), max(int(t[-1]) for t in stamps)
    cameras = {
        name: {
            **summarize_stamps(log.streams[name].t_ns),
            "size_px": [int(c.width_px), int(c.height_px)],
            "field_of_view_deg": rounded(np.degrees(2 * np.arctan(c.width_px / 2 / c.K[0, 0])), 1),
            "distortion_model": c.distortion_model,
            "rectified": c.rectified,
            "rolling_shutter": None if c.rolling_shutter is None else asdict(c.rolling_shutter),
            **_mounting(c.mount, c.mount_T_cam),
        }
        for name, c in log.cameras.items()
    }
    lidars = {
        name: {**summarize_stamps(log.streams[name].t_ns), **_mounting(s.mount, s.mount_T_lidar)}
        for name, s in log.lidars.items()
    }
    return {
        "name": log.name,
        "format": log.format,
        "begin_ns": begin,
        "end_ns": end,
        "duration_s": rounded((end - begin) / NS_PER_S, 3),
        "reference_camera": log.reference_camera,
        "cameras": cameras,
        "lidars": lidars,
        "ego": _ego(log),
        "map": {**asdict(log.map), "offset_m": list(log.map.offset_m)},
        "labels": _labels(log),
        "image_labels": {name: _counts(boxes.category) for name, boxes in log.image_labels.items()},
        "ignored_regions": {name: len(regions.t_ns) for name, regions in log.ignored_regions.items()},
        "details": dict(log.details),
        "notes": list(log.notes),
        "digest": log.digest,
    }


def summarize_stamps(t_ns: NDArray[np.int64], min_gap_ns: int = 0) -> dict[str, Any]:
    """Count, rate, range and gaps of increasing stamps (F,); gaps are longer than `min_gap_ns`."""
    step = np.diff(t_ns)
    median = float(np.median(step)) if len(step) else 0.0
    gap = np.flatnonzero(step > max(MIN_GAP_PERIODS * median, min_gap_ns))
    return {
        "records": len(t_ns),
        "rate_hz": rounded(NS_PER_S / median, 3) if median > 0 else None,
        "begin_ns": int(t_ns[0]),
        "end_ns": int(t_ns[-1]),
        "gaps": [{"after_ns": int(t_ns[k]), "length_s": rounded(int(step[k]) / NS_PER_S, 6)} for k in gap],
    }


def _mounting(mount: str, mount_T_sensor: NDArray[np.float64]) -> dict[str, Any]:
    return {"mount": mount, "translation_m": [rounded(v, 4) for v in mount_T_sensor[:3, 3]]}


def _ego(log: Log) -> dict[str, Any] | None:
    if log.ego is None:
        return None
    # Poses may be nanoseconds apart: path and speed are measured over steps of a tenth of a second.
    step = (log.ego.t_ns - log.ego.t_ns[0]) // MIN_SPEED_STEP_NS
    chosen = np.union1d(np.unique(step, return_index=True)[1], len(step) - 1)
    position, t_ns = log.ego.map_T_ego[chosen, :3, 3], log.ego.t_ns[chosen]
    steps = np.linalg.norm(np.diff(position[:, :2], axis=0), axis=1)
    seconds = np.diff(t_ns) / NS_PER_S
    return {
        # Poses at the stamps of all sensors are no regular series; nothing is missing where there are ten in a second.
        **summarize_stamps(log.ego.t_ns, MAX_EGO_STEP_NS),
        "distance_m": rounded(steps.sum(), 2),
        "top_speed_mps": rounded((steps / seconds)[seconds > 0.5 * MIN_SPEED_STEP_NS / NS_PER_S].max(initial=0.0), 2),
        "size_m": list(log.ego_vehicle.size_m),
    }


def _labels(log: Log) -> dict[str, Any] | None:
    if log.labels is None:
        return None
    first = dict(zip(log.labels.track_id.tolist()[::-1], log.labels.category.tolist()[::-1]))
    return {"boxes": len(log.labels.t_ns), "tracks": len(first), "tracks_by_category": _counts(first.values())}


def _counts(words: Iterable[Any]) -> dict[str, int]:
    names, counts = np.unique([str(w) for w in words], return_counts=True)
    return {str(n): int(c) for n, c in zip(names, counts)}
