"""Plug-ins by name, imported when they are used: built-in ones and those of other packages (entry points)."""

from __future__ import annotations

import difflib
import importlib
from typing import TYPE_CHECKING, Any

from log2sim.errors import ConfigError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoints

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
}


KIND_LABELS = {"log": "log format", "lidar_detector": "LiDAR detector", "export": "export format"}


def names(kind: str) -> list[str]:
    """List the plug-ins of a kind ("log", "detector", "lidar_detector", "export"), built-in ones first."""
    return list(BUILT_IN[kind]) + sorted(e.name for e in installed(kind))


def installed(kind: str) -> EntryPoints:
    """Return the plug-ins of a kind that other packages declare."""
    from importlib.metadata import entry_points  # imported here: it takes as long as the rest of `log2sim --help`

    return entry_points(group=f"log2sim.{kind}")


def load(kind: str, name: str) -> Any:
    """Import the plug-in `name` of a kind.

    Raises
    ------
    ConfigError
        When no plug-in has that name; the message lists the known ones and the nearest.
    """
    if name in BUILT_IN[kind]:
        module, _, attribute = BUILT_IN[kind][name].partition(":")
        return getattr(importlib.import_module(module), attribute)
    for entry in installed(kind):
        if entry.name == name:
            return entry.load()
    raise ConfigError(
        f"unknown {KIND_LABELS.get(kind, kind)} '{name}'{nearest(name, names(kind))}; known: {', '.join(names(kind))}"
    )


def nearest(word: str, known: list[str]) -> str:
    """Return a hint " (did you mean '...'?)", or "" when no known word is similar."""
    close = difflib.get_close_matches(word, known, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""
