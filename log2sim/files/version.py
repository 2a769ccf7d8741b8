"""The version of the package, which a build takes from the tag and writes into `version.txt`."""

from __future__ import annotations

from pathlib import Path

FALLBACK = "0.1.dev0"
"""Of a checkout that was never installed; `fallback_version` of pyproject.toml is the same."""


def read_version(file: Path) -> str:
    """Return what a build wrote into a file, or `FALLBACK` without it."""
    try:
        return file.read_text(encoding="ascii").strip() or FALLBACK
    except (OSError, ValueError):
        return FALLBACK


__version__ = read_version(Path(__file__).parents[1] / "version.txt")
