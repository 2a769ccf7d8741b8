"""The background of pictures: a map of the ground, made of a log or read from a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from log2sim.datatypes import Log, Scenario
    from log2sim.mapping.ground_map import GroundMap

CELL_M = 0.06
"""Edge of a cell, m: pictures on paper and screens show no more of a hundred meters."""


def load_background(
    path: Path,
    scenario: Scenario,
    sequence: str | None,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> GroundMap:
    """Return the map of the ground in a PNG that `log2sim map` wrote, or that of a log, without the agents of the scenario.

    Of a log without cameras it shows the intensity of the LiDAR.

    Raises
    ------
    LogError
        When the file is no such map, or the log has neither pictures nor intensity of the ground.
    """
    from dataclasses import replace

    import numpy as np

    from log2sim.errors import LogError
    from log2sim.localization.choice import localize_like
    from log2sim.logs.opening import open_log
    from log2sim.mapping.files import read_png_map

    if path.suffix.lower() == ".png":
        return read_png_map(path, scenario.map)
    log = localize_like(open_log(path, sequence=sequence), scenario.provenance)
    ground = map_of(log, scenario, progress)
    if ground.has_color:
        return ground
    known = np.isfinite(ground.intensity)
    if not known.any():
        raise LogError(f"{log.name}: the log has no pictures of the ground, and its sweeps have no intensity")
    gray = np.rint(255 * np.nan_to_num(ground.intensity)).astype(np.uint8)
    return replace(ground, color_bgr=np.dstack([gray] * 3), alpha=np.where(known, 255, 0).astype(np.uint8))


def map_of(log: Log, scenario: Scenario, progress: Callable[[str, int, int], None]) -> GroundMap:
    """Return the map of the ground of an opened log, as fine as screens and paper show it."""
    from log2sim.config_sections import MapConfig
    from log2sim.mapping.builder import map_ground

    return map_ground(log, scenario, MapConfig(cell_m=CELL_M), progress=progress)
