"""Tracking of people in simulated crowds of several densities: boxes as a detector finds them, scored as KITTI's tracking benchmark is.

A camera that stands, or drives at 2 m/s, sees a square of 30 x 24 m in which people walk at 0.5 to 1.8 m/s toward places that they choose
anew; some stand. A box is off by 8 cm along each axis (a little more far away), a tenth of them is missed, so is who is hidden by
more than half, and each frame has half a false box with a lower score. Nothing of the tracker was fitted to them.
"""

from __future__ import annotations

import time

import numpy as np
from kitti.boxes import EGO_R_CAM, Boxes, View
from kitti.choice import choose
from kitti.scoring import evaluate

from benchmarks.kitti import HEAD, describe_sequence
from benchmarks.table import markdown
from log2sim.geometry import transform

FOCAL_PX, HEIGHT_M, PERIOD_S = 721.5, 1.65, 0.1
P = np.array([[FOCAL_PX, 0.0, 609.6, 0.0], [0.0, FOCAL_PX, 172.9, 0.0], [0.0, 0.0, 1.0, 0.0]])
PEOPLE = (6, 18, 40, 80)  # in the square
DEPTH_M, HALF_WIDTH_M = (6.0, 36.0), 12.0
MISSED, FALSE_A_FRAME, HIDDEN_SHARE = 0.1, 0.5, 0.5


def main(frames: int = 200, seeds: int = 3, online: bool = False) -> None:
    rows = []
    for count in PEOPLE:
        for speed_mps in (0.0, 2.0):
            found, labels, seconds = {}, {}, 0.0
            for seed in range(seeds):
                labels[str(seed)], detected, view = make_crowd(count, frames, speed_mps, seed)
                begin = time.process_time()
                found[str(seed)] = choose(describe_sequence(detected, view, online=online), online=online)
                seconds += time.process_time() - begin
            score = evaluate(found, labels, "Pedestrian")
            name = f"{count} people, {'stands' if speed_mps == 0 else f'{speed_mps:g} m/s'}"
            speed = f"{frames * seeds / seconds:.0f}"
            rows.append([name, *(f"{v:.2f}" for v in score[:6]), *map(str, score[6:]), speed])
    print(markdown(["crowd", *HEAD[1:], "frames/s"], rows))


def make_crowd(count: int, frames: int, speed_mps: float, seed: int) -> tuple[Boxes, Boxes, View]:
    """Labels and detections of one sequence, and its view."""
    rng = np.random.default_rng([seed, count, int(speed_mps)])
    place, size = _anywhere(rng, count), rng.normal([1.75, 0.6, 0.7], [0.08, 0.06, 0.1], (count, 3))
    goal, pace = _anywhere(rng, count), np.where(rng.random(count) < 0.2, 0.0, rng.uniform(0.5, 1.8, count))
    yaw, labels, detected = rng.uniform(-np.pi, np.pi, count), [], []
    for frame in range(frames):
        ego_x = speed_mps * PERIOD_S * frame
        to_goal = goal - place
        near = (np.hypot(*to_goal.T) < 1.0) | (rng.random(count) < 0.005)
        goal[near] = np.add(_anywhere(rng, count), [ego_x, 0.0])[near]
        wanted = np.where(pace > 0, np.arctan2(to_goal[:, 1], to_goal[:, 0]), yaw)
        yaw = yaw + np.clip(np.arctan2(np.sin(wanted - yaw), np.cos(wanted - yaw)), -0.3, 0.3)
        place = place + PERIOD_S * pace[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        at = place - [ego_x, 0.0]
        truth = _boxes(frame, np.arange(count), at, yaw, size, np.full(count, np.nan))
        hidden = _hidden(truth)
        seen = (at[:, 0] > DEPTH_M[0] - 2) & (truth.box_px[:, 0] >= 0) & (truth.box_px[:, 2] <= 1242)
        truth.occlusion[:] = np.digitize(hidden, [0.1, 0.5, 0.9])
        labels.append(truth.take(seen))
        kept = np.flatnonzero(seen & (hidden < HIDDEN_SHARE) & (rng.random(count) >= MISSED))
        false = _anywhere(rng, rng.poisson(FALSE_A_FRAME))
        sigma_m = 0.08 + 0.002 * at[kept, :1]
        where = np.concatenate([at[kept] + sigma_m * rng.normal(size=(len(kept), 2)), false])
        turned = np.concatenate([yaw[kept] + 0.2 * rng.normal(size=len(kept)), rng.uniform(-3, 3, len(false))])
        own = size[kept] * rng.normal(1, 0.04, (len(kept), 3))
        sizes = np.concatenate([own, np.tile([1.7, 0.6, 0.7], (len(false), 1))])
        score = np.concatenate([rng.normal(2.5 - hidden[kept], 1.0), rng.normal(-0.5, 1.0, len(false))])
        detected.append(_boxes(frame, np.full(len(where), -1), where, turned, sizes, score))
    ego = np.column_stack([speed_mps * PERIOD_S * np.arange(frames), np.zeros((frames, 2))])
    return Boxes.join(labels), Boxes.join(detected), View(transform(np.tile(EGO_R_CAM, (frames, 1, 1)), ego), P)


def _anywhere(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.column_stack([rng.uniform(*DEPTH_M, count), rng.uniform(-HALF_WIDTH_M, HALF_WIDTH_M, count)])


def _boxes(
    frame: int, number: np.ndarray, at: np.ndarray, yaw: np.ndarray, size: np.ndarray, score: np.ndarray
) -> Boxes:
    """Boxes of people at places (N, 2), x ahead and y to the left."""
    depth, right, n = np.maximum(at[:, 0], 0.5), -at[:, 1], len(at)
    u, half = 609.6 + FOCAL_PX * right / depth, FOCAL_PX * size[:, 1] / 2 / depth
    low, high = 172.9 + FOCAL_PX * HEIGHT_M / depth, 172.9 + FOCAL_PX * (HEIGHT_M - size[:, 0]) / depth
    bottom = np.column_stack([right, np.full(n, HEIGHT_M), at[:, 0]])
    zero = np.zeros(n)
    return Boxes(
        np.full(n, frame), number, np.full(n, "Pedestrian", dtype="<U16"), zero, zero.copy(),
        np.column_stack([u - half, high, u + half, low]), size, bottom, -yaw - np.pi / 2, score,
    )  # fmt: skip


def _hidden(boxes: Boxes) -> np.ndarray:
    """Share (N,) of the width of each box that nearer people cover."""
    left, right, depth = boxes.box_px[:, 0], boxes.box_px[:, 2], boxes.bottom_m[:, 2]
    columns = left[:, None] + (np.arange(16) + 0.5) / 16 * (right - left)[:, None]
    covers = (columns[:, :, None] > left) & (columns[:, :, None] < right)
    nearer = (depth[None, :] < depth[:, None] - 0.3) & (depth > 0.5)[None, :]
    return np.asarray((covers & nearer[:, None, :]).any(axis=2).mean(axis=1))
