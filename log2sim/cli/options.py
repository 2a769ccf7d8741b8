"""Options that several commands share, and output for the user.

Every command writes with `-o/--out` and tells more with `-v/--verbose`. `--quiet`, `--debug`, `--follow-links` and `--help` are
added to all of them by `log2sim.cli.shared`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from log2sim.errors import ConfigError
from log2sim.files.plugins import BUILT_IN

if TYPE_CHECKING:
    from log2sim.config import Config


def complete(*choices: str) -> Callable[[str], list[str]]:
    """Return a function by which a shell completes one of the choices."""
    return lambda incomplete: [choice for choice in choices if choice.startswith(incomplete)]


def complete_plugins(*kinds: str, prefix: str = "") -> Callable[[str], list[str]]:
    """Return a function by which a shell completes the name of a plug-in; installed ones are looked up only then."""

    def completed(incomplete: str) -> list[str]:
        from log2sim.files.plugins import names

        known = [prefix + name for kind in kinds for name in names(kind)]
        return [name for name in known if name.startswith(incomplete)]

    return completed


def option(
    help: str, metavar: str | None = None, *flags: str, default: Any = True, completes: Any = None, **more: Any
) -> Any:
    """Make an option; `default` says in words what happens without it, where its default is None."""
    return typer.Option(*flags, metavar=metavar, help=help, show_default=default, autocompletion=completes, **more)


def choose(flag: str, choices: str, help: str, *, default: Any = True) -> Any:
    """Make an option that takes one of a few words, "a|b", which a shell completes."""
    return option(help, choices, flag, completes=complete(*choices.split("|")), default=default)


def write_to(metavar: str, help: str) -> Any:
    """Make the option -o/--out."""
    return option(help, metavar, "--out", "-o")


def complete_detectors(incomplete: str) -> list[str]:
    """Complete the name of a detector in images or in LiDAR sweeps."""
    return [*complete_plugins("detector")(incomplete), *complete_plugins("lidar_detector", prefix="lidar:")(incomplete)]


LogPath = Annotated[Path, typer.Argument(metavar="LOG", help="Folder or file of a log.")]
ScenarioPath = Annotated[Path, typer.Argument(metavar="SCENARIO", help="A scenario.json.")]
Overwrite = Annotated[bool, option("Replace files that exist.", None, "--overwrite", "-f", envvar="LOG2SIM_OVERWRITE")]
OverwriteFolder = Annotated[bool, option("Replace the folder of an earlier run.", None, "--overwrite", "-f")]
ScenarioFolder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder with scenarios, such as that of batch.")]
Condition = Annotated[str, typer.Argument(metavar="CONDITION", help="As that of find; it finds tags of one kind.")]
LeastProbability = Annotated[float, option(
    "Least probability of the tags, unless the condition has one.", "P", min=0.0, max=1.0)]  # fmt: skip
PageLog = Annotated[Path | None, option(
    "Log whose pictures with boxes, LiDAR points and map of the ground the page shows.", "LOG")]  # fmt: skip
DropDoubtful = Annotated[bool, option(
    "Leave out agents that the scenario itself doubts; the ego stays.", None, "--drop-doubtful")]  # fmt: skip

Verbose = Annotated[bool, option("Print everything, not only the first of many.", None, "--verbose", "-v")]
AsJson = Annotated[bool, option("Print JSON, for programs, instead of a table.", None, "--json")]
Format = Annotated[str, option(
    f"Log format: auto, {', '.join(BUILT_IN['log'])}.", "FORMAT",
    completes=lambda incomplete: [*complete("auto")(incomplete), *complete_plugins("log")(incomplete)])]  # fmt: skip
SequenceName = Annotated[str | None, option(
    "Sequence to open, when the folder has several.", "NAME", default="the only one")]  # fmt: skip
Settings = Annotated[list[str] | None, option("Change a setting; see log2sim config.", "SECTION.KEY=VALUE", "--set")]
Cameras = Annotated[str | None, option("Use only these cameras.", "A,B", default="all")]
ConfigFile = Annotated[Path | None, option("File with settings; see log2sim config.", "FILE.toml", "--config")]
Start = Annotated[float | None, option("First time to use, in s from the start of the log.", "S", default="the start")]
Stop = Annotated[float | None, option("Last time to use, in s from the start of the log.", "S", default="the end")]
Range = Annotated[float | None, option(
    "Compare agents or boxes up to this distance from the ego, in m.", "M", default="no limit")]  # fmt: skip
Categories = Annotated[str | None, option(
    "Compare only these categories or groups, e.g. vehicle.", "A,B", default="all")]  # fmt: skip
Truth = Annotated[Path | None, option("Ground truth: a scenario file or a log with labels.", "TRUTH")]
LabelFile = Annotated[Path | None, option(
    "True boxes in place of those of the log: KITTI tracking, nuScenes JSON, OpenLABEL, or CSV as labels/boxes_3d.csv.",
    "FILE", "--labels")]  # fmt: skip
Poses = Annotated[str | None, choose(
    "--poses", "given|lidar|camera|auto",
    "Ego poses: the log's own, from LiDAR odometry (extra odometry), from the motion of a camera, or what fits to the sensors best.",
    default="the log's own; what fits best for a log without any")]  # fmt: skip
NoCache = Annotated[bool, option(
    "Search every picture again, and keep nothing of it; see log2sim cache.", None, "--no-cache")]  # fmt: skip


def printable(text: str) -> str:
    """Return a text whose control characters are escaped: names in a log must not steer the terminal."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)


