"""What a plug-in of each kind must be; that of another package is checked before it is used."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from log2sim.errors import PluginError


@dataclass(frozen=True)
class Call:
    """A call that log2sim makes.

    Attributes
    ----------
    shown : str
        As it is declared, for messages.
    positional : int
        Number of positional arguments.
    keywords : tuple of str
    """

    shown: str
    positional: int
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
POLICY = Call("policy(observation)", 1)


def find_defect(kind: str, found: Any) -> str | None:
    """Return why an object is no plug-in of a kind; None where nothing is wrong."""
    if kind in FUNCTIONS:
        return find_call_defect(found, FUNCTIONS[kind])
    members = OBJECTS.get(kind)
    if members is None:
        return None
    if isinstance(found, type):
        return f"is the class {found.__name__}, expected an object of it: name an instance, such as {found.__name__}()"
    missing = [name for name in members if not hasattr(found, name)]
    if missing:
        return f"has no {', '.join(repr(name) for name in missing)}; expected an object with {', '.join(members)}"
    defects = (find_call_defect(getattr(found, name), call) for name, call in members.items() if call is not None)
    return next((defect for defect in defects if defect is not None), None)


def require_members(found: Any, members: tuple[str, ...], call: Call, source: str) -> None:
    """Require that an object has its members and that its method `detect` can be called.

    Raises
    ------
    PluginError
        In one line that begins with `source`.
    """
    defect = _find_member_defect(found, members, call)
    if defect is not None:
        raise PluginError(f"{source}: {defect}")


def _find_member_defect(found: Any, members: tuple[str, ...], call: Call) -> str | None:
    """Return which of its members an object lacks, or why its method `detect` cannot be called; None where nothing is wrong."""
    missing = [name for name in members if not hasattr(found, name)]
    if missing:
        lacking = ", ".join(repr(name) for name in missing)
        return f"is a {type(found).__name__} without {lacking}; expected an object with {', '.join(members)}"
    return find_call_defect(found.detect, call)


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
