"""Export to CARLA: a script that replays the scenario through CARLA's Python client, and its data.

The script is a copy of `log2sim.simulation.carla.player`, so the tested code is what is written.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from log2sim.datatypes import Agent, Scenario
from log2sim.errors import ConfigError
from log2sim.export.exporters import ExportPlacement, Options
from log2sim.export.roads.opendrive import add_road_file
from log2sim.simulation.carla import player
from log2sim.simulation.carla.data import carla_agents, controller_data

MODES = ("exact", "pid")


class Carla:
    """`replay_carla.py`, `scenario_carla.json` in CARLA's axes (y to the right, yaw clockwise), and `road.xodr`."""

    options: tuple[str, ...] = ("map", "mode")
    loses = (
        "sizes (CARLA's assets have their own; the data list by how much), states of traffic lights, map origin, cameras, quality,"
        " stages, provenance"
    )

    def write(self, scenario: Scenario, folder: Path, options: Options) -> None:
        """Write script, data and road."""
        mode = options.mode or "exact"
        if mode not in MODES:
            raise ConfigError(f"--mode: '{mode}', expected one of {', '.join(MODES)}")
        road, placement = add_road_file(scenario, folder, options.map)
        x, y, z = placement.origin_m
        data = {
            "format": "log2sim-carla",
            "version": player.VERSION,
            "scenario": scenario.name,
            "mode": mode,
            "road": road,
            "offset_m": [x, 0.0 - y, z],  # to be added to the coordinates in the file, for those of the map
            "controller": controller_data(),
            "agents": carla_agents([_placed(a, placement) for a in scenario.agents]),
        }
        text = json.dumps(data, allow_nan=False, ensure_ascii=False)
        (folder / "scenario_carla.json").write_text(text + "\n", encoding="utf-8")
        (folder / "replay_carla.py").write_bytes(Path(player.__file__).read_bytes())


EXPORTER = Carla()


def _placed(agent: Agent, placement: ExportPlacement) -> Agent:
    """Transform an agent to the coordinates of the road."""
    w = agent.waypoints
    x, y, z, yaw = placement.forward(np.column_stack([w.x_m, w.y_m, w.z_m, w.yaw_rad])).T
    return replace(agent, waypoints=replace(w, x_m=x, y_m=y, z_m=z, yaw_rad=yaw))
