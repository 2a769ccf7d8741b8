"""Options that several commands share, and output for the user."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from log2sim.errors import ConfigError
from log2sim.registry import BUILT_IN

LogPath = Annotated[Path, typer.Argument(metavar="LOG", help="Folder or file of a log.")]
ScenarioPath = Annotated[Path, typer.Argument(metavar="SCENARIO", help="A scenario.json.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")]
DropDoubtful = Annotated[
    bool, typer.Option("--drop-doubtful", help="Leave out agents that the scenario itself doubts; the ego stays.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
Format = Annotated[str, typer.Option(help=f"Log format: auto, {', '.join(BUILT_IN['log'])}.")]
Sequence = Annotated[str | None, typer.Option(help="Sequence to open, when the folder has several.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.KEY=VALUE", help="Change a setting; see log2sim config.")
]
Cameras = Annotated[str | None, typer.Option(metavar="A,B", help="Use only these cameras.")]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE.toml", help="File with settings; see log2sim config.")
]


Poses = Annotated[
    str | None,
    typer.Option(
        metavar="given|lidar|camera|auto",
        help="Ego poses: the log's own, from LiDAR odometry (extra odometry), from the motion of a camera, or what fits to the "
        "sensors best. Default: the log's own; what fits best for a log without any.",
    ),
]


def fail(message: str, code: int) -> NoReturn:
    """Print an error and exit with a code."""
    sys.stderr.write(f"log2sim: {message}\n")
    sys.exit(code)


def say(text: str, *, quiet: bool = False) -> None:
    """Print a line for the user."""
    if not quiet:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


def camera_names(text: str | None) -> tuple[str, ...]:
    """Split what `--cameras` takes; none stands for all.

    Raises
    ------
    ConfigError
        When it is empty.
    """
    names = tuple(name.strip() for name in (text or "").split(",") if name.strip())
    if text is not None and not names:
        raise ConfigError("--cameras: is empty; name cameras separated by commas, or leave it out to use all")
    return names


def counted(count: int, noun: str) -> str:
    """Format a count with its noun, such as "1 agent" or "2 agents"."""
    return f"{count} {noun}{'s' * (count != 1)}"
