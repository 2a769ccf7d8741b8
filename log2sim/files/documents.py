"""JSON documents: atomic writing, strict reading, validation against `schemas/`; errors of models in one line.

Python itself also takes "1_000" and the digits of all scripts, which no writer of a log means.
"""

from __future__ import annotations

import difflib
import json
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import Field, fields
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from log2sim.errors import ConfigError, Log2SimError, LogError
from log2sim.files.inputs import read_file
from log2sim.files.outputs import claim, expect_new, put, temporary_beside

Entry = TypeVar("Entry")

MAX_SHOWN = 100
"""Letters of a value that `short_repr` shows."""


def is_plain(text: str) -> bool:
    """Return whether a text has nothing in it that Python, but no format of files, takes for a part of a number."""
    return text.isascii() and "_" not in text


def parse_float(text: str) -> float:
    """Parse a number, which may be infinite or NaN; `ValueError` for any other text."""
    if not is_plain(text):
        raise ValueError(f"could not convert string to float: {text[:40]!a}")
    return float(text)


def parse_int(text: str) -> int:
    """Parse a whole number; `ValueError` for any other text."""
    if not is_plain(text):
        raise ValueError(f"invalid whole number: {text[:40]!a}")
    return int(text)


def short_repr(value: Any) -> str:
    """Return a dataclass in one line, as its `__repr__`: arrays by shape and type, long values by their count.

    What a field defers is not read for it.
    """
    parts = (f"{f.name}={_short(vars(value).get(f.name))}" for f in fields(value) if f.repr)
    return f"{type(value).__name__}({', '.join(parts)})"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"<{value.shape} {value.dtype}>"
    if callable(value):
        return "..."
    if isinstance(value, (tuple, list, Mapping)) and len(value) > 1:
        text = repr(value) if all(isinstance(v, (str, int, float, type(None))) for v in value) else ""
        return text if 0 < len(text) <= MAX_SHOWN else f"<{len(value)} entries>"
    return repr(value)


_TO_JSON: dict[str, Callable[[Any], Any]] = {
    "float": float, "tuple[str, ...]": list, "Mapping[str, float]": dict, "Array": np.ndarray.tolist, "NDArray[np.str_]": np.ndarray.tolist,
}  # fmt: skip
_FROM_JSON: dict[str, Callable[[Any], Any]] = {
    "float": float, "tuple[str, ...]": tuple, "Array": partial(np.array, dtype=np.float64), "NDArray[np.str_]": partial(np.array, dtype=str),
}  # fmt: skip
"""By what the fields of dataclasses are annotated with."""


def to_entry(value: Any) -> dict[str, Any]:
    """Return a dataclass as the entry of a document."""
    return {f.name: _TO_JSON.get(str(f.type), lambda v: v)(getattr(value, f.name)) for f in fields(value)}


def from_entry(of: Callable[..., Entry], entry: Mapping[str, Any]) -> Entry:
    """Build a dataclass of an entry that keeps the schema."""
    named: tuple[Field[Any], ...] = fields(of)  # type: ignore[arg-type]
    return of(**{f.name: _FROM_JSON.get(str(f.type), lambda v: v)(entry[f.name]) for f in named})


class RepeatedKeysError(ValueError):
    """Keys of a JSON text that occur twice in one object; the text says how many, and the first of them."""


def parse_unique(text: str, **hooks: Any) -> Any:
    """Parse a JSON text in which no key occurs twice in one object, with `json.loads`' parsers of numbers as `hooks`.

    Raises `RepeatedKeysError` for keys that do; all others are found first; `ValueError` for what is no JSON.
    """
    repeated: list[str] = []
    value = unique_decoder(repeated, **hooks).decode(text)
    require_unique(repeated)
    return value


def unique_decoder(repeated: list[str], **hooks: Any) -> json.JSONDecoder:
    """Return a decoder of JSON that adds the keys to `repeated` that occur twice in one object."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        value = dict(pairs)
        if len(value) < len(pairs):
            counts = Counter(key for key, _ in pairs)
            repeated.extend(key for key, count in counts.items() for _ in range(count - 1))
        return value

    return json.JSONDecoder(object_pairs_hook=unique, **hooks)


def require_unique(repeated: list[str]) -> None:
    """Raise `RepeatedKeysError` where there are keys that occur twice."""
    if repeated:
        count = f"{len(repeated)} keys occur" if len(repeated) > 1 else "a key occurs"
        advice = "remove the one of the two that is wrong"
        raise RepeatedKeysError(f"{count} twice in one object, first {repeated[0][:40]!a}; {advice}")


SHOWN_CHARACTERS = 80


def first_problem(error: ValidationError, model: type[BaseModel]) -> str:
    """Describe the first error of a document, unknown keys before all others; the model's JSON Schema tells what is possible.

    Returns such as "unknown key 'agent[0].colour'; did you mean 'agent[0].color'?" or "'rate_hz' is 0, expected a number from 0.1
    to 200".
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
    if problem["type"] == "missing":
        if isinstance(location[-1], str):
            return f"'{_key(location)}' is missing"
        location = location[:-1]  # a list that is too short
    expected = _schema_at(schema, location)
    if isinstance(found, list | tuple) and expected.get("type") == "array":
        low, high = expected.get("minItems", 0), expected.get("maxItems")
        count = f"{low} or more" if high is None else f"{low}" if low == high else f"{low} to {high}"
        return f"'{_key(location)}' has {len(found)} values, expected {count}"
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
            free = [*node.get("patternProperties", {}).values(), node.get("additionalProperties")]
            any_key: dict[str, Any] = next((schema for schema in free if isinstance(schema, dict)), {})
            node = node.get("properties", {}).get(part) or any_key
        elif isinstance(part, int):
            places = node.get("prefixItems", [])
            node = places[part] if part < len(places) else node.get("items", {})
        if "anyOf" in node:
            node = node["anyOf"][0]
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rpartition("/")[2]]
    return node


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


