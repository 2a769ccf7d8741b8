"""Find logs of any format below a folder."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from log2sim.errors import ConfigError, LogError
from log2sim.files import plugins
from log2sim.files.inputs import follows_links
from log2sim.logs.opening import Reader, find_reader
from log2sim.scenarios.index import SCENARIO_FILE, find_scenarios

MAX_LEVELS = 8  # below the root; data sets have up to four (split, date, drive, sensor)
MAX_FOLDERS = 500_000  # that are looked into, so that a wrong root such as "/" ends
SCENARIO = "scenario"  # in place of a log format: scenario files, which are there already and are only replayed


@dataclass(frozen=True)
class FoundLog:
    """A log that can be opened, or a scenario file."""

    id: str  # path of the log below the root, with the sequence where one folder holds several; unique within a format
    path: Path  # what `open_log` or `Scenario.load` takes
    format: str
    sequence: str


def find_logs(
    root: Path, *, format: str = "auto", leave_out: Path | None = None, max_folders: int = MAX_FOLDERS
) -> list[FoundLog]:
    """Find all logs at and below a folder, in the order of their ids.

    `root`: a folder, or the file of one log. `format`: name of the only format that is looked for, "auto", or "scenario" for
    scenario files: of a batch those of its logs, elsewhere all that begin as one.
    `leave_out`: folder that is not looked into. `max_folders`: that are looked into before the search is given up.
    Raises `LogError` when the root is missing or holds no log, `ConfigError` for an unknown format or too many folders.

    A log is reported at the deepest folder that its reader accepts. Nothing below a folder that is a log itself is another one. Hidden
    folders are skipped, and links are followed only where that was asked for (`log2sim.files.inputs.following_links`).
    """
    if not root.exists():
        raise LogError(f"{root}: no such folder; give a folder with logs")
    if format == SCENARIO:
        inside = root / "logs" if (root / "batch.json").is_file() else root.parent if root.is_file() else root
        paths = (
            [root]
            if root.is_file()
            else [p for p in map(inside.joinpath, find_scenarios(inside)) if follows_links() or not p.is_symlink()]
        )
        if not paths:
            raise LogError(f"{root}: holds no scenario")
        ids = [p.relative_to(inside).as_posix().removesuffix(f"/{SCENARIO_FILE}") for p in paths]
        return [FoundLog(_text(id), p, SCENARIO, "") for id, p in zip(ids, paths)]
    names = plugins.names("log") if format == "auto" else [format]
    readers: dict[str, Reader] = {name: plugins.load("log", name) for name in names}
    if root.is_file():
        name = find_reader(root) if format == "auto" else format
        reader: Reader = plugins.load("log", name)
        found = [FoundLog(_text(sequence), root, name, sequence) for sequence in reader.sequences(root)]
    else:
        left_out = None if leave_out is None else leave_out.resolve()
        found = _Search(root, readers, left_out, max_folders).below(root, MAX_LEVELS)
    if not found:
        kind = "of any format" if format == "auto" else f"of format '{format}'"
        raise LogError(f"{root}: holds no log {kind}, down to {MAX_LEVELS} folders below it")
    return sorted(found, key=lambda log: (log.id, log.format))


class _Search:
    """A search below one root."""

    def __init__(self, root: Path, readers: Mapping[str, Reader], leave_out: Path | None, max_folders: int) -> None:
        self.root, self.readers, self.leave_out, self.max_folders = root, readers, leave_out, max_folders
        self._seen: set[Path] = set()

    def below(self, folder: Path, levels: int) -> list[FoundLog]:
        """Return the logs at and below a folder, of which `levels` more levels are searched."""
        if len(self._seen) >= self.max_folders:
            raise ConfigError(
                f"{self.root}: more than {self.max_folders} folders are below it; give the folder of the logs"
            )
        self._seen.add(folder.resolve())
        held = self._held(folder)
        own_name = folder.resolve().name
        for name, sequences in held.items():  # a log itself, rather than a folder that holds some
            if sequences == [own_name] and not (folder / own_name).is_dir():
                return [self._log(folder, name, own_name)]
        folders, stems = self._entries(folder)
        deeper = [log for child in folders for log in self.below(child, levels - 1)] if levels else []
        # Names under which a reader may list a log that lies deeper, when it is asked for those of this folder. A file here
        # that has the name, with any suffix, is a log of its own.
        known = {
            (log.format, name)
            for log in deeper
            for place in (log.path.relative_to(folder).as_posix(),)
            for name in (place, f"{place}/{log.sequence}", *({log.sequence} - stems))
        }
        own = [(name, s) for name, some in held.items() for s in some if (name, s) not in known and s[0] != "."]
        return [*deeper, *(self._log(folder, name, sequence) for name, sequence in own)]

    def _held(self, folder: Path) -> dict[str, list[str]]:
        """Return the sequences at a folder by format."""
        held = {}
        for name, reader in self.readers.items():
            try:
                sequences = reader.sequences(folder) if reader.matches(folder) else []
            except Exception as error:  # of a plug-in, which should raise none
                raise ConfigError(
                    f"log format '{name}': its reader fails on {folder}: {type(error).__name__}: {error}"
                ) from error
            if sequences:
                held[name] = sequences
        return held

    def _entries(self, folder: Path) -> tuple[list[Path], set[str]]:
        """Return the folders in a folder that are searched, and the names of its files up to any dot; none if it cannot be listed."""
        try:
            with os.scandir(folder) as entries:
                listed = sorted((e for e in entries if not e.name.startswith(".")), key=lambda e: e.name)
        except OSError:
            return [], set()
        inner = [Path(e.path) for e in listed if e.is_dir(follow_symlinks=follows_links())]
        inner = [path for path in inner if path.resolve() not in self._seen and path.resolve() != self.leave_out]
        parts = [e.name.split(".") for e in listed if not e.is_dir()]
        return inner, {".".join(part[:k]) for part in parts for k in range(1, len(part) + 1)}

    def _log(self, folder: Path, format: str, sequence: str) -> FoundLog:
        parts = folder.relative_to(self.root).parts
        name = sequence.rpartition("/")[2]
        is_itself = bool(parts) and folder.name == name
        return FoundLog(_text("/".join(parts if is_itself else (*parts, sequence))), folder, format, sequence)


def _text(name: str) -> str:
    """Return a name with escapes for bytes that are no UTF-8, which files of text cannot hold."""
    return name.encode("utf-8", "backslashreplace").decode()
