"""Files written whole or not at all, and paths of a log that stay inside it."""

from __future__ import annotations

import json
import math
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from log2sim.errors import ConfigError, LogError

JSON_LIMIT_BYTES = 512 * 1024 * 1024


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


def write_json(path: Path | str, value: Any) -> None:
    """Write JSON (no NaN, no infinity), whole or not at all."""
    with replaced(path) as temporary:
        temporary.write_text(json.dumps(value, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def read_json(path: Path | str, error: type[LogError] = LogError) -> Any:
    """Read a JSON file; anything wrong with it becomes `error` naming the file and the place."""
    path = Path(path)
    if not path.is_file():
        raise error(f"{path}: no such file")
    if path.stat().st_size > JSON_LIMIT_BYTES:
        raise error(f"{path}: {path.stat().st_size} bytes, more than the {JSON_LIMIT_BYTES} that a JSON file may have")
    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except json.JSONDecodeError as problem:
        raise error(f"{path}: not valid JSON at line {problem.lineno}, column {problem.colno}: {problem.msg}") from None
    except (UnicodeDecodeError, RecursionError, ValueError) as problem:
        raise error(f"{path}: not valid JSON: {problem}") from None


def _refuse_constant(word: str) -> float:
    raise ValueError(f"{word} is not a number that JSON allows; write null or leave the value out")


def inside(root: Path, relative: str, what: str) -> Path:
    """Resolve a path that a log names, and refuse one that leaves the log's folder (also through a symbolic link)."""
    candidate = root / relative
    resolved = candidate.resolve()
    if Path(relative).is_absolute() or not resolved.is_relative_to(root.resolve()):
        raise LogError(f"{what}: path '{relative}' leaves the log folder; use a path relative to it, without '..'")
    return resolved


def rounded(value: float, digits: int) -> float | None:
    """A float for JSON with so many decimals; None when it is not finite."""
    return round(float(value), digits) if math.isfinite(value) else None
