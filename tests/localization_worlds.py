"""Worlds for poses of the ego: a street, a tunnel and an empty plain, with a LiDAR whose points have times."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.datatypes import Log
from log2sim.geometry import Array, PoseTrack, inverse
from log2sim.synth.actors import MovingScene
from log2sim.synth.scene import scene_from_table
from log2sim.synth.synthesis import synthesize

LIDAR = {
    "name": "top", "position_m": [1.2, 0.0, 1.9], "channels": 20, "elevation_deg": [-22.0, 6.0],
    "azimuth_step_deg": 1.5, "range_m": 80.0,
}  # fmt: skip
HOUSES = [
    {
        "center": [x, side * (11.0 + (k * 37 % 5))],
        "size_m": [8.0 + k * 13 % 5, 6.0, 7.0],
        "yaw_deg": float(k * 29 % 17 - 8),
    }
    for k, x in enumerate(range(-40, 90, 13))
    for side in (-1, 1)
]
TUNNEL = [{"center": [100.0, side * 7.0], "size_m": [500.0, 2.0, 8.0]} for side in (-1, 1)]
BEND = [[0.0, 0.0, 8.0], [14.0, 0.0, 8.0], [30.0, 10.0, 8.0], [60.0, 30.0, 8.0]]
STRAIGHT = [[0.0, 0.0, 10.0], [200.0, 0.0, 10.0]]
STANDING = [[0.0, 0.0, 0.0], [30.0, 0.0, 8.0]]
PARKED = [
    {"id": f"parked{k}", "category": "car", "pose": [x, -4.5 if k % 2 else 5.0, 4.0 * k]}
    for k, x in enumerate((-6.0, 9.0, 24.0, 33.0))
]


def drive(
    buildings: list[dict[str, Any]],
    waypoints: list[list[float]],
    *,
    duration_s: float = 2.5,
    sigma_m: float = 0.0,
    angle_deg: float = 0.0,
    seed: int = 0,
    lidar: dict[str, Any] | None = None,
    lidars: list[dict[str, Any]] | None = None,
    observe: bool = False,
) -> tuple[Log, PoseTrack]:
    """A log with GNSS errors of a standard deviation, and the exact poses of its ego."""
    table: dict[str, Any] = {
        "name": "drive", "duration_s": duration_s, "ego": {"waypoints": waypoints, "poses": "poses", "rounding_m": 10.0, "wait_s": [[0, 60.0]] if waypoints is STANDING else []},
        "building": buildings, "agent": PARKED if observe else [], "lidar": lidars or [{**LIDAR, **(lidar or {})}],
        "gnss": {"position_sigma_m": sigma_m, "angle_sigma_deg": angle_deg},
    }  # fmt: skip
    scene = scene_from_table(table)
    log, _ = synthesize(scene, seed=seed, observe=observe)
    moving = MovingScene.of(scene)
    assert log.ego is not None
    return log, PoseTrack(log.ego.t_ns, moving.map_T_mount("ego", log.ego.t_ns))


def relative_errors(found: PoseTrack, true: PoseTrack) -> tuple[Array, Array]:
    """Errors of poses after the first one has been laid on the true one: m (P,) and rad (P,)."""
    exact, _ = true.at(found.t_ns)
    off = inverse(inverse(exact[0]) @ exact) @ (inverse(found.map_T_ego[0]) @ found.map_T_ego)
    turned = np.linalg.norm(off[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2)
    return np.linalg.norm(off[:, :3, 3], axis=1), turned
