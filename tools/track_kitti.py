"""Runs log2sim's tracker on 3D boxes of the KITTI tracking benchmark and writes results in its format.

    python tools/track_kitti.py --detections DIR [--detections DIR ...] --calib DIR [--ego-motion DIR] [--online] --out DIR

Detections are given once for each category, one file a sequence. Where the ego motion of a sequence is known, tracking is done in
the map frame; where it is not, nothing stands for it: the axes of the car serve as the map, and that is said. By default
tracks are made as for a scenario, with all frames at hand: stitched over occlusions, gaps filled, smoothed. With --online
what is said of a frame depends on no later one.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from kitti_boxes import Boxes, read_detections, write_tracks
from kitti_map import PERIOD_NS, View, from_map, hidden_share, read_view, to_measurements
from kitti_paths import smooth_paths
from numpy.typing import NDArray

from log2sim.datatypes import Measurements, Track
from log2sim.errors import Log2SimError, LogError
from log2sim.geometry import NS_PER_S, Array
from log2sim.tracking.forward import ForwardTracker
from log2sim.tracking.tracker import track

# A detector that finds a rider on a bicycle often finds a pedestrian there as well.
SAME_OBJECT_M = 0.6
MAY_BE_ONE = ("Pedestrian", "Cyclist")
# A track that was seen often is believed more, up to so many times.
FULL_HITS = 10
# The benchmark labels what its camera sees: what nearer boxes hide by more than this share counts only where the detector is
# this sure of it (a logit).
HIDDEN_SHARE, SURE_SCORE = 0.8, 2.0
# Online, a track that was seen this often and well goes on while it is not seen, for so long.
COAST_S, COAST_HITS, COAST_SCORE = 0.15, 5, 4.0
# Offline, gaps up to this are bridged; in tracks of at least this confidence those up to so many frames are filled.
MAX_GAP_S = 2.0
FILL_SCORE, FILL_FRAMES, FILL_HIDDEN = 4.0, 7, 0.7
# Who comes into the detector's range this far away, or leaves it there, was there a little before and is a little longer.
FAR_M, FAR_FRAMES = 55.0, 4

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Rows:
    """Boxes of tracks: `frame`, `track`, `source` the row of the detection or -1 where only predicted, `model` the row of the
    detection that tells size, height and heading there, `xy_m` (N, 2) in the map, `score` and `category` (N,).
    """

    frame: Index
    track: Index
    source: Index
    model: Index
    xy_m: Array
    score: Array
    category: NDArray[np.str_]

    def take(self, index: NDArray[np.generic]) -> Rows:
        """The rows at `index`."""
        return Rows(*(column[index] for column in vars(self).values()))


def track_boxes(boxes: Boxes, view: View, *, online: bool) -> Boxes:
    """Tracks of the detections of one sequence, all categories together."""
    boxes = one_category_each(boxes.take(np.argsort(boxes.frame, kind="stable")))
    if len(boxes) == 0:
        return boxes
    measurements = to_measurements(boxes, view)
    rows = rows_online(boxes, measurements) if online else rows_offline(boxes, measurements)
    limit = 1.0 if online else FILL_HIDDEN
    return as_seen(rows, boxes, Measurements.join(measurements), view, limit)


def one_category_each(boxes: Boxes) -> Boxes:
    """Boxes, sorted by frame, without those of a pedestrian where a rider is found with a higher score, and the other way round."""
    first, second = (np.flatnonzero(boxes.category == c) for c in MAY_BE_ONE)
    if len(first) == 0 or len(second) == 0:
        return boxes
    begin, end = (np.searchsorted(boxes.frame[second], boxes.frame[first], side) for side in ("left", "right"))
    count = end - begin
    a = np.repeat(first, count)
    b = second[np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(begin, count)]
    one = np.hypot(*(boxes.bottom_m[a] - boxes.bottom_m[b])[:, [0, 2]].T) < SAME_OBJECT_M
    a, b = a[one], b[one]
    keep = np.ones(len(boxes), dtype=bool)
    keep[np.where(boxes.score[a] < boxes.score[b], a, b)] = False
    return boxes.take(keep)


def rows_online(boxes: Boxes, measurements: Sequence[Measurements]) -> Rows:
    """What the tracker says frame by frame, from that frame and those before it."""
    first = np.searchsorted(boxes.frame, np.arange(len(measurements)))
    tracker = ForwardTracker(birth_score=0.0, period_s=PERIOD_NS / NS_PER_S, whole_boxes=True)
    latest = np.zeros(len(boxes), dtype=np.int64)  # row of the last detection, by track
    parts: list[tuple[Index, Index, Index, Index, Array]] = []
    for frame, found in enumerate(measurements):
        now_ns = frame * PERIOD_NS
        taken, number = tracker.step(found, now_ns)
        source = first[frame] + taken
        latest[number] = source
        missed = (tracker.seen_ns < now_ns) & (tracker.seen_ns >= now_ns - round(COAST_S * NS_PER_S))
        coasting = np.flatnonzero(missed & (tracker.hits >= COAST_HITS))
        coasting = coasting[boxes.score[latest[tracker.number[coasting]]] >= COAST_SCORE]
        number = np.concatenate([number, tracker.number[coasting]])
        source = np.concatenate([source, np.full(len(coasting), -1)])
        parts.append((np.full(len(number), frame), number, source, latest[number], tracker.mean[coasting, :2]))
    frames, number, source, model, predicted = (np.concatenate(c) for c in zip(*parts))
    xy = Measurements.join(measurements).center_m[model, :2]
    xy[source < 0] = predicted
    score, category = _so_far(number, source, model, boxes)
    return Rows(frames, number, source, model, xy, score, category)


def _so_far(number: Index, source: Index, model: Index, boxes: Boxes) -> tuple[Array, NDArray[np.str_]]:
    """Confidence and category (N,) of a track at each of its rows, from the rows up to it, which come in order of time.

    The confidence is the score of the last detection plus the logarithm of how many there were; its mean over the track is
    that of the scores, raised for long tracks. The category is the one with more of the score so far.
    """
    order = np.argsort(number, kind="stable")
    fresh = np.r_[True, np.diff(number[order]) != 0]
    begin = np.flatnonzero(fresh)[np.cumsum(fresh) - 1]
    hit = (source[order] >= 0).astype(np.float64)
    probability = hit / (1 + np.exp(-boxes.score[model[order]]))
    vote = np.where(boxes.category[model[order]] == MAY_BE_ONE[1], probability, -probability)
    count, lead = (np.cumsum(v) - (np.cumsum(v) - v)[begin] for v in (hit, vote))
    score, rider = np.empty(len(number)), np.empty(len(number), dtype=bool)
    score[order] = boxes.score[model[order]] + np.log(np.minimum(count, FULL_HITS))
    rider[order] = lead > 0
    category = boxes.category[model]
    return score, np.where(np.isin(category, MAY_BE_ONE), np.where(rider, *MAY_BE_ONE[::-1]), category)


def rows_offline(boxes: Boxes, measurements: Sequence[Measurements]) -> Rows:
    """Stitched tracks with their gaps filled by the smoothed path."""
    first = np.searchsorted(boxes.frame, np.arange(len(measurements)))
    t_ns = np.arange(len(measurements), dtype=np.int64) * PERIOD_NS
    # The tracker does not read how many points there were, so the row of a detection travels in their place.
    marked = [replace(m, points=first[k] + np.arange(len(m))) for k, m in enumerate(measurements)]
    tracks = track(marked, t_ns, birth_score=0.0, max_gap_s=MAX_GAP_S, min_life_s=0.0, whole_boxes=True)
    paths = smooth_paths(tracks, t_ns, whole_boxes=True, before=FAR_FRAMES, after=FAR_FRAMES)
    rows_of = np.concatenate([t.measurements.points for t in tracks])
    seen = paths.row >= 0
    source = np.full(len(seen), -1, dtype=np.int64)
    source[seen] = rows_of
    # What is not seen looks like the detection before; ahead of the first one, like that one.
    before = paths.tick < np.array([t.tick[0] for t in tracks])[paths.track]
    model = rows_of[np.cumsum(seen) - 1 + before]
    score = np.array([_confidence(t, boxes) for t in tracks])[paths.track]
    category = np.array(
        [boxes.category[t.measurements.points][t.measurements.category == t.category][0] for t in tracks]
    )
    beyond = before | (paths.tick > np.array([t.tick[-1] for t in tracks])[paths.track])
    far = np.hypot(*boxes.bottom_m[model][:, [0, 2]].T) >= FAR_M
    short = _gap_frames(seen, paths.track) <= FILL_FRAMES
    keep = seen | ((score >= FILL_SCORE) & np.where(beyond, far, short))
    return Rows(paths.tick, paths.track, source, model, paths.mean[:, :2], score, category[paths.track]).take(keep)


def _confidence(t: Track, boxes: Boxes) -> float:
    return float(boxes.score[t.measurements.points].mean() + np.log(min(len(t), FULL_HITS)))


def _gap_frames(seen: NDArray[np.bool_], number: Index) -> Index:
    """Length (N,) of the run of rows alike of one track that each row is in."""
    run = np.cumsum(np.r_[False, (seen[1:] != seen[:-1]) | (number[1:] != number[:-1])])
    return np.bincount(run)[run]


def as_seen(rows: Rows, boxes: Boxes, measurements: Measurements, view: View, filled_limit: float) -> Boxes:
    """The rows as boxes of the camera, without those that it cannot see."""
    rows = rows.take(np.lexsort([rows.track, rows.frame]))
    columns = {**vars(boxes.take(rows.model)), "frame": rows.frame, "track_id": rows.track, "score": rows.score}
    columns |= {"category": rows.category}
    center = np.column_stack([rows.xy_m, measurements.center_m[rows.model, 2]])
    size = boxes.size_hwl_m[rows.model, ::-1]
    in_camera = from_map(center, size, measurements.yaw_rad[rows.model], rows.frame, view)
    # In the image the detector knows better than a box around a box.
    in_camera["box_px"] = np.where((rows.source < 0)[:, None], in_camera["box_px"], boxes.box_px[rows.model])
    columns |= in_camera
    inside = np.isfinite(columns["box_px"]).all(axis=1)
    out, source = Boxes(**columns).take(inside), rows.source[inside]
    hidden = hidden_share(out, len(view.map_T_cam))
    sure = (source >= 0) & (boxes.score[source] >= SURE_SCORE)
    return out.take((hidden <= np.where(source >= 0, HIDDEN_SHARE, min(filled_limit, HIDDEN_SHARE))) | sure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--detections", type=Path, action="append", required=True, help="folder of one category; repeatable"
    )
    parser.add_argument("--calib", type=Path, required=True)
    parser.add_argument("--ego-motion", type=Path, help="folder of poses t x y z qx qy qz qw, one row a frame")
    parser.add_argument("--online", action="store_true", help="causal: no frame knows of a later one")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    try:
        run(options.detections, options.calib, options.ego_motion, options.out, online=options.online)
    except Log2SimError as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 3
    return 0


def run(detections: Sequence[Path], calib: Path, ego_motion: Path | None, out: Path, *, online: bool) -> None:
    """Track all sequences and write their results; tells what was done with which."""
    detections = [f for folder in detections for f in (folder, *sorted(folder.glob("*/"))) if any(f.glob("*.txt"))]
    names = sorted({p.stem for folder in detections for p in folder.glob("*.txt")})
    if not names:
        raise LogError("--detections: no files NNNN.txt in the given folders; expected one a sequence")
    out.mkdir(parents=True, exist_ok=True)
    frames, seconds = 0, 0.0
    for name in names:
        parts = [read_detections(f / f"{name}.txt") for f in detections if (f / f"{name}.txt").is_file()]
        boxes = Boxes.join(parts)
        poses = ego_motion / f"{name}.txt" if ego_motion is not None else None
        if poses is not None and not poses.is_file():
            poses = None
        count = int(boxes.frame.max(initial=-1)) + 1
        view = read_view(calib / f"{name}.txt", poses, count)
        began = time.perf_counter()
        tracks = track_boxes(boxes, view, online=online)
        seconds += time.perf_counter() - began
        frames += count
        write_tracks(out / f"{name}.txt", tracks)
        frame = (
            "map frame" if poses is not None else "frame of the car: its motion is not known and nothing stands for it"
        )
        print(f"{name}: {count} frames, {len(np.unique(tracks.track_id))} tracks, {frame}")
    print(f"{frames} frames in {seconds:.2f} s: {frames / max(seconds, 1e-9):.0f} frames/s without reading and writing")


if __name__ == "__main__":
    sys.exit(main())
