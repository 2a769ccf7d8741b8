"""Ways to damage a file, and the order in which they are drawn.

Whether damage is *visible* is stated by each way and never guessed from the outcome. Visible is what a program can tell from the
input alone, without knowing the sound one: text where a number stands, numbers that are not finite or of more digits than any
quantity has, a missing or empty file that others name, a line without all of its fields, bytes under a check sum, a file that
ends too early. Not visible is whatever leaves a valid input with other content: a changed float, a label that is not there, two
records whose contents are exchanged, bytes of a format without check sums.
"""

from __future__ import annotations

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

from log2sim.logs.waymo.messages import masked_crc32c
from mutation.bases import small_world

MAX_TRIES = 50
TEXT = (".txt", ".csv", ".json", ".xosc", ".xml", ".yaml")
TABLES = (".txt", ".csv")
# Every byte of the records is under a check sum.
CHECKED = (".npz", ".gz", ".png", ".tfrecord")
# Lengths, an index at the end, or an end mark: a file that ends too early can be told.
ENDED = (*CHECKED, ".json", ".xosc", ".jpg", ".feather", ".parquet", ".bag", ".mcap", ".db3", ".npy", ".pcd")
BOMB_BYTES = 300_000_000


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
# New content, words and whether it shows; None where the way does not fit.
Changed = tuple[Any, str, bool] | None


def files_below(path: Path) -> list[Path]:
    """Regular files of an input, in order of their names."""
    return [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file() and not p.is_symlink())


def damage(rng: Rng, place: Place) -> tuple[str, Damage]:
    """Damage one file in one way of `WAYS`; each folder's kind of file is drawn as often as any other, however many there are."""
    groups: dict[tuple[Path, str], list[Path]] = {}
    for file in files_below(place.input):
        groups.setdefault((file.parent, "".join(file.suffixes[-2:])), []).append(file)
    for _ in range(MAX_TRIES):
        file = pick(rng, pick(rng, list(groups.values())))
        usable = [way for way in WAYS if not way[2] or file.name.endswith(way[2])]
        weights = np.array([weight for _, _, _, weight in usable])
        codec, change, _, _ = usable[rng.choice(len(usable), p=weights / weights.sum())]
        if codec is None:
            done = change(rng, file, place)
        elif (changed := change(rng, codec[0](file), file)) is None:
            done = None
        else:
            codec[1](file, changed[0])
            done = Damage(changed[1], bool(changed[2]))
        if done is not None:
            inner = file.relative_to(place.input) if file != place.input else Path(file.name)
            return f"{change.__name__} {inner}", done
    raise RuntimeError(f"no mutation fits to {place.input}")


def pick(rng: Rng, values: Sequence[Any]) -> Any:
    """One of some values, which may be of different types."""
    return values[int(rng.integers(len(values)))]


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
    near_end = len(data) - min(len(data), 20) + 1
    keep = int(rng.integers(1 if rng.random() < 0.8 else near_end, len(data)))
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


def change_stretch(rng: Rng, data: bytes, file: Path) -> Changed:
    """Bytes inserted, deleted, repeated or zero; appended ones may be room for growth."""
    if len(data) < 2:
        return None
    kind, at = pick(rng, ("inserted", "deleted", "repeated", "zero")), int(rng.integers(len(data)))
    limit = 65 if kind in ("inserted", "deleted") else 4096
    count = int(rng.integers(1, limit if kind == "inserted" else min(limit, len(data) - at + 1)))
    new = {"inserted": data[:at] + rng.bytes(count) + data[at:], "deleted": data[:at] + data[at + count :],
           "repeated": data[: at + count] + data[at:], "zero": data[:at] + bytes(count) + data[at + count :]}[kind]  # fmt: skip
    within = kind != "repeated" or at + count < len(data)
    visible = kind != "zero" and count % 4 != 0 if file.suffix == ".bin" else within and file.name.endswith(CHECKED)
    return new, f"{count} bytes at {at} {kind}", visible


def blow_up_integer(rng: Rng, data: bytes, file: Path) -> Changed:
    """Replace what may be a length or count, an integer below a million, by an extreme one."""
    starts = [k for k in range(min(len(data), 4096) - 4) if 0 < int.from_bytes(data[k : k + 4], "little") < 1_000_000]
    if file.suffix in TEXT or not starts:
        return None
    at, value = pick(rng, starts), pick(rng, (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF))
    new = data[:at] + value.to_bytes(4, "little") + data[at + 4 :]
    return new, f"the integer at {at} is {value}", file.name.endswith(CHECKED)


