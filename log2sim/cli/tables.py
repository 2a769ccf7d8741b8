"""Rows of text in columns, and lines that fit a terminal."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Sequence

MIN_COLUMNS = 40
"""Narrower terminals are treated as this wide: a word a line reads no better."""


def format_rows(rows: Sequence[Sequence[str]], indent: int = 0) -> list[str]:
    """Format rows in columns, each as wide as its longest entry; the last column goes on below itself on a narrow terminal."""
    if not rows:
        return []
    count = max(len(row) for row in rows)
    widths = [max(len(row[k]) if k < len(row) else 0 for row in rows) for k in range(count - 1)]
    lines = []
    for row in rows:
        start = " " * indent + "".join(f"{cell:<{width}}  " for cell, width in zip(row, widths))
        last = row[count - 1] if len(row) == count else ""
        lines += wrap(start + last, indent=len(start))
    return lines


def wrap(line: str, indent: int = 2) -> list[str]:
    """Break a line at the width of the terminal, the rest indented; elsewhere, in a pipe or a file, lines stay whole."""
    width = terminal_width()
    if width is None or len(line) <= width:
        return [line.rstrip()]
    room = " " * min(indent, width // 2)
    return textwrap.wrap(
        line, width, subsequent_indent=room, break_long_words=False, break_on_hyphens=False, drop_whitespace=True
    )


def terminal_width() -> int | None:
    """Return the width of the terminal that output goes to, characters; None where it goes elsewhere."""
    if not sys.stdout.isatty():
        return None
    return max(shutil.get_terminal_size().columns, MIN_COLUMNS)
