"""What all commands have in common: options, errors, tables of text, and the process they run in."""

from __future__ import annotations

import functools
import inspect
import os
import shutil
import signal
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Annotated, Any, TextIO

import typer
from typer.core import TyperCommand

from log2sim.cli.options import is_quiet
from log2sim.files.inputs import OPTION

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
        if stream is None:
            return
        try:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)
        except (OSError, ValueError):
            return


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
    """Format rows in columns, each as wide as its longest entry; the last column goes on below itself on a narrow terminal."""
    if not rows:
        return []
    count = max(len(row) for row in rows)
    widths = [max(len(row[k]) if k < len(row) else 0 for row in rows) for k in range(count - 1)]
    lines = []
    for row in rows:
        start = " " * indent + "".join(f"{cell:<{width}}  " for cell, width in zip(row, widths))
        last = row[count - 1] if len(row) == count else ""
        lines += wrap(start + last, indent=len(start))
    return lines


def wrap(line: str, indent: int = 2) -> list[str]:
    """Break a line at the width of the terminal, the rest indented; elsewhere, in a pipe or a file, lines stay whole."""
    # Narrower terminals are treated as wider: a word a line reads no better.
    width = max(shutil.get_terminal_size().columns, MIN_COLUMNS) if sys.stdout.isatty() else len(line)
    if len(line) <= width:
        return [line.rstrip()]
    room = " " * min(indent, width // 2)
    return textwrap.wrap(
        line, width, subsequent_indent=room, break_long_words=False, break_on_hyphens=False, drop_whitespace=True
    )


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
