"""What pictures and pages show besides a scenario: a replay, the truth, and a map of the ground."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from log2sim.cli import options as opt

if TYPE_CHECKING:
    from collections.abc import Callable

    from log2sim.datatypes import Log, Scenario
    from log2sim.road.ground_map import GroundMap
    from log2sim.simulation.result import Replay
    from log2sim.visualization.recording import Recorded

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


def open_recorded(
    path: Path,
    scenario: Scenario,
    sequence: str | None,
    max_bytes: int,
    cameras: tuple[str, ...],
    progress: Callable[[str, int, int], None],
) -> Recorded:
    """Open the log whose pictures and points are shown, with the poses that the scenario was made with."""
    from log2sim.localization.choice import localize_like
    from log2sim.logs.opening import open_log
    from log2sim.visualization.recording import Recorded, require_overlap

    log = localize_like(open_log(path, sequence=sequence), scenario.provenance)
    require_overlap(log, scenario)
    return Recorded(log, max_bytes, cameras, progress)


def shows_ground(log: Log) -> bool:
    """Whether a log has a camera whose place is known, so that its ground can be mapped."""
    return any(camera.mount == "map" or log.ego is not None for camera in log.cameras.values())


def load_placed_truth(path: Path, scenario: Scenario, sequence: str | None) -> Scenario:
    """Return the truth of a scenario, in its map."""
    from log2sim.evaluation.metrics.evaluator import place_truth
    from log2sim.evaluation.metrics.truth import load_truth

    return place_truth(load_truth(path, scenario, sequence=sequence), scenario)[0]


def load_replay(path: Path, scenario: Scenario, *, quiet: bool = False) -> Replay:
    """Load a replay to show with a scenario; warn when it belongs to another scenario."""
    from log2sim.datatypes import EGO
    from log2sim.simulation.result import Replay as Replayed

    loaded = Replayed.load(path)
    known = {a.id for a in scenario.agents}
    others = [a.id for a in loaded.agents if a.id != EGO]
    unknown = [id for id in others if id not in known]
    if loaded.scenario != scenario.name:
        opt.say(
            f"warning: {path} replays '{loaded.scenario}', not '{scenario.name}'; the two may not match", quiet=quiet
        )
    elif unknown:
        count = f"{len(unknown)} of its {opt.counted(len(others), 'agent')} {'is' if len(unknown) == 1 else 'are'}"
        opt.say(f"warning: {path} replays another version of '{scenario.name}': {count} not in it", quiet=quiet)
    return loaded
