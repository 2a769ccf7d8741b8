"""Ways to damage a file, and the order in which they are drawn.

Whether damage is *visible* is stated by each way and never guessed from the outcome. Visible is what a program can tell from the
input alone, without knowing the sound one: text where a number stands, numbers that are not finite or of more digits than any
quantity has, a missing or empty file that others name, a line without all of its fields, bytes under a check sum, a file that
ends too early. Not visible is whatever leaves a valid input with other content: a changed float, a label that is not there, two
records whose contents are exchanged, bytes of a format without check sums.
"""

from __future__ import annotations

import builtins
import gzip
import io
import json
import os
import pickle
import re
import shutil
import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from log_encoders import ros

from log2sim.logs.waymo.tfrecord import masked_crc32c
from mutation.bases import small_world

MAX_TRIES = 50
TEXT = (".txt", ".csv", ".json", ".xosc", ".xml", ".yaml")
TABLES = (".txt", ".csv")
# Every byte of the records is under a check sum.
CHECKED = (".npz", ".gz", ".png", ".tfrecord")
# Lengths, an index at the end, or an end mark: a file that ends too early can be told.
ENDED = (*CHECKED, ".json", ".xosc", ".jpg", ".feather", ".parquet", ".bag", ".mcap", ".db3", ".npy", ".pcd")


@dataclass(frozen=True)
class Damage:
    """What was done, in words; whether a program can see it; files outside of the input that may be read for it."""

    what: str
    visible: bool
    allowed: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Place:
    """The input to damage, a sound copy of it, and a folder beside it that nothing may read or write."""

    input: Path
    sound: Path
    outside: Path


Rng = np.random.Generator
Function = Callable[[Rng, Path, Place], "Damage | None"]
# New content, words and whether it shows; None where the way does not fit.
Changed = tuple[Any, str, bool] | None


@dataclass(frozen=True)
class Mutation:
    """A way to damage a file, of the files with `suffixes` (all without); None from it: not of this file."""

    function: Function
    suffixes: tuple[str, ...] = ()
    weight: float = 1.0

    @property
    def name(self) -> str:
        return self.function.__name__


def files_below(path: Path) -> list[Path]:
    """Regular files of an input, in order of their names."""
    return [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file() and not p.is_symlink())


def damage(rng: Rng, place: Place, mutations: Sequence[Mutation]) -> tuple[str, Damage]:
    """Apply one mutation to one file; each folder's kind of file is drawn as often as any other, however many there are."""
    groups: dict[tuple[Path, str], list[Path]] = {}
    for file in files_below(place.input):
        groups.setdefault((file.parent, "".join(file.suffixes[-2:])), []).append(file)
    for _ in range(MAX_TRIES):
        group = pick(rng, list(groups.values()))
        file = pick(rng, group)
        usable = [m for m in mutations if not m.suffixes or file.name.endswith(m.suffixes)]
        weights = np.array([m.weight for m in usable])
        chosen = usable[rng.choice(len(usable), p=weights / weights.sum())]
        done = chosen.function(rng, file, place)
        if done is not None:
            inner = file.relative_to(place.input) if file != place.input else Path(file.name)
            return f"{chosen.name} {inner}", done
    raise RuntimeError(f"no mutation fits to {place.input}")


def pick(rng: Rng, values: Sequence[Any]) -> Any:
    """One of some values, which may be of different types."""
    return values[int(rng.integers(len(values)))]


def changing(
    change: Callable[..., Changed], read: Callable[[Path], Any], write: Callable[[Path, Any], Any]
) -> Function:
    """A mutation of `change(rng, content, file)`, which gives other content."""

    def mutate(rng: Rng, file: Path, place: Place) -> Damage | None:
        changed = change(rng, read(file), file)
        if changed is None:
            return None
        content, words, visible = changed
        write(file, content)
        return Damage(words, bool(visible))

    mutate.__name__ = change.__name__
    return mutate


def of_bytes(change: Callable[[Rng, bytes, Path], Changed]) -> Function:
    return changing(change, Path.read_bytes, Path.write_bytes)


def of_text(change: Callable[[Rng, str, Path], Changed]) -> Function:
    return changing(change, lambda f: f.read_text("utf-8"), lambda f, text: f.write_text(text, "utf-8"))


# --- bytes of any file


def flip_bytes(rng: Rng, data: bytes, file: Path) -> Changed:
    if not data:
        return None
    # The first bytes hold headers, which a draw over the whole file would hardly ever hit.
    where = rng.integers(len(data) if rng.random() < 0.6 else min(len(data), 256), size=int(rng.integers(1, 16)))
    out = bytearray(data)
    for k in where:
        out[k] ^= 1 << int(rng.integers(8))
    return out, f"{len(where)} bits flipped, first at {where[0]}", file.name.endswith(CHECKED)


def cut_file(rng: Rng, data: bytes, file: Path) -> Changed:
    if len(data) < 2:
        return None
    keep = (
        int(rng.integers(1, len(data))) if rng.random() < 0.8 else len(data) - int(rng.integers(1, min(len(data), 20)))
    )
    if file.name.endswith(ENDED):
        visible = not data[keep:].isspace()
    elif file.suffix == ".bin":
        visible = keep % 4 != 0
    else:
        # The last line that is kept has fewer fields than it had.
        line = data[:keep].rpartition(b"\n")[2]
        whole = data[keep - len(line) :].partition(b"\n")[0]
        fewer = len(re.split(rb"[\s,]+", line.strip())) < len(re.split(rb"[\s,]+", whole.strip()))
        visible = file.suffix in TEXT and bool(line.strip()) and fewer
    return data[:keep], f"cut to {keep} of {len(data)} bytes", visible


