"""The command line. Each command imports what it needs, so that `log2sim --help` answers at once."""

from __future__ import annotations

import sys
from collections.abc import Callable

import typer

from log2sim.cli import build, change, judge, look, page, share
from log2sim.cli.app import app, fail
from log2sim.errors import Log2SimError

__all__ = ["app", "build", "change", "judge", "look", "main", "page", "share"]

INTERRUPTED = 130


def main() -> None:
    """Run the command line; every error of ours becomes one clear message and its exit code."""
    arguments = [a for a in sys.argv[1:] if a != "--debug"]
    debug = len(arguments) != len(sys.argv) - 1
    try:
        code = app(args=arguments, prog_name="log2sim", standalone_mode=False)
    except Log2SimError as error:
        if debug:
            raise
        fail(str(error), error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except OSError as error:
        if debug:
            raise
        fail(f"{error.filename or 'a file'}: {error.strerror or error}; check the name and the permissions", 3)
    except Exception as error:
        format_message: Callable[[], str] | None = getattr(error, "format_message", None)  # click's own usage errors
        if format_message is None:
            if debug:
                raise
            fail(f"internal error: {type(error).__name__}: {error}; run again with --debug for the place", 1)
        if not arguments:
            sys.stderr.write(format_message() + "\n")
            sys.exit(2)
        fail(f"{format_message()} (see log2sim --help)", getattr(error, "exit_code", 2))
    if code == INTERRUPTED:  # typer returns it for Ctrl-C within a command
        fail("interrupted; nothing half-written was left", INTERRUPTED)
    sys.exit(code if isinstance(code, int) else 0)