def replace_content(rng: Rng, data: bytes, file: Path) -> Changed:
    new = pick(rng, (
        b"", b"\0", b" \n" * 50, rng.bytes(2000), bytes(3000), b"<!DOCTYPE html><html><body>404 Not Found</body></html>",
        b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 123456\n",
    ))  # fmt: skip
    return new, f"holds {new[:30]!r}", not (file.suffix in (".bin", ".txt") and not new.strip())


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


def change_number(rng: Rng, text: str, file: Path) -> Changed:
    """An impossible value, or now and then another of the same kind: its opposite, zero, or ten times as much."""
    found = list(_NUMBER.finditer(text))
    if not found:
        return None
    match, impossible = pick(rng, found), rng.random() < 6 / 7
    old = match.group()
    same = (f"-{old}".replace("--", ""), "0", f"{old[:1]}{old[1:2] or '0'}{old[1:]}", "-1", "1e-300")
    value = pick(rng, IMPOSSIBLE if impossible else same)
    line = text.count("\n", 0, match.start()) + 1
    return put(match, text, value), f"line {line}: {old} is {value[:50]!r}", impossible and file.suffix != ".yaml"


def change_line(rng: Rng, text: str, file: Path) -> Changed:
    """A line removed, cut, repeated, exchanged with another, or with a field more."""
    lines = text.splitlines(keepends=True)
    if not lines:
        return None
    at, separator = int(rng.integers(len(lines))), "," if file.suffix == ".csv" else " "
    words = lines[at].rstrip("\n").split(separator)
    kind = pick(rng, ("removed", "cut", "cut", "twice", "exchanged", "longer"))
    if (kind == "cut" and len(words) < 2) or (kind == "exchanged" and len(lines) < 3):
        return None
    visible = {
        # A header, or the line that pairs with a file; any other row may never have been there.
        "removed": (file.suffix == ".csv" and at == 0) or file.name.startswith("timestamps") or "calib" in str(file),
        # Two boxes in one place may be two objects for layouts without tracks.
        "twice": file.name.startswith(("timestamps", "index.csv", "poses.csv")),
        "cut": True, "exchanged": False, "longer": file.suffix == ".csv",
    }[kind]  # fmt: skip
    if kind == "exchanged":
        a, b = rng.choice(np.arange(1, len(lines)), 2, replace=False)
        lines[a], lines[b] = lines[b], lines[a]
    else:
        cut = separator.join(words[: int(rng.integers(1, max(len(words), 2)))]) + "\n"
        longer = separator.join([*words, "1.5"]) + "\n"
        lines[at] = {"removed": "", "cut": cut, "twice": lines[at] * 2, "longer": longer}[kind]
    return "".join(lines), f"line {at + 1}: {kind}", visible


def encode_otherwise(rng: Rng, data: bytes, file: Path) -> Changed:
    """A byte order mark, other line ends or another encoding; the content stays."""
    text, kind = data.decode(), pick(rng, ("utf-8-sig", "utf-16", "latin-1", "crlf", "cr"))
    ends = {"crlf": "\r\n", "cr": "\r"}
    out = text.replace("\n", ends[kind]).encode() if kind in ends else text.encode(kind)
    return out, f"written as {kind}", kind == "utf-16"


# --- values, keys and lists of JSON

# Written as they are, without quotes, for values that JSON has no words for.
VERBATIM = "@@raw:"
IMPOSSIBLE_VALUES: tuple[Any, ...] = (
    f"{VERBATIM}NaN@@", f"{VERBATIM}Infinity@@", f"{VERBATIM}-Infinity@@", 1e308, -1e308, f"{VERBATIM}1e400@@", 2**63 - 1, -(2**63),
    10**40, -(10**40), f"{VERBATIM}{'9' * 5000}@@", None, "", "x", [], {}, [[1.0]], "1.5",
)  # fmt: skip
OTHER_WORDS = (
    "other", "..", "../outside/canary", "/etc/passwd", "a\0b", "w" * 5000, "\u202e\ud800", "CON", "-", " ", "a/b",
)  # fmt: skip


def read_json(file: Path) -> Any:
    return {"": json.loads(file.read_text("utf-8"))}


def write_json(file: Path, root: Any) -> None:
    text = json.dumps(root[""])
    file.write_text(re.sub(rf'"{VERBATIM}(.*?)@@"', lambda m: m[1].replace('\\"', '"'), text), encoding="utf-8")


