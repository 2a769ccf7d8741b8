"""The sensitivity tool finds thresholds by itself, and tells those that matter from those that nobody uses."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
import sensitivity
import thresholds

pytestmark = pytest.mark.slow

TOY = """
from dataclasses import dataclass
import numpy as np
GATE_M = 2.0
UNUSED_S, BOTH_MPS = 1.0, {"car": 3.0, "truck": 4.0}
MIN_COUNT: int = 2
DERIVED = GATE_M * GATE_M
names = 3.0
@dataclass(frozen=True)
class Row:
    label: str
    length_m: float
    size_m: tuple[float, float]
TABLE = {"car": Row("c", 4.0, (1.0, 2.0)), "truck": Row("t", 8.0, (3.0, 4.0))}
"""
USER = "from toy.numbers import GATE_M, TABLE\nHALF_GATE_M = 0.5 * GATE_M\ndef answer():\n    return HALF_GATE_M + TABLE['car'].length_m\n"


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A package whose answer depends on one constant, through a derived one in another module, and on one column."""
    (tmp_path / "toy").mkdir()
    for name, text in (("__init__", ""), ("numbers", TOY), ("user", USER)):
        (tmp_path / "toy" / f"{name}.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    for name in [n for n in sys.modules if n.split(".")[0] == "toy"]:
        del sys.modules[name]


def answers(threshold):
    thresholds.import_varied(threshold, 1.5, kept=lambda name: False)
    return importlib.import_module("toy.user").answer()


def test_constants_that_matter_are_told_from_those_nobody_uses(toy):
    found = thresholds.thresholds_in(["toy"])
    moved = dict(zip([t.label for t in found], thresholds.in_processes(answers, found)))
    assert moved == {
        "toy.numbers.GATE_M": 5.5, "toy.numbers.UNUSED_S": 5.0, "toy.numbers.BOTH_MPS": 5.0, "toy.numbers.MIN_COUNT": 5.0,
        "toy.numbers.TABLE.length_m": 7.0, "toy.numbers.TABLE.size_m": 5.0, "toy.user.HALF_GATE_M": 5.5,
    }  # fmt: skip
    assert importlib.import_module("toy.user").answer() == 5.0
    assert [t.unit for t in found[:4]] == ["m", "s", "m/s", ""]


def test_a_module_can_be_left_out(toy):
    assert [t.label for t in thresholds.thresholds_in(["toy"], ["toy.numbers"])] == ["toy.user.HALF_GATE_M"]


def test_whole_numbers_change_by_one_and_shares_stay_below_one():
    assert [thresholds.scaled(2, f) for f in (0.7, 1.3)] == [1, 3]
    assert thresholds.scaled(10, 1.3) == 13
    assert thresholds.scaled({"a": (0.9, 0.2)}, 1.3, share=True) == {"a": pytest.approx((0.95, 0.26))}
    assert thresholds.scaled(0.9, 1.3) == pytest.approx(1.17)
    np.testing.assert_allclose(thresholds.scaled(np.array([1.0, 2.0]), 0.7), [0.7, 1.4])
    assert thresholds.scaled("text", 0.7) == "text"
    assert thresholds.scaled(True, 0.7) is True


def test_the_methods_own_constants_are_found():
    labels = {t.label for t in thresholds.thresholds_in(["log2sim.tracking", "log2sim.datatypes.categories"])}
    assert {"datatypes.categories.CATEGORY.max_size_m", "tracking.forward.CONFIRMED_AGE_S"} <= labels


def test_the_report_orders_by_influence_and_lists_the_idle():
    usual = {"log": dict.fromkeys(sensitivity.RESOLUTION, 1.0)}
    matters, idle = (thresholds.Threshold("log2sim.a", n, 2.0) for n in ("MATTERS_M", "IDLE_M"))
    results = {
        "a.MATTERS_M": {"0.7": {"log": {**usual["log"], "recall": 0.9}}, "1.3": {"log": {}}},
        "a.IDLE_M": {"0.7": usual, "1.3": usual},
    }
    text = sensitivity.report(usual, [idle, matters], results)
    assert "| a.MATTERS_M | m | 2 | 100.0 | x1.3: fails |" in text
    assert "(1 of 2): a.IDLE_M." in text


def test_a_section_between_markers_is_replaced_and_the_rest_stays(tmp_path):
    path = tmp_path / "B.md"
    path.write_text(
        f"# Head\n{sensitivity.BEGIN}\nwords\n\n| figure |\nold\n{sensitivity.END}\ntail\n", encoding="utf-8"
    )
    sensitivity.write_between_markers(path, "| figure |\nnew")
    assert path.read_text(encoding="utf-8") == (
        f"# Head\n{sensitivity.BEGIN}\nwords\n\n| figure |\nnew\n{sensitivity.END}\ntail\n"
    )
