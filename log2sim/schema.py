"""Checks documents against the JSON Schemas that ship with the package."""

from __future__ import annotations

import json
import math
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from log2sim.errors import Log2SimError


@cache
def load_schema(name: str) -> dict[str, Any]:
    """The schema `name` ("log-1", "scenario-1", "replay-1", "report-1", "metrics-1", "bench-1") as a document."""
    beside_source = Path(__file__).resolve().parent.parent / "schemas" / f"{name}.json"
    if beside_source.is_file():
        return json.loads(beside_source.read_text(encoding="utf-8"))
    return json.loads(resources.files("log2sim_schemas").joinpath(f"{name}.json").read_text(encoding="utf-8"))


def check(document: Any, name: str, error: type[Log2SimError]) -> None:
    """Raise `error` naming the first field that breaks the schema and what was expected there."""
    problem = next(_validator()(load_schema(name)).iter_errors(document), None)
    if problem is None:
        return
    place = (
        "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in problem.absolute_path).lstrip(".")
        or "the document"
    )
    message = problem.message if len(problem.message) < 200 else f"{problem.message[:80]} ... {problem.message[-100:]}"
    raise error(f"{place}: {message}")


@cache
def _validator() -> Any:
    """A validator that looks at columns of plain numbers as a whole: one by one, a long scenario takes seconds."""
    from jsonschema import Draft202012Validator
    from jsonschema.validators import extend

    item_by_item = Draft202012Validator.VALIDATORS["items"]

    def items(validator: Any, expected: Any, values: Any, schema: Any) -> Any:
        if not _all_right(expected, values):
            yield from item_by_item(validator, expected, values, schema)

    return extend(Draft202012Validator, {"items": items})


PLAIN: dict[str, set[type]] = {"number": {int, float}, "integer": {int}, "boolean": {bool}}


def _all_right(expected: Any, values: Any) -> bool:
    """Whether values are a list of plain ones that keep to `expected`; False also where that takes a closer look."""
    if not isinstance(values, list) or not values or set(expected) - {"type", "minimum", "maximum"}:
        return False
    if not set(map(type, values)) <= PLAIN.get(expected.get("type", ""), set()):
        return False
    return min(values) >= expected.get("minimum", -math.inf) and max(values) <= expected.get("maximum", math.inf)
