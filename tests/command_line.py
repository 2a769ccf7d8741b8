"""Runs the command line in this process, as a shell would see it."""

from __future__ import annotations

import contextlib
import io
import shlex
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from unittest import mock

import typer.main

from log2sim.cli import entry

# The commands are put together from their signatures, which takes longer than many of them run.
typer.main.get_command = cache(typer.main.get_command)


@dataclass(frozen=True)
class Ran:
    """What a command left behind."""

    code: int
    out: str
    err: str

    @property
    def line(self) -> str:
        """The error, which must be one line of ours and no traceback."""
        assert self.err.startswith("log2sim: "), self.err
        assert self.err.count("\n") == 1, self.err
        assert self.err.endswith("\n"), self.err
        assert "internal error" not in self.err, self.err
        return self.err.strip()


def run(command: object = "", *arguments: object) -> Ran:
    """Run `log2sim COMMAND ARGUMENTS` through `main`, with its exit code and what it printed; a shell splits the command alone."""
    argv = ["log2sim", *shlex.split(str(command)), *map(str, arguments)]
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", argv),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            entry.main()
        except SystemExit as stop:
            return Ran(int(stop.code or 0), out.getvalue(), err.getvalue())
    raise AssertionError("main returned instead of exiting")


def names(folder: Path) -> list[str]:
    """Everything in a folder, hidden files too, so that a forgotten temporary shows."""
    return sorted(p.name for p in folder.iterdir())
