"""What all commands have in common: options, output for the user, tables of text, errors, and the process they run in.

Every command writes with `-o/--out` and tells more with `-v/--verbose`; `add_command` adds `--quiet`, `--debug` and
`--follow-links` to all of them.
"""

from __future__ import annotations

import functools
import inspect
import os
import shutil
import signal
import sys
import textwrap
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TextIO

import typer
from typer.core import TyperCommand

from log2sim.errors import ConfigError
from log2sim.files.inputs import OPTION
from log2sim.files.plugins import BUILT_IN

if TYPE_CHECKING:
    from log2sim.config import Config


def complete(*choices: str) -> Callable[[str], list[str]]:
    """Return a function by which a shell completes one of the choices."""
    return lambda incomplete: [choice for choice in choices if choice.startswith(incomplete)]


def complete_plugins(kind: str, prefix: str = "") -> Callable[[str], list[str]]:
    """Return a function by which a shell completes the name of a plug-in; installed ones are looked up only then."""

    def completed(incomplete: str) -> list[str]:
        from log2sim.files.plugins import names

        return complete(*(prefix + name for name in names(kind)))(incomplete)

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


ENDING_SIGNALS = ("SIGTERM", "SIGHUP")
SIGNAL_CODE = 128  # a shell adds the number of the signal to this as the exit code: 143 for SIGTERM


class Ended:
    """Which signal ended the process; 0 while there was none."""

    signal = 0


@contextmanager
def ending_by_signals() -> Iterator[Ended]:
    """Within the block SIGTERM and SIGHUP raise `KeyboardInterrupt`, so that all that is cleaned up then is cleaned up.

    Signals that are ignored, as `nohup` does with SIGHUP, stay so. Other threads than the first get no signals.
    """
    ended = Ended()

    def end(number: int, frame: FrameType | None) -> None:
        ended.signal = number
        raise KeyboardInterrupt

    numbers = [getattr(signal, name) for name in ENDING_SIGNALS if hasattr(signal, name)]
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {n: signal.signal(n, end) for n in numbers if signal.getsignal(n) == signal.SIG_DFL}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class TolerantStream:
    """A stream of text that drops what cannot be written: closed, full, or of characters that it cannot show."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> object:
        """Return whatever else the stream has."""
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, with escapes for characters that the stream cannot show."""
        try:
            if self._stream is not None:
                encoding = self._stream.encoding or "utf-8"
                self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        except (OSError, ValueError):  # ValueError: it is closed
            self._give_up()
        return len(text)

    def flush(self) -> None:
        """Write what waits to be written."""
        try:
            if self._stream is not None:
                self._stream.flush()
        except (OSError, ValueError):
            self._give_up()

    def isatty(self) -> bool:
        """Return whether somebody looks at it."""
        return self._stream is not None and not self._stream.closed and self._stream.isatty()

    def _give_up(self) -> None:
        """Write nowhere from now on; Python would try again to write what waits when it ends, and fail."""
        stream, self._stream = self._stream, None
        if stream is not None:
            with suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, stream.fileno())
                os.close(nowhere)


@contextmanager
def tolerating_lost_output() -> Iterator[None]:
    """Within the block what cannot be printed changes nothing else."""
    # Let the standard streams that are closed lead nowhere: a file opened next would get the number, and what libraries print.
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = TolerantStream(sys.stdout), TolerantStream(sys.stderr)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before


MIN_COLUMNS = 40


