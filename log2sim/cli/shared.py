"""What all commands have in common: the options --debug and --follow-links, and examples in their help."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer

from log2sim.cli.plugin_help import CommandWithPlugins
from log2sim.links import OPTION

DEBUG = "--debug"
KEYWORD = inspect.Parameter.KEYWORD_ONLY
Debug = Annotated[bool, typer.Option(DEBUG, help="Show where in the program an error comes from.")]
FollowLinks = Annotated[bool, typer.Option(OPTION, help="Follow links in logs that lead out of their folders.")]


def add_command(app: typer.Typer, command: Callable[..., None], name: str | None = None) -> None:
    """Add a command to the program, with the shared options, and the examples of its docstring below its options.

    Parameters
    ----------
    app : typer.Typer
    command : callable
        Its docstring is the help. What stands below the heading "Examples" are lines for the shell.
    name : str, optional
        Default: that of the function.
    """
    text, _, examples = (inspect.getdoc(command) or "").partition("\nExamples\n--------\n")
    app.command(name=name, cls=CommandWithPlugins, help=text.strip(), epilog=format_examples(examples))(
        with_shared_options(command)
    )


def with_shared_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with options that `log2sim.cli.entry` reads before it runs any command."""

    @functools.wraps(command)
    def run(*args: Any, debug: bool = False, follow_links: bool = False, **options: Any) -> None:
        command(*args, **options)

    signature = inspect.signature(command, eval_str=True)
    shared = [
        inspect.Parameter("debug", KEYWORD, default=False, annotation=Debug),
        inspect.Parameter("follow_links", KEYWORD, default=False, annotation=FollowLinks),
    ]
    parameters = [*signature.parameters.values(), *shared]
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def format_examples(lines: str) -> str | None:
    """Format examples for the end of a help text, a line each; None without any."""
    found = [line.strip() for line in lines.splitlines() if line.strip()]
    if not found:
        return None
    # A paragraph that begins with \b keeps its lines.
    return "\n".join(["\b", "Examples:" if len(found) > 1 else "Example:", *(f"  {line}" for line in found)])
