"""Fit the errors of detected boxes by side: `python tools/fit.py box_errors --scenes 300 --seed 5`.

Random scenes with exact truth are cast, searched by the networks for vehicles and for the roadside, and each box is matched
with the truth by overlap. The logarithm of the error of each side is regressed on points and distance; the weights are those of
`log2sim.perception.cooperative.WEIGHTS`.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.optimize import minimize
from training.clouds import draw_example

from log2sim.config import LidarConfig
from log2sim.datatypes import GROUP_OF, GROUPS, Boxes3D
from log2sim.geometry import Array, rectangle_iou, wrap_angle
from log2sim.perception.boxes import rotate
from log2sim.perception.cooperative import refine_boxes, side_terms, yaw_terms
from log2sim.perception.detect3d.detectors import open_shipped

# A box that overlaps an object less is none of it.
MIN_IOU = 0.1
MIN_SCORE = 0.1
# Degrees of freedom of the distribution of errors: a few boxes are far off, and must not widen the rest.
STUDENT_DOF = 4.0
MIN_ERRORS = 50


Row = tuple[str, str, Array, float]
"""Group, "side" or "yaw", terms and error."""


def errors_of(boxes: Boxes3D, truth: Boxes3D, sensor: Array) -> list[Row]:
    """List the errors of the sides and yaws of the boxes that match the truth."""
    if not len(boxes) or not len(truth):
        return []
    of_sides = side_terms(boxes, sensor)
    of_yaw = yaw_terms(boxes.points, np.hypot(*(boxes.center_m[:, :2] - sensor[:2]).T), boxes.score)
    out: list[Row] = []
    found, true = rectangles(boxes), rectangles(truth)
    for k in range(len(boxes)):
        iou = rectangle_iou(np.repeat(found[k : k + 1], len(truth), axis=0), true)
        best, group = int(np.argmax(iou)), GROUP_OF[str(boxes.category[k])]
        if iou[best] < MIN_IOU or GROUP_OF[str(truth.category[best])] != group:
            continue
        turned = float(wrap_angle(2 * (truth.yaw_rad[best] - boxes.yaw_rad[k]))) / 2
        if group != "pedestrian" and abs(turned) < np.pi / 4:
            out.append((group, "yaw", of_yaw[k], turned))
        elif group != "pedestrian":
            continue
        offset = rotate(truth.center_m[best, :2] - boxes.center_m[k, :2], -boxes.yaw_rad[k])
        for axis in range(2):
            grown = (truth.size_m[best, axis] - boxes.size_m[k, axis]) / 2
            for end, sign in enumerate((-1, 1)):
                out.append((group, "side", of_sides[k, axis, end], float(offset[axis] + sign * grown)))
    return out


def rectangles(boxes: Boxes3D) -> Array:
    """Take the boxes in the plane (M, 5)."""
    return np.column_stack([boxes.center_m[:, :2], boxes.size_m[:, :2], boxes.yaw_rad])


def fit_sigma(terms: Array, error: Array) -> Array:
    """Fit weights (K,) of the logarithm of the scale of errors (n,) by the likelihood of Student's distribution."""

    def cost(weights: Array) -> float:
        log_sigma = terms @ weights
        z2 = (error * np.exp(-log_sigma)) ** 2
        return float((log_sigma + (STUDENT_DOF + 1) / 2 * np.log1p(z2 / STUDENT_DOF)).mean() + 1e-3 * weights @ weights)

    start = np.r_[np.log(np.median(np.abs(error)) + 1e-3), np.zeros(terms.shape[1] - 1)]
    return np.asarray(minimize(cost, start, method="BFGS").x)


def collect(scenes: int, seed: int) -> list[Row]:
    """Search random scenes of both mounts."""
    rows: list[Row] = []
    for number, mount in enumerate(("vehicle", "roadside")):
        detector = open_shipped(mount, LidarConfig())
        for k in range(scenes):
            example = draw_example(mount, (seed, number, k))  # type: ignore[arg-type]
            found = detector.detect(example.cloud)
            found = refine_boxes(found.take(found.score >= MIN_SCORE), example.cloud)
            t = example.truth
            true = Boxes3D(
                np.zeros(len(t), np.int64), t.box[:, :3], t.box[:, 3:6], t.box[:, 6], np.ones(len(t)),
                t.category, np.ones(len(t)), np.ones(len(t), np.int64),
            )  # fmt: skip
            rows += errors_of(found, true, example.cloud.sensor.astype(np.float64))
            if k % 50 == 49:
                print(f"{mount}: {k + 1} of {scenes} scenes", file=sys.stderr)
    return rows


def main(scenes: int = 300, seed: int = 5) -> None:
    """Print the weights of scenes of each mount, and how well they describe the errors."""
    rows = collect(scenes, seed)
    for group in GROUPS:
        for kind in ("side", "yaw"):
            mine = [row for row in rows if row[:2] == (group, kind)]
            if len(mine) < MIN_ERRORS:
                print(f"{group:12s} {kind}: {len(mine)} errors are too few")
                continue
            terms, error = np.array([row[2] for row in mine]), np.array([row[3] for row in mine])
            weights = fit_sigma(terms, error)
            within = (np.abs(error) < np.exp(terms @ weights)).mean()
            print(
                f"{group:12s} {kind}: {np.round(weights, 2).tolist()}, n {len(mine)}, mean {error.mean():+.3f}, "
                f"rms {np.sqrt((error**2).mean()):.3f}, within one sigma {within:.2f}"
            )
