"""Small errors of the pose of the road's sensors, estimated from what both ends see at one moment and taken off the road's boxes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from log2sim.geometry import Array, wrap_angle
from log2sim.perception.cooperative.matching import (
    POSE_SIGMA_M,
    POSE_SIGMA_RAD,
    SeenBoxes,
    center_covariance,
    is_walking,
    motion_covariance,
)

ROUNDS = 4
# Pairs that are off by more standard deviations lose weight: boxes of different objects, or of a part of one.
CAUCHY_SIGMAS = 2.0


def take_off_offset(a: SeenBoxes, b: SeenBoxes, b_all: SeenBoxes) -> SeenBoxes:
    """Move all boxes of the road to where pairs of boxes (P,) that belong together show that they are.

    Parameters
    ----------
    a, b : P SeenBoxes
        Of the vehicle and of the road, row by row the same objects.
    b_all : N SeenBoxes
        Of the road.

    Notes
    -----
    A shift and a turn about the sensor by weighted least squares. Their prior is what registration leaves: a single pair says
    little, and many move the boxes where they agree to. Cauchy's weights make single wrong pairs harmless (Holland & Welsch,
    "Robust regression using iteratively reweighted least-squares", 1977).
    """
    if not len(a) or b_all.sensor_m is None:
        return b_all
    pivot = b_all.sensor_m[:2]
    shift, turn = _estimate(a, b, pivot)
    boxes = b_all.boxes
    away = boxes.center_m[:, :2] - pivot
    moved = boxes.center_m.copy()
    moved[:, :2] += shift + turn * np.column_stack([-away[:, 1], away[:, 0]])
    return replace(b_all, boxes=replace(boxes, center_m=moved, yaw_rad=boxes.yaw_rad + turn))


def _estimate(a: SeenBoxes, b: SeenBoxes, pivot: Array) -> tuple[Array, float]:
    """Estimate shift (2,), m, and turn, rad, of the road's boxes b."""
    away = b.boxes.center_m[:, :2] - pivot
    difference = a.boxes.center_m[:, :2] - b.boxes.center_m[:, :2]
    precision = np.linalg.inv(center_covariance(a) + center_covariance(b) + motion_covariance(a, b))
    design = np.zeros((len(a), 2, 3))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    design[:, 0, 2], design[:, 1, 2] = -away[:, 1], away[:, 0]
    turned = wrap_angle(2 * (a.boxes.yaw_rad - b.boxes.yaw_rad)) / 2
    of_yaw = np.where(is_walking(a.boxes), 0.0, 1 / (a.errors.yaw_rad**2 + b.errors.yaw_rad**2))
    prior = np.diag([POSE_SIGMA_M**-2, POSE_SIGMA_M**-2, POSE_SIGMA_RAD**-2])
    x = np.zeros(3)
    for _ in range(ROUNDS):
        rest, rest_yaw = difference - design @ x, turned - x[2]
        squared = np.einsum("pi,pij,pj->p", rest, precision, rest) + of_yaw * rest_yaw**2
        weight = 1 / (1 + squared / CAUCHY_SIGMAS**2)
        weighted = weight[:, None, None] * precision
        normal = prior + np.einsum("pik,pij,pjl->kl", design, weighted, design)
        right = np.einsum("pik,pij,pj->k", design, weighted, difference)
        normal[2, 2] += (weight * of_yaw).sum()
        right[2] += (weight * of_yaw * turned).sum()
        x = np.linalg.solve(normal, right)
    return x[:2], float(x[2])
