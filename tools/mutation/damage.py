"""What a mutation does to a folder, and the order in which mutations are drawn.

Whether damage is *visible* is stated by each kind of mutation and never guessed from the outcome. Visible is what a program
can tell from the input alone, without knowing the sound one: text where a number stands, numbers that are not finite or of
more digits than any quantity has, a missing or empty file that others name, a line without all of its fields, bytes under a
check sum, a file that ends too early. Not visible is whatever leaves a valid input with other content: a changed float, a
label that is not there, two records whose contents are exchanged, bytes of a format without check sums.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MAX_TRIES = 50


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


Function = Callable[[np.random.Generator, Path, Place], "Damage | None"]


@dataclass(frozen=True)
class Mutation:
    """A way to damage a file; `suffixes` of the files that it is for, all files without. None from it: not of this file."""

    function: Function
    suffixes: tuple[str, ...] = ()
    weight: float = 1.0

    @property
    def name(self) -> str:
        return self.function.__name__

    def is_for(self, file: Path) -> bool:
        return not self.suffixes or file.name.endswith(self.suffixes)


def files_below(path: Path) -> list[Path]:
    """Regular files of an input, in order of their names."""
    return [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file() and not p.is_symlink())


def damage(rng: np.random.Generator, place: Place, mutations: Sequence[Mutation]) -> tuple[str, Damage]:
    """Apply one mutation to one file; each folder's kind of file is drawn as often as any other, however many there are."""
    groups: dict[tuple[Path, str], list[Path]] = {}
    for file in files_below(place.input):
        groups.setdefault((file.parent, "".join(file.suffixes[-2:])), []).append(file)
    for _ in range(MAX_TRIES):
        group = list(groups.values())[rng.integers(len(groups))]
        file = group[rng.integers(len(group))]
        usable = [m for m in mutations if m.is_for(file)]
        weights = np.array([m.weight for m in usable])
        chosen = usable[rng.choice(len(usable), p=weights / weights.sum())]
        done = chosen.function(rng, file, place)
        if done is not None:
            inner = file.relative_to(place.input) if file != place.input else Path(file.name)
            return f"{chosen.name} {inner}", done
    raise RuntimeError(f"no mutation fits to {place.input}")


def pick(rng: np.random.Generator, values: Sequence[object]) -> object:
    """One of some values, which may be of different types."""
    return values[int(rng.integers(len(values)))]
