"""log2sim: driving logs of cameras, LiDAR and GNSS/IMU in, scenarios that a simulator can run out."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from log2sim.config import Config
    from log2sim.errors import Log2SimError
    from log2sim.logs import open_log
    from log2sim.pipeline import reconstruct
    from log2sim.replay import replay
    from log2sim.scenario import Scenario

__all__ = ["Config", "Log2SimError", "Scenario", "__version__", "open_log", "reconstruct", "replay"]

_HOME = {
    "Config": "log2sim.config",
    "Log2SimError": "log2sim.errors",
    "Scenario": "log2sim.scenario",
    "open_log": "log2sim.logs",
    "reconstruct": "log2sim.pipeline",
    "replay": "log2sim.replay",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that `import log2sim` stays fast."""
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'log2sim' has no attribute '{name}'")
