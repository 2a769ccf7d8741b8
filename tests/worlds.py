"""Small synthetic worlds with exact truth that tests of all stages can build on. Nothing is rendered before it is read."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from log2sim.scenario import Scenario
from log2sim.synth.assemble import synthesize
from log2sim.synth.scene import Scene, scene_from_table
from log2sim.types import Log

CAR = {"id": "car", "category": "car", "size_m": [4.4, 1.8, 1.5], "waypoints": [[16.0, 2.0, 4.0], [40.0, 2.0, 4.0]]}
PARKED = {"id": "parked", "category": "car", "size_m": [4.2, 1.8, 1.5], "pose": [14.0, -4.0, 10.0]}
WALKER = {"id": "walker", "category": "pedestrian", "waypoints": [[12.0, 5.0, 1.4], [12.0, -5.0, 1.4]]}


def tiny_table(agents: list[dict[str, Any]] | None = None, **changes: Any) -> dict[str, Any]:
    """A scene as its TOML document: one street, one camera, one coarse LiDAR, the ego driving east at 3 m/s."""
    table: dict[str, Any] = {
        "name": "tiny",
        "duration_s": 1.0,
        "ego": {"waypoints": [[0.0, 0.0, 3.0], [20.0, 0.0, 3.0]], "poses": "poses"},
        "road": [{"line": [[-10.0, 0.0], [50.0, 0.0]], "width_m": 10.0}],
        "agent": [CAR, PARKED, WALKER] if agents is None else agents,
        "camera": [{"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [480, 300], "offset_s": 0.03}],
        "lidar": [
            {
                "name": "top",
                "position_m": [1.2, 0.0, 1.9],
                "channels": 24,
                "elevation_deg": [-18.0, 3.0],
                "azimuth_deg": [-60.0, 60.0],
                "azimuth_step_deg": 0.5,
                "range_m": 60.0,
            }
        ],
        "gnss": {"position_sigma_m": 0.0, "angle_sigma_deg": 0.0},
    }
    return {**table, **changes}


def tiny_scene(agents: list[dict[str, Any]] | None = None, **changes: Any) -> Scene:
    """The scene of `tiny_table`."""
    return scene_from_table(tiny_table(agents, **changes))


def tiny_log(
    agents: list[dict[str, Any]] | None = None,
    *,
    seed: int = 0,
    noise_m: float = 0.02,
    observe: bool = True,
    **changes: Any,
) -> tuple[Log, Scenario]:
    """A log of about ten ticks in memory and its truth, in well under a second.

    `changes` replace whole entries of `tiny_table`; `noise_m` is the LiDAR's range noise (0 also turns dropouts and
    rounding off); without `observe` there are no labels and no `visible`.
    """
    scene = tiny_scene(agents, **changes)
    calm = {"dropout": 0.0, "resolution_m": 0.0} if noise_m == 0 else {}
    lidars = tuple(replace(spec, noise_m=noise_m, **calm) for spec in scene.lidar)
    return synthesize(replace(scene, lidar=lidars), seed=seed, observe=observe)
