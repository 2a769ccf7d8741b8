"""Print how the package holds together: rooms, imports between them and import cycles.

A room is a folder or a module directly below `log2sim`. Imports within functions count like all others.

Usage: python tools/imports.py [--edges]
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
from entry import SAMPLES, run
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Graph = Mapping[str, set[str]]


def main(edges: bool = False) -> None:
    """Print the figures of the package, with `edges` also every import between rooms."""
    modules = module_graph(SAMPLES.parent / "log2sim")
    rooms = room_graph(modules)
    apart = sum(room_of(m) != room_of(t) for m in modules for t in modules[m])
    print(f"rooms                                     {len(rooms)}")
    print(f"imports between rooms (room -> room)      {sum(map(len, rooms.values()))}")
    print(f"imports between modules of two rooms      {apart}")
    print(f"import cycles of modules                  {len(cycles(modules))}")
    print(f"import cycles of rooms                    {len(cycles(rooms))}")
    if edges:
        for room, targets in rooms.items():
            print(f"{room}: {', '.join(sorted(targets))}")
        for group in (*cycles(modules), *cycles(rooms)):
            print(f"cycle: {', '.join(sorted(group))}")


def module_graph(package: Path) -> dict[str, set[str]]:
    """Modules of the package and the modules that each imports, lazily or not; names without the package's own."""
    dotted = {f: ".".join(f.relative_to(package).with_suffix("").parts) for f in sorted(package.rglob("*.py"))}
    files = {name.removesuffix(".__init__"): f for f, name in dotted.items()}
    return {name: set(_imports(file, files)) - {name} for name, file in files.items()}


def _imports(file: Path, known: Mapping[str, Path]) -> Iterator[str]:
    for node in _statements(ast.parse(file.read_text(encoding="utf-8")).body):
        if isinstance(node, ast.Import):
            yield from (a.name.removeprefix("log2sim.") for a in node.names if a.name.startswith("log2sim."))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "log2sim":
            module = (node.module or "").removeprefix("log2sim").removeprefix(".")
            for alias in node.names:
                inner = f"{module}.{alias.name}".removeprefix(".")
                yield inner if inner in known else module or "__init__"


def _statements(body: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """All statements in others, without their expressions, which hold none."""
    for node in body:
        yield node
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            yield from _statements(getattr(node, part, ()))


def room_of(module: str) -> str:
    """The folder or module below the package that a module belongs to."""
    return module.split(".")[0]


def room_graph(modules: Graph) -> dict[str, set[str]]:
    """Rooms and the rooms that each imports."""
    rooms: dict[str, set[str]] = {}
    for module, targets in modules.items():
        rooms.setdefault(room_of(module), set()).update(room_of(t) for t in targets)
    return {room: targets - {room} for room, targets in rooms.items()}


def cycles(graph: Graph) -> list[set[str]]:
    """Groups of two or more nodes that import each other, directly or through others."""
    names = sorted({*graph, *(t for targets in graph.values() for t in targets)})
    at = {name: k for k, name in enumerate(names)}
    edges = np.array([(at[n], at[t]) for n, targets in graph.items() for t in targets], dtype=int).reshape(-1, 2)
    matrix = coo_array((np.ones(len(edges)), edges.T), shape=(len(names), len(names)))
    group = connected_components(matrix, connection="strong")[1]
    groups = [{names[k] for k in np.flatnonzero(group == g)} for g in range(group.max(initial=-1) + 1)]
    return [nodes for nodes in groups if len(nodes) > 1]


if __name__ == "__main__":
    run(main, __doc__)
