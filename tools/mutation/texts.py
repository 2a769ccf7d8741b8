"""Damage to lines and numbers of text: tables of words, CSV, and attributes of XML."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mutation.damage import Damage, Mutation, Place, pick

TEXT = (".txt", ".csv", ".json", ".xosc", ".xml", ".yaml")
TABLES = (".txt", ".csv")
# No quantity of a log has such a value: visible wherever one of them stands for a number.
IMPOSSIBLE = (
    "nan", "NaN", "inf", "-Infinity", "1e308", "-1e308", "1e400", "9223372036854775807", "-9223372036854775808",
    "9" * 40, "", "null", "x", "0x10", "1,5", "1_000", "--1", "1e", "\u0663", "'", "true", "9" * 5000,
)  # fmt: skip
TELLING_ORDER = ("timestamps", "index.csv", "poses.csv")
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")


def cut_is_visible(data: bytes, keep: int) -> bool:
    """Whether the last line that is kept has fewer fields than it had."""
    line = data[:keep].rpartition(b"\n")[2]
    whole = data[keep - len(line) :].partition(b"\n")[0]
    return bool(line.strip()) and len(re.split(rb"[\s,]+", line.strip())) < len(re.split(rb"[\s,]+", whole.strip()))


def replace_number(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    text = file.read_text(encoding="utf-8")
    found = list(_NUMBER.finditer(text))
    if not found:
        return None
    match = found[rng.integers(len(found))]
    value = str(pick(rng, IMPOSSIBLE))
    file.write_text(text[: match.start()] + value + text[match.end() :], encoding="utf-8")
    line = text.count("\n", 0, match.start()) + 1
    return Damage(f"line {line}: {match.group()} is {value[:50]!r}", file.suffix != ".yaml")


def change_number(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Another value of the same kind: its opposite, zero, or ten times as much."""
    text = file.read_text(encoding="utf-8")
    found = list(_NUMBER.finditer(text))
    if not found:
        return None
    match = found[rng.integers(len(found))]
    old = match.group()
    value = str(pick(rng, (f"-{old}".replace("--", ""), "0", f"{old[:1]}{old[1:2] or '0'}{old[1:]}", "-1", "1e-300")))
    file.write_text(text[: match.start()] + value + text[match.end() :], encoding="utf-8")
    return Damage(f"{old} is {value}", False)


