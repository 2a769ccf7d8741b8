"""Loads the policy that a name on the command line refers to, of an installed package, a module or a file."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from log2sim import registry
from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError, PluginError
from log2sim.registry import nearest
from log2sim.simulation.policy import Controls, Observation, Policy, query_policy, reset_policy


def load_policy(name: str) -> Policy:
    """Load the policy "module:attribute" or "path/to/file.py:attribute", or a plug-in by its name; the attribute may contain dots.

    A module is looked up in the current folder first, as `python -m` does; a file can import from its own folder. A class is
    instantiated without arguments.

    Raises
    ------
    ConfigError
        When the name has another form, or cannot be imported, instantiated or called.
    """
    source, colon, attribute = name.rpartition(":")
    if not colon and name:
        return _load_plugin(name)
    if not (source and attribute):
        raise ConfigError(
            f"policy '{name}': expected module:attribute or file.py:attribute, such as my_driver:brake_late, or the name of a plug-in"
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
    return _made(target, f"policy '{name}'", ConfigError)


@dataclass(frozen=True, eq=False)
class PluginPolicy:
    """A policy of another package; its faults are told with the name of the package.

    Attributes
    ----------
    inner : callable
    source : str
        How messages name it.
    """

    inner: Policy
    source: str

    def reset(self, scenario: Scenario) -> None:
        """Prepare it for a replay, if it wants to be."""
        with self._blamed():
            reset_policy(self.inner, scenario)

    def __call__(self, observation: Observation) -> Controls:
        """Return its controls."""
        with self._blamed():
            return query_policy(self.inner, observation)

    @contextmanager
    def _blamed(self) -> Iterator[None]:
        try:
            yield
        except ConfigError as error:  # whatever it raises and returns is one already
            raise PluginError(f"{self.source}: {error}") from error


def _load_plugin(name: str) -> Policy:
    """Load the policy that another package declares as an entry point of the group "log2sim.policy"."""
    try:
        target = registry.load("policy", name)
    except PluginError:
        raise
    except ConfigError as error:
        raise ConfigError(
            f"{error}; of a module or a file, expected module:attribute or file.py:attribute, such as my_driver:brake_late"
        ) from None
    source = registry.say_plugin("policy", name)
    return PluginPolicy(_made(target, source, PluginError), source)


def _made(target: Any, source: str, error_type: type[ConfigError]) -> Policy:
    """Return the policy itself, which a class is made to without arguments."""
    if isinstance(target, type):
        try:
            target = target()
        except Exception as error:
            raise error_type(f"{source}: cannot be made: {type(error).__name__}: {error}") from error
    if not callable(target):
        raise error_type(f"{source}: is a {type(target).__name__}, expected a callable policy(observation) -> Controls")
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
