"""Tables of benchmarks: times, Markdown, and sections of a file between markers."""

from __future__ import annotations

import importlib
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

HEAD = """# Benchmarks

log2sim's single estimators beside what a user would otherwise take. Each table comes from one process on one machine, so
its ratios mean more than its times; times are those of the processor, one thread. `tools/bench.py` writes the parts
between the markers; what was measured, on which worlds, is told above each table.
"""


def optional(name: str) -> ModuleType | None:
    """A peer's module, None where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def timed(call: Callable[[], Any], repeats: int) -> tuple[Any, float]:
    """What a call returns and the median of its seconds of processor time, which other programs hardly disturb."""
    seconds, out = [], None
    for _ in range(repeats):
        begin = time.process_time()
        out = call()
        seconds.append(time.process_time() - begin)
    return out, statistics.median(seconds)


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def replace_section(path: Path, name: str, text: str) -> None:
    """Put a section between its markers in a file; at the end where the file has none."""
    begin, end = f"<!-- bench {name} -->", f"<!-- end {name} -->"
    old = path.read_text(encoding="utf-8") if path.exists() else HEAD
    block = f"{begin}\n{text}\n{end}"
    if begin in old and end in old:
        new = old[: old.index(begin)] + block + old[old.index(end) + len(end) :]
    else:
        new = f"{old.rstrip()}\n\n{block}\n"
    path.write_text(new, encoding="utf-8")
