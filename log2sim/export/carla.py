"""A scenario for CARLA: a script that replays it through CARLA's Python client, and its data.

The script is `log2sim.replay.carla_player` as it stands there, so what is tested is what is written.
"""

from __future__ import annotations

import json
from pathlib import Path

from log2sim.errors import ConfigError
from log2sim.export import Options
from log2sim.export.placement import origin_m
from log2sim.replay import carla_player
from log2sim.replay.carla_data import carla_agents
from log2sim.scenario import Scenario

MODES = ("exact", "pid")


class Carla:
    """`replay_carla.py` and `scenario_carla.json`, whose coordinates are CARLA's: y to the right, yaw clockwise, degrees."""

    options: tuple[str, ...] = ("mode",)
    loses = "sizes (CARLA's assets have their own; the data list by how much), map origin, cameras, quality, plan, provenance"

    def write(self, scenario: Scenario, folder: Path, options: Options) -> None:
        mode = options.mode or "exact"
        if mode not in MODES:
            raise ConfigError(f"--mode: '{mode}', expected one of {', '.join(MODES)}")
        offset_m = origin_m(scenario)
        data = {
            "format": "log2sim-carla",
            "version": carla_player.VERSION,
            "scenario": scenario.name,
            "mode": mode,
            "offset_m": [offset_m[0], 0.0 - offset_m[1], 0.0],  # to be added to the coordinates in the file
            "agents": carla_agents(scenario.agents, offset_m),
        }
        text = json.dumps(data, allow_nan=False, ensure_ascii=False)
        (folder / "scenario_carla.json").write_text(text + "\n", encoding="utf-8")
        (folder / "replay_carla.py").write_bytes(Path(carla_player.__file__).read_bytes())


EXPORTER = Carla()
