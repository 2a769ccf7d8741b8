"""Runs blocks of pages in one process, which imports once what each command would: `log2sim` by its `main`, other lines in bash.

    python tests/run_blocks.py < blocks.json

where the file holds pairs of "sh" or "python" and the text of a block. The first line that fails ends it and is named.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys

from log2sim.cli import entry


def run_command(line: str) -> None:
    sys.argv = shlex.split(line, comments=True)
    try:
        entry.main()
    except SystemExit as stop:
        if stop.code:
            sys.exit(f"failed: {line}")


def run_shell(block: str) -> None:
    others: list[str] = []
    for line in [*block.replace("\\\n", " ").splitlines(), "log2sim"]:
        if not line.startswith("log2sim"):
            others.append(line)
            continue
        if others:
            subprocess.run(["bash", "-e", "-c", "\n".join(others)], check=True)
            others.clear()
        if line != "log2sim":
            run_command(line)


def main() -> None:
    for language, block in json.load(sys.stdin):
        if language == "sh":
            run_shell(block)
        else:
            exec(compile(block, "a block of a page", "exec"), {"__name__": "__main__"})


if __name__ == "__main__":
    main()
