"""What a log reader offers."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from log2sim.datatypes import Log


class Reader(Protocol):
    """A log format. `name` is what --format takes, `looks_for` tells a user what a folder of it must hold.

    `matches` and `sequences` only look at names of files; they open none and never raise on a foreign folder.
    """

    @property
    def name(self) -> str: ...

    @property
    def looks_for(self) -> str: ...

    def matches(self, path: Path) -> bool:
        """Whether the folder is a sequence of this format or a root of such sequences."""

    def sequences(self, path: Path) -> list[str]:
        """Names of the sequences at `path`, sorted; one when it is itself a sequence."""

    def open(self, path: Path, sequence: str) -> Log:
        """Open the sequence of that name."""
