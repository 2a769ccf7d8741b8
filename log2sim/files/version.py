"""The version of the package, which a build takes from the tag and writes into `version.txt`."""

from __future__ import annotations

from pathlib import Path

FALLBACK = "0.1.dev0"
"""Of a checkout that was never installed; `fallback_version` of pyproject.toml is the same."""

try:
    __version__ = (Path(__file__).parents[1] / "version.txt").read_text(encoding="ascii").strip() or FALLBACK
except (OSError, ValueError):
    __version__ = FALLBACK
