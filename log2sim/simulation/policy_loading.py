"""Loads the policy that a name on the command line refers to."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from log2sim.errors import ConfigError
from log2sim.registry import nearest
from log2sim.simulation.policy import Policy


def load_policy(name: str) -> Policy:
    """Load the policy "module:attribute" or "path/to/file.py:attribute"; the attribute may contain dots.

    A module is looked up in the current folder first, as `python -m` does; a file can import from its own folder. A class is
    instantiated without arguments.

    Raises
    ------
    ConfigError
        When the name has another form, or cannot be imported, instantiated or called.
    """
    source, colon, attribute = name.rpartition(":")
    if not (source and colon and attribute):
        raise ConfigError(
            f"policy '{name}': expected module:attribute or file.py:attribute, such as my_driver:brake_late"
        )
    try:
        target: Any = _import_file(Path(source)) if source.endswith(".py") else _import_module(source)
    except Exception as error:  # a user's module may raise anything while it is imported
        raise ConfigError(f"policy '{name}': '{source}' cannot be imported: {type(error).__name__}: {error}") from error
    for part in attribute.split("."):
        if not hasattr(target, part):
            known = [key for key in vars(target) if not key.startswith("_")] if hasattr(target, "__dict__") else []
            raise ConfigError(f"policy '{name}': there is no '{part}' in '{source}'{nearest(part, known)}")
        target = getattr(target, part)
    if isinstance(target, type):
        try:
            target = target()
        except Exception as error:
            raise ConfigError(f"policy '{name}': cannot be made: {type(error).__name__}: {error}") from error
    if not callable(target):
        raise ConfigError(
            f"policy '{name}': is a {type(target).__name__}, expected a callable policy(observation) -> Controls"
        )
    result: Policy = target
    return result


def _import_module(name: str) -> ModuleType:
    with _first_on_path(Path.cwd()):
        return importlib.import_module(name)


def _import_file(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"log2sim_policy_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses of the file look their module up there
    with _first_on_path(path.resolve().parent):
        spec.loader.exec_module(module)
    return module


@contextmanager
def _first_on_path(folder: Path) -> Iterator[None]:
    """Search a folder before all others during an import."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        if str(folder) in sys.path:
            sys.path.remove(str(folder))
