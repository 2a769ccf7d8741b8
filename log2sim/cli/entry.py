"""The command line. Each command imports what it needs, so that `log2sim --help` answers at once."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Annotated, NoReturn

import typer

from log2sim.cli import (
    bench,
    config,
    convert,
    detect,
    edit,
    evaluate,
    export,
    import_,
    inspect,
    map,
    plot,
    predict,
    reconstruct,
    replay,
    synth,
    validate,
    view,
)
from log2sim.cli.options import fail, say
from log2sim.cli.process import SIGNAL_CODE, Ended, ending_by_signals, tolerating_lost_output
from log2sim.errors import Log2SimError
from log2sim.links import OPTION, following_links
from log2sim.output_claims import holding_claims
from log2sim.outputs import refusing_to_replace
from log2sim.version import __version__

INTERRUPTED = 130

app = typer.Typer(
    name="log2sim",
    help="Reconstruct driving logs as scenarios that a simulator can run. Add --debug for tracebacks, --follow-links for logs with links that leave their folders.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    """Reconstruct driving logs as scenarios that a simulator can run. Add --debug for tracebacks, --follow-links for logs with links that leave their folders."""
    if version:
        say(__version__)
        raise typer.Exit


for command in (
    reconstruct.reconstruct, detect.detect, replay.replay, predict.predict, synth.synth, edit.edit, plot.plot, evaluate.evaluate, bench.bench,
    inspect.inspect, validate.validate, convert.convert, config.config, view.view, export.export,
):  # fmt: skip
    app.command()(command)
app.command(name="import")(import_.import_)
app.command(name="map")(map.map_)


def main() -> None:
    """Run the command line; every `Log2SimError` becomes one message and its exit code."""
    with tolerating_lost_output(), ending_by_signals() as ended, refusing_to_replace(), holding_claims():
        _run(ended)


def _run(ended: Ended) -> NoReturn:
    arguments = [a for a in sys.argv[1:] if a not in ("--debug", OPTION)]
    debug = "--debug" in sys.argv
    try:
        with following_links(OPTION in sys.argv):
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
        word, code = ("terminated", SIGNAL_CODE + ended.signal) if ended.signal else ("interrupted", INTERRUPTED)
        fail(f"{word}; no incomplete file was left", code)
    sys.exit(code if isinstance(code, int) else 0)
