"""Pitch and roll of each tick: decided by held-out errors, and used where obstacles are placed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from plain_settings import AGENTS_ALONE
from worlds import camera_ahead, outline_px, scan, standing

import log2sim.pipeline
from log2sim.config import Config
from log2sim.datatypes import ImageLabels, Lidar, Log, Measurements, Stream, Sweep
from log2sim.geometry import Array, PoseTrack, apply, inverse, rotation_from_rpy, transform
from log2sim.perception.homography import estimate, pitch_roll
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import EstimationOptions
from log2sim.pipeline import reconstruct
from log2sim.tracking.tracker import track

T0_NS = 1_700_000_000_000_000_000
TICKS = 40
LIDAR_M = np.array([0.0, 0.0, 1.9])
PLACES_M = (
    (9, 4.5),
    (11, -4),
    (14, 6),
    (17, -7),
    (20, 5),
    (24, -5),
    (28, 8),
    (32, -9),
    (37, 5),
    (42, -6),
    (48, 9),
    (54, -8),
)
SEEN = [standing(x, y) for x, y in PLACES_M]
# What the LiDAR has no point on, such as cars that swallow its light.
UNSEEN = [standing(18.0, 0.0), standing(30.0, 1.0), standing(38.0, 0.0), standing(48.0, -2.0)]


def pitching_log(pitch_deg: float, seed: int = 0, *, level_poses: bool = False) -> Log:
    """A standing vehicle whose body pitches and rolls with camera and LiDAR; `level_poses` tell nothing of it."""
    rng = np.random.default_rng(seed)
    t = T0_NS + np.arange(TICKS) * 100_000_000
    angles = np.radians(pitch_deg) * rng.normal(size=(TICKS, 2)) * [0.3, 1.0]
    poses = np.array([transform(rotation_from_rpy(roll, pitch, 0.0), np.zeros(3)) for roll, pitch in angles])
    camera = replace(
        camera_ahead(mount="ego"), K=np.diag([3.0, 3.0, 1.0]) @ camera_ahead().K, width_px=3600, height_px=1800
    )
    boxes = np.array([[outline_px(camera, p @ camera.mount_T_cam, s) for s in (*SEEN, *UNSEEN)] for p in poses])
    boxes[..., 1::2] += rng.normal(0.0, 0.4, boxes[..., 1::2].shape)
    labels = ImageLabels(
        t_ns=np.repeat(t, boxes.shape[1]),
        category=np.full(boxes.shape[0] * boxes.shape[1], "car"),
        box_px=boxes.reshape(-1, 4),
    )

    @cache
    def sweep(i: int) -> Sweep:
        world, _ = scan(SEEN, sensor=tuple(LIDAR_M), noise_m=0.01, seed=i)
        points = apply(inverse(poses[i]), world) - LIDAR_M
        return Sweep(int(t[i]), points, "lidar", np.full(len(points), t[i]))

    return Log(
        "log",
        "test",
        {"front": camera},
        {"top": Lidar("top", "ego", transform(np.eye(3), LIDAR_M))},
        {"front": Stream("front", t, lambda i: np.zeros((600, 1200, 3), np.uint8)), "top": Stream("top", t, sweep)},
        PoseTrack(t, np.tile(np.eye(4), (TICKS, 1, 1)) if level_poses else poses),
        image_labels={"front": labels},
    )


@dataclass
class Outcome:
    """What a run makes of the cars without LiDAR points.

    `scatter_m` (U,) is the standard deviation over the frames of where they are placed along the ray, `error_m` (U,) the
    distance of each from the nearest agent of the scenario.
    """

    scatter_m: Array
    error_m: Array
    homography: dict[str, Any]


def outcome(log: Log, monkeypatch: pytest.MonkeyPatch) -> Outcome:
    placed: list[Measurements] = []

    def spy(fused: list[Measurements], *rest: Any, **options: Any) -> Any:
        placed.extend(fused)
        return track(fused, *rest, **options)

    with monkeypatch.context() as patch:
        patch.setattr(log2sim.pipeline, "track", spy)
        scenario = reconstruct(log, Config.load(detect={"name": "labels"}, **AGENTS_ALONE)).scenario
    rows = Measurements.join(placed)
    rows = rows.take(rows.source == "topdown")
    truth = np.array([s.center_m[:2] for s in UNSEEN])
    # Boxes of cars at different ranges have different widths, however the camera pitches.
    near_side = truth[:, 0] - 2.2
    u, width = 1800 - 2100 * truth[:, 1] / near_side, 2100 * 1.85 / near_side
    rows_u, rows_width = rows.box_px[:, [0, 2]].mean(axis=1), rows.box_px[:, 2] - rows.box_px[:, 0]
    own = (np.abs(rows_u[:, None] - u) < 60) & (np.abs(rows_width[:, None] / width - 1) < 0.15)
    placed_m = [rows.center_m[own[:, k], :2] for k in range(len(UNSEEN))]
    return Outcome(
        np.array([xy[:, 0].std() for xy in placed_m]),
        np.array([np.hypot(*(xy.mean(axis=0) - center)) for xy, center in zip(placed_m, truth)]),
        dict(scenario.cameras[0]["homography"]),
    )


@pytest.mark.slow
def test_a_pitching_vehicle_places_far_cars_as_well_as_one_that_does_not_pitch(monkeypatch: pytest.MonkeyPatch) -> None:
    still = outcome(pitching_log(0.0), monkeypatch)
    assert not still.homography["pitch_roll"]["per_tick"]
    assert still.homography["pitch_roll"]["significance"] == 0.0
    log = pitching_log(0.1)
    stabilized = outcome(log, monkeypatch)
    movement = stabilized.homography["pitch_roll"]
    assert movement["per_tick"]
    assert movement["pitch_sigma_deg"] == pytest.approx(0.1, rel=0.2)
    with monkeypatch.context() as patch:
        patch.setattr(pitch_roll, "MIN_SIGNIFICANCE_SIGMA", np.inf)
        fixed = outcome(log, patch)
    assert (stabilized.scatter_m < 1.15 * still.scatter_m).all()
    # The heights of cars tell their distance, too, whatever the pitch.
    assert (fixed.scatter_m > 2.5 * still.scatter_m).all()
    assert np.abs(stabilized.error_m - still.error_m).max() < 0.2


def test_a_camera_that_moves_on_its_own_is_found_by_the_obstacles_alone() -> None:
    # The LiDAR's ground points are projected by the calibration and tell nothing of a camera that shakes in its mount.
    rng = np.random.default_rng(3)
    K = np.array([[2000.0, 0.0, 960.0], [0.0, 2000.0, 600.0], [0.0, 0.0, 1.0]])
    ticks, cars = 60, 10
    tick = np.repeat(np.arange(ticks), cars)
    xy = np.column_stack([rng.uniform(8.0, 50.0, len(tick)), rng.uniform(-8.0, 8.0, len(tick))])
    level = np.column_stack([960 - 2000 * xy[:, 1] / xy[:, 0], 600 + 2000 * 1.6 / xy[:, 0]])
    shake_px = 2000 * np.radians(0.3) * rng.normal(size=ticks)
    feet = Correspondences(level + rng.normal(0.0, 1.5, level.shape) + np.outer(shake_px[tick], [0.0, 1.0]), xy, tick)
    ground = Correspondences(level + rng.normal(0.0, 0.3, level.shape), xy, tick)
    fit, source = estimate.fit_camera(feet, ground, EstimationOptions(K=K), rng=np.random.default_rng(0))
    assert source == "obstacles"
    assert fit.pitch_roll is not None
    assert fit.pitch_roll.per_tick
    assert fit.pitch_roll.source == "obstacles"
    assert fit.pitch_roll.pitch_sigma_deg == pytest.approx(np.degrees(shake_px.std() / 2000), rel=0.1)