def change_length(rng: Rng, data: bytes, file: Path) -> Changed:
    """Bytes inserted, deleted or repeated; appended ones may be room for growth."""
    if len(data) < 2:
        return None
    kind, at = int(rng.integers(3)), int(rng.integers(len(data)))
    count = int(rng.integers(1, min((65, 65, 4096)[kind], len(data) - at + 1))) if kind else int(rng.integers(1, 65))
    out = (data[:at] + rng.bytes(count) + data[at:], data[:at] + data[at + count :], data[: at + count] + data[at:])[
        kind
    ]
    within = at + count < len(data) if kind == 2 else True
    visible = count % 4 != 0 if file.suffix == ".bin" else within and file.name.endswith(CHECKED)
    return out, f"{count} bytes {('inserted', 'deleted', 'repeated')[kind]} at {at}", visible


def zero_bytes(rng: Rng, data: bytes, file: Path) -> Changed:
    if len(data) < 2:
        return None
    at = int(rng.integers(len(data)))
    count = min(int(rng.integers(1, 4096)), len(data) - at)
    return data[:at] + bytes(count) + data[at + count :], f"{count} bytes at {at} are zero", file.name.endswith(CHECKED)


def blow_up_integer(rng: Rng, data: bytes, file: Path) -> Changed:
    """Replace what may be a length or count, an integer below a million, by an extreme one."""
    starts = [k for k in range(min(len(data), 4096) - 4) if 0 < int.from_bytes(data[k : k + 4], "little") < 1_000_000]
    if file.suffix in TEXT or not starts:
        return None
    at, value = pick(rng, starts), pick(rng, (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF))
    return (
        data[:at] + value.to_bytes(4, "little") + data[at + 4 :],
        f"the integer at {at} is {value}",
        file.name.endswith(CHECKED),
    )


def replace_content(rng: Rng, data: bytes, file: Path) -> Changed:
    contents = {
        "nothing": b"", "one zero": b"\0", "spaces": b" \n" * 50, "noise": rng.bytes(2000), "zeros": bytes(3000),
        "a page": b"<!DOCTYPE html><html><body>404 Not Found</body></html>",
        "a git-lfs pointer": b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 123456\n",
    }  # fmt: skip
    name = pick(rng, list(contents))
    return contents[name], f"holds {name}", not (file.suffix in (".bin", ".txt") and not contents[name].strip())


RAW = tuple(
    Mutation(of_bytes(change), weight=weight)
    for change, weight in ((flip_bytes, 3.0), (cut_file, 2.0), (change_length, 3.0), (zero_bytes, 1.0), (blow_up_integer, 1.0),
                           (replace_content, 1.0))
)  # fmt: skip


# --- lines and numbers of text

# No quantity of a log has such a value: visible wherever one of them stands for a number.
IMPOSSIBLE = (
    "nan", "NaN", "inf", "-Infinity", "1e308", "-1e308", "1e400", "9223372036854775807", "-9223372036854775808",
    "9" * 40, "", "null", "x", "0x10", "1,5", "1_000", "--1", "1e", "\u0663", "'", "true", "9" * 5000,
)  # fmt: skip
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")


def put(match: re.Match[str], text: str, value: str, group: int = 0) -> str:
    """The text with another value in the place of what was matched."""
    return text[: match.start(group)] + value + text[match.end(group) :]


def replace_number(rng: Rng, text: str, file: Path) -> Changed:
    found = list(_NUMBER.finditer(text))
    if not found:
        return None
    match, value = pick(rng, found), pick(rng, IMPOSSIBLE)
    line = text.count("\n", 0, match.start()) + 1
    return put(match, text, value), f"line {line}: {match.group()} is {value[:50]!r}", file.suffix != ".yaml"


def change_number(rng: Rng, text: str, file: Path) -> Changed:
    """Another value of the same kind: its opposite, zero, or ten times as much."""
    found = list(_NUMBER.finditer(text))
    if not found:
        return None
    match = pick(rng, found)
    old = match.group()
    value = pick(rng, (f"-{old}".replace("--", ""), "0", f"{old[:1]}{old[1:2] or '0'}{old[1:]}", "-1", "1e-300"))
    return put(match, text, value), f"{old} is {value}", False


def change_line(rng: Rng, text: str, file: Path) -> Changed:
    """A line removed, cut, repeated, exchanged with another, or with a field more."""
    lines = text.splitlines(keepends=True)
    if not lines:
        return None
    at, separator = int(rng.integers(len(lines))), "," if file.suffix == ".csv" else " "
    line = lines[at].rstrip("\n")
    kind = pick(rng, ("removed", "cut", "cut", "twice", "exchanged", "longer"))
    # A header, or the line that pairs with a file; any other row may never have been there.
    visible = (file.suffix == ".csv" and at == 0) or file.name.startswith("timestamps") or "calib" in str(file)
    if kind == "removed":
        del lines[at]
    elif kind == "cut":
        parts = line.split(separator)
        if len(parts) < 2:
            return None
        lines[at], visible = separator.join(parts[: int(rng.integers(1, len(parts)))]) + "\n", True
    elif kind == "twice":
        # Two boxes in one place may be two objects for layouts without tracks.
        lines[at], visible = lines[at] * 2, file.name.startswith(("timestamps", "index.csv", "poses.csv"))
    elif kind == "exchanged":
        if len(lines) < 3:
            return None
        a, b = rng.choice(np.arange(1, len(lines)), 2, replace=False)
        lines[a], lines[b] = lines[b], lines[a]
        visible = False
    else:
        lines[at], visible = f"{line}{separator}1.5\n", file.suffix == ".csv"
    return "".join(lines), f"line {at + 1}: {kind}", visible


def encode_otherwise(rng: Rng, data: bytes, file: Path) -> Changed:
    """A byte order mark, other line ends or another encoding; the content stays."""
    text, kind = data.decode(), pick(rng, ("utf-8-sig", "utf-16", "latin-1", "crlf", "cr"))
    ends = {"crlf": "\r\n", "cr": "\r"}
    out = text.replace("\n", ends[kind]).encode() if kind in ends else text.encode(kind)
    return out, f"written as {kind}", kind == "utf-16"


