"""One table of all agents: a row for every agent and time, as spreadsheets and data frames read it."""

from __future__ import annotations

import csv
from pathlib import Path

from log2sim.export import Options
from log2sim.scenario import Scenario

COLUMNS = ("t_s", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "observed", "sigma_xy_m")
HEADER = ("id", "category", *COLUMNS, "length_m", "width_m", "height_m", "static", "rear_axle_offset_m", "confidence")


class Csv:
    """`agents.csv`, ordered by agent and time; numbers in full precision."""

    options: tuple[str, ...] = ()
    loses = "map origin, colors, cameras, quality, plan and provenance"

    def write(self, scenario: Scenario, folder: Path, options: Options) -> None:
        with (folder / "agents.csv").open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(HEADER)
            for agent in scenario.agents:
                about = (*agent.size_m, int(agent.static), agent.rear_axle_offset_m, agent.confidence)
                columns = [getattr(agent.waypoints, name).tolist() for name in COLUMNS]
                columns[COLUMNS.index("observed")] = agent.waypoints.observed.astype(int).tolist()
                table.writerows((agent.id, agent.category, *row, *about) for row in zip(*columns))


EXPORTER = Csv()
