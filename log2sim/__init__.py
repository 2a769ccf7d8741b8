"""Reconstruct driving logs (cameras, LiDAR, GNSS/IMU) as scenarios that a simulator can run."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from log2sim.version import __version__

if TYPE_CHECKING:
    from log2sim.config import Config
    from log2sim.datatypes.scenario import Scenario
    from log2sim.errors import Log2SimError
    from log2sim.evaluation.metrics.evaluator import evaluate
    from log2sim.logs.opening import open_log
    from log2sim.pipeline import reconstruct
    from log2sim.simulation.runner import replay
    from log2sim.visualization.plot.axes import plot

__all__ = ["Config", "Log2SimError", "Scenario", "__version__", "evaluate", "open_log", "plot", "reconstruct", "replay"]

_MODULE_OF = {
    "Config": "log2sim.config",
    "Log2SimError": "log2sim.errors",
    "Scenario": "log2sim.datatypes.scenario",
    "evaluate": "log2sim.evaluation.metrics.evaluator",
    "open_log": "log2sim.logs.opening",
    "plot": "log2sim.visualization.plot.axes",
    "reconstruct": "log2sim.pipeline",
    "replay": "log2sim.simulation.runner",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that `import log2sim` stays fast."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'log2sim' has no attribute '{name}'")
    value = getattr(importlib.import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*globals(), *__all__})
