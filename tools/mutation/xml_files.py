"""Damage to OpenSCENARIO files: attributes, elements and entities."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mutation.damage import Damage, Mutation, Place, pick
from mutation.text_lines import IMPOSSIBLE

_ATTRIBUTE = re.compile(r'(\w+)="([^"]*)"')
_EMPTY_ELEMENT = re.compile(r"[ \t]*<(\w+)[^<>]*/>\n?")
_NUMBER = re.compile(r"-?\d+(\.\d+)?([eE][-+]?\d+)?")
# What a program that reads trajectories has no use for.
UNUSED = ("revMajor", "revMinor", "date", "author", "mass", "frontAxle")


def replace_attribute(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    text = file.read_text(encoding="utf-8")
    found = [m for m in _ATTRIBUTE.finditer(text) if _NUMBER.fullmatch(m[2])]
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
