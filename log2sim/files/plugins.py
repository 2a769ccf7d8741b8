"""Plug-ins by name, imported when they are used, and what one of each kind must be; functions of higher rooms by name.

A room imports only rooms of lower rank. `log.show()` draws all the same: the type names the function here, as plug-ins are
named, and stays importable without all that drawing needs.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import os
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from log2sim.errors import ConfigError, Log2SimError, PluginError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint, EntryPoints


@dataclass(frozen=True)
class Call:
    """A call that log2sim makes."""

    shown: str  # as it is declared, for messages
    positional: int  # number of positional arguments
    keywords: tuple[str, ...] = ()


OBJECTS: dict[str, dict[str, Call | None]] = {
    "log": {
        "name": None,
        "looks_for": None,
        "suffixes": None,
        "matches": Call("matches(path)", 1),
        "sequences": Call("sequences(path)", 1),
        "open": Call("open(path, sequence)", 2),
    },
    "export": {"options": None, "loses": None, "write": Call("write(scenario, folder, options)", 3)},
}
"""Members of plug-ins that are objects; methods with how they are called."""

FUNCTIONS = {
    "detector": Call("create(log, *, min_score, max_overlap, tiles)", 1, ("min_score", "max_overlap", "tiles")),
    "lidar_detector": Call("create(log, settings)", 2),
    "vehicle_model": Call("step(state, controls, parameters, dt_s)", 4),
}
"""Plug-ins that are called themselves. A policy may be a class, which is made first, so it is checked where it is loaded."""

DETECT = Call("detect(frame)", 1)
DETECT_IN_CLOUD = Call("detect(cloud, earlier)", 2)


def find_defect(kind: str, found: Any) -> str | None:
    """Return why an object is no plug-in of a kind; None where nothing is wrong."""
    if kind in FUNCTIONS:
        return find_call_defect(found, FUNCTIONS[kind])
    members = OBJECTS.get(kind, {})
    if members and isinstance(found, type):
        return f"is the class {found.__name__}, expected an object of it: name an instance, such as {found.__name__}()"
    missing = [name for name in members if not hasattr(found, name)]
    if missing:
        return f"has no {', '.join(map(repr, missing))}; expected an object with {', '.join(members)}"
    defects = (find_call_defect(getattr(found, name), call) for name, call in members.items() if call is not None)
    return next((defect for defect in defects if defect is not None), None)


def require_members(found: Any, members: tuple[str, ...], call: Call, source: str) -> None:
    """Require that an object has its members and that its method `detect` can be called; `PluginError` begins with `source`."""
    missing = [name for name in members if not hasattr(found, name)]
    if missing:
        lacking = f"without {', '.join(map(repr, missing))}; expected an object with {', '.join(members)}"
        raise PluginError(f"{source}: is a {type(found).__name__} {lacking}")
    defect = find_call_defect(found.detect, call)
    if defect is not None:
        raise PluginError(f"{source}: {defect}")


def find_call_defect(function: Callable[..., Any], call: Call) -> str | None:
    """Return why something cannot be called in a way; None where it can, or where it does not tell its signature."""
    if not callable(function):
        return f"is a {type(function).__name__}, expected {call.shown}"
    try:
        signature = inspect.signature(function)
    except (ValueError, TypeError):  # of some functions that are not written in Python
        return None
    try:
        signature.bind(*range(call.positional), **dict.fromkeys(call.keywords))
    except TypeError as error:
        name = getattr(function, "__name__", type(function).__name__)
        return f"{name}{signature} cannot be called as {call.shown}: {error}"
    return None


BUILT_IN: dict[str, dict[str, str]] = {
    "log": {
        # Before "log2sim": a folder of nuScenes tables has a log.json as well.
        "nuscenes": "log2sim.logs.nuscenes.reader:READER",
        "log2sim": "log2sim.logs.native.reader:READER",
        "kitti": "log2sim.logs.kitti.drives:READER",
        "kitti-tracking": "log2sim.logs.kitti.drives:TRACKING_READER",
        "kitti-object": "log2sim.logs.kitti.drives:OBJECT_READER",
        "pandaset": "log2sim.logs.pandaset.reader:READER",
        "waymo": "log2sim.logs.waymo.reader:READER",
        "waymo-parquet": "log2sim.logs.waymo.parquet_reader:READER",
        "argoverse2": "log2sim.logs.argoverse:READER",
        "ros": "log2sim.logs.ros.reader:READER",
    },
    "detector": {
        "ssd-mobilenet-v2": "log2sim.perception.detect.ssd_mobilenet:create",
        "labels": "log2sim.perception.detect.detectors:create",
    },
    "lidar_detector": {
        "vehicle": "log2sim.perception.detect3d.detectors:create_vehicle",
        "roadside": "log2sim.perception.detect3d.detectors:create_roadside",
        "labels": "log2sim.perception.detect3d.detectors:create",
    },
    "export": {
        "openscenario": "log2sim.export.openscenario.write",
        "carla": "log2sim.export.carla",
        "csv": "log2sim.export.csv_table",
        "scenarionet": "log2sim.export.scenarionet",
        "commonroad": "log2sim.export.commonroad",
        "lanelet2": "log2sim.export.lanelet2",
        "openlabel": "log2sim.export.openlabel",
        "osi": "log2sim.export.osi",
        "mcap": "log2sim.export.mcap",
        "rerun": "log2sim.export.rerun",
    },
    "policy": {},
    "vehicle_model": {
        "kinematic": "log2sim.simulation.vehicles.vehicle:step_bicycle",
        "dynamic": "log2sim.simulation.vehicles.single_track:step_dynamic",
        "single-track": "log2sim.simulation.vehicles.single_track:step_single_track",
    },
}
"""Plug-ins of log2sim itself by kind and name; other packages declare theirs as entry points of the group "log2sim.KIND"."""


KIND_LABELS = {
    "log": "log format", "lidar_detector": "LiDAR detector", "export": "export format", "vehicle_model": "vehicle model",
}  # fmt: skip


def names(kind: str) -> list[str]:
    """List the plug-ins of a kind, one of those of `BUILT_IN`: the built-in ones first, then those of other packages."""
    return list(BUILT_IN[kind]) + sorted({e.name for e in installed(kind)} - set(BUILT_IN[kind]))


def installed(kind: str) -> EntryPoints:
    """Return the plug-ins of a kind that other packages declare; nothing of them is imported."""
    from importlib.metadata import entry_points  # imported here: it takes as long as the rest of `log2sim --help`

    return entry_points(group=f"log2sim.{kind}")


def load(kind: str, name: str) -> Any:
    """Import the plug-in `name` of a kind.

    Raises `ConfigError` that lists the known ones when none has that name; `PluginError` that names the package when one of another
    package cannot be imported, or is not what the kind asks for.
    """
    if name in BUILT_IN[kind]:
        return _import(BUILT_IN[kind][name])
    label, entries = KIND_LABELS.get(kind, kind), [entry for entry in installed(kind) if entry.name == name]
    if not entries:
        known = ", ".join(names(kind)) or "none"
        raise ConfigError(f"unknown {label} '{name}'{nearest(name, names(kind))}; known: {known}")
    if len({entry.value for entry in entries}) > 1:
        packages = " and ".join(sorted(package_of(entry) for entry in entries))
        raise PluginError(f"{label} '{name}': is declared by {packages}; uninstall one of them")
    with blaming(kind, name):
        found = entries[0].load()
    defect = find_defect(kind, found)
    if defect is not None:
        raise PluginError(f"{plugin_label(kind, name)}: {defect}")
    return found


def _import(place: str) -> Any:
    name, _, attribute = place.partition(":")
    module = importlib.import_module(name)
    return getattr(module, attribute) if attribute else module


def is_built_in(kind: str, name: str) -> bool:
    """Return whether log2sim itself has a plug-in of that name."""
    return name in BUILT_IN[kind]


def plugin_label(kind: str, name: str) -> str:
    """Name a plug-in for messages: its kind, its name and, of another package, that package and the place in it."""
    places = [f" of {package_of(e)} ({e.value})" for e in installed(kind) if e.name == name]
    return f"{KIND_LABELS.get(kind, kind)} '{name}'{places[0] if places and not is_built_in(kind, name) else ''}"


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
        raise PluginError(f"{plugin_label(kind, name)}: {exception_line(error)}") from error


def require_type(kind: str, name: str, value: Any, expected: type) -> None:
    """Raise `PluginError` when a plug-in returned something of another type."""
    if not isinstance(value, expected):
        raise PluginError(f"{plugin_label(kind, name)}: returned {type(value).__name__}, expected {expected.__name__}")


def exception_line(error: Exception) -> str:
    """Say in one line what was raised, and in which line of which file."""
    last = traceback.extract_tb(error.__traceback__, limit=-1)
    place = "".join(f" (line {frame.lineno} of {os.path.basename(frame.filename)})" for frame in last)
    first = next(iter(str(error).strip().splitlines()), "")
    return f"raised {type(error).__name__}{': ' * bool(first)}{first}{place}"


def package_of(entry: EntryPoint) -> str:
    """Name the package of an entry point with its version."""
    return "an unknown package" if entry.dist is None else f"package '{entry.dist.name} {entry.dist.version}'"


def nearest(word: str, known: list[str]) -> str:
    """Return a hint " (did you mean '...'?)", or "" when no known word is similar."""
    close = difflib.get_close_matches(word, known, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


LATE_FUNCTIONS = {
    "find_logs": "log2sim.batch.discovery:find_logs",
    "html_of": "log2sim.visualization.notebook:notebook_html",
    "show_log": "log2sim.visualization.notebook:show_log",
    "truth_of": "log2sim.evaluation.metrics.truth:truth_from_log",
    "ticks_of": "log2sim.perception.sync:ticks_of",
}


def call(name: str, *arguments: Any, **options: Any) -> Any:
    """Call one of `LATE_FUNCTIONS`."""
    return _import(LATE_FUNCTIONS[name])(*arguments, **options)


def html_or_none(value: Any) -> str | None:
    """Return what a notebook shows of a log, a scenario or a replay; None where that fails, so that it shows the `repr`."""
    try:
        return str(call("html_of", value))
    except Exception:  # whatever fails while something is shown must not hide the value itself
        return None
