"""Functions of higher rooms that methods of lower ones call: by name, imported when they are called.

A room imports only rooms of lower rank. `log.show()` draws all the same: the type names the function here, as `registry`
names plug-ins, and stays importable without all that drawing needs.
"""

from __future__ import annotations

import importlib
from typing import Any

FUNCTIONS = {
    "find_logs": "log2sim.batch.discovery:find_logs",
    "html_of": "log2sim.visualization.notebook.html:html_of",
    "show_log": "log2sim.visualization.notebook.show:show_log",
    "truth_of": "log2sim.evaluation.metrics.truth:truth_from_log",
    "ticks_of": "log2sim.perception.ticks:ticks_of",
}


def call(name: str, *arguments: Any, **options: Any) -> Any:
    """Call the function that `FUNCTIONS` names."""
    module, _, attribute = FUNCTIONS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)(*arguments, **options)


def html_or_none(value: Any) -> str | None:
    """Return what a notebook shows of a log, a scenario or a replay; None where that fails, so that it shows the `repr`."""
    try:
        return str(call("html_of", value))
    except Exception:  # whatever fails while something is shown must not hide the value itself
        return None
