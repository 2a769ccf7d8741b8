"""Placeholder until the reader stands."""

from __future__ import annotations

from pathlib import Path

from log2sim.errors import LogError
from log2sim.types import Log


class _Reader:
    name = "pandaset"
    looks_for = "not readable yet"

    def matches(self, path: Path) -> bool:
        return False

    def sequences(self, path: Path) -> list[str]:
        return []

    def open(self, path: Path, sequence: str) -> Log:
        raise LogError(f"{path}: this format is not readable yet")


READER = _Reader()