LINES = (
    Mutation(of_text(replace_number), (*TABLES, ".yaml"), 6.0), Mutation(of_text(change_number), (*TABLES, ".yaml"), 1.0),
    Mutation(of_text(change_line), TABLES, 6.0), Mutation(of_bytes(encode_otherwise), TEXT),
)  # fmt: skip


# --- values, keys and lists of JSON

# Written as they are, without quotes, for values that JSON has no words for.
VERBATIM = "@@raw:"
IMPOSSIBLE_VALUES: tuple[Any, ...] = (
    f"{VERBATIM}NaN@@", f"{VERBATIM}Infinity@@", f"{VERBATIM}-Infinity@@", 1e308, -1e308, f"{VERBATIM}1e400@@", 2**63 - 1, -(2**63),
    10**40, -(10**40), f"{VERBATIM}{'9' * 5000}@@", None, "", "x", [], {}, [[1.0]], "1.5",
)  # fmt: skip
OTHER_WORDS = (
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


def write_json(file: Path, root: Any) -> None:
    text = json.dumps(root[""])
    file.write_text(re.sub(rf'"{VERBATIM}(.*?)@@"', lambda m: m[1].replace('\\"', '"'), text), encoding="utf-8")


def is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def value_of(wanted: Callable[[Any], bool]) -> Callable[[Callable[..., tuple[str, bool]]], Mutation]:
    """Make a mutation of a function `(rng, holder, key, path)` that changes a value in place, where a wanted one stands."""

    def decorate(change: Callable[..., tuple[str, bool]]) -> Function:
        def at_random(rng: Rng, root: Any, file: Path) -> Changed:
            for _ in range(30):
                holder, key, path = root, "", ""
                while True:
                    value = holder[key]
                    if not isinstance(value, (dict, list)) or not value or rng.random() < 0.1:
                        break
                    key = pick(rng, list(value) if isinstance(value, dict) else range(len(value)))
                    holder = value
                    path += f"[{key}]" if isinstance(holder, list) else f".{key}"
                if wanted(holder[key]) and path:
                    return root, *change(rng, holder, key, path)
            return None

        at_random.__name__ = change.__name__
        return changing(at_random, lambda f: {"": json.loads(f.read_text("utf-8"))}, write_json)

    return decorate


def is_allowed(path: str, value: Any) -> bool:
    """Whether a scenario's format allows the value there: free-form parts, and what may be null."""
    return any(p in path for p in (".quality", ".provenance", ".homography")) or (
        value is None and any(p in path for p in (".map.", ".color"))
    )


@value_of(is_number)
def replace_number_by_impossible(rng: Rng, holder: Any, key: Any, path: str) -> tuple[str, bool]:
    old, holder[key] = holder[key], pick(rng, IMPOSSIBLE_VALUES)
    return f"{path}: {old} is {str(holder[key])[:50]}", not is_allowed(path, holder[key])


@value_of(lambda v: is_number(v) or isinstance(v, str))
def change_value(rng: Rng, holder: Any, key: Any, path: str) -> tuple[str, bool]:
    old = holder[key]
    holder[key] = pick(rng, (-old, 0, old * 10, 1e-300) if is_number(old) else OTHER_WORDS)
    return f"{path}: {str(old)[:50]} is {str(holder[key])[:50]!r}", False


@value_of(lambda v: isinstance(v, (str, dict, list)) and bool(v))
def replace_by_other_type(rng: Rng, holder: Any, key: Any, path: str) -> tuple[str, bool]:
    old, holder[key] = holder[key], pick(rng, (None, 1, -1.5, 10**40, [], {}, True, [None]))
    # An empty object or list instead of another is of the same type, and may have been so.
    visible = type(old) is not type(holder[key]) and not is_allowed(path, holder[key])
    return f"{path}: {type(old).__name__} is {str(holder[key])[:50]}", visible


@value_of(lambda v: isinstance(v, dict) and bool(v))
def change_key(rng: Rng, holder: Any, key: Any, path: str) -> tuple[str, bool]:
    """A key removed, which a format may lack; once more with another value; or one that is not known."""
    part, kind = holder[key], int(rng.integers(3))
    name = pick(rng, list(part))
    if kind == 0:
        del part[name]
        return f"{path}.{name} removed", False
    if kind == 1:
        old = part[name]
        part[f'{VERBATIM}"{name}"@@'] = old * 2 + 1 if is_number(old) else old
        return f"{path}.{name} occurs twice", is_number(old)
    part[pick(rng, ("unknown", "__proto__", "__class__", "", "k" * 10_000))] = 1
    return f"{path} has an unknown key", False


@value_of(lambda v: isinstance(v, list) and bool(v))
def change_list(rng: Rng, holder: Any, key: Any, path: str) -> tuple[str, bool]:
    values, kind = holder[key], int(rng.integers(4))
    at = int(rng.integers(len(values)))
    # A vector of another length shows; a list of records may have any.
    fixed = is_number(values[0]) and len(values) <= 9 and kind < 3
    holder[key] = (values[:at] + values[at + 1 :], values[: at + 1] + values[at:], [], values[::-1])[kind]
    return (
        f"{path}[{at}] {('removed', 'occurs twice', 'and all others are gone', 'and all others are in reverse order')[kind]}",
        fixed,
    )


@value_of(lambda v: True)
def nest_deeply(rng: Rng, holder: Any, key: Any, path: str) -> tuple[str, bool]:
    depth = pick(rng, (100, 3000, 200_000))
    holder[key] = f"{VERBATIM}{'[' * depth}{']' * depth}@@"
    return f"{path} is {depth} lists in each other", True


TREES = tuple(
    Mutation(function, (".json",), weight)
    for function, weight in ((replace_number_by_impossible, 6.0), (change_value, 2.0), (replace_by_other_type, 3.0), (change_key, 3.5),
                             (change_list, 3.5), (nest_deeply, 0.5))
)  # fmt: skip


# --- attributes and elements of XML

_ATTRIBUTE = re.compile(r'(\w+)="([^"]*)"')
_EMPTY_ELEMENT = re.compile(r"[ \t]*<(\w+)[^<>]*/>\n?")
_XML_NUMBER = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?")


def change_attribute(rng: Rng, text: str, file: Path) -> Changed:
    """A number that is none, another value, removed, or twice."""
    match, kind = pick(rng, list(_ATTRIBUTE.finditer(text))), pick(rng, (0, 0, 0, 0, 1, 1, 2, 3))
    if kind == 0:
        if not _XML_NUMBER.fullmatch(match[2]):
            return None
        value = pick(rng, IMPOSSIBLE).replace("'", "&apos;")
        return put(match, text, value, 2), f"{match[1]}: {match[2]} is {value[:40]!r}", True
    if kind == 1:
        value = pick(rng, ("0", "-1", "x", "$x", "..", "a/b", "&#x202e;", "1e3", "true"))
        return put(match, text, value, 2), f"{match[1]}: {match[2][:40]} is {value!r}", False
    if kind == 2:
        return put(match, text, ""), f"{match[1]} removed", False
    return put(match, text, f"{match[0]} {match[0]}"), f"{match[1]} occurs twice", True


def change_elements(rng: Rng, text: str, file: Path) -> Changed:
    found = list(_EMPTY_ELEMENT.finditer(text))
    if not found:
        return None
    match, kind = pick(rng, found), int(rng.integers(3))
    other = ("", match[0] * 2, match[0].replace(f"<{match[1]}", "<Unknown"))[kind]
    return put(match, text, other), f"<{match[1]}> {('removed', 'occurs twice', 'is called Unknown')[kind]}", False


def nest_elements(rng: Rng, text: str, file: Path) -> Changed:
    depth, at = pick(rng, (100, 5000, 300_000)), text.find("<Storyboard")
    return f"{text[:at]}{'<a>' * depth}{'</a>' * depth}{text[at:]}", f"{depth} elements in each other", False


def add_entities(rng: Rng, file: Path, place: Place) -> Damage | None:
    """Entities that grow, that read a file or ask a server."""
    secret = place.outside / "secret.txt"
    secret.write_text("secret")
    laughs = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 12))
    inner = pick(rng, (
        f'<!ENTITY l0 "ha">{laughs}', f'<!ENTITY l11 SYSTEM "file://{secret}">', '<!ENTITY l11 SYSTEM "http://127.0.0.1:9/x">',
        f'<!ENTITY % p SYSTEM "file://{secret}"> %p; <!ENTITY l11 "x">', '<!ENTITY l11 "&l11;">',
    ))  # fmt: skip
    head, _, rest = file.read_text(encoding="utf-8").partition("<OpenSCENARIO")
    used = rest.replace('description="', 'description="&l11;', 1) if rng.random() < 0.7 else rest
    file.write_text(f"{head}<!DOCTYPE OpenSCENARIO [{inner}]>\n<OpenSCENARIO{used}", encoding="utf-8")
    return Damage(f"declares {inner[:60]}", True)


