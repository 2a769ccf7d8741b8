"""What `bench.py`, `fit.py` and others have in common: one command that runs the modules of a folder by name."""

from __future__ import annotations

import argparse
import ast
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path


def run_named(folder: str, arguments: Sequence[str] | None = None) -> int:
    """Run `main` of the module of a folder beside this file that the first argument names; without one list them."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ("",)
    commands = commands_in(folder)
    if name in ("", "-h", "--help"):
        width = max(map(len, commands))
        print("\n".join(f"{command:{width}}  {title}" for command, title in commands.items()))
        return 0
    if name not in commands:
        print(f"unknown name '{name}'; known: {', '.join(commands)}", file=sys.stderr)
        return 2
    sys.argv[0] = f"{Path(sys.argv[0]).name} {name}"
    return importlib.import_module(f"{folder}.{name}").main(rest) or 0


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


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """A parser whose help is the docstring of a module."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
