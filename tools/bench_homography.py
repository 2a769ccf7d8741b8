"""Image-to-ground homographies of a stream of box feet: log2sim beside OpenCV, scikit-image, PoseLib and pycolmap.

The world: a camera 2.1 m above flat ground, 1920x1280 px, focal length 2050 px, looking 2 degrees down; in every frame
the two lower corners of boxes around cars 6-60 m ahead, whose ground positions a LiDAR measured to 5 cm. Of the outliers
one half has the ground position of another car, the other half a foot that something hides, 20-150 px too high.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]

FOCAL_PX, CENTER_PX, HEIGHT_M, TILT_DEG = 2050.0, (960.0, 640.0), 2.1, 2.0
K = np.array([[FOCAL_PX, 0.0, CENTER_PX[0]], [0.0, FOCAL_PX, CENTER_PX[1]], [0.0, 0.0, 1.0]])
GROUND_NOISE_M = 0.05
NEAR_M = (6.0, 8.0, 10.0, 15.0, 20.0, 25.0)
FAR_M = (30.0, 40.0, 50.0, 60.0)
HALF_TRACK_M = 0.9
TICK_S = 0.1


@dataclass(frozen=True)
class Case:
    """One row of the table: `noise_px`, share of `outliers`, `cars` in a frame (two correspondences each), `nod_deg`."""

    noise_px: float = 1.0
    outliers: float = 0.3
    cars: int = 10
    nod_deg: float = 0.0
    ticks: int = 40


@dataclass(frozen=True, eq=False)
class Stream:
    """Correspondences (N, 2), (N, 2), (N,) with `clean` (N,) and the true `image_H_ground` of each tick (T, 3, 3)."""

    uv: Array
    xy: Array
    tick: np.ndarray[Any, np.dtype[np.int64]]
    clean: np.ndarray[Any, np.dtype[np.bool_]]
    image_H_ground: Array


def camera(pitch_rad: float = np.radians(TILT_DEG), roll_rad: float = 0.0) -> Array:
    """Ground (x forward, y left, 1) to image, for a camera above the origin that looks down by `pitch_rad`."""
    down, turn = np.array([np.cos(pitch_rad), np.sin(pitch_rad)]), np.array([np.cos(roll_rad), np.sin(roll_rad)])
    ahead = np.array([down[0], 0.0, -down[1]])
    below = np.array([-down[1], 0.0, -down[0]])
    aside = np.array([0.0, -1.0, 0.0])
    rows = np.array([turn[0] * aside - turn[1] * below, turn[1] * aside + turn[0] * below, ahead])
    return np.asarray(K @ np.column_stack([rows[:, 0], rows[:, 1], -HEIGHT_M * rows[:, 2]]))


def mapped(h: Array, points: Array) -> Array:
    """Points (N, 2) through a homography (..., 3, 3)."""
    q = points @ np.swapaxes(h[..., :2], -1, -2) + h[..., None, :, 2]
    return np.asarray(q[..., :2] / q[..., 2:])


def make_stream(case: Case, seed: int) -> Stream:
    """A seeded stream of correspondences."""
    rng = np.random.default_rng([seed, case.cars, int(10 * case.noise_px), int(100 * case.outliers)])
    x, y = rng.uniform(6.0, 60.0, case.cars), rng.uniform(-9.0, 9.0, case.cars)
    speed = rng.uniform(-3.0, 3.0, case.cars)
    uv, xy, clean, poses = [], [], [], []
    for _ in range(case.ticks):
        x = x + speed * TICK_S
        left = (x < 6.0) | (x > 62.0)
        x = np.where(left, rng.uniform(6.0, 60.0, case.cars), x)
        middle = np.clip(y, -0.42 * x, 0.42 * x)
        feet = np.concatenate([np.column_stack([x, middle + s * HALF_TRACK_M]) for s in (1.0, -1.0)])
        nod, roll = np.radians(case.nod_deg) * rng.normal(size=2)
        poses.append(camera(np.radians(TILT_DEG) + nod, roll))
        pixel = mapped(poses[-1], feet) + rng.normal(0.0, case.noise_px, feet.shape)
        ground = feet + rng.normal(0.0, GROUND_NOISE_M, feet.shape)
        wrong = rng.permutation(len(feet))[: round(case.outliers * len(feet))]
        confused, hidden = wrong[: len(wrong) // 2], wrong[len(wrong) // 2 :]
        other = (confused + rng.integers(1, len(feet), len(confused))) % len(feet)
        ground[confused] = ground[other] + rng.normal(0.0, 0.3, (len(confused), 2))
        pixel[hidden, 1] -= rng.uniform(20.0, 150.0, len(hidden))
        uv.append(pixel)
        xy.append(ground)
        clean.append(~np.isin(np.arange(len(feet)), wrong))
    tick = np.repeat(np.arange(case.ticks), 2 * case.cars)
    return Stream(np.concatenate(uv), np.concatenate(xy), tick, np.concatenate(clean), np.array(poses))


def probes(ranges_m: tuple[float, ...]) -> Array:
    """Ground points (n, 2) across the view at these ranges."""
    return np.array([[x, y] for x in ranges_m for y in (-0.35 * x, 0.0, 0.35 * x) if abs(y) <= 12.0])


def errors_m(found: Array, stream: Stream, ranges_m: tuple[float, ...]) -> Array:
    """Ground distances (T, n) between what `ground_H_image` (T, 3, 3) and the truth say of the same pixels."""
    pixels = mapped(camera(), probes(ranges_m))
    truth = mapped(np.linalg.inv(stream.image_H_ground), pixels)
    return np.asarray(np.linalg.norm(mapped(found, pixels) - truth, axis=-1))


def limit(stream: Stream, noise_px: float, rows: Array | None = None) -> Array:
    """The most likely `ground_H_image` of the clean correspondences, noise known and started at the truth."""
    from scipy.optimize import least_squares

    use = stream.clean if rows is None else stream.clean & rows
    g, p, start = stream.xy[use], stream.uv[use], camera()
    w = g @ start[2, :2] + start[2, 2]
    slope = (start[:2, :2] - mapped(start, g)[:, :, None] * start[2:, :2]) / w[:, None, None]
    spread = noise_px**2 * np.eye(2) + GROUND_NOISE_M**2 * slope @ slope.swapaxes(1, 2)
    whiten = np.linalg.inv(np.linalg.cholesky(spread))
    scale = np.abs(start.ravel()[:8] / start[2, 2]) + 1e-3

    def residuals(q: Array) -> Array:
        h = np.append(q * scale, 1.0).reshape(3, 3)
        return np.asarray(np.einsum("nij,nj->ni", whiten, mapped(h, g) - p).ravel())

    best = least_squares(residuals, start.ravel()[:8] / start[2, 2] / scale, method="lm").x
    return np.asarray(np.linalg.inv(np.append(best * scale, 1.0).reshape(3, 3)))


Estimator = Callable[[Stream], Array]