def format_rows(rows: Sequence[Sequence[str]], indent: int = 0) -> list[str]:
    """Format rows of equal length in columns, each as wide as its longest entry; the last goes on below itself on a narrow terminal."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = []
    for *cells, last in rows:
        start = " " * indent + "".join(f"{cell:<{width}}  " for cell, width in zip(cells, widths))
        lines += wrap(start + last, indent=len(start))
    return lines


def wrap(line: str, indent: int) -> list[str]:
    """Break a line at the width of the terminal, the rest indented; elsewhere, in a pipe or a file, lines stay whole."""
    # Narrower terminals are treated as wider: a word a line reads no better.
    width = max(shutil.get_terminal_size().columns, MIN_COLUMNS) if sys.stdout.isatty() else len(line)
    if len(line) <= width:
        return [line.rstrip()]
    room = " " * min(indent, width // 2)
    return textwrap.wrap(line, width, subsequent_indent=room, break_long_words=False, break_on_hyphens=False)


# Kinds of plug-ins that an option takes, and what stands before their names.
KINDS = {
    "--format": {"log": ""},
    "--detector": {"detector": "", "lidar_detector": "lidar:"},
    "--to": {"export": ""},
    "--ego": {"policy": ""},
    "--model": {"vehicle_model": ""},
}
# Commands of which alone an option means that; `export --ego` takes the id of an agent.
ONLY_OF = {"--ego": "replay", "--model": "replay"}
SWEEPS_ALONE = "detect"  # command whose `--detector` takes none in pictures


class CommandWithPlugins(TyperCommand):
    """A command whose help names installed plug-ins; they are looked up only then, and none is imported."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the installed plug-ins by option, then the examples."""
        from log2sim.files.plugins import installed, package_of

        options = {name for parameter in self.params for name in parameter.opts}
        found = []
        for option in [o for o in KINDS if o in options and ONLY_OF.get(o, self.name) == self.name]:
            kinds = {k: prefix for k, prefix in KINDS[option].items() if (self.name, k) != (SWEEPS_ALONE, "detector")}
            for kind, prefix in kinds.items():
                entries = sorted(installed(kind), key=lambda entry: entry.name)
                found += [(f"{option} {prefix}{entry.name}", package_of(entry)) for entry in entries]
        if found:
            with formatter.section("Plug-ins that are installed"):
                formatter.write_dl(found)
        super().format_epilog(ctx, formatter)


OUTPUT_ALONE = ("config", "cache", "doctor", "help")  # commands that only print, also with nobody to tell
DEBUG = "--debug"
KEYWORD = inspect.Parameter.POSITIONAL_OR_KEYWORD
Debug = Annotated[bool, typer.Option(DEBUG, help="Show where in the program an error comes from.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
FollowLinks = Annotated[bool, typer.Option(OPTION, help="Follow links in logs that lead out of their folders.")]


def add_command(app: typer.Typer, command: Callable[..., None]) -> None:
    """Add a command to the program, with the shared options, and the examples of its docstring below its options.

    `command`: its name, without a "_" at the end, is that of the command, and its docstring the help. What stands below
    the heading "Examples" are lines for the shell.
    """
    name = command.__name__.rstrip("_")
    text, _, examples = (inspect.getdoc(command) or "").partition("\nExamples\n--------\n")
    # With defaults of its own, since those of the program for its option `--help` are not those of a command `help`.
    settings: dict[str, Any] | None = {"default_map": {}} if name == "help" else None
    lines = [line.strip() for line in examples.splitlines() if line.strip()]
    # A paragraph that begins with \b keeps its lines.
    epilog = "\n".join(["\b", f"Example{'s' * (len(lines) > 1)}:", *(f"  {line}" for line in lines)]) if lines else None
    add = app.command(name=name, cls=CommandWithPlugins, help=text.strip(), epilog=epilog, context_settings=settings)

    @functools.wraps(command)
    def run(*args: Any, quiet: bool = False, debug: bool = False, follow_links: bool = False, **options: Any) -> None:
        is_quiet.set(quiet)
        command(*args, **options)  # `log2sim.cli.entry` reads the others before it runs any command

    signature = inspect.signature(command, eval_str=True)
    parameters = list(signature.parameters.values())
    shared = {"debug": Debug, "follow_links": FollowLinks}
    parameters += [inspect.Parameter(key, KEYWORD, default=False, annotation=kind) for key, kind in shared.items()]
    if name not in OUTPUT_ALONE:  # before --verbose, where there is that
        place = next(k for k, p in enumerate(parameters) if p.name in ("verbose", "debug"))
        parameters.insert(place, inspect.Parameter("quiet", KEYWORD, default=False, annotation=Quiet))
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    add(run)
