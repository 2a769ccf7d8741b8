"""Imports flow inward: every room imports only rooms of a lower rank, lazy imports included, and start-up stays light."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import imports
import pytest

import log2sim
from log2sim.cli import app
from log2sim.files import plugins

ROOT = Path(__file__).resolve().parents[1]

# Folders and modules of the package from the ground floor up. Each may import those before it and nothing else.
RANKED = (
    "errors", "version", "files", "geometry", "datatypes", "config", "logs", "synth", "tracking", "plan", "perception", "localization",
    "agents", "road", "report", "pipeline", "prediction", "simulation", "edit", "export", "visualization", "evaluation", "batch", "cli",
    "__init__", "__main__",
)  # fmt: skip


@pytest.fixture(scope="module")
def modules() -> dict[str, set[str]]:
    return imports.module_graph(ROOT / "log2sim")


def test_every_room_imports_only_rooms_of_a_lower_rank(modules: dict[str, set[str]]) -> None:
    rank = {room: k for k, room in enumerate(RANKED)}
    rooms = imports.room_graph(modules)
    assert set(rooms) == set(RANKED)
    assert {(room, t) for room, targets in rooms.items() for t in targets if rank[t] >= rank[room]} == set()


def test_there_is_no_import_cycle(modules: dict[str, set[str]]) -> None:
    assert imports.cycles(modules) == []


@pytest.mark.parametrize("face", sorted((ROOT / "log2sim").rglob("*/__init__.py")), ids=lambda f: f.parent.name)
def test_the_face_of_a_folder_only_lists_names(face: Path) -> None:
    statements = ast.parse(face.read_text(encoding="utf-8")).body
    assert ast.get_docstring(ast.Module(statements, []))
    for node in statements[1:]:
        listed = isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
        assert listed or isinstance(node, ast.ImportFrom), ast.unparse(node)


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


def test_every_command_is_a_listed_function() -> None:
    """README says which; those of the cache and of the settings are for the shell, and for `Config`."""
    table = (ROOT / "README.md").read_text(encoding="utf-8").partition("| command | function |")[2].partition("\n\n")[0]
    rows = [[cell.strip(" `") for cell in line.split("|")[1:3]] for line in table.splitlines()[2:]]
    commands = {(c.name or c.callback.__name__).rstrip("_") for c in app.registered_commands}
    assert {command for command, _ in rows} == commands - {"cache"}
    assert {function.partition("(")[0].partition(".")[0] for _, function in rows} <= set(log2sim.__all__)


@pytest.mark.parametrize("place", plugins.LATE_FUNCTIONS.values())
def test_late_functions_are_of_higher_rooms_and_exist(place: str) -> None:
    module, _, name = place.partition(":")
    assert callable(getattr(importlib.import_module(module), name))
    assert RANKED.index(imports.room_of(module.removeprefix("log2sim."))) > RANKED.index("datatypes")
