"""The background of pictures: a map of the ground, made of a log or read from a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from log2sim.datatypes import Log, Scenario
    from log2sim.road.ground_map import GroundMap

CELL_M = 0.06  # edge of a cell, m: pictures on paper and screens show no more of a hundred meters


def load_background(
    path: Path,
    scenario: Scenario,
    sequence: str | None,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> GroundMap:
    """Return the map of the ground in a PNG that `log2sim map` wrote, or that of a log, without the agents of the scenario.

    Raises `LogError` when the file is no such map, or the log has neither camera nor LiDAR.
    """
    from log2sim.errors import LogError
    from log2sim.localization.choice import localize_like
    from log2sim.logs.opening import open_log
    from log2sim.road.map_files import read_png_map

    if path.suffix.lower() == ".png":
        return read_png_map(path, scenario.map)
    log = localize_like(open_log(path, sequence=sequence), scenario.provenance)
    if not log.cameras and not log.lidars:
        raise LogError(f"{log.name}: the log has neither a camera nor a LiDAR, so there is no picture of the ground")
    return map_of(log, scenario, progress)


def map_of(log: Log, scenario: Scenario, progress: Callable[[str, int, int], None]) -> GroundMap:
    """Return the map of the ground of an opened log, as fine as screens and paper show it; in LiDAR intensities without a camera."""
    from log2sim.config import MapConfig
    from log2sim.road.builder import map_ground

    return map_ground(log, scenario, MapConfig(cell_m=CELL_M), progress=progress).as_picture()