XML = (
    Mutation(of_text(change_attribute), (".xosc",), 14.0), Mutation(of_text(change_elements), (".xosc",), 3.0),
    Mutation(add_entities, (".xosc",), 2.0), Mutation(of_text(nest_elements), (".xosc",), 0.5),
)  # fmt: skip


# --- containers: archives of arrays, tables, images

EXTREMES = (np.nan, np.inf, -np.inf, 1e308, -1e30, 1e9)
BOMB_BYTES = 300_000_000
OBJECTS = "{'descr': '|O', 'fortran_order': False, 'shape': (4, 3), }"
HUGE_HEADER = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 3), }"
HEADERS = (
    HUGE_HEADER, OBJECTS,
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (3, 4611686018427387905), }",
    "{'descr': '|V1000000', 'fortran_order': False, 'shape': (100000, 3), }",
    "{'descr': [('x', '<f8'), ('y', '<f8'), ('z', '<f8')], 'fortran_order': False, 'shape': (4,), }",
    "{'descr': '<U500000', 'fortran_order': False, 'shape': (1000, 3), }",
    "{'descr': '<f8', 'fortran_order': True, 'shape': (4, 3, 2, 1), }",
    "{'descr': '<f8', 'fortran_order': 7, 'shape': '4', }",
    "{'descr': '<f8', 'shape': (4, 3), }",
    "__import__('os').mkdir('pwned')", "(" * 500 + ")" * 500, "{'descr': '<f8', 'fortran_order': False, 'shape': (4, 3)", "\0\n\t" * 30,
)  # fmt: skip


