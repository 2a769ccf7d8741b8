"""Plug-ins by name, imported when they are used: built-in ones and those of other packages (entry points)."""

from __future__ import annotations

import difflib
import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from log2sim.errors import ConfigError, Log2SimError, PluginError
from log2sim.plugin_checks import find_defect

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint, EntryPoints

BUILT_IN: dict[str, dict[str, str]] = {
    "log": {
        # Before "log2sim": a folder of nuScenes tables has a log.json as well.
        "nuscenes": "log2sim.logs.nuscenes.reader:READER",
        "log2sim": "log2sim.logs.native.reader:READER",
        "kitti": "log2sim.logs.kitti.raw:READER",
        "kitti-tracking": "log2sim.logs.kitti.tracking:READER",
        "kitti-object": "log2sim.logs.kitti.object:READER",
        "pandaset": "log2sim.logs.pandaset.reader:READER",
        "waymo": "log2sim.logs.waymo.reader:READER",
        "waymo-parquet": "log2sim.logs.waymo.parquet_reader:READER",
        "argoverse2": "log2sim.logs.argoverse.reader:READER",
        "ros": "log2sim.logs.ros.reader:READER",
    },
    "detector": {
        "ssd-mobilenet-v2": "log2sim.perception.detect.ssd_mobilenet:create",
        "labels": "log2sim.perception.detect.labels:create",
    },
    "lidar_detector": {
        "vehicle": "log2sim.perception.detect3d.network_detector:create_vehicle",
        "roadside": "log2sim.perception.detect3d.network_detector:create_roadside",
        "labels": "log2sim.perception.detect3d.labels:create",
    },
    "export": {
        "openscenario": "log2sim.export.openscenario.write:EXPORTER",
        "carla": "log2sim.export.carla:EXPORTER",
        "csv": "log2sim.export.csv_table:EXPORTER",
        "scenarionet": "log2sim.export.scenarionet:EXPORTER",
        "commonroad": "log2sim.export.commonroad:EXPORTER",
        "osi": "log2sim.export.osi:EXPORTER",
        "mcap": "log2sim.export.viewers.mcap:EXPORTER",
        "rerun": "log2sim.export.viewers.rerun:EXPORTER",
    },
    "policy": {},
    "vehicle_model": {
        "kinematic": "log2sim.simulation.vehicles.vehicle:step_bicycle",
        "dynamic": "log2sim.simulation.vehicles.dynamic:step_dynamic",
        "single-track": "log2sim.simulation.vehicles.single_track:step_single_track",
    },
}
"""Plug-ins of log2sim itself by kind and name; other packages declare theirs as entry points of the group "log2sim.KIND"."""


KIND_LABELS = {
    "log": "log format",
    "lidar_detector": "LiDAR detector",
    "export": "export format",
    "vehicle_model": "vehicle model",
}


def names(kind: str) -> list[str]:
    """List the plug-ins of a kind, one of those of `BUILT_IN`: the built-in ones first, then those of other packages."""
    return list(BUILT_IN[kind]) + sorted({e.name for e in installed(kind)} - set(BUILT_IN[kind]))


def installed(kind: str) -> EntryPoints:
    """Return the plug-ins of a kind that other packages declare; nothing of them is imported."""
    from importlib.metadata import entry_points  # imported here: it takes as long as the rest of `log2sim --help`

    return entry_points(group=f"log2sim.{kind}")


def load(kind: str, name: str) -> Any:
    """Import the plug-in `name` of a kind.

    Raises
    ------
    ConfigError
        When no plug-in has that name; the message lists the known ones and the nearest.
    PluginError
        When one of another package cannot be imported, or is not what the kind asks for; the message names the package.
    """
    if name in BUILT_IN[kind]:
        module, _, attribute = BUILT_IN[kind][name].partition(":")
        return getattr(importlib.import_module(module), attribute)
    entries = [entry for entry in installed(kind) if entry.name == name]
    if not entries:
        known = ", ".join(names(kind)) or "none"
        raise ConfigError(f"unknown {_label(kind)} '{name}'{nearest(name, names(kind))}; known: {known}")
    if len({entry.value for entry in entries}) > 1:
        packages = " and ".join(sorted(package_of(entry) for entry in entries))
        raise PluginError(f"{_label(kind)} '{name}': is declared by {packages}; uninstall one of them")
    with blaming(kind, name):
        found = entries[0].load()
    defect = find_defect(kind, found)
    if defect is not None:
        raise PluginError(f"{say_plugin(kind, name)}: {defect}")
    return found


def is_built_in(kind: str, name: str) -> bool:
    """Return whether log2sim itself has a plug-in of that name."""
    return name in BUILT_IN[kind]


def say_plugin(kind: str, name: str) -> str:
    """Name a plug-in for messages: its kind, its name and, of another package, that package and the place in it."""
    places = [f" of {package_of(e)} ({e.value})" for e in installed(kind) if e.name == name]
    return f"{_label(kind)} '{name}'{places[0] if places and not is_built_in(kind, name) else ''}"


@contextmanager
def blaming(kind: str, name: str) -> Iterator[None]:
    """Turn what a plug-in of another package raises within the block into a `PluginError` of one line that names it.

    Errors of log2sim pass: plug-ins raise them on purpose. Of built-in plug-ins everything passes.
    """
    try:
        yield
    except (Log2SimError, MemoryError):
        raise
    except Exception as error:
        if is_built_in(kind, name):
            raise
        raise PluginError(f"{say_plugin(kind, name)}: {say_exception(error)}") from error


def require_type(kind: str, name: str, value: Any, expected: type) -> None:
    """Raise `PluginError` when a plug-in returned something of another type."""
    if not isinstance(value, expected):
        raise PluginError(f"{say_plugin(kind, name)}: returned {type(value).__name__}, expected {expected.__name__}")


def say_exception(error: Exception) -> str:
    """Say in one line what was raised, and in which line of which file."""
    trace, place = error.__traceback__, ""
    while trace is not None:
        code = trace.tb_frame.f_code
        place = f" (line {trace.tb_lineno} of {os.path.basename(code.co_filename)})"
        trace = trace.tb_next
    first = next(iter(str(error).strip().splitlines()), "")
    return f"raised {type(error).__name__}{': ' * bool(first)}{first}{place}"


def package_of(entry: EntryPoint) -> str:
    """Name the package of an entry point with its version."""
    if entry.dist is None:
        return "an unknown package"
    return f"package '{entry.dist.name} {entry.dist.version}'"


def nearest(word: str, known: list[str]) -> str:
    """Return a hint " (did you mean '...'?)", or "" when no known word is similar."""
    close = difflib.get_close_matches(word, known, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def _label(kind: str) -> str:
    return KIND_LABELS.get(kind, kind)
