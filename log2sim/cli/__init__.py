"""The command line, one module for the commands of a task."""

from __future__ import annotations

from log2sim.cli.entry import app, main

__all__ = ["app", "main"]
