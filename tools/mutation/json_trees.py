"""Damage to JSON documents: values, keys and structure."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mutation.damage import Damage, Mutation, Place, pick

# Written as they are, without quotes, for values that JSON has no words for.
RAW = "@@raw:"
IMPOSSIBLE: tuple[Any, ...] = (
    f"{RAW}NaN@@", f"{RAW}Infinity@@", f"{RAW}-Infinity@@", 1e308, -1e308, f"{RAW}1e400@@", 2**63 - 1, -(2**63), 10**40,
    -(10**40), f"{RAW}{'9' * 5000}@@", None, "", "x", [], {}, [[1.0]], "1.5",
)  # fmt: skip
OTHER_TYPES: tuple[Any, ...] = (None, 1, -1.5, 10**40, [], {}, True, [None])
# Parts of a scenario in which any value may stand.
FREE_FORM = (".quality", ".provenance", ".homography")
# And what may be null there.
NULLABLE = (".map.", ".color")
DEPTHS = (100, 3000, 200_000)


def _damaged(change: Callable[[np.random.Generator, Any], tuple[str, bool] | None]) -> Any:
    """Make a mutation of a function that changes a document in place, or replaces what is in `{"": document}`."""

    def mutate(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
        root = {"": json.loads(file.read_text(encoding="utf-8"))}
        done = change(rng, root)
        if done is None:
            return None
        text = json.dumps(root[""])
        for part in set(_raw_parts(root)):
            text = text.replace(json.dumps(part), part.removeprefix(RAW).removesuffix("@@"))
        file.write_text(text, encoding="utf-8")
        return Damage(*done)

    mutate.__name__ = change.__name__
    return mutate


def _raw_parts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value] if value.startswith(RAW) else []
    items = [*value.keys(), *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else []
    return [part for item in items for part in _raw_parts(item)]


def _walk(rng: np.random.Generator, root: Any, wanted: Callable[[Any], bool]) -> tuple[Any, Any, str] | None:
    """A container and key at which a wanted value stands, and the path to it."""
    for _ in range(30):
        holder, key, path = root, "", ""
        while True:
            value = holder[key]
            if not isinstance(value, (dict, list)) or not value or rng.random() < 0.1:
                break
            keys = list(value) if isinstance(value, dict) else range(len(value))
            holder, key = value, keys[int(rng.integers(len(keys)))]
            path += f"[{key}]" if isinstance(holder, list) else f".{key}"
        if wanted(holder[key]) and path:
            return holder, key, path
    return None


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_valid(path: str, value: Any) -> bool:
    """Whether the format allows the value there."""
    return any(part in path for part in FREE_FORM) or (value is None and any(part in path for part in NULLABLE))


def replace_number_by_impossible(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    found = _walk(rng, root, _is_number)
    if found is None:
        return None
    holder, key, path = found
    old, holder[key] = holder[key], pick(rng, IMPOSSIBLE)
    return f"{path}: {old} is {str(holder[key])[:50]}", not _is_valid(path, holder[key])


def change_value(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    """Another number of the same kind, or a word of another meaning."""
    found = _walk(rng, root, lambda v: _is_number(v) or isinstance(v, str))
    if found is None:
        return None
    holder, key, path = found
    old = holder[key]
    words = (
        "other",
        "..",
        "../outside/canary",
        "/etc/passwd",
        "a\0b",
        "w" * 5000,
        "\u202e\ud800",
        "CON",
        "-",
        " ",
        "a/b",
    )
    holder[key] = pick(rng, (-old, 0, old * 10, 1e-300) if _is_number(old) else words)
    return f"{path}: {str(old)[:50]} is {str(holder[key])[:50]!r}", False


def replace_by_other_type(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    found = _walk(rng, root, lambda v: isinstance(v, (str, dict, list)) and bool(v))
    if found is None:
        return None
    holder, key, path = found
    old, holder[key] = holder[key], pick(rng, OTHER_TYPES)
    # An empty object or list instead of another is of the same type, and may have been so.
    visible = type(old) is not type(holder[key]) and not _is_valid(path, holder[key])
    return f"{path}: {type(old).__name__} is {str(holder[key])[:50]}", visible


def remove_key(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    found = _walk(rng, root, lambda v: isinstance(v, dict) and bool(v))
    if found is None:
        return None
    holder, key, path = found
    name = pick(rng, list(holder[key]))
    del holder[key][name]
    # Which keys a format may lack is its own matter: a reader cannot tell those from keys that were never there.
    return f"{path}.{name} removed", False


def repeat_key(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    """The key once more, last, with another value."""
    found = _walk(rng, root, lambda v: isinstance(v, dict) and bool(v))
    if found is None:
        return None
    holder, key, path = found
    name = pick(rng, list(holder[key]))
    old = holder[key][name]
    holder[key][f'{RAW}"{name}"@@'] = old * 2 + 1 if _is_number(old) else old
    return f"{path}.{name} occurs twice", _is_number(old)


def remove_item(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    return _change_list(rng, root, lambda values, k: values.pop(k), "removed")


def repeat_item(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    return _change_list(rng, root, lambda values, k: values.insert(k, values[k]), "occurs twice")


def empty_list(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    return _change_list(rng, root, lambda values, k: values.clear(), "and all others are gone")


def shuffle_list(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    return _change_list(rng, root, lambda values, k: values.reverse(), "and all others are in reverse order")


def _change_list(
    rng: np.random.Generator, root: Any, change: Callable[[list[Any], int], object], word: str
) -> tuple[str, bool] | None:
    found = _walk(rng, root, lambda v: isinstance(v, list) and bool(v))
    if found is None:
        return None
    holder, key, path = found
    at = int(rng.integers(len(holder[key])))
    # A vector of another length shows; a list of records may have any.
    fixed = _is_number(holder[key][0]) and len(holder[key]) <= 9 and "reverse" not in word
    change(holder[key], at)
    return f"{path}[{at}] {word}", fixed


def nest_deeply(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    found = _walk(rng, root, lambda v: True)
    depth = DEPTHS[rng.integers(len(DEPTHS))]
    if found is None:
        return None
    holder, key, path = found
    holder[key] = f"{RAW}{'[' * depth}{']' * depth}@@"
    return f"{path} is {depth} lists in each other", True


def add_unknown_key(rng: np.random.Generator, root: Any) -> tuple[str, bool] | None:
    found = _walk(rng, root, lambda v: isinstance(v, dict))
    if found is None:
        return None
    holder, key, path = found
    holder[key][str(pick(rng, ("unknown", "__proto__", "__class__", "", "k" * 10_000)))] = 1
    return f"{path} has an unknown key", False


TREES = tuple(
    Mutation(_damaged(change), (".json",), weight)
    for change, weight in (
        (replace_number_by_impossible, 6.0), (change_value, 2.0), (replace_by_other_type, 3.0), (remove_key, 2.0),
        (repeat_key, 1.0), (remove_item, 1.0), (repeat_item, 1.0), (empty_list, 1.0), (shuffle_list, 0.5), (nest_deeply, 0.5),
        (add_unknown_key, 0.5),
    )
)  # fmt: skip
