"""The command line. Each command imports what it needs, so that `log2sim --help` answers at once."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Annotated, Any, NoReturn

import typer

from log2sim.cli import change, doctor, evaluate, exchange, logs, options, reconstruct, show, simulate, situations
from log2sim.errors import Log2SimError
from log2sim.files.inputs import OPTION, following_links
from log2sim.files.outputs import holding_claims
from log2sim.files.version import __version__

INTERRUPTED = 130
EXIT_CODES = """\b
Exit codes:
    0  done
    1  an error within log2sim; --debug shows where
    2  wrong usage or setting
    3  a log or file that cannot be read or written
    4  nothing to reconstruct
    5  an extra is missing; log2sim doctor lists them
    6  a check of --strict failed
    7  some logs of a batch failed
  130  interrupted"""
UNSET = {"help": False, "install_completion": False, "show_completion": False}
"""Flags that typer adds without a default: it would load pydantic to check them, which takes as long as all of --help."""

app = typer.Typer(
    name="log2sim",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "default_map": UNSET},
)


@app.callback(invoke_without_command=True)
def root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    debug: options.Debug = False,
    follow_links: options.FollowLinks = False,
) -> None:
    """Reconstruct driving logs as scenarios that a simulator can run."""
    if version:
        options.say(__version__)
        raise typer.Exit


for command in (
    reconstruct.reconstruct, reconstruct.batch, logs.inspect, logs.validate, logs.convert, logs.detect, evaluate.evaluate,
    evaluate.bench, show.plot, show.view, change.studio, simulate.replay, simulate.predict, change.edit, simulate.resimulate,
    change.correct, situations.tag, situations.find, situations.vary, exchange.export, exchange.synth, doctor.config, doctor.cache,
    doctor.doctor, doctor.help, exchange.import_, situations.test_, logs.map,
):  # fmt: skip
    options.add_command(app, command)


def main() -> None:
    """Run the command line; every `Log2SimError` becomes one message and its exit code."""
    # Work is shared by processes, and their matrices are small: threads of OpenBLAS wait for each other. NumPy reads it when it is
    # first imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with options.tolerating_lost_output(), options.ending_by_signals() as ended, holding_claims():
        _run(ended)


def _run(ended: options.Ended) -> NoReturn:
    # Both options may also stand before the name of the command.
    arguments = [a for a in sys.argv[1:] if a not in (options.DEBUG, OPTION)]
    debug = options.DEBUG in sys.argv
    try:
        with following_links(OPTION in sys.argv):
            code = app(args=arguments, prog_name="log2sim", standalone_mode=False)
    except Log2SimError as error:
        if debug:
            raise
        options.fail(str(error), error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except OSError as error:
        if debug:
            raise
        options.fail(f"{error.filename or 'a file'}: {error.strerror or error}; check the name and the permissions", 3)
    except Exception as error:
        format_message: Callable[[], str] | None = getattr(error, "format_message", None)  # click's own usage errors
        if format_message is None:
            # Ctrl-C while libraries are being imported gives an ImportError from it.
            cause: BaseException | None = error
            while cause is not None and not isinstance(cause, KeyboardInterrupt):
                cause = cause.__cause__ or cause.__context__
            if cause is not None:
                _end(INTERRUPTED, ended)
            if debug:
                raise
            options.fail(f"internal error: {type(error).__name__}: {error}; run again with --debug for the place", 1)
        if not arguments:
            sys.stderr.write(options.printable(format_message()) + "\n")
            sys.exit(2)
        command = getattr(getattr(error, "ctx", None), "command_path", "log2sim")
        options.fail(f"{format_message()} (see {command} --help)", getattr(error, "exit_code", 2))
    _end(code, ended)


def _end(code: Any, ended: options.Ended) -> NoReturn:
    if code == INTERRUPTED:  # typer returns it for Ctrl-C within a command
        word, code = (
            ("terminated", options.SIGNAL_CODE + ended.signal) if ended.signal else ("interrupted", INTERRUPTED)
        )
        options.fail(f"{word}; no incomplete file was left", code)
    sys.exit(code if isinstance(code, int) else 0)
