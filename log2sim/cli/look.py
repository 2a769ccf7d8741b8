"""Commands that look into logs, files and settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from log2sim.cli.app import ConfigFile, Format, LogPath, Sequence, Settings, app, say


@app.command()
def inspect(log: LogPath, format: Format = "auto", sequence: Sequence = None) -> None:
    """Say what a log holds, as JSON."""
    import json

    from log2sim.logs import open_log
    from log2sim.logs.summary import summarize

    say(json.dumps(summarize(open_log(log, format=format, sequence=sequence)), indent=2))


@app.command()
def validate(
    path: Annotated[Path, typer.Argument(metavar="FILE_OR_LOG", help="A scenario, a replay, or a log folder.")],
    format: Format = "auto",
    sequence: Sequence = None,
) -> None:
    """Check a file or every record of a log.

    Exits with 3 and the problems, if there are any.
    """
    from log2sim.errors import LogError

    if path.is_dir():
        from log2sim.logs.validate import validate_log

        problems = validate_log(path, format=format, sequence=sequence)
        if problems:
            raise LogError(f"{path}: {len(problems)} problem{'s' * (len(problems) > 1)}\n  " + "\n  ".join(problems))
    else:
        _validate_file(path)
    say(f"{path}: valid")


def _validate_file(path: Path) -> None:
    from log2sim.errors import ScenarioError
    from log2sim.files import read_json
    from log2sim.replay import Replay
    from log2sim.scenario import Scenario
    from log2sim.schema import check

    document = read_json(path, ScenarioError)
    keys = document if isinstance(document, dict) else {}
    if "replay_version" in keys:
        Replay.load(path)
    elif "metrics_version" in keys:
        check(document, "metrics-1", ScenarioError)
    elif "report_version" in keys:
        check(document, "report-1", ScenarioError)
    elif "bench_version" in keys:
        check(document, "bench-1", ScenarioError)
    else:
        Scenario.load(path)


@app.command()
def config(
    file: ConfigFile = None,
    settings: Settings = None,
) -> None:
    """Print all settings as TOML.

    The defaults, or what a file and --set make of them.
    """
    from log2sim.config import Config

    say(Config.load(file, settings or ()).to_toml().rstrip())
