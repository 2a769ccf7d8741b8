"""Imports flow inward: stages know the ground floor and never each other, and start-up stays light."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "log2sim"

# What every unit (module or folder of the package) is. A new one has to be given its place here.
GROUND = {
    "boxfit", "camera", "clock", "config", "errors", "files", "geometry", "registry", "scenario", "schema", "types", "unlabeled",
}  # fmt: skip
STAGES = {
    "detect", "export", "extend", "fuse", "logs", "measure", "metrics", "plot", "replay", "shape", "smooth", "sync", "synth", "thin", "topdown", "track",
}  # fmt: skip
PIPELINE = {
    "assemble", "bench", "credit", "edit", "finish", "ground_plane", "look", "mosaic", "observe", "overlap", "pipeline", "plan", "report", "savings", "view",
}  # fmt: skip
TOP = {"__init__", "__main__", "cli", "progress"}
# Synthetic logs are written by the writer of logs; scripts for other simulators follow the courses that a replay follows.
ALLOWED = {("synth", "logs"), ("export", "replay")}


def unit(module: str) -> str:
    """The unit of "log2sim.unit.rest"; `__init__` for the package itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def imports(file: Path, *, lazy: bool) -> Iterator[str]:
    """Modules of the package that a file imports; with `lazy` also those imported within functions."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree) if lazy else tree.body:
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.split(".")[0] == "log2sim")
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            module = node.module or ""
            if module.split(".")[0] == "log2sim":
                for alias in node.names:
                    inner = f"{module}.{alias.name}"
                    path = PACKAGE.parent / inner.replace(".", "/")
                    yield inner if path.with_suffix(".py").exists() or path.is_dir() else module


def graph(*, lazy: bool) -> dict[str, set[str]]:
    """Imports by module; without `lazy` only those that run when the module is imported."""
    edges: dict[str, set[str]] = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        edges[name] = set(imports(file, lazy=lazy))
    return edges


def units() -> dict[str, set[str]]:
    out: dict[str, set[str]] = {}
    for module, targets in graph(lazy=True).items():
        out.setdefault(unit(module), set()).update(unit(t) for t in targets)
    return {u: t - {u} for u, t in out.items()}


def test_every_unit_has_its_place() -> None:
    kinds = [GROUND, STAGES, PIPELINE, TOP]
    assert set(units()) == set().union(*kinds)
    assert sum(map(len, kinds)) == len(set().union(*kinds))


def test_the_ground_floor_stands_on_nothing_else() -> None:
    wrong = {(u, t) for u, targets in units().items() if u in GROUND for t in targets - GROUND}
    assert wrong == set()


def test_stages_import_only_the_ground_floor() -> None:
    wrong = {(u, t) for u, targets in units().items() if u in STAGES for t in targets - GROUND - {"__init__"}}
    assert wrong == ALLOWED


def test_nothing_imports_the_command_line() -> None:
    assert {u for u, targets in units().items() if targets & {"cli", "progress"}} == {"cli", "__main__"}


def test_there_is_no_cycle() -> None:
    edges, done, path = graph(lazy=False), set(), []

    def visit(module: str) -> None:
        if module in path:
            pytest.fail(" -> ".join([*path[path.index(module) :], module]))
        if module not in done:
            path.append(module)
            for target in sorted(edges.get(module, set()) - {module, "log2sim"}):
                visit(target)
            done.add(path.pop())

    for module in edges:
        visit(module)


@pytest.mark.parametrize(
    "statement",
    [
        "import log2sim",
        "from log2sim import cli",
        "import sys; sys.argv = ['log2sim', '--help']\nfrom log2sim import cli\ntry: cli.main()\nexcept SystemExit: pass",
        "import sys; sys.argv = ['log2sim', 'reconstruct', '--help']\nfrom log2sim import cli\ntry: cli.main()\nexcept SystemExit: pass",
    ],
    ids=["package", "cli", "--help", "reconstruct --help"],
)
def test_start_up_loads_nothing_heavy(statement: str) -> None:
    heavy = ["cv2", "scipy", "onnxruntime", "matplotlib.pyplot", "matplotlib", "pandas", "skimage", "numpy", "pyproj"]
    code = f"{statement}\nimport sys\nsys.stderr.write(','.join(m for m in {heavy} if m in sys.modules))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stderr == ""


def test_the_public_names_exist() -> None:
    import log2sim

    assert all(getattr(log2sim, name) is not None for name in log2sim.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'recontruct'"):
        log2sim.recontruct  # noqa: B018