def remove_line(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    lines, at = draw_line(rng, file)
    if not lines:
        return None
    file.write_text("".join(lines[:at] + lines[at + 1 :]), encoding="utf-8")
    # A header, or the line that pairs with a file; any other row may never have been there.
    visible = (file.suffix == ".csv" and at == 0) or file.name.startswith("timestamps") or "calib" in str(file)
    return Damage(f"line {at + 1} of {len(lines)} removed", visible)


def draw_line(rng: np.random.Generator, file: Path) -> tuple[list[str], int]:
    """Lines of a file with their ends, and the index of one of them, 0 for an empty file."""
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    return lines, int(rng.integers(len(lines))) if lines else 0


def cut_line(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    lines, at = draw_line(rng, file)
    if not lines:
        return None
    separator = "," if file.suffix == ".csv" else " "
    fields = lines[at].rstrip("\n").split(separator)
    if len(fields) < 2:
        return None
    kept = int(rng.integers(1, len(fields)))
    lines[at] = separator.join(fields[:kept]) + "\n"
    file.write_text("".join(lines), encoding="utf-8")
    return Damage(f"line {at + 1} cut to {kept} of {len(fields)} fields", True)


def repeat_line(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    lines, at = draw_line(rng, file)
    if not lines:
        return None
    file.write_text("".join(lines[: at + 1] + lines[at:]), encoding="utf-8")
    # Two boxes in one place may be two objects for layouts without tracks.
    return Damage(f"line {at + 1} occurs twice", file.name.startswith(TELLING_ORDER))


def swap_lines(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    if len(lines) < 3:
        return None
    a, b = rng.choice(np.arange(1, len(lines)), 2, replace=False)
    lines[a], lines[b] = lines[b], lines[a]
    file.write_text("".join(lines), encoding="utf-8")
    return Damage(f"lines {a + 1} and {b + 1} are exchanged", False)


def add_field(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    lines, at = draw_line(rng, file)
    if not lines:
        return None
    lines[at] = lines[at].rstrip("\n") + ("," if file.suffix == ".csv" else " ") + "1.5\n"
    file.write_text("".join(lines), encoding="utf-8")
    return Damage(f"line {at + 1} has a field more", file.suffix == ".csv")


def encode_otherwise(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """A byte order mark, other line ends or another encoding; the content stays."""
    text = file.read_text(encoding="utf-8")
    kind = str(pick(rng, ("utf-8-sig", "utf-16", "latin-1", "crlf", "cr")))
    data = (
        text.replace("\n", "\r\n" if kind == "crlf" else "\r").encode() if kind.startswith("cr") else text.encode(kind)
    )
    file.write_bytes(data)
    return Damage(f"written as {kind}", kind == "utf-16")


LINES = (
    Mutation(replace_number, (*TABLES, ".yaml"), 6.0), Mutation(change_number, (*TABLES, ".yaml"), 1.0),
    Mutation(remove_line, TABLES), Mutation(cut_line, TABLES, 2.0), Mutation(repeat_line, TABLES), Mutation(swap_lines, TABLES),
    Mutation(add_field, TABLES), Mutation(encode_otherwise, TEXT),
)  # fmt: skip


# Written as they are, without quotes, for values that JSON has no words for.
RAW = "@@raw:"
IMPOSSIBLE_VALUES: tuple[Any, ...] = (
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
    old, holder[key] = holder[key], pick(rng, IMPOSSIBLE_VALUES)
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


_ATTRIBUTE = re.compile(r'(\w+)="([^"]*)"')
_EMPTY_ELEMENT = re.compile(r"[ \t]*<(\w+)[^<>]*/>\n?")
_XML_NUMBER = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?")
# What a program that reads trajectories has no use for.
UNUSED = ("revMajor", "revMinor", "date", "author", "mass", "frontAxle")


def replace_attribute(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    text = file.read_text(encoding="utf-8")
    found = [m for m in _ATTRIBUTE.finditer(text) if _XML_NUMBER.fullmatch(m[2])]
    if not found:
        return None
    match = found[rng.integers(len(found))]
    value = str(pick(rng, IMPOSSIBLE)).replace("'", "&apos;")
    file.write_text(text[: match.start(2)] + value + text[match.end(2) :], encoding="utf-8")
    return Damage(f"{match[1]}: {match[2]} is {value[:40]!r}", True)


def change_attribute(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    text = file.read_text(encoding="utf-8")
    found = list(_ATTRIBUTE.finditer(text))
    match = found[rng.integers(len(found))]
    value = str(pick(rng, ("0", "-1", "x", "$x", "..", "a/b", "&#x202e;", "1e3", "true")))
    file.write_text(text[: match.start(2)] + value + text[match.end(2) :], encoding="utf-8")
    return Damage(f"{match[1]}: {match[2][:40]} is {value!r}", False)


def remove_attribute(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    text = file.read_text(encoding="utf-8")
    found = list(_ATTRIBUTE.finditer(text))
    match = found[rng.integers(len(found))]
    file.write_text(text[: match.start()] + text[match.end() :], encoding="utf-8")
    return Damage(f"{match[1]} removed", False)


def repeat_attribute(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    text = file.read_text(encoding="utf-8")
    found = list(_ATTRIBUTE.finditer(text))
    match = found[rng.integers(len(found))]
    file.write_text(f"{text[: match.end()]} {match[0]}{text[match.end() :]}", encoding="utf-8")
    return Damage(f"{match[1]} occurs twice", True)


def change_elements(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    text = file.read_text(encoding="utf-8")
    found = list(_EMPTY_ELEMENT.finditer(text))
    if not found:
        return None
    match = found[rng.integers(len(found))]
    kind = int(rng.integers(3))
    other = ("", match[0] * 2, match[0].replace(f"<{match[1]}", "<Unknown"))[kind]
    file.write_text(text[: match.start()] + other + text[match.end() :], encoding="utf-8")
    return Damage(f"<{match[1]}> {('removed', 'occurs twice', 'is called Unknown')[kind]}", False)


def add_entities(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Entities that grow, that read a file or ask a server."""
    secret = place.outside / "secret.txt"
    secret.write_text("secret")
    laughs = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 12))
    inner = str(pick(rng, (
        f'<!ENTITY l0 "ha">{laughs}', f'<!ENTITY l11 SYSTEM "file://{secret}">', '<!ENTITY l11 SYSTEM "http://127.0.0.1:9/x">',
        f'<!ENTITY % p SYSTEM "file://{secret}"> %p; <!ENTITY l11 "x">', '<!ENTITY l11 "&l11;">',
    )))  # fmt: skip
    text = file.read_text(encoding="utf-8")
    head, _, rest = text.partition("<OpenSCENARIO")
    used = rest.replace('description="', 'description="&l11;', 1) if rng.random() < 0.7 else rest
    file.write_text(f"{head}<!DOCTYPE OpenSCENARIO [{inner}]>\n<OpenSCENARIO{used}", encoding="utf-8")
    return Damage(f"declares {inner[:60]}", True)


def nest_elements(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    depth = int(pick(rng, (100, 5000, 300_000)))
    text = file.read_text(encoding="utf-8")
    at = text.find("<Storyboard")
    file.write_text(f"{text[:at]}{'<a>' * depth}{'</a>' * depth}{text[at:]}", encoding="utf-8")
    return Damage(f"{depth} elements in each other", False)


XML = tuple(
    Mutation(function, (".xosc",), weight)
    for function, weight in (
        (replace_attribute, 8.0), (change_attribute, 3.0), (remove_attribute, 2.0), (repeat_attribute, 1.0), (change_elements, 3.0),
        (add_entities, 2.0), (nest_elements, 0.5),
    )
)  # fmt: skip
