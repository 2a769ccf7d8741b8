"""The folder of the user in which log2sim keeps what it can make again: converted models, detections."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from log2sim.errors import ConfigError

VARIABLE = "LOG2SIM_CACHE"
"""Environment variable that names another folder."""


def cache_folder() -> Path:
    r"""Return the user's cache folder of log2sim; it need not exist.

    `LOG2SIM_CACHE` where it is set, else `log2sim` in `XDG_CACHE_HOME` where that is an absolute path, else the place that the
    system has for such files: `~/.cache/log2sim`, on macOS `~/Library/Caches/log2sim`, on Windows
    `%LOCALAPPDATA%\log2sim\Cache`.

    Raises
    ------
    ConfigError
        When the user has no home folder.
    """
    chosen, home = os.environ.get(VARIABLE, ""), os.environ.get("XDG_CACHE_HOME", "")
    if chosen:
        return Path(chosen).absolute()
    if Path(home).is_absolute():
        return Path(home) / "log2sim"
    local = os.environ.get("LOCALAPPDATA", "")
    if sys.platform == "win32" and local:
        return Path(local) / "log2sim" / "Cache"
    try:
        user = Path.home()
    except RuntimeError:
        raise ConfigError(f"the user has no home folder to cache anything in; name a folder in {VARIABLE}") from None
    return user / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "log2sim"


def detection_folder() -> Path:
    """Return the folder of detections in the user's cache, which need not exist."""
    return cache_folder() / "detections"
