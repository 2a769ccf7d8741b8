"""What `bench.py`, `fit.py` and the other tools have in common: a command line that is read off the signature of `main`."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import typer

SAMPLES = Path(__file__).resolve().parents[1] / "samples"
# Small worlds, the encoders of formats and the browser are those of the tests.
sys.path.append(str(SAMPLES.parent / "tests"))


def run(main: Callable[..., Any], doc: str | None, arguments: list[str] | None = None, name: str = "") -> Any:
    """Run a `main` with the arguments of the command line: parameters with a default are options, the docstring is the help.

    It ends the process, with the number that `main` returns if it does.
    """

    @wraps(main)
    def command(**values: Any) -> None:
        code = main(**values)
        sys.exit(code if isinstance(code, int) else 0)

    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    # Paragraphs stay as they are.
    app.command(help="\b\n" + (doc or "").strip().replace("\n\n", "\n\n\b\n"))(command)
    app(arguments, prog_name=f"{Path(sys.argv[0]).name} {name}".strip())


def run_named(folder: str, arguments: list[str] | None = None) -> int:
    """Run the module of a folder beside this file that the first argument names; without one list them."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ("",)
    commands = commands_in(folder)
    if name in ("", "-h", "--help"):
        width = max(map(len, commands))
        print("\n".join(f"{command:{width}}  {title}" for command, title in commands.items()))
        return 0
    if name not in commands:
        print(f"unknown name '{name}'; known: {', '.join(commands)}", file=sys.stderr)
        return 2
    module = importlib.import_module(f"{folder}.{name}")
    return int(run(module.main, module.__doc__, rest, name) or 0)


def commands_in(folder: str) -> dict[str, str]:
    """Modules of a folder that have a `main`, with the first lines of their docstrings."""
    trees = {
        path.stem: ast.parse(path.read_text(encoding="utf-8")) for path in (Path(__file__).parent / folder).glob("*.py")
    }
    return {
        name: (ast.get_docstring(tree) or "").split("\n")[0]
        for name, tree in sorted(trees.items())
        if any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in tree.body)
    }
