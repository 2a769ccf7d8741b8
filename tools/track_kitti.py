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
from pathlib import Path

import numpy as np
from kitti.boxes import Boxes, read_detections, rows_offline, rows_online, write_tracks
from kitti.choice import Described, choose, decide_people, describe, find_pairs
from kitti.map import View, read_view, to_measurements

from log2sim.datatypes import Measurements
from log2sim.errors import Log2SimError, LogError


def track_boxes(boxes: Boxes, view: View, *, online: bool) -> Boxes:
    """Tracks of the detections of one sequence, all categories together."""
    return choose(describe_sequence(boxes, view, online=online), online=online) if len(boxes) else boxes


def describe_sequence(boxes: Boxes, view: View, *, online: bool) -> Described:
    """All boxes of tracks, detected and predicted ones, before it is chosen which are told."""
    pairs = find_pairs(boxes)
    measurements = to_measurements(pairs.tracked, view)
    rows = (rows_online if online else rows_offline)(pairs.tracked, measurements)
    others = to_measurements(pairs.boxes.take(slice(pairs.count, None)), view)
    everything = Measurements.join([*measurements, *others])
    rows = decide_people(rows, pairs, everything.center_m if view.motion_known else None, online=online)
    return describe(rows, pairs.boxes, everything, view, online=online)


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
    folders, names = find_sequences(detections)
    out.mkdir(parents=True, exist_ok=True)
    frames, seconds = 0, 0.0
    for name in names:
        boxes, view = read_sequence(name, folders, calib, ego_motion)
        count = len(view.map_T_cam)
        began = time.perf_counter()
        tracks = track_boxes(boxes, view, online=online)
        seconds += time.perf_counter() - began
        frames += count
        write_tracks(out / f"{name}.txt", tracks)
        frame = (
            "map frame" if view.motion_known else "frame of the car: its motion is not known and nothing stands for it"
        )
        print(f"{name}: {count} frames, {len(np.unique(tracks.track_id))} tracks, {frame}")
    print(f"{frames} frames in {seconds:.2f} s: {frames / max(seconds, 1e-9):.0f} frames/s without reading and writing")


def find_sequences(detections: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Folders with files of detections, given ones and those in them, and the names of the sequences."""
    folders = [f for folder in detections for f in (folder, *sorted(folder.glob("*/"))) if any(f.glob("*.txt"))]
    names = sorted({p.stem for folder in folders for p in folder.glob("*.txt")})
    if not names:
        raise LogError("--detections: no files NNNN.txt in the given folders; expected one a sequence")
    return folders, names


def read_sequence(name: str, folders: Sequence[Path], calib: Path, ego_motion: Path | None) -> tuple[Boxes, View]:
    """Detections of all categories of one sequence, and its view, which knows the motion only where a file tells it."""
    boxes = Boxes.join([read_detections(f / f"{name}.txt") for f in folders if (f / f"{name}.txt").is_file()])
    poses = ego_motion / f"{name}.txt" if ego_motion is not None else None
    if poses is not None and not poses.is_file():
        poses = None
    return boxes, read_view(calib / f"{name}.txt", poses, int(boxes.frame.max(initial=-1)) + 1)


if __name__ == "__main__":
    sys.exit(main())
