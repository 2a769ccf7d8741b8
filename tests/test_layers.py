"""Imports flow inward: every room imports only rooms of a lower rank, lazy imports included, and start-up stays light."""

from __future__ import annotations

import ast
import importlib
import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import imports
import pytest
from mutants import MUTANTS

import log2sim
from log2sim.cli import app
from log2sim.files import plugins

ROOT = Path(__file__).resolve().parents[1]


# Folders and modules of the package from the ground floor up. Each may import those before it and nothing else.
RANKED = (
    "errors", "files", "geometry", "datatypes", "config", "logs", "synth", "tracking", "plan", "perception", "localization",
    "agents", "road", "report", "pipeline", "simulation", "resim", "edit", "export", "visualization", "evaluation", "scenarios", "batch", "cli",
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


@pytest.mark.parametrize(("given", "expected"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")])
def test_commands_multiply_matrices_in_one_thread_unless_the_user_wants_more(
    given: dict[str, str], expected: str
) -> None:
    code = """import os, sys; sys.argv = ["log2sim", "--version"]
from log2sim import cli
try: cli.main()
finally: sys.stderr.write(os.environ["OPENBLAS_NUM_THREADS"])"""
    others = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=others | given)
    assert ran.stderr == expected


def test_every_command_is_a_listed_function() -> None:
    """The cookbook says which; the cache, the cookbook and the studio are for the shell."""
    page = ROOT / "samples/cookbook/python.md"
    table = page.read_text(encoding="utf-8").partition("| command | function |")[2].partition("\n\n")[0]
    rows = [[cell.strip(" `") for cell in line.split("|")[1:3]] for line in table.splitlines()[2:]]
    commands = {(c.name or c.callback.__name__).rstrip("_") for c in app.registered_commands}
    assert {command for command, _ in rows} == commands - {"cache", "help", "studio"}
    assert {function.partition("(")[0].partition(".")[0] for _, function in rows} <= set(log2sim.__all__)


@pytest.mark.parametrize("place", plugins.LATE_FUNCTIONS.values())
def test_late_functions_are_of_higher_rooms_and_exist(place: str) -> None:
    module, _, name = place.partition(":")
    assert callable(getattr(importlib.import_module(module), name))
    assert RANKED.index(imports.room_of(module.removeprefix("log2sim."))) > RANKED.index("datatypes")


TEXT = (ROOT / "log2sim" / "README.md").read_text(encoding="utf-8")


def test_the_picture_shows_every_room_in_the_order_of_its_rank() -> None:
    picture = re.search(r"```text\n(.*?)```", TEXT, re.DOTALL)
    assert picture is not None
    shown = [word for line in picture[1].splitlines() for word in line[17:53].split()]
    assert sorted(shown) == sorted(RANKED)
    rank = {room: k for k, room in enumerate(RANKED)}
    lines = [[rank[word] for word in line[17:53].split()] for line in picture[1].splitlines()]
    for above, below in pairwise(lines):
        assert min(above) > max(below)


@pytest.mark.parametrize(("path", "name"), sorted(set(re.findall(r"`([\w/]+\.py)` `(\w+)`", TEXT))))
def test_the_names_exist(path: str, name: str) -> None:
    module = importlib.import_module(f"log2sim.{path.removesuffix('.py').replace('/', '.')}")
    assert name in vars(module)


def test_the_pipeline_calls_the_functions_of_the_table_in_their_order() -> None:
    source = (ROOT / "log2sim" / "pipeline.py").read_text(encoding="utf-8")
    rows = re.findall(r"^\| [\w ]+ \| `[\w/.]+` `(\w+)`", TEXT, re.MULTILINE)
    called = {name: source.rfind(f" {name}(") for name in rows if f" {name}(" in source}
    second_pass = [name for name in rows[rows.index("fit_homographies") :] if name in called]
    assert len(second_pass) >= 6
    assert second_pass == sorted(second_pass, key=called.__getitem__)


def test_every_kind_of_plug_in_is_explained() -> None:
    for kind in plugins.BUILT_IN:
        assert f"kind `{kind}`" in TEXT


def test_one_door_leads_to_the_records() -> None:
    doors = (
        "logs/",
        "perception/records.py",
        "localization/replaced.py",
        "perception/run_detectors.py",
    )  # readers, the door, streams of changed logs, and those that note what stages read
    package = ROOT / "log2sim"
    reading = re.compile(r"\bstream\w*(\[[^\]]*\])?\.read\b")
    files = {path.relative_to(package).as_posix(): path for path in package.rglob("*.py")}
    around = {name for name, path in files.items() if reading.search(path.read_text(encoding="utf-8"))}
    assert not [name for name in around if not name.startswith(doors)]
    assert "perception/records.py" in around


def test_every_mutant_changes_what_is_there_once() -> None:
    for name, file, old, new, tests in MUTANTS:
        assert (ROOT / "log2sim" / file).read_text(encoding="utf-8").count(old) == 1, name
        assert new != old
        assert all((ROOT / f"tests/test_{of}.py").is_file() for of in tests.split()), name
