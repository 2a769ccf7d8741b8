"""Export to CARLA: `replay_carla.py`, which moves the agents by CARLA's Python client, `scenario_carla.json` and `road.xodr`.

The data have CARLA's axes (y to the right, yaw clockwise). The script is a copy of `log2sim.simulation.carla.player`, so the tested code is what is written.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.export.exporters import Options
from log2sim.export.roads.opendrive import add_road_file
from log2sim.simulation.carla import player
from log2sim.simulation.carla.data import carla_agents, controller_data

MODES = ("exact", "pid")
options: tuple[str, ...] = ("map", "mode")
loses = (
    "sizes (CARLA's assets have their own; the data list by how much), states of traffic lights, map origin, cameras, quality,"
    " stages, provenance"
)


def write(scenario: Scenario, folder: Path, options: Options) -> None:
    """Write script, data and road."""
    mode = options.mode or "exact"
    if mode not in MODES:
        raise ConfigError(f"--mode: '{mode}', expected one of {', '.join(MODES)}")
    road, placement = add_road_file(scenario, folder, options.map)
    placed = []  # in the coordinates of the road
    for agent in scenario.agents:
        w = agent.waypoints
        states = placement.forward(np.column_stack([w.x_m, w.y_m, w.z_m, w.yaw_rad]))
        placed.append(replace(agent, waypoints=replace(w, **dict(zip(("x_m", "y_m", "z_m", "yaw_rad"), states.T)))))
    x, y, z = placement.origin_m
    data = {
        "format": "log2sim-carla",
        "version": player.VERSION,
        "scenario": scenario.name,
        "mode": mode,
        "road": road,
        "offset_m": [x, 0.0 - y, z],  # to be added to the coordinates in the file, for those of the map
        "controller": controller_data(),
        "agents": carla_agents(placed),
    }
    text = json.dumps(data, allow_nan=False, ensure_ascii=False)
    (folder / "scenario_carla.json").write_text(text + "\n", encoding="utf-8")
    (folder / "replay_carla.py").write_bytes(Path(player.__file__).read_bytes())
