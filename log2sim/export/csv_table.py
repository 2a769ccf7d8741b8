"""Export to CSV: `agents.csv`, ordered by agent and time; numbers in full precision.

Standard deviations that are unknown are empty. `doubts` holds the flags of the doubts that hold at the time.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from log2sim.datatypes import Scenario
from log2sim.export.exporters import Options

COLUMNS = (
    "t_s", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "observed", "sigma_xy_m", "sigma_yaw_rad", "sigma_speed_mps",
)  # fmt: skip
ABOUT = ("length_m", "width_m", "height_m", "static", "rear_axle_offset_m", "confidence", "doubts")
# Texts that spreadsheets execute as a formula: they begin so and are no number.
FORMULA = re.compile(r"\s*[=+\-@](?!\d+(\.\d+)?$)")


def write_csv_table(file: Path, rows: Iterable[Sequence[Any]]) -> None:
    """Write rows as CSV; an apostrophe is put before texts that a spreadsheet would execute as a formula."""
    with file.open("w", newline="", encoding="utf-8") as opened:
        table = csv.writer(opened, lineterminator="\n")
        for row in rows:
            table.writerow([f"'{v}" if isinstance(v, str) and FORMULA.match(v) else v for v in row])


options: tuple[str, ...] = ()
loses = (
    "map origin, colors, cameras, quality, stages and provenance; ids that a spreadsheet would run get an apostrophe"
)


def write(scenario: Scenario, folder: Path, options: Options) -> None:
    """Write the table."""
    write_csv_table(folder / "agents.csv", _rows(scenario))


def _rows(scenario: Scenario) -> Iterator[Sequence[Any]]:
    yield "id", "category", *COLUMNS, *ABOUT
    for agent in scenario.agents:
        w = agent.waypoints
        about = (*agent.size_m, int(agent.static), agent.rear_axle_offset_m, agent.confidence)
        known = {**w.columns(), "observed": w.observed.astype(int)}
        columns = [known[name].tolist() if name in known else [""] * len(w) for name in COLUMNS]
        held = [(doubt.kind, doubt.holds(w.t_s)) for doubt in agent.doubts]
        for k, row in enumerate(zip(*columns)):
            yield agent.id, agent.category, *row, *about, " ".join(kind for kind, at in held if at[k])
