"""Rows of figures that are kept in a file, so that a long run can be cut off and go on, and ways be added."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


class Rows:
    """What was measured, by test, seed, way and settings; with a file also across runs.

    Parameters
    ----------
    path : Path or None
        JSON lines; rows of older code are not told apart, so begin a new file after a change.
    """

    def __init__(self, path: Path | None) -> None:
        self._path, self._rows = path, {}
        if path is not None and path.is_file():
            for line in path.read_text().splitlines():
                key, row = json.loads(line)
                self._rows[tuple(key)] = row

    def __contains__(self, key: tuple[Any, ...]) -> bool:
        """Return whether a row is there."""
        return key in self._rows

    def __getitem__(self, key: tuple[Any, ...]) -> Any:
        """Return a row."""
        return self._rows[key]

    def __setitem__(self, key: tuple[Any, ...], row: Any) -> None:
        """Keep a row."""
        self._rows[key] = row
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(json.dumps([key, row]) + "\n")
