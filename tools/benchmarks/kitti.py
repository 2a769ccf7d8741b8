"""Tracking of whole boxes on the KITTI tracking benchmark, beside its labels.

    python tools/bench.py kitti KITTI_TRACKING [--online] [--fit]
    python tools/bench.py kitti KITTI_TRACKING --results DIR      # scores the tracks of another program

The folder holds detections/*/NNNN.txt, one folder a category, calib/, label_02/ and ego_motion/. Where the ego motion of a sequence is
known, tracking is done in the map frame; where it is not, the axes of the car serve as the map. By default tracks are made as for
a scenario, with all frames at hand: stitched over occlusions, gaps filled, smoothed. With --online what is said of a frame depends on no later one. With --fit
the weights of both logistic models of `kitti/choice.py` are fitted to the sequences that were not left out for the benchmark's validation and
printed, and each sequence is scored with weights that never saw it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from fits.logistic import logistic_regression
from kitti import choice
from kitti.boxes import (
    Boxes,
    View,
    in_areas,
    is_ignorable,
    is_small,
    overlap_3d,
    read_detections,
    read_tracks,
    read_view,
    same_frame,
    to_measurements,
    with_neighbors,
)
from kitti.choice import Described, choose, decide_people, describe, find_pairs
from kitti.scoring import IOU, evaluate
from kitti.tracks import rows_offline, rows_online

from benchmarks.table import markdown
from log2sim.geometry import Array

CATEGORIES = ("Car", "Pedestrian", "Cyclist")
HEAD = ["class", "sAMOTA", "AMOTA", "AMOTP", "MOTA", "MOTP", "HOTA", "IDS", "FRAG", "FP", "FN"]
LEARNED = ("0000", "0002", "0004", "0005", "0007", "0009", "0011")
FEATURES = {True: ("score", "near_score", "near_share", "height"), False: ("near_score", "near_share")}
# Standard deviation of the weights beforehand is 1.
PENALTY, CONSTANT_PENALTY = 1.0, 0.01


def main(folder: Path, online: bool = False, fit: bool = False, results: Path | None = None) -> None:
    if results is not None:
        told = {path.stem: read_tracks(path) for path in sorted(results.glob("*.txt"))}
    else:
        names = sorted({path.stem for path in (folder / "detections").glob("*/*.txt")})
        sequences = {name: read_sequence(folder, name) for name in names}
        describe_sequence(*next(iter(sequences.values())), online=online)  # imports what is imported when it is needed
        begin = time.process_time()
        described = {name: describe_sequence(*sequence, online=online) for name, sequence in sequences.items()}
        told = {name: choose(d, online=online) for name, d in described.items()}
        frames, seconds = sum(len(view.map_T_cam) for _, view in sequences.values()), time.process_time() - begin
        print(f"{frames} frames, {frames / seconds:.0f} a second of processor time without reading\n")
    labels = {name: read_tracks(folder / "label_02" / f"{name}.txt") for name in told}
    if fit:
        learned = [name for name in LEARNED if name in labels]
        for kind, seen in (("detected", True), ("predicted", False)):
            print(kind, weights_of(learned, described, labels, seen=seen))
        told = {name: told_by_others(name, described, labels, online=online) for name in told}
    scores = {category: evaluate(told, labels, category) for category in CATEGORIES}
    print(markdown(HEAD, [[c, *(f"{v:.2f}" for v in s[:6]), *map(str, s[6:])] for c, s in scores.items()]))


def read_sequence(folder: Path, name: str) -> tuple[Boxes, View]:
    """Detections of all categories of one sequence, and its view, which knows the motion only where a file tells it."""
    boxes = Boxes.join([read_detections(path) for path in sorted((folder / "detections").glob(f"*/{name}.txt"))])
    poses = folder / "ego_motion" / f"{name}.txt"
    frames = int(boxes.frame.max(initial=-1)) + 1
    return boxes, read_view(folder / "calib" / f"{name}.txt", poses if poses.is_file() else None, frames)


def describe_sequence(boxes: Boxes, view: View, *, online: bool) -> Described:
    """All boxes of tracks, detected and predicted ones, before it is chosen which are told."""
    pairs = find_pairs(boxes)
    everything, tracked = to_measurements(pairs.boxes, view), pairs.tracked
    cuts = np.searchsorted(tracked.frame, np.arange(len(view.map_T_cam) + 1)).tolist()
    by_frame = [everything.take(slice(a, b)) for a, b in pairwise(cuts)]
    rows = (rows_online if online else rows_offline)(tracked, by_frame)
    rows = decide_people(rows, pairs, everything.center_m if view.motion_known else None, online=online)
    return describe(rows, pairs.boxes, everything, view, online=online)


def labeled(boxes: Boxes, labels: Boxes, category: str) -> Array:
    """Whether boxes (N,) lie on a label: 1 if they do, 0 if they are errors, NaN where the benchmark never counts them as such."""
    truth = labels.take(np.isin(labels.category, with_neighbors(category)))
    truth = truth.take(np.argsort(truth.frame, kind="stable"))
    row, col = same_frame(boxes, truth, reach_m=True)
    hit = overlap_3d(boxes.take(row), truth.take(col)) >= IOU
    row, col = row[hit], col[hit]
    ignorable = is_ignorable(truth, category)
    out = np.where(in_areas(boxes, labels.take(labels.category == "DontCare")), np.nan, 0.0)
    out[boxes.frame > labels.frame.max(initial=-1)] = np.nan
    out[row[ignorable[col]]] = np.nan
    out[row[~ignorable[col]]] = 1.0
    out[is_small(boxes)] = np.nan
    return out


def weights_of(
    names: Sequence[str], described: Mapping[str, Described], labels: Mapping[str, Boxes], *, seen: bool
) -> dict[str, float]:
    """Weights by which detected, or else predicted, boxes of cars in some sequences are likely labeled."""
    rows, truth = [], []
    for name in names:
        d, on_label = described[name], labeled(described[name].boxes, labels[name], "Car")
        wanted = (d.boxes.category == "Car") & np.isfinite(on_label) & (d.seen == seen)
        columns = [np.ones(len(d.boxes)), *(d.features[feature] for feature in FEATURES[seen])]
        rows.append(np.column_stack(columns)[wanted])
        truth.append(on_label[wanted])
    precision = np.r_[CONSTANT_PENALTY, np.full(len(FEATURES[seen]), PENALTY)]
    weights = logistic_regression(np.concatenate(rows), np.concatenate(truth), precision)
    return dict(zip(("constant", *FEATURES[seen]), weights.round(2).tolist()))


def told_by_others(
    name: str, described: Mapping[str, Described], labels: Mapping[str, Boxes], *, online: bool
) -> Boxes:
    """Tracks of a sequence with weights from the others."""
    for constant, seen in (("SEEN", True), ("PREDICTED", False)):
        weights = weights_of([k for k in LEARNED if k != name and k in labels], described, labels, seen=seen)
        setattr(choice, constant + ("_ONLINE" if online else ""), weights)
    return choose(described[name], online=online)