def is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def is_allowed(path: str, value: Any) -> bool:
    """Whether a scenario's format allows the value there: free-form parts, and what may be null."""
    return any(p in path for p in (".quality", ".provenance", ".homography")) or (
        value is None and any(p in path for p in (".map.", ".color"))
    )


def change_tree(rng: Rng, root: Any, file: Path) -> Changed:
    """Another value, type, key or element at a random place of a document."""
    kinds = (impossible_number, other_value, other_type, other_keys, other_elements, deep_nesting)
    change = kinds[rng.choice(len(kinds), p=np.array([6.0, 2.0, 3.0, 3.5, 3.5, 0.5]) / 18.5)]
    for _ in range(30):
        holder, key, path = root, "", ""
        while isinstance(holder[key], (dict, list)) and holder[key] and rng.random() >= 0.1:
            holder = holder[key]
            key = pick(rng, list(holder) if isinstance(holder, dict) else range(len(holder)))
            path += f"[{key}]" if isinstance(holder, list) else f".{key}"
        changed = change(rng, holder[key], path) if path else None
        if changed is not None:
            holder[key], words, visible = changed
            return root, f"{path} {words}", visible
    return None


def impossible_number(rng: Rng, old: Any, path: str) -> Changed:
    new = pick(rng, IMPOSSIBLE_VALUES)
    return (new, f"{old} is {str(new)[:50]}", not is_allowed(path, new)) if is_number(old) else None


def other_value(rng: Rng, old: Any, path: str) -> Changed:
    if not is_number(old) and not isinstance(old, str):
        return None
    new = pick(rng, (-old, 0, old * 10, 1e-300) if is_number(old) else OTHER_WORDS)
    return new, f"{str(old)[:50]} is {str(new)[:50]!r}", False


def other_type(rng: Rng, old: Any, path: str) -> Changed:
    if not isinstance(old, (str, dict, list)) or not old:
        return None
    new = pick(rng, (None, 1, -1.5, 10**40, [], {}, True, [None]))
    # An empty object or list instead of another is of the same type, and may have been so.
    return new, f"{type(old).__name__} is {str(new)[:50]}", type(old) is not type(new) and not is_allowed(path, new)


def other_keys(rng: Rng, old: Any, path: str) -> Changed:
    """A key removed, which a format may lack; once more with another value; or one that is not known."""
    if not isinstance(old, dict) or not old:
        return None
    name, kind = pick(rng, list(old)), int(rng.integers(3))
    number = is_number(old[name])
    unknown = pick(rng, ("unknown", "__proto__", "__class__", "", "k" * 10_000)) if kind == 2 else ""
    twice = {**old, f'{VERBATIM}"{name}"@@': old[name] * 2 + 1 if number else old[name]}
    new = ({k: v for k, v in old.items() if k != name}, twice, {**old, unknown: 1})[kind]
    return new, (f"{name} removed", f"{name} occurs twice", "has an unknown key")[kind], kind == 1 and number


def other_elements(rng: Rng, old: Any, path: str) -> Changed:
    if not isinstance(old, list) or not old:
        return None
    at, kind = int(rng.integers(len(old))), int(rng.integers(4))
    new = (old[:at] + old[at + 1 :], old[: at + 1] + old[at:], [], old[::-1])[kind]
    # A vector of another length shows; a list of records may have any.
    visible = is_number(old[0]) and len(old) <= 9 and kind < 3
    return new, (f"[{at}] removed", f"[{at}] occurs twice", "has no elements", "is in reverse order")[kind], visible


def deep_nesting(rng: Rng, old: Any, path: str) -> Changed:
    depth = pick(rng, (100, 3000, 200_000))
    return f"{VERBATIM}{'[' * depth}{']' * depth}@@", f"is {depth} lists in each other", True


# --- attributes and elements of XML

_ATTRIBUTE = re.compile(r'(\w+)="([^"]*)"')
_EMPTY_ELEMENT = re.compile(r"[ \t]*<(\w+)[^<>]*/>\n?")
_XML_NUMBER = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?")


