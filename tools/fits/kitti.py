"""Fits what tools/kitti/choice.py knows of labeled boxes, and scores every sequence with weights that never saw it.

    python tools/fit.py kitti --detections DIR [--detections DIR ...] --calib DIR --ego-motion DIR --labels DIR \\
      [--sequences 0000,0002,...] [--online]

Printed are the weights of both logistic models and then, for each sequence with labels, the scores that weights from the other
ones of `--sequences` give, and all of them together.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from entry import parser_of
from evaluate_kitti import evaluate, table
from kitti import choice as kitti_choice
from kitti.boxes import Boxes, overlap_3d, read_tracks
from kitti.choice import Described, choose
from kitti.map import in_areas, is_ignorable, is_small, same_frame, with_neighbors
from track_kitti import describe_sequence, find_sequences, read_sequence

from log2sim.errors import Log2SimError
from log2sim.geometry import Array

IOU = 0.25
FEATURES = {True: ("score", "near_score", "near_share", "hidden", "height"), False: ("near_score", "near_share")}
# Standard deviation of the weights beforehand is 1.
PENALTY, CONSTANT_PENALTY = 1.0, 0.01
ITERATIONS = 30


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


def fit(described: Sequence[Described], labels: Sequence[Boxes], *, seen: bool) -> dict[str, float]:
    """Weights by which detected, or else predicted, boxes of cars are likely labeled."""
    rows, truth = [], []
    for d, label in zip(described, labels):
        on_label = labeled(d.boxes, label, "Car")
        wanted = (d.boxes.category == "Car") & np.isfinite(on_label) & (d.seen == seen)
        if not seen:
            wanted &= ~d.doubled
        columns = [np.ones(len(d.boxes)), *(d.features[name] for name in FEATURES[seen])]
        rows.append(np.column_stack(columns)[wanted])
        truth.append(on_label[wanted])
    weights = logistic_regression(np.concatenate(rows), np.concatenate(truth))
    return dict(zip(("constant", *FEATURES[seen]), weights.round(2).tolist()))


def logistic_regression(x: Array, y: Array) -> Array:
    """Weights of the columns of `x` (N, K), the first of which is constant, for the log-odds of `y` (N,); Newton's method."""
    penalty = np.r_[CONSTANT_PENALTY, np.full(x.shape[1] - 1, PENALTY)]
    w = np.zeros(x.shape[1])
    for _ in range(ITERATIONS):
        p = 1 / (1 + np.exp(-x @ w))
        w += np.linalg.solve((x * (p * (1 - p))[:, None]).T @ x + np.diag(penalty), x.T @ (y - p) - penalty * w)
    return w


def told_with(
    train: Sequence[str], name: str, described: Mapping[str, Described], labels: Mapping[str, Boxes], *, online: bool
) -> Boxes:
    """Tracks of a sequence with weights from the sequences `train`."""
    parts = [described[k] for k in train], [labels[k] for k in train]
    names = ("SEEN_ONLINE", "PREDICTED_ONLINE") if online else ("SEEN", "PREDICTED")
    for constant, seen in zip(names, (True, False)):
        setattr(kitti_choice, constant, fit(*parts, seen=seen))
    return choose(described[name], online=online)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = parser_of(__doc__)
    parser.add_argument("--detections", type=Path, action="append", required=True)
    for name in ("--calib", "--ego-motion", "--labels"):
        parser.add_argument(name, type=Path, required=True)
    parser.add_argument("--sequences", default="0000,0002,0004,0005,0007,0009,0011", help="those to learn from")
    parser.add_argument("--online", action="store_true")
    options = parser.parse_args(arguments)
    try:
        folders, names = find_sequences(options.detections)
        labels = {n: read_tracks(options.labels / f"{n}.txt") for n in names}
        described = {
            n: describe_sequence(*read_sequence(n, folders, options.calib, options.ego_motion), online=options.online)
            for n in names
        }
    except Log2SimError as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 3
    train = [n for n in options.sequences.split(",") if n in names]
    for seen in (True, False):
        print(
            "detected" if seen else "predicted",
            fit([described[n] for n in train], [labels[n] for n in train], seen=seen),
        )
    told = {n: told_with([k for k in train if k != n], n, described, labels, online=options.online) for n in names}
    print(table({n: evaluate({n: told[n]}, {n: labels[n]}, "Car") for n in names}))
    print(table({c: evaluate(told, labels, c) for c in ("Car", "Pedestrian", "Cyclist")}))
    return 0