JSON_LIMIT_BYTES = 512 * 1024 * 1024
# Of a whole number; the largest float64 has 309.
MAX_DIGITS = 308
_SURROGATE_ESCAPE = re.compile(r"\\u[dD][89a-fA-F]")


@contextmanager
def replaced(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path`, renamed to it when the block succeeds and removed when it fails.

    Within `log2sim.files.outputs.together` it is renamed at the end of that. Raises `ConfigError` for a path that cannot be written.
    """
    target = Path(path)
    if target.is_dir():
        raise ConfigError(f"{target}: is a folder; give the name of a file")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{target.parent}: cannot be created as a folder: {error.strerror}") from error
    temporary, waits = temporary_beside(target), False
    try:
        yield temporary
        waits = put(temporary, target)
    except OSError as error:
        raise ConfigError(f"{target}: cannot be written: {error.strerror or error}") from error
    finally:
        if not waits:
            temporary.unlink(missing_ok=True)


def refuse_existing(path: Path | str, *, overwrite: bool) -> None:
    """Raise `ConfigError` when `path` exists and may not be overwritten."""
    if not overwrite and Path(path).exists():
        raise ConfigError(f"{path}: exists already; choose another name or pass --overwrite")


def refuse_folder(folder: Path, *, overwrite: bool, holding: str, kind: str) -> None:
    """Raise `ConfigError` for a folder with files that may not be replaced: never one that lacks the file that marks its kind."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    refuse_existing(folder, overwrite=overwrite)
    if not (folder / holding).is_file():
        raise ConfigError(f"{folder}: exists and is no {kind}, so it is not replaced; choose another name")


def refuse_below_file(path: Path | str) -> None:
    """Raise `ConfigError` when what should be a folder above `path` is a file, or may not be written in."""
    above = next((p for p in Path(path).parents if p.exists()), None)
    if above is not None and not above.is_dir():
        raise ConfigError(f"{path}: cannot be written, since {above} is a file and not a folder; choose another place")
    if above is not None and not os.access(above, os.W_OK | os.X_OK):
        raise ConfigError(f"{path}: cannot be written: you may not write in the folder {above}; choose another place")


def check_targets(*paths: Path | str | None, overwrite: bool) -> None:
    """Refuse output files that could not be written, before any work is done for them; None is skipped.

    Raises `ConfigError` for a file that exists and may not be replaced, a folder, a parent that is a file or may not be
    written in, or one name for two files.
    """
    targets = [Path(p) for p in paths if p is not None]
    for k, target in enumerate(targets):
        if target.is_dir():
            raise ConfigError(f"{target}: is a folder; give the name of a file")
        refuse_existing(target, overwrite=overwrite)
        refuse_below_file(target)
        if target.resolve() in [t.resolve() for t in targets[:k]]:
            advice = "choose another for one of them"
            raise ConfigError(f"{target}: two files would be written under this one name; {advice}")
    for target in targets:
        claim(target, overwrite=overwrite)
    if not overwrite:
        expect_new(targets)


def check_folder(folder: Path, *, overwrite: bool) -> None:
    """Refuse with `ConfigError` a folder that cannot be written, or that another run is writing, before any work is done for it."""
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder}: is a file; give the name of a folder")
    refuse_below_file(folder / "any file" if folder.exists() else folder)
    claim(folder, overwrite=overwrite)


def write_json(path: Path | str, value: Any) -> None:
    """Write JSON (no NaN, no infinity) atomically."""
    with replaced(path) as temporary:
        temporary.write_text(json.dumps(value, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def read_json(path: Path | str, error: type[LogError] = LogError) -> Any:
    """Read a JSON file.

    Raises `error`, with its position, for a file that is missing, too large, not valid JSON, or has a number that is not finite or
    keys that occur twice in one object: which of the two values is meant, no program can tell.
    """
    path = Path(path)
    if path.is_dir():
        raise error(f"{path}: is a folder; expected a JSON file, such as the scenario.json that `reconstruct` writes")
    data = read_file(path, JSON_LIMIT_BYTES, error)
    try:
        text = data.decode("utf-8")
        value = parse_unique(text, parse_constant=_refuse, parse_float=_finite, parse_int=_whole)
        if _SURROGATE_ESCAPE.search(text):  # JSON can escape an unpaired surrogate, which UTF-8 cannot encode
            json.dumps(value, ensure_ascii=False).encode()
        return value
    except _NotFinite as problem:
        try:
            place = _path_of_not_finite(json.loads(text)) or "the document"
        except (ValueError, RecursionError):  # another error follows it, or too deep nesting
            place = "a number"
        advice = "write one, or null where the schema allows it"
        raise error(f"{path}: {place} is {problem}, expected a finite number; {advice}") from None
    except RepeatedKeysError as problem:
        raise error(f"{path}: {problem}") from None
    except json.JSONDecodeError as problem:
        raise error(f"{path}: not valid JSON at line {problem.lineno}, column {problem.colno}: {problem.msg}") from None
    except UnicodeEncodeError as problem:
        half = f"{problem.object[problem.start : problem.end][:1]!a}, an unpaired surrogate"
        raise error(f"{path}: a text has {half}, which UTF-8 cannot encode; correct the text") from None
    except (UnicodeDecodeError, RecursionError, ValueError) as problem:
        raise error(f"{path}: not valid JSON: {problem}") from None


class _NotFinite(ValueError):
    """A number of a JSON file that is NaN, infinite or too large for a float64."""


def _refuse(word: str) -> float:
    raise _NotFinite(word[:40])


def _finite(word: str) -> float:
    value = float(word)
    return value if math.isfinite(value) else _refuse(word)


def _whole(word: str) -> int | float:
    """Parse a whole number; one that no float64 can hold overflows wherever it meets NumPy."""
    return int(word) if len(word) <= MAX_DIGITS else _refuse(word)


def _path_of_not_finite(value: Any) -> str | None:
    """Return the path of the first number that is not finite, as "a.b[3]"; None when there is none."""
    if isinstance(value, (float, int)):
        return None if abs(value) < 10**MAX_DIGITS else ""  # False for NaN
    if not isinstance(value, (dict, list)):
        return None
    for key, item in value.items() if isinstance(value, dict) else enumerate(value):
        place = _path_of_not_finite(item)
        if place is not None:
            step = f"[{key}]" if isinstance(key, int) else f"{key}"
            return step + ("." if place and not place.startswith("[") else "") + place
    return None


def rounded(value: float, digits: int) -> float | None:
    """Round a float to a number of decimals for JSON; None when it is not finite."""
    return round(float(value), digits) if math.isfinite(value) else None


@cache
def load_schema(name: str) -> dict[str, Any]:
    """Load a schema by name, such as "scenario-1"."""
    package = Path(__file__).resolve().parents[1]
    folder = package / "schemas"  # of an installation; a checkout has them at its top level
    file = (folder if folder.is_dir() else package.parent / "schemas") / f"{name}.json"
    document: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return document


def kind_of(document: Any) -> str | None:
    """Name the kind of file of log2sim that a document is, by its version or format, such as "replay"; None for what is none."""
    keys = document if isinstance(document, dict) else {}
    if str(keys.get("format")).startswith("log2sim-"):
        return str(keys["format"]).removeprefix("log2sim-")
    return next(
        (str(key).removesuffix("_version").replace("_", "-") for key in keys if str(key).endswith("_version")), None
    )


def check(document: Any, name: str, error: type[Log2SimError]) -> None:
    """Validate a document against a schema; `error` names the first field that violates it and what was expected there."""
    problem = next(_validator()(load_schema(name)).iter_errors(document), None)
    if problem is None:
        return
    place = _key(list(problem.absolute_path)) or "the document"
    message = problem.message if len(problem.message) < 200 else f"{problem.message[:80]} ... {problem.message[-100:]}"
    raise error(f"{place}: {message}")


@cache
def _validator() -> Any:
    """Return a validator that checks columns of plain numbers at once: item by item, a long scenario takes seconds."""
    from jsonschema import Draft202012Validator
    from jsonschema.validators import extend

    item_by_item = Draft202012Validator.VALIDATORS["items"]

    def items(validator: Any, expected: Any, values: Any, schema: Any) -> Any:
        if not _column_is_valid(expected, values):
            yield from item_by_item(validator, expected, values, schema)

    return extend(Draft202012Validator, {"items": items})


_COLUMN_TYPES: dict[str, set[type]] = {"number": {int, float}, "integer": {int}, "boolean": {bool}}


def _column_is_valid(expected: Any, values: Any) -> bool:
    """Whether values are a column of plain values that matches `expected`; False also where only the full check can tell."""
    if not isinstance(values, list) or not values or set(expected) - {"type", "minimum", "maximum"}:
        return False
    if not set(map(type, values)) <= _COLUMN_TYPES.get(expected.get("type", ""), set()):
        return False
    return bool(min(values) >= expected.get("minimum", -math.inf) and max(values) <= expected.get("maximum", math.inf))
