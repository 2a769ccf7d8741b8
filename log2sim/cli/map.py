"""Make a map of the ground of a log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from log2sim.cli import options as opt

if TYPE_CHECKING:
    from log2sim.datatypes import Log, Scenario


def map(
    log: opt.LogPath,
    out: Annotated[Path, opt.write_to("FILE", "Map to write: .tif (GeoTIFF), .png or .jpg (with a world file).")],
    scenario: Annotated[
        Path | None, opt.option("Scenario of the log; its agents are left out of the map.", "SCENARIO")
    ] = None,
    layer: Annotated[
        str, opt.choose("--layer", "color|intensity|height", "What is written; intensity is that of the LiDAR.")
    ] = "color",
    cell: Annotated[float, opt.option("Edge of a cell, in m.", "M")] = 0.05,
    format: opt.Format = "auto",
    sequence: opt.SequenceName = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:
    """Make a map of the ground of a log: its color, its height, or how strongly it reflects the LiDAR.

    Examples
    --------
    log2sim map samples/crossing --scenario s.json -o ground.tif
    log2sim map samples/crossing --layer intensity -o ground.png
    """
    from typing import cast

    from log2sim.cli.progress import progress
    from log2sim.config import Config
    from log2sim.errors import ConfigError
    from log2sim.files.documents import check_targets
    from log2sim.files.outputs import together
    from log2sim.logs.opening import open_log
    from log2sim.perception.records import RecordSource
    from log2sim.road.builder import map_ground
    from log2sim.road.map_files import (
        HEIGHT_STEP_M,
        LAYERS,
        Layer,
        check_name,
        geokeys_of,
        known_cells,
        lowest_m,
        world_file_of,
        write_map,
        write_world_file,
    )

    check_name(out)
    world = world_file_of(out)
    check_targets(out, world, overwrite=overwrite)
    if layer not in LAYERS:
        raise ConfigError(f"--layer: '{layer}' is none of {', '.join(LAYERS)}")
    chosen, settings = cast(Layer, layer), Config.load(map={"cell_m": cell}).map
    opened = open_log(log, format=format, sequence=sequence)
    if chosen == "color" and not opened.cameras:
        raise ConfigError(f"{opened.name}: the log has no camera; take --layer intensity or --layer height")
    if chosen != "color" and not opened.lidars:
        raise ConfigError(f"{opened.name}: the log has no LiDAR; take --layer color")
    opened, loaded, note = _agents_of(opened, scenario)
    opt.say_all("note", (*opened.notes, *((note,) if note else ())), quiet=quiet)
    records = RecordSource(opened)
    with progress(quiet=quiet) as report_progress:
        whole = map_ground(opened, loaded, settings, records, report_progress)
    ground = whole.around(known_cells(whole, chosen))
    with together():
        write_map(ground, out, chosen, opened.map, overwrite=overwrite)
        if world is not None:
            write_world_file(ground, world, opened.map, overwrite=overwrite)
    notes = [
        *ground.notes,
        *(f"{name}: {u['count']} records could not be read" for name, u in records.summary().items()),
    ]
    problem = geokeys_of(opened.map).problem
    notes += [f"no place on Earth: {problem}"] if problem else []
    if chosen == "height" and out.suffix.lower() == ".png":
        notes.append(
            f"heights in {out.name}: value 1 is {lowest_m(ground):.2f} m, {HEIGHT_STEP_M:g} m a step, 0 is unknown"
        )
    opt.say_all("note", notes, quiet=quiet)
    rows, columns = ground.alpha.shape
    d = ground.resolution_m
    opt.report_written(world, quiet=quiet)
    opt.say(f"{out}: {columns * d:.0f} x {rows * d:.0f} m in cells of {d:g} m", quiet=quiet)


def _agents_of(log: Log, scenario: Path | None) -> tuple[Log, Scenario, str | None]:
    """Return the log as the scenario places it, the agents to leave out, and what is to be said of them."""
    from log2sim.datatypes import Scenario
    from log2sim.localization.choice import localize_like

    if scenario is not None:
        loaded = Scenario.load(scenario)
        return localize_like(log, loaded.provenance), loaded, None
    if log.labels is not None:
        from log2sim.evaluation.metrics.truth import truth_from_log

        return log, truth_from_log(log), "without --scenario only agents with labels are left out of the map"
    from log2sim.geometry import NS_PER_S

    stamps = [stream.t_ns for stream in log.streams.values() if len(stream.t_ns)]
    first = min((int(t[0]) for t in stamps), default=0)
    last = max((int(t[-1]) for t in stamps), default=0)
    whole = Scenario(log.name, first, (last - first) / NS_PER_S, (), log.map)
    return log, whole, "no agent is left out of the map: the log has no labels; pass --scenario to leave out its agents"
