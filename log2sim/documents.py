"""Files written whole or not at all, and paths of a log that stay inside it."""

from __future__ import annotations

import json
import math
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from log2sim.errors import ConfigError, Log2SimError, LogError

JSON_LIMIT_BYTES = 512 * 1024 * 1024
_HALF_PAIR = re.compile(r"\\u[dD][89a-fA-F]")


@contextmanager
def replaced(path: Path | str) -> Iterator[Path]:
    """Yield a temporary name beside `path` that is renamed to it when the block ends well and removed when it does not."""
    target = Path(path)
    if target.is_dir():
        raise ConfigError(f"{target}: is a folder; give the name of a file")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{target.parent}: cannot be made a folder: {error.strerror}") from error
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise ConfigError(f"{target}: cannot be written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def refuse_existing(path: Path | str, *, overwrite: bool) -> None:
    """Raise `ConfigError` when `path` exists and may not be overwritten."""
    if not overwrite and Path(path).exists():
        raise ConfigError(f"{path}: exists already; choose another name or pass --overwrite")


def refuse_below_file(path: Path | str) -> None:
    """Raise `ConfigError` when what should be a folder above `path` is a file."""
    above = next((p for p in Path(path).parents if p.exists()), None)
    if above is not None and not above.is_dir():
        raise ConfigError(f"{path}: cannot be written, since {above} is a file and not a folder; choose another place")


def check_targets(*paths: Path | str | None, overwrite: bool) -> None:
    """Refuse output files that could not be written, before any work is done for them; None is skipped.

    Raises
    ------
    ConfigError
        For a file that exists and may not be replaced, a folder, a parent that is a file, or one name for two files.
    """
    targets = [Path(p) for p in paths if p is not None]
    for k, target in enumerate(targets):
        if target.is_dir():
            raise ConfigError(f"{target}: is a folder; give the name of a file")
        refuse_existing(target, overwrite=overwrite)
        refuse_below_file(target)
        if target.resolve() in [t.resolve() for t in targets[:k]]:
            raise ConfigError(
                f"{target}: two files would be written under this one name; choose another for one of them"
            )


def write_json(path: Path | str, value: Any) -> None:
    """Write JSON (no NaN, no infinity), whole or not at all."""
    with replaced(path) as temporary:
        temporary.write_text(json.dumps(value, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def read_json(path: Path | str, error: type[LogError] = LogError) -> Any:
    """Read a JSON file; anything wrong with it becomes `error` naming the file and the place."""
    path = Path(path)
    if path.is_dir():
        raise error(f"{path}: is a folder; expected a JSON file, such as the scenario.json that `reconstruct` writes")
    if not path.is_file():
        raise error(f"{path}: no such file")
    if path.stat().st_size > JSON_LIMIT_BYTES:
        raise error(f"{path}: {path.stat().st_size} bytes, more than the {JSON_LIMIT_BYTES} that a JSON file may have")
    try:
        text = path.read_text(encoding="utf-8")
        value = json.loads(text, parse_constant=_refuse, parse_float=_finite)
        if _HALF_PAIR.search(text):  # an escape may stand for half a surrogate pair, which no file can hold
            json.dumps(value, ensure_ascii=False).encode()
        return value
    except _NotFinite as problem:
        raise error(
            f"{path}: {_place_in(text)} is {problem}, expected a finite number; write one, or null where it may be absent"
        ) from None
    except json.JSONDecodeError as problem:
        raise error(f"{path}: not valid JSON at line {problem.lineno}, column {problem.colno}: {problem.msg}") from None
    except UnicodeEncodeError as problem:
        half = problem.object[problem.start : problem.end][:1]
        raise error(
            f"{path}: a text holds {half!a}, half a surrogate pair, which no file can; write the whole"
        ) from None
    except (UnicodeDecodeError, RecursionError, ValueError) as problem:
        raise error(f"{path}: not valid JSON: {problem}") from None


class _NotFinite(ValueError):
    """A number of a JSON file that is NaN, infinite or too large for a float64."""


def _refuse(word: str) -> float:
    raise _NotFinite(word[:40])


def _finite(word: str) -> float:
    value = float(word)
    return value if math.isfinite(value) else _refuse(word)


def _place_in(text: str) -> str:
    """Where the first number of a JSON text that is not finite stands."""
    try:
        return _place_not_finite(json.loads(text)) or "the document"
    except (ValueError, RecursionError):  # what follows it is no JSON either, or nested without end
        return "a number"


def _place_not_finite(value: Any) -> str | None:
    """Where the first number that is not finite stands, as "a.b[3]"; None when there is none."""
    if isinstance(value, float):
        return None if math.isfinite(value) else ""
    if not isinstance(value, (dict, list)):
        return None
    for key, item in value.items() if isinstance(value, dict) else enumerate(value):
        place = _place_not_finite(item)
        if place is not None:
            step = f"[{key}]" if isinstance(key, int) else f"{key}"
            return step + ("." if place and not place.startswith("[") else "") + place
    return None


def inside(root: Path, relative: str, what: str) -> Path:
    """Resolve a path that a log names, and refuse one that leaves the log's folder (also through a symbolic link)."""
    try:
        resolved = (root / relative).resolve()
    except (OSError, RuntimeError, ValueError) as problem:  # a loop of symbolic links, a zero byte
        raise LogError(
            f"{what}: path {relative[:100]!r} cannot be followed: {problem}; give the path of a file"
        ) from None
    if Path(relative).is_absolute() or not resolved.is_relative_to(root.resolve()):
        raise LogError(f"{what}: path '{relative}' leaves the log folder; use a path relative to it, without '..'")
    return resolved


def rounded(value: float, digits: int) -> float | None:
    """A float for JSON with so many decimals; None when it is not finite."""
    return round(float(value), digits) if math.isfinite(value) else None


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