def change_attribute(rng: Rng, text: str, file: Path) -> Changed:
    """A number that is none, another value, removed, or twice."""
    match, kind = pick(rng, list(_ATTRIBUTE.finditer(text))), pick(rng, (0, 0, 0, 0, 1, 1, 2, 3))
    if kind == 0 and not _XML_NUMBER.fullmatch(match[2]):
        return None
    new = (pick(rng, IMPOSSIBLE).replace("'", "&apos;"), pick(rng, ("0", "-1", "x", "$x", "..", "a/b", "&#x202e;", "1e3", "true")),
           "", f"{match[0]} {match[0]}")[kind]  # fmt: skip
    return put(match, text, new, 2 if kind < 2 else 0), f"{match[1]}: {match[2][:40]} is {new[:40]!r}", kind in (0, 3)


def change_elements(rng: Rng, text: str, file: Path) -> Changed:
    """An element removed, twice or of another name, or very many within each other."""
    found, kind = list(_EMPTY_ELEMENT.finditer(text)), pick(rng, ("removed", "twice", "unknown", "nested"))
    if not found:
        return None
    match, depth = pick(rng, found), pick(rng, (100, 5000, 300_000))
    new = {"removed": "", "twice": match[0] * 2, "unknown": match[0].replace(f"<{match[1]}", "<Unknown"),
           "nested": "<a>" * depth + "</a>" * depth}[kind]  # fmt: skip
    return put(match, text, new), f"<{match[1]}> {kind}", False


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


# --- archives and pickles

HUGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 3), }"
OBJECTS = "{'descr': '|O', 'fortran_order': False, 'shape': (4, 3), }"
HEADERS = (
    HUGE, OBJECTS, HUGE.replace("1000000000", "-1"), HUGE.replace("(1000000000, 3)", "'4'"), HUGE.replace("<f8", "|V1000000"),
    HUGE.replace("False", "7"), "{'descr': '<f8', 'shape': (4, 3), }", "__import__('os').mkdir('pwned')", "(" * 500 + ")" * 500, HUGE[:-4],
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


def archive(members: Sequence[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as file:
        for name, data in members:
            file.writestr(name, data)
    return stream.getvalue()


def change_arrays(rng: Rng, file: Path, place: Place) -> Damage | None:
    """Other values, types, shapes and members; whatever is compressed stays consistent."""
    with np.load(file) as loaded:
        arrays = {name: loaded[name] for name in loaded.files}
    name, kind = pick(rng, list(arrays)), int(rng.integers(7))
    array, new, visible = arrays[name].copy(), None, True
    if kind == 0 and array.dtype.kind in "fi":
        extreme = (2**62, -(2**62)) if array.dtype.kind == "i" else EXTREMES
        rows = rng.random(len(array)) < rng.choice([0.001, 0.3, 1.0])
        with np.errstate(over="ignore"):
            of = array.dtype if array.dtype.itemsize == 8 else "f4"
            array[rows] = np.array(pick(rng, extreme), of).astype(array.dtype)
        new, words, visible = npy(array), f"{rows.sum()} rows are extreme", rows.sum() > len(array) / 2
    elif kind <= 2:
        dtype = pick(rng, ("f2", "i8", "u1", "c16", "?", "U10", "O", "M8[ns]", "f16", ">f4"))
        new, words, visible = npy(array.astype(dtype)), f"is of type {dtype}", dtype not in ("f2", "f16", ">f4", "i8")
    elif kind == 3:
        other = pick(rng, (array[:0], array[:-1], array[..., None], np.concatenate([array] * 2), array[:1]))
        new, words, visible = npy(other), f"is {other.shape}", other.shape[1:] != array.shape[1:] or len(arrays) > 1
    elif kind == 4:
        words, visible = "is missing", name == "xyz_m"
    elif kind == 5:
        header = pick(rng, HEADERS)
        new, words = npy_with_header(header, array.tobytes()), f"has the header {header[:60]!r}"
    else:
        payload = pickle.dumps(Payload(os.mkdir, str(place.outside / "pwned")))
        new, words = pick(rng, (
            (npy_with_header(OBJECTS, payload), "is a pickle that makes a folder"),
            (npy_with_header(HUGE, bytes(BOMB_BYTES)), f"unpacks to {BOMB_BYTES} zeros"), (rng.bytes(300), "is noise"),
        ))  # fmt: skip
    members = {**{k: npy(v) for k, v in arrays.items()}, name: new}
    file.write_bytes(archive([(f"{k}.npy", v) for k, v in members.items() if v is not None]))
    return Damage(f"{name} {words}", bool(visible))


def change_archive(rng: Rng, data: bytes, file: Path) -> Changed:
    """Other compressions, an encrypted bit, names that lead elsewhere, a wrong number of members."""
    with zipfile.ZipFile(io.BytesIO(data)) as loaded:
        members = [(i.filename, loaded.read(i)) for i in loaded.infolist()]
    out, kind = bytearray(data), int(rng.integers(4))
    if kind == 0:
        method = pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
        return archive(members, method), f"compressed by method {method}", False
    if kind == 1:
        # In the entry of the index and in the member's own header.
        for mark, flag in ((b"PK\1\2", 8), (b"PK\3\4", 6)):
            out[out.find(mark) + flag] |= 1
        return out, "its first member is encrypted", True
    if kind == 2:
        name = pick(rng, ("../../pwned.npy", "/tmp/pwned.npy", "xyz_m.npy/", "a" * 60_000))
        return archive([(name, b"x"), *members]), f"has a member {name[:30]}", False
    at = out.rfind(b"PK\5\6")
    out[at + 8 : at + 12] = b"\xff\xff\xff\xff"
    return out, "states 65535 members", False


def replace_pickle(rng: Rng, file: Path, place: Place) -> Damage | None:
    """Pickles that run a function, that are deeply nested or huge, or hold no table."""
    target = str(place.outside / "pwned")
    data = pick(rng, (
        pickle.dumps(Payload(os.mkdir, target)), pickle.dumps(Payload(os.system, f"touch {target}")), pickle.dumps(Payload(open, target, "w")),
        pickle.dumps(Payload(eval, f"open({target!r}, 'w')")), pickle.dumps([Payload(np.load, target), 1]), b"\x80\x04" + b"(" * 100_000 + b".",
        b"\x80\x04]" + b"]a" * 5 + b"\x85" * 100_000 + b".", b"\x80\x04\x8e" + (2**62).to_bytes(8, "little") + b"abc.",
        pickle.dumps({"x": [1.0]}), pickle.dumps(np.zeros((4, 3))), pickle.dumps(None), bytes(BOMB_BYTES),
    ))  # fmt: skip
    file.write_bytes(gzip.compress(data, 1))
    return Damage(f"holds {data[:40]!r}", True)


# --- tables: Arrow and pickled ones

EXTREMES = (np.nan, np.inf, -np.inf, 1e308, -1e30)
EXTREME_VALUES: dict[str, tuple[Any, ...]] = {"f": EXTREMES, "i": (2**63 - 1, -(2**63), 2**31 - 1, -1)}


def read_table(file: Path) -> Any:
    import pandas
    import pyarrow.feather
    import pyarrow.parquet

    if file.name.endswith(".pkl.gz"):
        return pyarrow.Table.from_pandas(pandas.read_pickle(file))
    # Read from bytes: a file that is mapped must not be written over.
    data = pyarrow.BufferReader(file.read_bytes())
    return pyarrow.feather.read_table(data) if file.suffix == ".feather" else pyarrow.parquet.read_table(data)


def write_table(file: Path, table: Any) -> None:
    import pyarrow.feather
    import pyarrow.parquet

    if file.name.endswith(".pkl.gz"):
        file.write_bytes(gzip.compress(pickle.dumps(table.to_pandas()), 1))
    elif file.suffix == ".feather":
        pyarrow.feather.write_feather(table, file, compression="lz4")
    else:
        pyarrow.parquet.write_table(table, file)


def change_cells(rng: Rng, table: Any, file: Path) -> Changed:
    """One cell is extreme or null, or a whole column is of another type, null or gone."""
    import pyarrow

    names = [name for name in table.column_names if not name.startswith("__index")]
    if not table.num_rows:
        return None
    name, at, kind = pick(rng, names), int(rng.integers(table.num_rows)), int(rng.integers(6))
    column, where, pickled = table.column(name), table.column_names.index(name), file.name.endswith(".gz")
    if kind <= 2:
        group = "f" if pyarrow.types.is_floating(column.type) else "i" if pyarrow.types.is_integer(column.type) else ""
        if not group and (kind < 2 or pickled):
            return None
        values, value = column.to_pylist(), pick(rng, EXTREME_VALUES[group]) if kind < 2 or pickled else None
        values[at] = value
        try:
            changed = pyarrow.array(values, column.type)
        except (pyarrow.ArrowInvalid, OverflowError):
            return None  # more than the type holds
        # Points may be misses; a measure of -1 may be one; a cuboid has no such value.
        of_cuboid = "cuboids" in str(file) and group == "f" and "rider" not in name
        shows = of_cuboid if pickled else "lidar" not in str(file.parent.name)
        return table.set_column(where, name, changed), f"{name}[{at}] is {value}", value != -1 and shows
    if kind == 3:
        optional = ("attributes", "cuboids", "camera", "i", "stationary") if pickled else ("num_interior", "intensity")
        return table.drop_columns([name]), f"{name} is missing", not name.startswith(optional)
    if kind == 4:
        words = pyarrow.array([str(v)[:20] for v in column.to_pylist()])
        wordy = any(part in name for part in ("uuid", "label", "attributes")) or column.type == pyarrow.string()
        return table.set_column(where, name, words), f"{name} holds text", not wordy
    nulls = table.set_column(where, name, pyarrow.nulls(table.num_rows))
    return None if pickled else (nulls, f"{name} is null", True)


def change_rows(rng: Rng, table: Any, file: Path) -> Changed:
    if table.num_rows < 2:
        return None
    at, kind = int(rng.integers(table.num_rows)), int(rng.integers(4))
    rows = list(range(table.num_rows))
    kept = (rows[:at] + rows[at + 1 :], rows[: at + 1] + rows[at:], [], rows[::-1])[kind]
    return table.take(np.array(kept, np.int64)), f"row {at}: rows {kept[:4]}...", kind == 1 and "cuboids" in str(file)


ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT"
MESSAGE, TOPIC = (f"WHERE id = (SELECT id FROM {table} LIMIT 1 OFFSET {{row}})" for table in ("messages", "topics"))
STATEMENTS = (
    (f"ALTER TABLE messages RENAME TO old; CREATE VIEW messages AS {ENDLESS} x AS id, 1 AS topic_id, x AS timestamp, x'00' AS data FROM n", True),
    (f"ALTER TABLE topics RENAME TO old; CREATE VIEW topics AS {ENDLESS} x AS id, 'a' AS name, 'b' AS type, 'cdr' AS serialization_format,"
     " '' AS offered_qos_profiles FROM n", True),
    ("DELETE FROM messages", True), (f"DELETE FROM topics {TOPIC}", True), ("UPDATE topics SET type = 'x/msg/Y'", True),
    (f"UPDATE topics SET type = (SELECT type FROM topics LIMIT 1) {TOPIC}", True), (f"UPDATE topics SET name = 5.5 {TOPIC}", True),
    (f"UPDATE messages SET data = 'text' {MESSAGE}", True), (f"UPDATE messages SET data = CAST(NULL AS BLOB) {MESSAGE}", True),
    (f"UPDATE messages SET data = zeroblob(500000000) {MESSAGE}", True),
    (f"UPDATE messages SET data = substr(data, 1, length(data) / 2) {MESSAGE}", True),
    (f"UPDATE messages SET timestamp = 'x' {MESSAGE}", False), (f"DELETE FROM messages {MESSAGE}", False),
    (f"UPDATE messages SET topic_id = 1 + topic_id {MESSAGE}", False), ("DROP TABLE messages", True),
)  # fmt: skip


def change_database(rng: Rng, file: Path, place: Place) -> Damage | None:
    statements, visible = pick(rng, STATEMENTS)
    statements = statements.replace("{row}", str(int(rng.integers(4))))
    connection = sqlite3.connect(file)
    try:
        connection.executescript(statements)
        connection.commit()
    except sqlite3.Error:
        return None
    finally:
        connection.close()
    return Damage(statements[:120], visible)


# --- pictures


def change_image(rng: Rng, data: bytes, file: Path) -> Changed:
    """Sizes that need gigabytes, other sizes, and files of other kinds of images."""
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    height, width = image.shape[:2]
    kind, huge = int(rng.integers(4)), pick(rng, (65_535, 65_500, 30_000))
    if kind == 0:
        wide, high = pick(rng, ((huge, huge), (huge, huge), (0, height), (1, height)))
        return _with_size(data, wide, high), f"states {wide} x {high} pixels", True
    if kind == 1:
        suffix = pick(rng, (".bmp", ".tiff", ".webp", ".png", ".jpg", ".ppm", ".jp2", ".hdr"))
        other = cv2.imencode(suffix, image.astype(np.float32) if suffix == ".hdr" else image)[1].tobytes()
        return other, f"is a {suffix} image", False
    if kind == 2:
        head = pick(rng, (f"P6 {huge} {huge} 255\n", f"P1 {huge} {huge}\n", "GIF89a\xff\xff\xff\xff",
                          f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {huge} +X {huge}\n"))  # fmt: skip
        return head.encode("latin-1") + bytes(100), "is another image format that states a huge size", True
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    other = pick(rng, (image[: height // 2], gray, image[::2, ::2], image.transpose(1, 0, 2)))
    encoded = cv2.imencode(file.suffix, np.ascontiguousarray(other))[1].tobytes()
    return encoded, f"is {other.shape}", other.shape[:2] != (height, width)


def _with_size(data: bytes, width: int, height: int) -> bytes:
    """An image file that states another size: the header of PNG with its check sum, or of JPEG."""
    if data[:4] == b"\x89PNG":
        header = b"IHDR" + struct.pack(">II", width, height) + data[24:29]
        return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
    at = next((data.find(bytes([0xFF, m])) for m in (0xC0, 0xC2, 0xC1) if data.find(bytes([0xFF, m])) > 0), -1)
    return data if at < 0 else data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]


# --- records: TFRecord, messages of ROS


def change_records(rng: Rng, data: bytes, file: Path) -> Changed:
    """Records of a TFRecord file with right check sums: damaged messages, records that are gone, twice or exchanged."""
    records, begin = [], 0
    while begin < len(data):
        length = int.from_bytes(data[begin : begin + 8], "little")
        records.append(data[begin + 12 : begin + 12 + length])
        begin += length + 16
    at, kind = int(rng.integers(len(records))), pick(rng, ("changed",) * 3 + ("cut", "gone", "twice", "reversed"))
    one = bytearray(records[at])
    for _ in range(int(rng.integers(1, 8))):
        # Near the begin, as tags and lengths of the outer messages stand there.
        one[int(rng.integers(len(one) if rng.random() < 0.5 else min(len(one), 400)))] = int(rng.integers(256))
    cut = records[at][: int(rng.integers(len(one)))]
    new = {"changed": [bytes(one)], "cut": [cut], "gone": [], "twice": [records[at]] * 2}
    records = records[::-1] if kind == "reversed" else records[:at] + new[kind] + records[at + 1 :]
    lengths = [struct.pack("<Q", len(record)) for record in records]
    wrong = bool(lengths) and rng.random() < 0.1
    if wrong:
        lengths[0] = struct.pack("<Q", int(pick(rng, (2**64 - 1, 2**62, 2**33, 0))))
    checked = [part + struct.pack("<I", masked_crc32c(part)) for pair in zip(lengths, records) for part in pair]
    return b"".join(checked), f"record {at} {kind}, length wrong: {wrong}", wrong or kind in ("cut", "twice")


STYLES = {".bag": ros.Style(container="bag"), ".mcap": ros.Style(), ".db3": ros.Style(container="db3")}


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
    old, visible = getattr(message, name), True
    inner = old[int(rng.integers(len(old)))] if isinstance(old, list) and old else old
    if is_dataclass(inner):
        changed = _changed(rng, inner)
        if changed is None:
            return None
        value = [changed[0] if one is inner else one for one in old] if isinstance(old, list) else changed[0]
        return replace(message, **{name: value}), f"{name}.{changed[1]}", changed[2]
    if isinstance(old, np.ndarray) and old.dtype.kind == "f" and len(old):
        value = old.copy()
        value[int(rng.integers(len(old)))] = pick(rng, EXTREMES)
    elif isinstance(old, np.ndarray) and old.dtype == np.uint8 and len(old):
        value = old[: len(old) // 2] if rng.random() < 0.5 else old[:0]
    elif isinstance(old, float):
        value = pick(rng, EXTREMES)
    elif isinstance(old, (bool, int, str)):
        words = ("", "x", "/" * 500, "../..", "\u0663", "base_link", "map")
        numbers = (0, 1, -1, 2**31 - 1, -(2**31), 2**32 - 1, 65535)
        value = not old if isinstance(old, bool) else pick(rng, words if isinstance(old, str) else numbers)
        visible = False
    else:
        return None
    return replace(message, **{name: value}), f"{name} is {str(value)[:30]!r}", visible


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
    end = file.suffix
    name = pick(rng, ("9" * 30 + end, f"-1{end}", f"x{end}", file.stem, f".hidden{end}"))
    file.rename(file.with_name(name))
    return Damage(f"is called {name}", False)


DEVICES = ("/dev/zero", "/dev/null", "/dev/urandom", "/dev/tty", "/proc/self/mem", "/proc/self/environ")


def replace_file(rng: Rng, file: Path, place: Place) -> Damage | None:
    """A folder, a pipe, a device, a file of eight GiB that takes no place, or a link to itself or to nothing in the place of the file."""
    kind = pick(rng, ("folder", "pipe", "pipe", "device", "device", "loop", "nothing", "8 GiB"))
    if kind == "8 GiB":
        os.truncate(file, 8 * 1024**3)
        return Damage("has 8 GiB", True)
    file.unlink()
    if kind == "folder":
        file.mkdir()
    elif kind == "pipe":
        os.mkfifo(file)
    else:
        target = pick(rng, DEVICES) if kind == "device" else file.name if kind == "loop" else "nothing-there"
        file.symlink_to(target)
        # A log that is one file is what the user named.
        return Damage(f"links to {target}", True, (Path(target),) if kind == "device" and file == place.input else ())
    return Damage(f"is a {kind}", True)


def link_file(rng: Rng, file: Path, place: Place) -> Damage | None:
    """Link to a sound file of another name outside, which no log may read unless links are followed, or as data sets do to its like."""
    alike, single = rng.random() < 1 / 3, file == place.input
    like = place.sound / (Path() if single else file.relative_to(place.input))
    target = like if alike else place.outside / f"secret{file.suffix}"
    if not target.exists():
        shutil.copyfile(file, target)
    file.unlink()
    file.symlink_to(target)
    words = f"links to {'its sound copy' if alike else 'a file outside'}"
    return Damage(words, not alike and not single, (target,) if alike or single else ())


def change_folder(rng: Rng, file: Path, place: Place) -> Damage | None:
    """A folder that links to one above it or outside, or with what file managers and archives leave behind and a loop."""
    folder = file.parent
    if place.input in (file, folder):
        return None
    if rng.random() < 0.4:
        for name, content in ((".DS_Store", b"\0\0\0\1Bud1"), (f"._{file.name}", b"\0\5\x16\7"), ("Thumbs.db", b"")):
            (folder / name).write_bytes(content)
        (folder / "loop").symlink_to("..")
        return Damage("strange files beside it", False)
    shutil.rmtree(folder)
    target = pick(rng, (Path(".."), place.outside))
    folder.symlink_to(target)
    return Damage(f"its folder links to {target.name or 'the one above'}", False)


RAW = Path.read_bytes, Path.write_bytes
STRING = lambda file: file.read_text("utf-8"), lambda file, text: file.write_text(text, "utf-8")
TREE, TABLE = (read_json, write_json), (read_table, write_table)
ARROW, PICKLED = (".feather", ".parquet"), (".pkl.gz",)
# Ways to damage: how content is read from a file and written, `change(rng, content, file)`, or without that `change(rng, file, place)`;
# suffixes of files (all without), and how often.
WAYS: tuple[tuple[Any, Callable[..., Any], tuple[str, ...], float], ...] = (
    (RAW, flip_bytes, (), 3.0), (RAW, cut_file, (), 2.0), (RAW, change_stretch, (), 4.0), (RAW, blow_up_integer, (), 1.0),
    (RAW, replace_content, (), 1.0), (STRING, change_number, (*TABLES, ".yaml"), 7.0), (STRING, change_line, TABLES, 6.0),
    (RAW, encode_otherwise, TEXT, 1.0), (TREE, change_tree, (".json",), 18.5),
    (STRING, change_attribute, (".xosc",), 14.0), (STRING, change_elements, (".xosc",), 3.5), (None, add_entities, (".xosc",), 2.0),
    (None, change_arrays, (".npz",), 8.0), (RAW, change_archive, (".npz",), 4.0), (None, replace_pickle, PICKLED, 5.0),
    (TABLE, change_cells, PICKLED, 5.0), (TABLE, change_rows, PICKLED, 1.0),
    (TABLE, change_cells, ARROW, 10.0), (TABLE, change_rows, ARROW, 2.0), (RAW, change_image, (".png", ".jpg"), 3.0),
    (None, change_database, (".db3",), 12.0), (RAW, change_records, (".tfrecord",), 10.0), (None, change_message, tuple(STYLES), 14.0),
    (None, remove_file, (), 2.0), (None, exchange_files, (), 1.0), (None, rename_file, (), 1.0), (None, replace_file, (), 3.5),
    (None, link_file, (), 1.5), (None, change_folder, (), 0.8),
)  # fmt: skip
