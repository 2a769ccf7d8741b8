"""Files that are missing, exchanged, or something else than files."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np

from mutation.damage import Damage, Mutation, Place, files_below, pick

# Layouts whose records are named by their stamps, and nothing else names them.
NAMED_BY_STAMPS = ("sensors",)


def remove_file(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    if file == place.input:
        return None
    file.unlink()
    others = [f for f in files_below(place.input) if f.parent == file.parent and f.suffix == file.suffix]
    inner = file.relative_to(place.input)
    optional = inner.parts[0] in NAMED_BY_STAMPS or "label" in str(inner)
    return Damage("is missing", bool(others) and not optional)


def exchange_files(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    others = [f for f in files_below(place.input) if f.parent == file.parent and f.suffix == file.suffix and f != file]
    if not others:
        return None
    other = others[rng.integers(len(others))]
    one, two = file.read_bytes(), other.read_bytes()
    file.write_bytes(two)
    if rng.random() < 0.5:
        other.write_bytes(one)
        return Damage(f"exchanged with {other.name}", False)
    return Damage(f"holds what {other.name} holds", False)


def rename_file(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    if file == place.input:
        return None
    name = str(
        pick(rng, ("9" * 30 + file.suffix, "-1" + file.suffix, "x" + file.suffix, file.stem, ".hidden" + file.suffix))
    )
    file.rename(file.with_name(name))
    return Damage(f"is called {name}", False)


def replace_by_folder(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    file.unlink()
    file.mkdir()
    return Damage("is a folder", True)


def replace_by_pipe(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    file.unlink()
    os.mkfifo(file)
    return Damage("is a named pipe", True)


def replace_by_device(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    target = str(
        pick(rng, ("/dev/zero", "/dev/null", "/dev/urandom", "/dev/tty", "/proc/self/mem", "/proc/self/environ"))
    )
    file.unlink()
    file.symlink_to(target)
    # A log that is one file is what the user named.
    return Damage(f"links to {target}", True, (Path(target),) if file == place.input else ())


def link_outside(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """To a sound file of another name, which no log may read unless links are followed."""
    target = place.outside / f"secret{file.suffix}"
    if not target.exists():
        shutil.copyfile(file, target)
    file.unlink()
    file.symlink_to(target)
    # A log that is one file is what the user named.
    return Damage("links to a file outside", file != place.input, (target,) if file == place.input else ())


def link_to_same_name(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """To its like of a sound copy, as data sets are laid out."""
    inner = file.relative_to(place.input) if file != place.input else Path()
    target = place.sound / inner
    file.unlink()
    file.symlink_to(target)
    return Damage("links to its sound copy", False, (target,))


def link_in_loop(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    file.unlink()
    if rng.random() < 0.5:
        file.symlink_to(file.name)
    else:
        file.symlink_to("nothing-there")
    return Damage("is a link to itself or to nothing", True)


def link_folder(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """A folder that links to one above it, or to another one outside."""
    folder = file.parent
    if file == place.input or folder == place.input:
        return None
    shutil.rmtree(folder)
    target = Path("..") if rng.random() < 0.5 else place.outside
    folder.symlink_to(target)
    return Damage(f"its folder links to {'the one above' if target == Path('..') else 'one outside'}", False)


def add_strange_files(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Files that file managers and archives leave behind, and a loop of folders."""
    if file == place.input:
        return None
    (file.parent / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    (file.parent / f"._{file.name}").write_bytes(b"\0\5\x16\7")
    (file.parent / "Thumbs.db").write_bytes(b"")
    (file.parent / "loop").symlink_to("..")
    return Damage("strange files beside it", False)


def forbid_reading(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    if os.geteuid() == 0:
        return None  # who may read everything
    file.chmod(0)
    return Damage("may not be read", True)


def grow_hugely(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Eight GiB that take no place on the disk."""
    os.truncate(file, 8 * 1024**3)
    return Damage("has 8 GiB", True)


FILES = (
    Mutation(remove_file, weight=2.0), Mutation(exchange_files), Mutation(rename_file), Mutation(replace_by_folder, weight=0.5),
    Mutation(replace_by_pipe), Mutation(replace_by_device), Mutation(link_outside), Mutation(link_to_same_name, weight=0.5),
    Mutation(link_in_loop, weight=0.5), Mutation(link_folder, weight=0.5), Mutation(add_strange_files, weight=0.3),
    Mutation(forbid_reading, weight=0.5), Mutation(grow_hugely, weight=0.5),
)  # fmt: skip
