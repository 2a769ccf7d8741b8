"""Large and close vehicles: five kinds of 4 to 19 m, in eight poses, with and without a second vehicle.

Each is a small synthetic log of one LiDAR, reconstructed by `lidar:vehicle` and compared with its truth as `evaluate` does: recall of
the vehicle, position, yaw, length, width and speed, and how many agents there are besides.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.table import cell, markdown
from log2sim.config import Config
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.geometry import Array
from log2sim.pipeline import reconstruct
from log2sim.synth.scene import Scene, scene_from_table
from log2sim.synth.synthesis import synthesize

# Length, width, height in m of common European vehicles: Directive 96/53/EC limits the long ones.
KINDS: Mapping[str, tuple[str, tuple[float, float, float]]] = {
    "hatchback": ("car", (4.0, 1.75, 1.5)),
    "van": ("car", (5.9, 2.0, 2.6)),
    "light_truck": ("truck", (6.8, 2.3, 2.8)),
    "bus": ("bus", (12.0, 2.55, 3.1)),
    "road_train": ("truck", (18.75, 2.55, 4.0)),
}
SECOND_SIZE_M, GAP_M, DURATION_S, EGO_FRONT_M, LANE_M = (4.5, 1.8, 1.5), 1.5, 2.6, 3.7, 3.4
LIDAR = {"name": "top", "position_m": [1.2, 0.0, 2.0], "channels": 40, "elevation_deg": [-25.0, 15.0]}
# By pose: x of the box's center less so many of its lengths, y, heading and speed of the vehicle, speed of the ego, and on which side
# the second one is.
POSES: Mapping[str, tuple[float, float, float, float, float, float, int]] = {
    "end_on": (EGO_FRONT_M + 12.0, 0.5, 0.0, 0.0, 0.0, 0.0, 1),  # its rear ahead of an ego that waits
    "beside": (3.0, 0.0, LANE_M, 0.0, 8.0, 8.0, -1),  # as fast as the ego
    "oblique": (12.0, 0.41, 3.0, 35.0, 0.0, 3.0, 1),  # parked across a corner
    "curb": (8.0, 0.5, -LANE_M, 0.0, 0.0, 8.0, -1),  # parked, passed by the ego
    "queue": (3.0, -0.25, LANE_M, 0.0, 0.0, 0.0, -1),  # stands beside an ego that stands
    "oncoming": (EGO_FRONT_M + 10.0, 0.5, LANE_M, 180.0, 7.0, 7.0, -1),
    "overtaking": (-4.0, -0.5, LANE_M, 0.0, 18.0, 8.0, -1),
    "overtaken": (EGO_FRONT_M + 4.0, 0.5, -LANE_M, 0.0, 6.0, 16.0, -1),
}
HEAD = ("kind", "pose", "second", "recall", "position m", "yaw deg", "length m", "width m", "speed m/s", "others")


def scene_of(kind: str, pose: str, *, second: bool) -> Scene:
    """Make the scene of a kind in a pose, with a car close behind it or ahead."""
    (category, size), (x_m, lengths, y_m, yaw_deg, speed, ego_mps, side) = KINDS[kind], POSES[pose]
    heading = np.array([np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))])
    center = np.array([x_m + lengths * size[0], y_m])

    def moving(at: Array, along: Array, mps: float) -> dict[str, Any]:
        rows = [[*map(float, at), mps], [*map(float, at + 200.0 * along), max(mps, 1.0)]]
        return {"waypoints": rows} | ({} if mps else {"wait_s": [[0, 60.0]]})

    def agent(name: str, of: str, size_m: tuple[float, float, float], at: Array) -> dict[str, Any]:
        axle = at - 0.3 * size_m[0] * heading
        where = moving(axle, heading, speed) if speed else {"pose": [*map(float, at), yaw_deg]}
        return {"id": name, "category": of, "size_m": list(size_m)} | where

    agents = [agent("target", category, size, center)]
    if second:
        away = side * (size[0] / 2 + GAP_M + SECOND_SIZE_M[0] / 2)
        agents.append(agent("second", "car", SECOND_SIZE_M, center + away * heading))
    return scene_from_table({
        "name": f"{kind}-{pose}", "duration_s": DURATION_S, "agent": agents, "lidar": [LIDAR],
        "ego": moving(np.zeros(2), np.array([1.0, 0.0]), ego_mps) | {"poses": "poses"},
        "road": [{"line": [[-60.0, 0.0], [150.0, 0.0]], "width_m": 14.0}],
    })  # fmt: skip


def main() -> None:
    """Reconstruct every scene and print the table, and the mean of each pose."""
    config = Config.load(settings=["detect.name=lidar:vehicle", "map.lanes=false"])
    keys = ("position_rmse_m", "yaw_median_deg", "length_error_m", "width_error_m", "speed_rmse_mps")
    rows: list[tuple[str, ...]] = []
    for name in POSES:
        found = list[list[float | None]]()
        for of in KINDS:
            for second in (False, True):
                log, truth = synthesize(scene_of(of, name, second=second), seed=0)
                judged = evaluate(reconstruct(log, config, cache=False), truth)
                row = next((a for a in judged["agents"] if a["id"] == "target"), None)
                recall = row["matched"] / row["ticks"] if row and row["ticks"] else 0.0
                values = [recall, *((row or {}).get(key) for key in keys)]
                others = str(len(judged["agents"]) - (row is not None) + len(judged["false_agents"]))
                rows.append((of, name, "yes" if second else "", *map(cell, values), others))
                print(" | ".join(rows[-1]), flush=True)
                found.append(values)
        known = [[abs(v) for v in column if v is not None] for column in zip(*found)]
        rows.append(("mean", name, "", *(cell(float(np.mean(column)) if column else None) for column in known), ""))
    print("", markdown(HEAD, rows), sep="\n")
