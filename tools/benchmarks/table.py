"""Tables of benchmarks: times, Markdown, and sections of a file between markers."""

from __future__ import annotations

import importlib
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Any

PEERS = ("numpy", "scipy", "opencv-contrib-python-headless", "scikit-image", "poselib", "pycolmap", "filterpy", "numba")


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


def cell(value: float | None, digits: int = 2, unit: str = "") -> str:
    """A figure, '-' without one."""
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def replace_section(path: Path, name: str, text: str) -> None:
    """Put a section between its markers in a file."""
    begin, end = f"<!-- bench {name} -->", f"<!-- end {name} -->"
    old = path.read_text(encoding="utf-8")
    path.write_text(old[: old.index(begin)] + f"{begin}\n{text}\n" + old[old.index(end) :], encoding="utf-8")


def print_section(name: str, tables: Callable[[], str], write: Path | None) -> None:
    """Print tables with the versions of what was compared; put them into a file, too."""
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        print("OPENBLAS_NUM_THREADS is not 1: times will swing", file=sys.stderr)
    command = f"OPENBLAS_NUM_THREADS=1 python tools/bench.py {name} --write BENCHMARKS.md"
    body = tables()
    versions = ", ".join(f"{peer} {_version(peer)}" for peer in PEERS)
    text = f"## {name.capitalize()}\n\n`{command}`\n\n{body}\n\nPython {platform.python_version()}, {versions}."
    print(text)
    if write:
        replace_section(write, name, text)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
