"""samples/first_steps.ipynb runs, shows what it ends its cells with, and is kept without outputs.

The cells run in order in this process, as a kernel would run them: nbclient would bring a kernel, ZeroMQ and a dozen packages to do
the same.
"""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "samples" / "first_steps.ipynb"
CELLS = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
MAX_BYTES = 20_000


def run_cell(source: str, names: dict[str, Any]) -> Any:
    """Run the code of a cell and return the value of its last line, None where that is no expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, NOTEBOOK.name, "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), NOTEBOOK.name, "eval"), names)


def shown(value: Any) -> str:
    """The kind of what a notebook would show of a value: the first representation that there is."""
    for kind in ("_repr_png_", "_repr_html_"):
        made = getattr(value, kind, lambda: None)()
        if made is not None:
            return "picture" if kind == "_repr_png_" or "<img" in made else "html"
    return "text"


def test_it_is_kept_without_outputs() -> None:
    assert NOTEBOOK.stat().st_size < MAX_BYTES
    code = [cell for cell in CELLS if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    assert len({cell["id"] for cell in CELLS}) == len(CELLS)
    assert all(re.fullmatch(r"[\w-]{1,64}", cell["id"]) for cell in CELLS)


@pytest.mark.slow
def test_its_cells_run_in_order(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pandas")
    import matplotlib.pyplot as plt

    plt.switch_backend("agg")
    monkeypatch.chdir(NOTEBOOK.parent)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    names: dict[str, Any] = {"__name__": "__main__"}
    kinds = []
    for cell in CELLS:
        if cell["cell_type"] == "code":
            value = run_cell("".join(cell["source"]), names)
            kinds.append("none" if value is None else shown(value))
    assert kinds == ["picture", "picture", "picture", "picture", "html", "picture", "text", "picture"]
    assert "front (520, 896, 3)" in capsys.readouterr().out
    assert len(names["result"].scenario.others) >= 5
    assert {"bus"} == {a.category for a in names["found"].scenario.others}
    assert len(plt.get_fignums()) == 1
    plt.close("all")
