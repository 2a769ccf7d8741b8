"""samples/first_steps.ipynb runs, and holds the outputs of a run that are small enough for a repository."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest
import run_notebook

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "samples" / "first_steps.ipynb"
CELLS = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
MAX_BYTES = 500_000


def kinds(cells: list[dict[str, Any]]) -> list[list[str]]:
    """The kinds of the outputs of each cell with code: media types, or the name of a stream."""
    code = [cell["outputs"] for cell in cells if cell["cell_type"] == "code"]
    return [[o.get("name") or min(o["data"]) for o in outputs] for outputs in code]


def test_it_is_a_notebook_with_small_outputs() -> None:
    assert NOTEBOOK.stat().st_size < MAX_BYTES
    code = [cell for cell in CELLS if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert all(cell["outputs"] for cell in code)
    assert len({cell["id"] for cell in CELLS}) == len(CELLS)
    assert all(re.fullmatch(r"[\w-]{1,64}", cell["id"]) for cell in CELLS)
    pictures = [o for cell in code for o in cell["outputs"] if "image/jpeg" in o.get("data", {})]
    assert len(pictures) >= 3


def test_of_a_line_that_was_written_anew_the_last_state_is_kept() -> None:
    assert run_notebook.lines_of("\rload: 1 of 2   \rload: 2 of 2   \ndone\n") == ["load: 2 of 2\n", "done\n"]


@pytest.mark.slow
def test_its_cells_run_and_show_what_it_holds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    monkeypatch.chdir(NOTEBOOK.parent)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cells = copy.deepcopy(CELLS)
    run_notebook.run(cells)
    assert kinds(cells) == kinds(CELLS)
    assert any("of 31" in line for cell in cells for o in cell.get("outputs", []) for line in o.get("text", []))
