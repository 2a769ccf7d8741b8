"""Which files make one recording: a bag, a rosbag2 folder, a bag that was split, several of them in a folder."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from log2sim.errors import LogError, MissingExtra
from log2sim.input_files import read_text
from log2sim.links import require_link_inside
from log2sim.logs.ros.containers import one_line

SUFFIXES = (".bag", ".db3", ".mcap")
METADATA = "metadata.yaml"
MAX_METADATA_BYTES = 16 * 1024 * 1024
SETTINGS = "topics.toml"
# "drive_2024-05-01-10-00-00_3.bag" and "drive_3.db3" are parts of a recording "drive".
_SPLIT = re.compile(r"^(?P<name>.*?)(?:_?\d{4}-\d\d-\d\d-\d\d-\d\d-\d\d)?_(?P<part>\d+)$")


@dataclass(frozen=True)
class Recording:
    """One recording, found by names alone.

    Attributes
    ----------
    name : str
    place : Path
        Its file or folder.
    files : tuple of Path
        In the order of the parts.
    settings : tuple of Path
        Where a TOML file for it may lie; the first that exists counts.
    """

    name: str
    place: Path
    files: tuple[Path, ...]
    settings: tuple[Path, ...]


def find_recordings(path: Path) -> dict[str, Recording]:
    """Find the recordings at a file or folder by name; none where there are none.

    Notes
    -----
    A folder with metadata.yaml is one recording. Bags of one name that are numbered from 0 are parts of one recording; other
    bags of a folder are recordings of their own.
    """
    path = path.absolute()
    try:
        if path.is_file():
            return {path.stem: _file_recording(path, path.parent)}
        if (path / METADATA).is_file() and _bags(path):
            return {path.name: _folder_recording(path, path)}
        found = {r.name: r for r in _loose(path)}
        for folder in sorted(p for p in path.iterdir() if p.is_dir() and (p / METADATA).is_file()):
            if _bags(folder):
                found[folder.name] = _folder_recording(folder, path)
        return found
    except OSError:
        return {}


def recorded_files(recording: Recording, notes: list[str]) -> tuple[list[Path], str]:
    """Return the files of a recording that are there, in order, and the compression of its messages."""
    if recording.place.is_dir():
        for file in recording.files:
            require_link_inside(file, recording.place)
    metadata = recording.place / METADATA
    if not recording.place.is_dir() or not metadata.is_file():
        _note_missing_parts(recording, notes)
        return list(recording.files), ""
    require_link_inside(metadata, recording.place)
    document = _read_metadata(metadata)
    mode, method = (str(document.get(key) or "").lower() for key in ("compression_mode", "compression_format"))
    if mode == "file":
        raise LogError(f"{metadata}: its files are compressed whole ({method}); unpack them with `ros2 bag convert`")
    named = document.get("relative_file_paths") or []
    names = [PurePosixPath(str(name)).name for name in named if isinstance(named, list)]
    paths = [recording.place / name for name in names]
    missing = [p.name for p in paths if not p.is_file()]
    if paths and len(missing) == len(paths):
        raise LogError(f"{metadata}: none of the files that it names is there: {', '.join(missing[:5])}")
    if missing:
        notes.append(f"{len(missing)} of {len(paths)} files of the recording are missing: {', '.join(missing[:5])}")
    return [p for p in paths if p.is_file()] or list(recording.files), method if mode == "message" else ""


def _bags(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())


def _file_recording(path: Path, root: Path) -> Recording:
    next_to = path.with_name(f"{path.stem}.{SETTINGS}")
    return Recording(path.stem, path, (path,), (next_to, path.parent / SETTINGS, root / SETTINGS))


def _folder_recording(folder: Path, root: Path) -> Recording:
    settings = (folder / SETTINGS, folder.parent / f"{folder.name}.{SETTINGS}", root / SETTINGS)
    return Recording(folder.name, folder, tuple(sorted(_bags(folder), key=_part)), settings)


def _loose(folder: Path) -> list[Recording]:
    """Find the recordings among the bags that lie in a folder."""
    groups: dict[tuple[str, str], list[Path]] = {}
    for path in _bags(folder):
        match = _SPLIT.match(path.stem)
        key = (match["name"] or folder.name) if match else path.stem
        groups.setdefault((key, path.suffix.lower()), []).append(path)
    found = []
    for (name, _), paths in groups.items():
        parts = sorted(paths, key=_part)
        numbers = [_part(p) for p in parts]
        if len(parts) > 1 and numbers[0] == 0 and len(set(numbers)) == len(numbers):
            settings = (folder / f"{name}.{SETTINGS}", folder / SETTINGS)
            found.append(Recording(name, folder, tuple(parts), settings))
        else:
            found += [_file_recording(p, folder) for p in parts]
    # Files of one name in two formats would hide each other.
    stems = [r.name for r in found]
    return [Recording(r.files[0].name, r.place, r.files, r.settings) if stems.count(r.name) > 1 else r for r in found]


def _part(path: Path) -> int:
    match = _SPLIT.match(path.stem)
    return int(match["part"]) if match else 0


def _note_missing_parts(recording: Recording, notes: list[str]) -> None:
    if len(recording.files) > 1:
        numbers = [_part(p) for p in recording.files]
        missing = sorted(set(range(numbers[-1] + 1)) - set(numbers))
        if missing:
            notes.append(
                f"{len(missing)} of {numbers[-1] + 1} files of the recording are missing, first part {missing[0]}"
            )


def _read_metadata(path: Path) -> dict[str, Any]:
    try:
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError
    except ImportError:
        raise MissingExtra("reading rosbag2 folders", "ros") from None
    text = read_text(path, MAX_METADATA_BYTES, LogError)
    try:
        document = YAML(typ="safe", pure=True).load(text)["rosbag2_bagfile_information"]
        if not isinstance(document, dict):
            raise TypeError("no table")
    except (YAMLError, ValueError, TypeError, KeyError, RecursionError) as problem:
        raise LogError(f"{path}: not the metadata of a rosbag2 recording: {one_line(problem)}") from None
    return document
