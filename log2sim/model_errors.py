"""Errors of pydantic models as one line that names the key, what was found and what the model's JSON Schema expects."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

SHOWN_CHARACTERS = 80


def first_problem(error: ValidationError, model: type[BaseModel]) -> str:
    """Describe the first error of a document, unknown keys before all others.

    Parameters
    ----------
    error : ValidationError
        What `model.model_validate` raised.
    model : type
        The model; its JSON Schema tells which keys and values are possible.

    Returns
    -------
    str
        Such as "unknown key 'agent[0].colour'; did you mean 'agent[0].color'?" or "'rate_hz' is 0, expected a number
        from 0.1 to 200".
    """
    problems = error.errors(include_url=False)
    problem = next((p for p in problems if p["type"] == "extra_forbidden"), problems[0])
    location, found, schema = list(problem["loc"]), problem["input"], model.model_json_schema()
    if problem["type"] == "value_error":
        return str(problem["ctx"]["error"])
    if problem["type"] == "extra_forbidden":
        known = list(_schema_at(schema, location[:-1]).get("properties", {}))
        near = difflib.get_close_matches(str(location[-1]), known, 1)
        hint = f"; did you mean '{_key([*location[:-1], near[0]])}'?" if near else f"; known: {', '.join(known)}"
        return f"unknown key '{_key(location)}'{hint}"
    if problem["type"] == "missing" and isinstance(location[-1], str):
        return f"'{_key(location)}' is missing"
    if problem["type"] == "missing":  # a list that is too short
        location = location[:-1]
    expected = _schema_at(schema, location)
    if isinstance(found, list | tuple) and expected.get("type") == "array":
        return f"'{_key(location)}' has {len(found)} values, expected {_count(expected)}"
    text = repr(found) if len(repr(found)) <= SHOWN_CHARACTERS else f"{repr(found)[:SHOWN_CHARACTERS]}..."
    wanted = "a finite number" if problem["type"] == "finite_number" else _expected(expected)
    return f"'{_key(location)}' is {text}, expected {wanted}" if location else str(problem["msg"])


def _key(location: Sequence[Any]) -> str:
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    return text.removeprefix(".")


def _schema_at(schema: dict[str, Any], location: Sequence[Any]) -> dict[str, Any]:
    """Sub-schema that describes the value at a location; of alternatives the first."""
    node = schema
    for part in [None, *location]:
        if isinstance(part, str):
            node = node.get("properties", {}).get(part) or _schema_of_free_keys(node)
        elif isinstance(part, int):
            places = node.get("prefixItems", [])
            node = places[part] if part < len(places) else node.get("items", {})
        if "anyOf" in node:
            node = node["anyOf"][0]
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rpartition("/")[2]]
    return node


def _schema_of_free_keys(node: dict[str, Any]) -> dict[str, Any]:
    """Sub-schema of the values of a table whose keys are free; empty without one."""
    schemas = [*node.get("patternProperties", {}).values(), node.get("additionalProperties")]
    return next((schema for schema in schemas if isinstance(schema, dict)), {})


def _count(schema: dict[str, Any]) -> str:
    low, high = schema.get("minItems", 0), schema.get("maxItems")
    return f"{low} or more" if high is None else f"{low}" if low == high else f"{low} to {high}"


def _expected(schema: dict[str, Any]) -> str:
    if "enum" in schema:
        return "one of " + ", ".join(str(v) for v in schema["enum"])
    kind = str(schema.get("type", ""))
    if kind in ("number", "integer"):
        low = schema.get("minimum", schema.get("exclusiveMinimum"))
        high = schema.get("maximum", schema.get("exclusiveMaximum"))
        limits = [] if low is None else [f" from {low:.10g}"]
        limits += [] if high is None else [f" to {high:.10g}"]
        return ("a whole number" if kind == "integer" else "a number") + "".join(limits)
    if kind == "object" and "properties" in schema:
        return f"a table with {', '.join(schema['properties'])}"
    if kind == "string" and "pattern" in schema:
        return "letters, digits, '_' and '-' only"
    return {"string": "text", "array": "a list", "object": "a table", "boolean": "true or false"}.get(kind, kind)
