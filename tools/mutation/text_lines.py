"""Damage to lines and numbers of text: tables of words, CSV, and attributes of XML."""

from __future__ import annotations

import re
from pathlib import Path

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
