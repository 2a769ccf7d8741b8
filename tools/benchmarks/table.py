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

from entry import parser_of

PEERS = ("numpy", "scipy", "opencv-contrib-python-headless", "scikit-image", "poselib", "pycolmap", "filterpy", "numba")
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


def cell(value: float | None, digits: int = 2, unit: str = "") -> str:
    """A figure, '-' without one."""
    return "-" if value is None else f"{value:.{digits}f}{unit}"


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


def print_section(name: str, sections: Callable[..., tuple[str, str]], arguments: list[str] | None) -> None:
    """Print what `sections(quick=...)` returns, a title and tables, with the versions of what was compared; `--write` puts it into a file."""
    parser = parser_of(sys.modules[sections.__module__].__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repeats, to see that everything runs")
    parser.add_argument(
        "--write", type=Path, metavar="FILE.md", help="put the tables between their markers in this file"
    )
    options = parser.parse_args(arguments)
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        print("OPENBLAS_NUM_THREADS is not 1: times will swing", file=sys.stderr)
    title, body = sections(quick=options.quick)
    flags = " --quick" if options.quick else ""
    command = f"OPENBLAS_NUM_THREADS=1 python tools/bench.py {name}{flags} --write BENCHMARKS.md"
    versions = ", ".join(f"{peer} {_version(peer)}" for peer in PEERS)
    text = f"## {title}\n\n`{command}`\n\n{body}\n\nPython {platform.python_version()}, {versions}."
    print(text)
    if options.write:
        replace_section(options.write, name, text)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
