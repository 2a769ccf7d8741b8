"""A crowd before a standing camera with what a detector finds of it, in the formats of the KITTI tracking benchmark."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from kitti.boxes import Boxes
from kitti.map import View, hidden_share, project

PERSON_HWL = (1.75, 0.65, 0.75)


def people(frame: int, xz: np.ndarray, track: object, score: object, view: View, yaw: object = 0.0) -> Boxes:
    """People at places (N, 2) of the camera, those that it sees."""
    n = len(xz)
    size, yaw = np.tile(PERSON_HWL, (n, 1)), np.broadcast_to(np.asarray(yaw, dtype=float), n).copy()
    bottom = np.column_stack([xz[:, 0], np.full(n, 1.65), xz[:, 1]])
    b = Boxes(
        np.full(n, frame), np.broadcast_to(np.asarray(track), n).copy(), np.full(n, "Pedestrian", "<U16"), np.zeros(n),
        np.zeros(n), np.zeros(n), project(bottom, size, yaw, view.P), size, bottom, yaw,
        np.broadcast_to(np.asarray(score, dtype=float), n).copy(),
    )  # fmt: skip
    return b.take(np.isfinite(b.box_px).all(axis=1))


def walking_crowd(view: View, *, count: int, rng: np.random.Generator) -> tuple[Boxes, Boxes]:
    """Labels and detections of `count` people who walk to and fro, hide each other and are then missed, among poles.

    Scores vary with the person, slowly over time, and fall with what is hidden. Poles stand and are found in half of the frames.
    """
    frames = len(view.map_T_cam)
    place = np.column_stack([rng.uniform(-9, 9, count), rng.uniform(7, 28, count)])
    velocity = np.column_stack([rng.choice([-1, 1], count) * rng.normal(1.3, 0.3, count), rng.normal(0, 0.3, count)])
    looks, drift = rng.normal(3.0, 1.0, count), np.zeros(count)
    poles, likeness = np.column_stack([rng.uniform(-12, 12, 12), rng.uniform(8, 35, 12)]), rng.normal(0.5, 0.7, 12)
    labels, found = [], []
    for frame in range(frames):
        place = place + velocity * 0.1
        velocity[(np.abs(place[:, 0]) > 10) | (place[:, 1] < 6) | (place[:, 1] > 30)] *= -1
        yaw = -np.arctan2(velocity[:, 1], velocity[:, 0])
        truth = people(frame, place, np.arange(count), np.nan, view, yaw)
        hidden = hidden_share(Boxes(**{**vars(truth), "frame": np.zeros(len(truth), dtype=int)}), 1)
        occlusion = np.select([hidden > 0.95, hidden > 0.5, hidden > 0.15], [3.0, 2.0, 1.0], 0.0)
        labels.append(Boxes(**{**vars(truth), "occlusion": occlusion}))
        drift = 0.8 * drift + 0.7 * rng.normal(size=count)
        score = (looks + drift)[truth.track_id] - 2.5 * hidden
        hit = (rng.random(len(truth)) < np.where(hidden > 0.7, 0.35, 0.9)) & (score > -1)
        seen = truth.track_id[hit]
        found.append(people(frame, place[seen] + rng.normal(0, 0.07, (len(seen), 2)), -1, score[hit], view, yaw[seen]))
        there = rng.random(12) < 0.5
        pole = np.maximum(likeness[there] + rng.normal(0, 0.8, there.sum()), -0.99)
        found.append(people(frame, poles[there] + rng.normal(0, 0.08, (there.sum(), 2)), -1, pole, view))
    return Boxes.join(labels), Boxes.join(found)
