"""The command line, one module a command."""

from __future__ import annotations

from log2sim.cli.entry import app, main

__all__ = ["app", "main"]
