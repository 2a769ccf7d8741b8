"""The ablation finds what can be changed by itself, changes it everywhere, and tells what matters from what does not."""

from __future__ import annotations

import importlib
import sys

import ablate
import pytest

from log2sim.config import Config

pytestmark = pytest.mark.slow

TOY = """
from __future__ import annotations
from dataclasses import dataclass
import numpy as np
GATE_M = 2.0
UNUSED_S, BOTH_MPS = 1.0, {"car": 3.0, "truck": 4.0}
MIN_COUNT: int = 2
names = 3.0
@dataclass(frozen=True)
class Row:
    label: str
    length_m: float
TABLE = {"car": Row("c", 4.0), "truck": Row("t", 8.0)}
def is_long(row: Row) -> bool:
    return row.length_m > 3.0
def is_never_asked(row: Row) -> bool:
    return False
"""
USER = """
from __future__ import annotations
from toy.numbers import GATE_M, TABLE, Row, is_long
HALF_GATE_M = 0.5 * GATE_M
def wide(value, gate_m=GATE_M):
    return value + gate_m
def turned(row: Row) -> Row:
    return Row(row.label, -row.length_m)
def answer():
    return HALF_GATE_M + wide(0.0) + (turned(TABLE["car"]).length_m if is_long(TABLE["car"]) else 0.0)
"""


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """Modules whose answer depends on one constant, through a derived one and a default elsewhere, on one column, and on two rules."""
    (tmp_path / "toy").mkdir()
    for name, text in (("__init__", ""), ("numbers", TOY), ("user", USER)):
        (tmp_path / "toy" / f"{name}.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield [importlib.import_module(f"toy.{name}") for name in ("numbers", "user")]
    for name in [n for n in sys.modules if n.split(".")[0] == "toy"]:
        del sys.modules[name]


def test_changes_reach_all_that_is_derived_from_what_is_changed(toy):
    found = {v.label: v for module in toy for v in (*ablate.constants_in(module, ""), *ablate.rules_in(module, ""))}
    assert set(found) == {
        "toy.numbers.GATE_M", "toy.numbers.UNUSED_S", "toy.numbers.BOTH_MPS", "toy.numbers.MIN_COUNT", "toy.numbers.TABLE.length_m",
        "toy.user.HALF_GATE_M", "toy.numbers.is_long", "toy.numbers.is_never_asked", "toy.user.turned",
    }  # fmt: skip
    answer = toy[1].answer
    assert answer() == -1.0
    for label, expected in (
        ("toy.numbers.GATE_M", 0.5), ("toy.user.HALF_GATE_M", -0.5), ("toy.numbers.TABLE.length_m", -3.0), ("toy.numbers.UNUSED_S", -1.0),
    ):  # fmt: skip
        one = found[label]
        graph, usual = ablate.Imports(toy), one.value
        graph.put(one.module, one.name, ablate.mapped(usual, lambda v: 1.5 * v, one.column))
        assert answer() == expected, label
        graph.put(one.module, one.name, usual)
        assert answer() == -1.0
    ablate.Imports(toy).put("toy.user", "turned", found["toy.user.turned"].value)
    assert answer() == 7.0


def test_stages_are_functions_of_the_pipeline_and_everything_belongs_to_one():
    assert all(hasattr(*ablate.place_of(name)) for functions, _, _ in ablate.STAGES.values() for name in functions)
    found = list(ablate.variations(Config()))
    assert {v.stage for v in found} == set(ablate.STAGES)
    labels = {v.label for v in found}
    assert {"track.max_gap_s", "agents.judge.TOUCHING", "datatypes.categories.CATEGORY.max_size_m"} <= labels
