"""log2sim/README.md tells what is true: rooms in their order, names that exist, examples that run when registered."""

from __future__ import annotations

import importlib
import re
from itertools import pairwise

import pytest
from test_layers import RANKED, ROOT

from log2sim.files import plugins

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