class Payload:
    """What runs a function when it is unpickled."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.made_by = function, arguments

    def __reduce__(self) -> Any:
        return self.made_by


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npy_with_header(header: str, data: bytes) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", min(len(header), 65535)) + header.encode()[:65535] + data


def archive(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as file:
        for name, data in members:
            file.writestr(name, data)
    return stream.getvalue()


def change_arrays(rng: Rng, file: Path, place: Place) -> Damage | None:
    """Other values, types, shapes and members; whatever is compressed stays consistent."""
    with np.load(file) as loaded:
        arrays = {name: loaded[name] for name in loaded.files}
    members = {k: npy(v) for k, v in arrays.items()}
    name, kind = pick(rng, list(arrays)), int(rng.integers(9))
    array = arrays[name].copy()
    if kind == 0 and array.dtype.kind == "f":
        value, rows = pick(rng, EXTREMES), rng.random(len(array)) < rng.choice([0.001, 0.3, 1.0])
        array[rows] = value
        new, words, visible = npy(array), f"{rows.sum()} rows are {value}", bool(rows.sum() > len(array) / 2)
    elif kind == 1 and array.dtype.kind == "i":
        limits = np.iinfo(array.dtype)
        value = min(int(pick(rng, (limits.max, limits.min, 10**9 + 1))), limits.max)
        array[int(rng.integers(len(array)))] = value
        new, words, visible = npy(array), f"a value is {value}", abs(value) > 10**9
    elif kind == 2:
        dtype = pick(rng, ("f2", "i8", "u1", "c16", "?", "U10", "O", "M8[ns]", "f16", ">f4"))
        new, words, visible = npy(array.astype(dtype)), f"is of type {dtype}", dtype not in ("f2", "f16", ">f4", "i8")
    elif kind == 3:
        other = pick(rng, (array[:0], array[:-1], array[..., None], np.concatenate([array] * 2), array[:1]))
        new, words, visible = npy(other), f"is {other.shape}", other.shape[1:] != array.shape[1:] or len(arrays) > 1
    elif kind == 4:
        new, words, visible = None, "is missing", name == "xyz_m"
    elif kind == 5:
        header = pick(rng, HEADERS)
        new, words, visible = npy_with_header(header, array.tobytes()), f"has the header {header[:60]!r}", True
    elif kind == 6:
        data = pickle.dumps(Payload(os.mkdir, str(place.outside / "pwned")))
        new, words, visible = npy_with_header(OBJECTS, data), "is a pickle that makes a folder", True
    elif kind == 7:
        new, words, visible = (
            npy_with_header(HUGE_HEADER, b"") + bytes(BOMB_BYTES),
            f"unpacks to {BOMB_BYTES} zeros",
            True,
        )
    else:
        new, words, visible = rng.bytes(300), "is noise", True
    rest = {**members, name: new}
    file.write_bytes(archive([(f"{k}.npy", v) for k, v in rest.items() if v is not None]))
    return Damage(f"{name} {words}", visible)


def change_archive(rng: Rng, data: bytes, file: Path) -> Changed:
    """Other compressions, an encrypted bit, a member twice, names that lead elsewhere."""
    with zipfile.ZipFile(io.BytesIO(data)) as loaded:
        members = [(i.filename, loaded.read(i)) for i in loaded.infolist()]
    out, kind = bytearray(data), int(rng.integers(6))
    if kind == 0:
        method = pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
        return archive(members, method), f"compressed by method {method}", False
    if kind == 1:
        out = bytearray(archive(members, pick(rng, (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))))
        out[len(out) // 3] ^= 0xFF
        return out, "compressed otherwise, a byte inverted", True
    if kind == 2:
        for mark, offset in ((b"PK\1\2", 8), (b"PK\3\4", 6)):
            out[out.find(mark) + offset] |= 1
        return out, "its first member is encrypted", True
    if kind == 3:
        method = int(rng.integers(1, 100))
        for mark, offset in ((b"PK\1\2", 10), (b"PK\3\4", 8)):
            at = out.find(mark) + offset
            out[at : at + 2] = method.to_bytes(2, "little")
        return out, f"its first member states the method {method}", method != 8
    if kind == 4:
        name = pick(rng, ("../../pwned.npy", "/tmp/pwned.npy", "xyz_m.npy/", "a" * 60_000))
        return archive([(name, b"x"), *members]), f"has a member {name[:30]}", False
    at = out.rfind(b"PK\5\6")
    out[at + 8 : at + 12] = b"\xff\xff\xff\xff"
    return out, "states 65535 members", False


def change_table_pickle(rng: Rng, file: Path, place: Place) -> Damage | None:
    """Payloads, deep nesting, and tables with other columns, types and values."""
    import pandas

    table = pandas.read_pickle(file)
    column, kind, target = pick(rng, list(table.columns)), int(rng.integers(10)), str(place.outside / "pwned")
    row = table.index[int(rng.integers(len(table)))] if len(table) else None
    visible: Any = True
    payloads = (Payload(os.mkdir, target), Payload(os.system, f"touch {target}"), Payload(builtins.eval, f"open({target!r}, 'w')"),
                Payload(builtins.open, target, "w"), Payload(np.load, target), [Payload(os.mkdir, target), table])  # fmt: skip
    if kind == 0:
        data, words = pickle.dumps(pick(rng, payloads)), "a pickle that runs a function"
    elif kind == 1:
        nested = b"(" * 100_000 + b"." if rng.random() < 0.5 else b"]" + b"]a" * 5 + b"\x85" * 100_000 + b"."
        data, words = b"\x80\x04" + nested, "deeply nested pickle"
    elif kind == 2:
        data, words = b"\x80\x04\x8e" + (2**62).to_bytes(8, "little") + b"abc.", "a pickle of 4 EiB"
    elif kind == 3 and row is not None:
        table[column] = table[column].astype(object)
        table.loc[row, column] = pick(rng, ("x", ""))
        data, words, visible = (
            pickle.dumps(table),
            f"{column} holds a word",
            column not in ("uuid", "label") and "attributes" not in column,
        )
    elif kind == 4 and table[column].dtype.kind == "f" and row is not None:
        table.loc[row, column] = pick(rng, EXTREMES)
        # Points that are not finite are misses; a cuboid has no such value.
        data, words, visible = (
            pickle.dumps(table),
            f"{column} is extreme",
            "cuboids" in str(file) and "rider" not in column,
        )
    elif kind == 5:
        data, words = pickle.dumps(table.drop(columns=[column])), f"{column} is missing"
        visible = not column.startswith(("attributes", "cuboids", "camera", "i", "stationary"))
    elif kind == 6:
        data, words, visible = pickle.dumps(table.iloc[:0]), "has no rows", False
    elif kind == 7:
        other = pick(rng, (table.to_dict(), table.values, [1, 2], None, "text", table[column]))
        data, words = pickle.dumps(other), f"is a {type(other).__name__}"
    elif kind == 8:
        data, words, visible = (
            pickle.dumps(pandas.concat([table, table])),
            "each row occurs twice",
            "cuboids" in str(file),
        )
    else:
        data, words = bytes(BOMB_BYTES), f"{BOMB_BYTES} zeros"
    file.write_bytes(gzip.compress(data, 1))
    return Damage(words, visible)


def change_image(rng: Rng, data: bytes, file: Path) -> Changed:
    """Sizes that need gigabytes, other sizes, and files of other kinds of images."""
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    height, width = image.shape[:2]
    kind, huge = int(rng.integers(6)), pick(rng, (65_535, 65_500, 30_000))
    if kind <= 1:
        return _with_size(data, huge, huge), f"states {huge} x {huge} pixels", True
    if kind == 2:
        size = pick(rng, (0, 1, 2))
        return _with_size(data, size, height), f"states a width of {size}", True
    if kind == 3:
        suffix = pick(rng, (".bmp", ".tiff", ".webp", ".png", ".jpg", ".ppm", ".jp2", ".hdr"))
        other = cv2.imencode(suffix, image.astype(np.float32) if suffix == ".hdr" else image)[1].tobytes()
        return other, f"is a {suffix} image", False
    if kind == 4:
        head = pick(rng, (f"P6 {huge} {huge} 255\n", f"P1 {huge} {huge}\n", "GIF89a\xff\xff\xff\xff",
                          f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {huge} +X {huge}\n"))  # fmt: skip
        return head.encode("latin-1") + bytes(100), "is another image format that states a huge size", True
    other = pick(
        rng, (image[: height // 2], cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), image[::2, ::2], image.transpose(1, 0, 2))
    )
    encoded = cv2.imencode(file.suffix, np.ascontiguousarray(other))[1].tobytes()
    return encoded, f"is {other.shape}", other.shape[:2] != (height, width)


def _with_size(data: bytes, width: int, height: int) -> bytes:
    """An image file that states another size: the header of PNG with its check sum, or of JPEG."""
    if data[:4] == b"\x89PNG":
        header = b"IHDR" + struct.pack(">II", width, height) + data[24:29]
        return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
    at = next((data.find(bytes([0xFF, m])) for m in (0xC0, 0xC2, 0xC1) if data.find(bytes([0xFF, m])) > 0), -1)
    return data if at < 0 else data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]


CONTAINERS = (
    Mutation(change_arrays, (".npz",), 8.0), Mutation(of_bytes(change_archive), (".npz",), 4.0),
    Mutation(change_table_pickle, (".pkl.gz",), 10.0), Mutation(of_bytes(change_image), (".png", ".jpg"), 3.0),
)  # fmt: skip


# --- tables and records: Arrow, SQLite, TFRecord, messages of ROS

EXTREME_VALUES: dict[str, tuple[Any, ...]] = {
    "f": (np.nan, np.inf, -np.inf, 1e308, -1e30), "i": (2**63 - 1, -(2**63), 2**31 - 1, -1),
}  # fmt: skip


def read_arrow(file: Path) -> Any:
    import pyarrow.feather
    import pyarrow.parquet

    # Read from bytes: a file that is mapped must not be written over.
    data = pyarrow.BufferReader(file.read_bytes())
    return pyarrow.feather.read_table(data) if file.suffix == ".feather" else pyarrow.parquet.read_table(data)


def write_arrow(file: Path, table: Any) -> None:
    import pyarrow.feather
    import pyarrow.parquet

    if file.suffix == ".feather":
        pyarrow.feather.write_feather(table, file, compression="lz4")
    else:
        pyarrow.parquet.write_table(table, file)


def change_cells(rng: Rng, table: Any, file: Path) -> Changed:
    """One cell, or a whole column, is extreme or null, of another type, or gone."""
    import pyarrow

    if not table.num_rows:
        return None
    where, at, kind = int(rng.integers(table.num_columns)), int(rng.integers(table.num_rows)), int(rng.integers(6))
    name, column = table.column_names[where], table.column(where)
    if kind <= 2:
        group = "f" if pyarrow.types.is_floating(column.type) else "i" if pyarrow.types.is_integer(column.type) else ""
        if not group and kind < 2:
            return None
        values, value = column.to_pylist(), pick(rng, EXTREME_VALUES[group]) if kind < 2 else None
        values[at] = value
        try:
            changed = pyarrow.array(values, column.type)
        except (pyarrow.ArrowInvalid, OverflowError):
            return None  # more than the type holds
        # Points may be misses; a measure of -1 may be one.
        visible = value != -1 and "lidar" not in str(file.parent.name)
        return table.set_column(where, name, changed), f"{name}[{at}] is {value}", visible
    if kind == 3:
        return table.drop_columns([name]), f"{name} is missing", "num_interior" not in name
    if kind == 4:
        words = pyarrow.array([str(v)[:20] for v in column.to_pylist()])
        return (
            table.set_column(where, name, words),
            f"{name} holds text",
            "uuid" not in name and column.type != pyarrow.string(),
        )
    return table.set_column(where, name, pyarrow.nulls(table.num_rows)), f"{name} is null", True


def change_rows(rng: Rng, table: Any, file: Path) -> Changed:
    import pyarrow

    if table.num_rows < 2:
        return None
    at, kind = int(rng.integers(table.num_rows)), int(rng.integers(4))
    rows = list(range(table.num_rows))
    kept = (rows[:at] + rows[at + 1 :], rows[: at + 1] + rows[at:], [], rows[::-1])[kind]
    return table.take(pyarrow.array(kept, pyarrow.int64())), f"row {at}: rows {kept[:4]}...", False


ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT"
MESSAGE, TOPIC = (f"WHERE id = (SELECT id FROM {table} LIMIT 1 OFFSET {{row}})" for table in ("messages", "topics"))
STATEMENTS = (
    (f"ALTER TABLE messages RENAME TO old; CREATE VIEW messages AS {ENDLESS} x AS id, 1 AS topic_id, x AS timestamp, x'00' AS data FROM n", True),
    (f"ALTER TABLE topics RENAME TO old; CREATE VIEW topics AS {ENDLESS} x AS id, 'a' AS name, 'b' AS type, 'cdr' AS serialization_format,"
     " '' AS offered_qos_profiles FROM n", True),
    ("DELETE FROM messages", True), ("DELETE FROM topics", True), (f"DELETE FROM topics {TOPIC}", True),
    ("UPDATE topics SET type = 'x/msg/Y'", True), (f"UPDATE topics SET type = (SELECT type FROM topics LIMIT 1) {TOPIC}", True),
    (f"UPDATE topics SET name = 5.5 {TOPIC}", True), (f"UPDATE messages SET data = 'text' {MESSAGE}", True),
    (f"UPDATE messages SET data = CAST(NULL AS BLOB) {MESSAGE}", True), (f"UPDATE messages SET data = x'' {MESSAGE}", True),
    (f"UPDATE messages SET data = zeroblob(500000000) {MESSAGE}", True),
    (f"UPDATE messages SET data = substr(data, 1, length(data) / 2) {MESSAGE}", True),
    (f"UPDATE messages SET timestamp = 'x' {MESSAGE}", False), (f"DELETE FROM messages {MESSAGE}", False),
    (f"UPDATE messages SET topic_id = 1 + topic_id {MESSAGE}", False), ("DROP TABLE messages", True),
    ("CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM topics; END", False),
)  # fmt: skip


def change_database(rng: Rng, file: Path, place: Place) -> Damage | None:
    statements, visible = pick(rng, STATEMENTS)
    statements = statements.replace("{row}", str(int(rng.integers(4))))
    connection = sqlite3.connect(file)
    try:
        connection.execute("PRAGMA writable_schema = ON")
        connection.executescript(statements)
        connection.commit()
    except sqlite3.Error:
        return None
    finally:
        connection.close()
    return Damage(statements[:120], visible)


def change_records(rng: Rng, data: bytes, file: Path) -> Changed:
    """Records of a TFRecord file with right check sums: damaged messages, records that are gone, twice or exchanged."""
    records, begin = [], 0
    while begin < len(data):
        length = int.from_bytes(data[begin : begin + 8], "little")
        records.append(data[begin + 12 : begin + 12 + length])
        begin += length + 16
    at, kind, visible = int(rng.integers(len(records))), int(rng.integers(7)), False
    if kind <= 2:
        changed = bytearray(records[at])
        for _ in range(int(rng.integers(1, 8))):
            # Near the begin, as tags and lengths of the outer messages stand there.
            changed[int(rng.integers(len(changed) if rng.random() < 0.5 else min(len(changed), 400)))] = int(
                rng.integers(256)
            )
        records[at], words = bytes(changed), f"bytes of record {at} changed"
    elif kind == 3:
        records[at], words, visible = records[at][: int(rng.integers(len(records[at])))], f"record {at} is cut", True
    elif kind == 4:
        del records[at]
        words = f"record {at} is gone"
    elif kind == 5:
        records.insert(at, records[at])
        words, visible = f"record {at} occurs twice", True
    else:
        records.reverse()
        words = "records in reverse order"
    lengths = [struct.pack("<Q", len(record)) for record in records]
    if rng.random() < 0.1:
        lengths[0] = struct.pack("<Q", int(pick(rng, (2**64 - 1, 2**62, 2**33, 0))))
        words, visible = "the first record states another length", True
    checked = [part + struct.pack("<I", masked_crc32c(part)) for pair in zip(lengths, records) for part in pair]
    return b"".join(checked), words, visible


STYLES = {".bag": ros.Style(container="bag"), ".mcap": ros.Style(), ".db3": ros.Style(container="db3")}
FLOATS = (np.nan, np.inf, -np.inf, 1e308, -1e308)


@cache
def sound_messages(container: str) -> tuple[ros.Message, ...]:
    return tuple(ros.Maker(small_world(), STYLES[container]))


def change_message(rng: Rng, file: Path, place: Place) -> Damage | None:
    """A value of a message is extreme, or a topic has messages missing, twice, or of another time."""
    messages = list(sound_messages(file.suffix))
    topic = pick(rng, sorted({m[2] for m in messages}))
    of_topic = [k for k, m in enumerate(messages) if m[2] == topic]
    at, kind, visible = pick(rng, of_topic), int(rng.integers(8)), False
    if kind <= 4:
        changed = _changed(rng, messages[at][4])
        if changed is None:
            return None
        message, words, visible = changed
        messages[at] = (*messages[at][:4], message)
    elif kind == 5:
        gone = of_topic if rng.random() < 0.5 else of_topic[1:]
        messages, words = [m for k, m in enumerate(messages) if k not in gone], f"{len(gone)} messages are gone"
    elif kind == 6:
        messages.insert(at, messages[at])
        words = "a message occurs twice"
    else:
        stamp = pick(rng, (0, 2**62, 1))
        messages[at], words = (stamp, stamp, *messages[at][2:]), f"a message was recorded at {stamp}"
    if not messages:
        return None
    target = file if file == place.input else file.parent
    anew = place.outside.parent / "anew"
    shutil.rmtree(anew, ignore_errors=True)  # of a try that failed
    try:
        written = ros.write(iter(messages), anew, "world", STYLES[file.suffix])
    except (struct.error, OverflowError, ValueError):
        return None  # more than the type of the field holds
    shutil.rmtree(target) if target.is_dir() else target.unlink()
    shutil.move(written, target)
    return Damage(f"{topic}: {words}", visible)


def _changed(rng: Rng, message: Any) -> Changed:
    """A message in which one value, at any depth, is another."""
    name = pick(rng, [f.name for f in fields(message) if not f.name.startswith("__")])
    old = getattr(message, name)
    if isinstance(old, list) and old and is_dataclass(old[0]):
        at = int(rng.integers(len(old)))
        inner = _changed(rng, old[at])
        return inner and (
            replace(message, **{name: [*old[:at], inner[0], *old[at + 1 :]]}),
            f"{name}[{at}].{inner[1]}",
            inner[2],
        )
    if is_dataclass(old):
        inner = _changed(rng, old)
        return inner and (replace(message, **{name: inner[0]}), f"{name}.{inner[1]}", inner[2])
    if isinstance(old, np.ndarray) and old.dtype.kind == "f" and len(old):
        value, visible = old.copy(), True
        value[int(rng.integers(len(old)))] = pick(rng, FLOATS)
    elif isinstance(old, np.ndarray) and old.dtype == np.uint8 and len(old):
        value, visible = old[: len(old) // 2] if rng.random() < 0.5 else old[:0], True
    elif isinstance(old, bool):
        value, visible = not old, False
    elif isinstance(old, float):
        value, visible = pick(rng, FLOATS), True
    elif isinstance(old, int):
        value, visible = pick(rng, (0, 1, -1, 2**31 - 1, -(2**31), 2**32 - 1, 2**16 - 1)), False
    elif isinstance(old, str):
        value, visible = pick(rng, ("", "x", "/" * 500, "../..", "\u0663", "base_link", "map")), False
    else:
        return None
    return replace(message, **{name: value}), f"{name} is {str(value)[:30]!r}", visible


STORED = (
    Mutation(changing(change_cells, read_arrow, write_arrow), (".feather", ".parquet"), 10.0),
    Mutation(changing(change_rows, read_arrow, write_arrow), (".feather", ".parquet"), 2.0),
    Mutation(change_database, (".db3",), 12.0), Mutation(of_bytes(change_records), (".tfrecord",), 10.0),
    Mutation(change_message, tuple(STYLES), 14.0),
)  # fmt: skip


# --- files and folders


def like(file: Path, place: Place) -> list[Path]:
    """Other files of the same kind in the same folder."""
    return [f for f in files_below(place.input) if f.parent == file.parent and f.suffix == file.suffix and f != file]


def remove_file(rng: Rng, file: Path, place: Place) -> Damage | None:
    if file == place.input:
        return None
    inner = file.relative_to(place.input)
    # Records of the native layout are named by their stamps, and nothing else names them.
    visible = bool(like(file, place)) and inner.parts[0] != "sensors" and "label" not in str(inner)
    file.unlink()
    return Damage("is missing", visible)


def exchange_files(rng: Rng, file: Path, place: Place) -> Damage | None:
    others = like(file, place)
    if not others:
        return None
    other = pick(rng, others)
    one, two = file.read_bytes(), other.read_bytes()
    file.write_bytes(two)
    if rng.random() < 0.5:
        other.write_bytes(one)
    return Damage(f"holds what {other.name} holds", False)


def rename_file(rng: Rng, file: Path, place: Place) -> Damage | None:
    if file == place.input:
        return None
    name = pick(
        rng, ("9" * 30 + file.suffix, "-1" + file.suffix, "x" + file.suffix, file.stem, ".hidden" + file.suffix)
    )
    file.rename(file.with_name(name))
    return Damage(f"is called {name}", False)


def replace_file(rng: Rng, file: Path, place: Place) -> Damage | None:
    """A folder, a pipe, a device, or a link to itself or to nothing in the place of the file."""
    file.unlink()
    kind = pick(rng, ("folder", "pipe", "pipe", "device", "device", "loop", "nothing"))
    if kind == "folder":
        file.mkdir()
    elif kind == "pipe":
        os.mkfifo(file)
    elif kind == "device":
        target = pick(
            rng, ("/dev/zero", "/dev/null", "/dev/urandom", "/dev/tty", "/proc/self/mem", "/proc/self/environ")
        )
        file.symlink_to(target)
        # A log that is one file is what the user named.
        return Damage(f"links to {target}", True, (Path(target),) if file == place.input else ())
    else:
        file.symlink_to(file.name if kind == "loop" else "nothing-there")
    return Damage(f"is a {kind}", True)


def link_outside(rng: Rng, file: Path, place: Place) -> Damage | None:
    """To a sound file of another name, which no log may read unless links are followed."""
    target = place.outside / f"secret{file.suffix}"
    if not target.exists():
        shutil.copyfile(file, target)
    file.unlink()
    file.symlink_to(target)
    return Damage("links to a file outside", file != place.input, (target,) if file == place.input else ())


def link_to_same_name(rng: Rng, file: Path, place: Place) -> Damage | None:
    """To its like of a sound copy, as data sets are laid out."""
    target = place.sound / (file.relative_to(place.input) if file != place.input else Path())
    file.unlink()
    file.symlink_to(target)
    return Damage("links to its sound copy", False, (target,))


def link_folder(rng: Rng, file: Path, place: Place) -> Damage | None:
    """A folder that links to one above it, or to another one outside."""
    folder = file.parent
    if place.input in (file, folder):
        return None
    shutil.rmtree(folder)
    target = pick(rng, (Path(".."), place.outside))
    folder.symlink_to(target)
    return Damage(f"its folder links to {target.name or 'the one above'}", False)


def add_strange_files(rng: Rng, file: Path, place: Place) -> Damage | None:
    """Files that file managers and archives leave behind, and a loop of folders."""
    if file == place.input:
        return None
    for name, content in ((".DS_Store", b"\0\0\0\1Bud1"), (f"._{file.name}", b"\0\5\x16\7"), ("Thumbs.db", b"")):
        (file.parent / name).write_bytes(content)
    (file.parent / "loop").symlink_to("..")
    return Damage("strange files beside it", False)


def forbid_reading(rng: Rng, file: Path, place: Place) -> Damage | None:
    if os.geteuid() == 0:
        return None  # who may read everything
    file.chmod(0)
    return Damage("may not be read", True)


def grow_hugely(rng: Rng, file: Path, place: Place) -> Damage | None:
    """Eight GiB that take no place on the disk."""
    os.truncate(file, 8 * 1024**3)
    return Damage("has 8 GiB", True)


FILES = (
    Mutation(remove_file, weight=2.0), Mutation(exchange_files), Mutation(rename_file), Mutation(replace_file, weight=3.0),
    Mutation(link_outside), Mutation(link_to_same_name, weight=0.5), Mutation(link_folder, weight=0.5),
    Mutation(add_strange_files, weight=0.3), Mutation(forbid_reading, weight=0.5), Mutation(grow_hugely, weight=0.5),
)  # fmt: skip

ALL: tuple[Mutation, ...] = (*RAW, *LINES, *TREES, *XML, *CONTAINERS, *STORED, *FILES)
