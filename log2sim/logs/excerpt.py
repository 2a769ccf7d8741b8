"""A part of a log, its digest, and its summary."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ImageLabels, ImageRegions, Labels, Log, Stream
from log2sim.errors import ConfigError
from log2sim.files.documents import rounded
from log2sim.files.plugins import nearest
from log2sim.geometry import NS_PER_S, PoseTrack

B = TypeVar("B", ImageLabels, ImageRegions)

# Beyond the first and the last tick, so that each still finds its nearest sweep, which may be a turn of 10 Hz away.
RECORD_MARGIN_NS = 200_000_000
# Stamps of labels and frames of one moment differ by rounding in some logs.
STAMP_TOLERANCE_NS = 1_000_000
# Labels are interpolated where they come at 1 Hz or denser; farther from a record they say nothing about it.
MAX_LABEL_DISTANCE_NS = 1_100_000_000


@dataclass(frozen=True)
class _Span:
    """First and last stamp of the ticks that are kept, absolute ns."""

    first_ns: int
    last_ns: int

    def contains(self, t_ns: NDArray[np.int64], margin_ns: int) -> NDArray[np.bool_]:
        """Mark the stamps (N,) in the span, widened on both sides."""
        return np.asarray((t_ns >= self.first_ns - margin_ns) & (t_ns <= self.last_ns + margin_ns))


def cut_log(log: Log, *, cameras: Sequence[str] = (), start_s: float | None = None, stop_s: float | None = None) -> Log:
    """Restrict a log to some cameras, all where there are none, and to a time; LiDARs are always kept.

    `start_s`, `stop_s`: ticks, the frames of the reference camera or else the sweeps of a LiDAR, are kept from `start_s` to
    `stop_s`, s after the first one. Other records reach up to `RECORD_MARGIN_NS` beyond them, poses and labels to the next one.
    Raises `ConfigError` for an unknown camera, and where no tick is left.
    """
    for name in cameras:
        if name not in log.cameras:
            hint, there = nearest(name, list(log.cameras)), ", ".join(log.cameras) or "none"
            raise ConfigError(f"--cameras: no camera '{name}'{hint}; the log has {there}")
    if not cameras and start_s is None and stop_s is None:
        return log
    chosen = {name: camera for name, camera in log.cameras.items() if not cameras or name in cameras}
    streams = {name: log.streams[name] for name in (*chosen, *log.lidars)}
    reference = reference_of(log, list(chosen))
    ticks, span = log.streams[reference].t_ns, None
    if start_s is not None or stop_s is not None:
        seconds = (ticks - ticks[0]) / NS_PER_S
        low, high = -np.inf if start_s is None else start_s, np.inf if stop_s is None else stop_s
        kept_ns = ticks[(seconds >= low) & (seconds <= high)]
        if not len(kept_ns):
            raise ConfigError(f"--start/--stop leave no record of '{reference}', which lasts {seconds[-1]:.3f} s")
        span = _Span(int(kept_ns[0]), int(kept_ns[-1]))
    notes: list[str] = []
    margins = {name: 0 if name == reference else RECORD_MARGIN_NS for name in streams}
    if span is not None:
        streams = {name: _cut_stream(stream, span, margins[name]) for name, stream in streams.items()}
        notes = [f"{name}: no record from --start to --stop" for name, s in streams.items() if not len(s.t_ns)]
        streams = {name: stream for name, stream in streams.items() if len(stream.t_ns)}
    kept = {name: chosen[name] for name in chosen if name in streams}
    return log.changed(
        cameras=kept,
        lidars={name: lidar for name, lidar in log.lidars.items() if name in streams},
        streams=streams,
        ego=log.ego if log.ego is None or span is None else _cut_poses(log.ego, span),
        labels=lambda: _cut_labels(log.labels, list(kept), span),
        image_labels={n: _cut_boxes(b, span, margins[n]) for n, b in log.image_labels.items() if n in kept},
        ignored_regions={n: _cut_boxes(r, span, margins[n]) for n, r in log.ignored_regions.items() if n in kept},
        reference_camera=log.reference_camera if log.reference_camera in kept else None,
        digest=hashlib.sha256(f"{log.digest} {sorted(streams)} {span}".encode()).hexdigest(),
        notes=lambda: (*log.notes, *notes),
    )


def reference_of(log: Log, cameras: Sequence[str]) -> str:
    """Return the sensor whose records are the ticks, as reconstruction chooses it: of some cameras, without any a LiDAR."""
    if cameras:
        wanted = log.reference_camera
        return wanted if wanted is not None and wanted in cameras else cameras[0]
    return max(log.lidars, key=lambda name: len(log.streams[name].t_ns))


def _cut_stream(stream: Stream, span: _Span, margin_ns: int) -> Stream:
    rows = np.flatnonzero(span.contains(stream.t_ns, margin_ns)).tolist()
    read, encoded = stream.read, stream.encoded
    files = None if encoded is None else lambda i: encoded(rows[i])
    return Stream(stream.name, stream.t_ns[rows], lambda i: read(rows[i]), files)


def _cut_poses(track: PoseTrack, span: _Span) -> PoseTrack:
    """Keep the poses of the records and one beyond on either side, for interpolation."""
    inside = np.flatnonzero(span.contains(track.t_ns, 2 * RECORD_MARGIN_NS))
    first, last = inside[[0, -1]] if len(inside) else [np.searchsorted(track.t_ns, span.first_ns)] * 2
    rows = slice(max(int(first) - 1, 0), int(last) + 2)
    return replace(track, t_ns=track.t_ns[rows], map_T_ego=track.map_T_ego[rows])


def _cut_labels(labels: Labels | None, cameras: list[str], span: _Span | None) -> Labels | None:
    """Keep the labels of each track in the span and one beyond on either side; none where no labeled camera is left."""
    if labels is None or (labels.cameras is not None and not set(labels.cameras) & set(cameras)):
        return None
    labeled_cameras = None if labels.cameras is None else tuple(name for name in labels.cameras if name in cameras)
    if span is None:
        return replace(labels, cameras=labeled_cameras)
    keep = np.zeros(len(labels.t_ns), dtype=bool)
    for track in np.unique(labels.track_id):
        keep |= _mark_rows(labels.t_ns, np.flatnonzero(labels.track_id == track), span)
    labeled = labels.labeled_ns
    if labeled is not None:
        labeled = labeled[_mark_rows(labeled, np.arange(len(labeled)), span)]
    return replace(labels.take(keep), cameras=labeled_cameras, labeled_ns=labeled)


def _mark_rows(t_ns: NDArray[np.int64], rows: NDArray[np.intp], span: _Span) -> NDArray[np.bool_]:
    """Mark (N,) those of `rows` in the span, and of the others the last before and the first after it, unless far from it."""
    mark = np.zeros(len(t_ns), dtype=bool)
    mark[rows[span.contains(t_ns[rows], 0)]] = True
    rows = rows[span.contains(t_ns[rows], MAX_LABEL_DISTANCE_NS)]
    before, after = rows[t_ns[rows] < span.first_ns], rows[t_ns[rows] > span.last_ns]
    if len(before):
        mark[before[np.argmax(t_ns[before])]] = True
    if len(after):
        mark[after[np.argmin(t_ns[after])]] = True
    return mark


def _cut_boxes(boxes: B, span: _Span | None, margin_ns: int) -> B:
    if span is None:
        return boxes
    rows = span.contains(boxes.t_ns, margin_ns + STAMP_TOLERANCE_NS)
    return replace(boxes, **{name: column[rows] for name, column in vars(boxes).items()})


def digest_of(texts: Iterable[str], files: Iterable[Path]) -> str:
    """SHA-256 over calibration and index texts and over names and sizes of the records."""
    value = hashlib.sha256()
    for text in texts:
        value.update(text.encode())
    for file in files:
        size = file.stat().st_size if file.exists() else -1
        value.update(f"{file.parent.name}/{file.name} {size}\n".encode())
    return value.hexdigest()


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
    labels = None
    if log.labels is not None:
        # Of each track the category of its first label.
        first = dict(zip(log.labels.track_id.tolist()[::-1], log.labels.category.tolist()[::-1]))
        labels = {"boxes": len(log.labels.t_ns), "tracks": len(first), "tracks_by_category": _counts(first.values())}
    return {
        "name": log.name,
        "format": log.format,
        "begin_ns": begin,
        "end_ns": end,
        "duration_s": rounded((end - begin) / NS_PER_S, 3),
        "reference_camera": log.reference_camera,
        "cameras": cameras,
        "lidars": lidars,
        "ego": None if log.ego is None else _summarize_ego(log, log.ego),
        "map": {**asdict(log.map), "offset_m": list(log.map.offset_m)},
        "labels": labels,
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


def _summarize_ego(log: Log, ego: PoseTrack) -> dict[str, Any]:
    # Poses may be nanoseconds apart: path and speed are measured over steps of a tenth of a second.
    step = (ego.t_ns - ego.t_ns[0]) // MIN_SPEED_STEP_NS
    chosen = np.union1d(np.unique(step, return_index=True)[1], len(step) - 1)
    position, t_ns = ego.map_T_ego[chosen, :3, 3], ego.t_ns[chosen]
    steps = np.linalg.norm(np.diff(position[:, :2], axis=0), axis=1)
    seconds = np.diff(t_ns) / NS_PER_S
    return {
        # Poses at the stamps of all sensors are no regular series; nothing is missing where there are ten in a second.
        **summarize_stamps(ego.t_ns, MAX_EGO_STEP_NS),
        "distance_m": rounded(steps.sum(), 2),
        "top_speed_mps": rounded((steps / seconds)[seconds > 0.5 * MIN_SPEED_STEP_NS / NS_PER_S].max(initial=0.0), 2),
        "size_m": list(log.ego_vehicle.size_m),
    }


def _counts(words: Iterable[Any]) -> dict[str, int]:
    names, counts = np.unique([str(w) for w in words], return_counts=True)
    return {str(n): int(c) for n, c in zip(names, counts)}