def fail(message: str, code: int) -> NoReturn:
    """Print an error and exit with a code."""
    sys.stderr.write(f"log2sim: {printable(message)}\n")
    sys.exit(code)


def say(text: str) -> None:
    """Print a line for the user."""
    sys.stdout.write(printable(text) + "\n")
    sys.stdout.flush()


is_quiet = ContextVar("is_quiet", default=False)
"""Whether the command runs with --quiet; then `tell`, all that uses it, and progress print nothing."""


def tell(text: str) -> None:
    """Print a line for the user, but for --quiet."""
    if not is_quiet.get():
        say(text)


def say_all(kind: str, lines: Iterable[object]) -> None:
    """Tell lines that each begin with their kind, such as "note"."""
    for line in lines:
        tell(f"{kind}: {line}")


def report_written(*paths: Path | None) -> None:
    """Name the files that a command wrote; None stands for one that was not asked for."""
    written = [str(path) for path in paths if path is not None]
    if written:
        tell(f"{', '.join(written)}: written")


def split_names(text: str | None) -> tuple[str, ...]:
    """Split names that are separated by commas; none stands for all."""
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())


def camera_names(text: str | None) -> tuple[str, ...]:
    """Split what `--cameras` takes; raises `ConfigError` when it is empty."""
    names = split_names(text)
    if text is not None and not names:
        raise ConfigError("--cameras: is empty; name cameras separated by commas, or leave it out to use all")
    return names


def load_config(
    file: Path | None,
    settings: list[str] | None,
    *,
    detector: str | None = None,
    poses: str | None = None,
    **options: Any,
) -> Config:
    """Return the settings of a file and of --set with those that options give; None leaves one as it is."""
    from log2sim.config import Config

    options["detect"] = None if detector is None else {"name": detector}
    options["poses"] = None if poses is None else {"source": poses}
    return Config.load(file, settings or (), **options)


def require_own_workers(jobs: int | None, scheduler: str | None) -> None:
    """Raise `ConfigError` where the workers of a scheduler are to be used, and a number of them is given."""
    if scheduler is not None and jobs is not None:
        raise ConfigError("--jobs: the scheduler decides how many workers there are; leave out --jobs or --scheduler")


def counted(count: int, noun: str) -> str:
    """Format a count with its noun, such as "1 agent" or "2 agents"."""
    return f"{count} {noun}{'s' * (count != 1)}"
