"""Columns are checked as a whole; the plain validator says what has to come of it."""

from __future__ import annotations

from typing import Any

import pytest
from jsonschema import Draft202012Validator

from log2sim.errors import ScenarioError
from log2sim.files import documents

COLUMN = {"type": "array", "minItems": 1, "maxItems": 5, "items": {"type": "number", "minimum": -10, "maximum": 10}}
FLAGS = {"type": "array", "items": {"type": "boolean"}}
WHOLE = {"type": "array", "items": {"type": "integer", "minimum": 0}}
ABOVE = {"type": "array", "items": {"type": "number", "exclusiveMinimum": 0}}
NAMES = {"type": "array", "items": {"type": "string"}}


@pytest.mark.parametrize(
    "expected", [COLUMN, FLAGS, WHOLE, ABOVE, NAMES], ids=["column", "flags", "whole", "above", "names"]
)
@pytest.mark.parametrize(
    "values",
    [
        [], [1.0], [1, 2.5, -10], [10.0, 10], [1.0, 10.1, 2.0], [-10.5, 0.0], [1.0, True], [False, True], [1.0, "2"], [1.0, None],
        [[1.0]], [0.0, 1.0], [0, 1], [1.0, 2.0, 3.0], [-1, 3], [1e300], [0] * 6, ["a"], "text", None, 3.0, {"0": 1.0},
    ],
    ids=str,
)  # fmt: skip
def test_a_column_is_judged_as_by_the_plain_validator(
    expected: dict[str, Any], values: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(documents, "load_schema", lambda name: {"properties": {"values": expected}})
    problem = next(Draft202012Validator({"properties": {"values": expected}}).iter_errors({"values": values}), None)
    if problem is None:
        documents.check({"values": values}, "any", ScenarioError)
    else:
        with pytest.raises(ScenarioError) as caught:
            documents.check({"values": values}, "any", ScenarioError)
        assert problem.message in str(caught.value)
        assert str(caught.value).startswith("values")
