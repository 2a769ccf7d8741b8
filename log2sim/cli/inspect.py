"""Describe the content of a log."""

from __future__ import annotations

from log2sim.cli.options import Format, LogPath, Sequence, say


def inspect(log: LogPath, format: Format = "auto", sequence: Sequence = None) -> None:
    """Describe the content of a log as JSON."""
    import json

    from log2sim.logs.opening import open_log
    from log2sim.logs.summary import summarize

    say(json.dumps(summarize(open_log(log, format=format, sequence=sequence)), indent=2))
