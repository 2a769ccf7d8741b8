"""Thresholds of a package: find the numbers that modules assign to names in capitals, and import them with other values."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import importlib.abc
import importlib.machinery
import math
import multiprocessing
import pkgutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

UNITS = {
    "M": "m", "S": "s", "MPS": "m/s", "MPS2": "m/s2", "MPS3": "m/s3", "PX": "px", "RAD": "rad", "DEG": "deg", "HZ": "Hz",
    "NS": "ns", "1PM": "1/m", "M2": "m2", "SIGMAS": "sigma",
}  # fmt: skip
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Threshold:
    """A number of the method, or a table of numbers by category.

    Attributes
    ----------
    module, name : str
        Where it is assigned; a setting of the configuration has no module.
    value : Any
        Number, array, or table.
    field : str
        Of a table of records, the one column that is meant.
    """

    module: str
    name: str
    value: Any
    field: str = ""

    @property
    def label(self) -> str:
        """Short name for tables."""
        return ".".join(p for p in (self.module.removeprefix("log2sim."), self.name, self.field) if p)

    @property
    def unit(self) -> str:
        """Unit, read off the end of the name; empty for counts and shares."""
        return UNITS.get((self.field or self.name).upper().rsplit("_", 1)[-1], "")


def thresholds_in(packages: Sequence[str], without: Sequence[str] = ()) -> list[Threshold]:
    """All thresholds of packages or single modules, in the order of the modules."""
    modules = [m for m in _modules(packages) if not any((m.__name__ + ".").startswith(w + ".") for w in without)]
    return [threshold for module in modules for threshold in _assigned(module)]


def _modules(packages: Sequence[str]) -> Iterator[ModuleType]:
    for package in packages:
        root = importlib.import_module(package)
        yield root
        for info in pkgutil.walk_packages(getattr(root, "__path__", []), package + "."):
            yield importlib.import_module(info.name)


def _assigned(module: ModuleType) -> Iterator[Threshold]:
    """Numbers and tables of numbers that a module assigns to names in capitals; what is derived without a literal is none."""
    for node in ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body:
        for name in _names(node):
            value = getattr(module, name)
            rows = list(value.values()) if isinstance(value, Mapping) else [value]
            if rows and all(dataclasses.is_dataclass(r) for r in rows):
                columns = {f.name: _column(value, f.name) for f in dataclasses.fields(rows[0])}
                yield from (Threshold(module.__name__, name, v, f) for f, v in columns.items() if _is_number(v))
            elif _is_number(value):
                yield Threshold(module.__name__, name, value)


def _column(table: Any, field: str) -> Any:
    return {k: getattr(r, field) for k, r in table.items()} if isinstance(table, Mapping) else getattr(table, field)


def _names(node: ast.stmt) -> list[str]:
    if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
        return []
    if not any(isinstance(n, ast.Constant) and isinstance(n.value, (int, float)) for n in ast.walk(node.value)):
        return []
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    names = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
    return [n for n in names if n.isupper() and not n.startswith("_")]


def _is_number(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(_is_number(v) for v in value.values())
    if isinstance(value, (tuple, list)):
        return any(_is_number(v) for v in value)
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "fi"
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def scaled(value: Any, factor: float, field: str = "", *, share: bool = False) -> Any:
    """A value, or every number in a table or record, times a factor.

    Whole numbers change by one at least; a `share` below one stays so, half as far from one at the nearest.
    """
    if isinstance(value, Mapping):
        return {k: scaled(v, factor, field, share=share) for k, v in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        changed = [f.name for f in dataclasses.fields(value) if f.init and field in ("", f.name)]
        return dataclasses.replace(value, **{n: scaled(getattr(value, n), factor, share=share) for n in changed})
    if isinstance(value, (tuple, list)):
        return type(value)(scaled(v, factor, share=share) for v in value)
    if isinstance(value, np.ndarray):
        return np.rint(value * factor).astype(value.dtype) if value.dtype.kind == "i" else value * factor
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    if isinstance(value, int):
        step = 1 if factor > 1 else -1
        return value + step * max(abs(round(value * factor) - value), 1) if value else value
    limit = (1 + value) / 2 if share and 0 < value < 1 else math.inf
    return min(value * factor, limit)


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads one module with one of its assignments followed by the scaling of what was assigned."""

    threshold: Threshold
    factor: float

    def get_code(self, fullname: str) -> Any:
        tree = ast.parse(self.get_data(self.path))
        k = next(i for i, node in enumerate(tree.body) if self.threshold.name in _names(node))
        tree.body[k + 1 : k + 1] = ast.parse(f"{self.threshold.name} = _scaled_({self.threshold.name})").body
        return compile(tree, self.path, "exec", dont_inherit=True)

    def exec_module(self, module: ModuleType) -> None:
        module.__dict__["_scaled_"] = lambda value: scaled(
            value, self.factor, self.threshold.field, share=not self.threshold.unit
        )
        super().exec_module(module)


class _Finder(importlib.abc.MetaPathFinder):
    def __init__(self, threshold: Threshold, factor: float) -> None:
        self._threshold, self._factor = threshold, factor

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> Any:
        spec = importlib.machinery.PathFinder.find_spec(fullname, path) if fullname == self._threshold.module else None
        if spec is not None and spec.origin is not None:
            spec.loader = loader = _Loader(fullname, spec.origin)
            loader.threshold, loader.factor = self._threshold, self._factor
        return spec


def import_varied(threshold: Threshold, factor: float, *, kept: Callable[[str], bool]) -> None:
    """Forget the modules of a package but those `kept`, so that they are imported next with a threshold scaled."""
    root = threshold.module.partition(".")[0]
    for name in list(sys.modules):
        if name.startswith(root + ".") and not kept(name):
            del sys.modules[name]
    sys.meta_path.insert(0, _Finder(threshold, factor))


def in_processes(run: Callable[[Any], T], tasks: Sequence[Any], jobs: int = 1) -> Iterator[T]:
    """Run tasks in their order, each in a process of its own that begins with all that this one has in memory."""
    _work[:] = [run, tasks]
    with multiprocessing.get_context("fork").Pool(jobs, maxtasksperchild=1) as pool:
        yield from pool.imap(_run_one, range(len(tasks)), chunksize=1)


# Tasks hold what cannot be sent to a process; forked ones find them here.
_work: list[Any] = []


def _run_one(index: int) -> Any:
    run, tasks = _work
    return run(tasks[index])
