"""The folder of a batch: its settings, a folder for each log, and the tables."""

from __future__ import annotations

import glob
import secrets
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from log2sim.batch.rows import Row
from log2sim.config import Config
from log2sim.documents import read_json, write_json
from log2sim.errors import ConfigError, LogError
from log2sim.model_errors import first_problem
from log2sim.output_claims import claim
from log2sim.output_folders import replaced_folder
from log2sim.outputs import is_left_over, is_temporary, remove
from log2sim.version import __version__

SETTINGS_FILE = "batch.json"
LOGS = "logs"
SCENARIO_FILE, REPORT_FILE, ROW_FILE, ERROR_FILE = "scenario.json", "report.json", "row.json", "error.txt"
TOKEN_BYTES = 8
MAX_LISTED = 5


class BatchSettings(BaseModel):
    """What all logs of a batch share, as `batch.json` holds it.

    Attributes
    ----------
    token : str
        Random, so that workers on other machines can tell whether they see the same folder.
    log2sim_version : str
    root : str
        Folder that is searched for logs, absolute.
    format : str
        Format that is looked for, or "auto".
    follow_links : bool
    config : dict
        Settings of the reconstruction.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    batch_version: int = 1
    token: str
    log2sim_version: str
    root: str
    format: str
    follow_links: bool
    config: dict[str, Any]

    @classmethod
    def create(cls, root: Path, format: str, follow_links: bool, config: Config) -> BatchSettings:
        """Return the settings of a new batch."""
        return cls(
            token=secrets.token_hex(TOKEN_BYTES),
            log2sim_version=__version__,
            root=str(root.resolve()),
            format=format,
            follow_links=follow_links,
            config=config.to_dict(),
        )

    def differences(self, other: BatchSettings) -> list[str]:
        """List the settings in which two batches differ, as "name: ours, theirs"."""
        mine, theirs = (_flat(_compared(s)) for s in (self, other))
        names = [name for name in {**mine, **theirs} if mine.get(name) != theirs.get(name)]
        return [f"{name}: {mine.get(name)!r}, before {theirs.get(name)!r}" for name in names]


@dataclass(frozen=True)
class BatchFolder:
    """A folder of a batch.

    Attributes
    ----------
    path : Path
    settings : BatchSettings
    """

    path: Path
    settings: BatchSettings

    @classmethod
    def load(cls, path: Path) -> BatchFolder:
        """Open the folder of an earlier run.

        Raises
        ------
        LogError
            When it is none.
        """
        document = read_json(path / SETTINGS_FILE)
        try:
            return cls(path, BatchSettings.model_validate(document))
        except ValidationError as problem:
            raise LogError(f"{path / SETTINGS_FILE}: {first_problem(problem, BatchSettings)}") from None

    @classmethod
    def start(cls, path: Path, wanted: BatchSettings, *, overwrite: bool) -> BatchFolder:
        """Go on with the batch in a folder, or begin one.

        Raises
        ------
        ConfigError
            When the folder holds something else, a batch of other settings, or is in use by another run.
        """
        claim(path / SETTINGS_FILE, overwrite=False)
        if not is_batch(path):
            if path.exists() and any(entry.name != f".{SETTINGS_FILE}.lock" for entry in path.iterdir()):
                raise ConfigError(f"{path}: holds something else than a batch; give an empty or a new folder")
            write_json(path / SETTINGS_FILE, wanted.model_dump())
            return cls(path, wanted)
        earlier = cls.load(path)
        changed = wanted.differences(earlier.settings)
        if overwrite:
            shutil.rmtree(path / LOGS, ignore_errors=True)
            write_json(path / SETTINGS_FILE, wanted.model_dump())
            return cls(path, wanted)
        if changed:
            more = f" and {len(changed) - MAX_LISTED} more" if len(changed) > MAX_LISTED else ""
            raise ConfigError(
                f"{path}: holds a batch of other settings ({'; '.join(changed[:MAX_LISTED])}{more}); choose another folder, the "
                "same settings to go on, or --overwrite to start over"
            )
        return earlier

    def log_folder(self, name: str) -> Path:
        """Return the folder for a log."""
        return self.path / LOGS / name

    def read_row(self, name: str) -> Row | None:
        """Read what an earlier run noted about a log; None where there is nothing that can be used."""
        file = self.log_folder(name) / ROW_FILE
        if not file.is_file():
            return None
        try:
            row = Row.model_validate(read_json(file))
        except (LogError, ValidationError):
            return None
        return row if row.name == name else None

    def write_failure(self, row: Row, text: str) -> None:
        """Write the folder of a log that failed, in place of what an earlier run left there."""
        with replaced_folder(self.log_folder(row.name), overwrite=True) as unfinished:
            (unfinished / ERROR_FILE).write_text(text.rstrip() + "\n", encoding="utf-8", errors="backslashreplace")
            write_json(unfinished / ROW_FILE, row.model_dump())

    def take_unfinished(self, name: str) -> bool:
        """Remove what a worker that died left of the folder of a log; return whether there was something."""
        left = [path for path in (self.path / LOGS).glob(f".{glob.escape(name)}.*") if is_temporary(path)]
        for path in left:
            remove(path)
        return bool(left)

    def remove_left_over(self) -> None:
        """Remove what processes of this machine that are gone left of folders of logs."""
        for path in (self.path / LOGS).glob(".*"):
            if is_left_over(path):
                remove(path)


def _compared(settings: BatchSettings) -> dict[str, Any]:
    return {key: value for key, value in settings.model_dump().items() if key not in ("token", "batch_version")}


def is_batch(path: Path) -> bool:
    """Return whether a folder is that of a batch."""
    return (path / SETTINGS_FILE).is_file()


def _flat(document: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of nested documents under names such as "track.max_gap_s"."""
    flat: dict[str, Any] = {}
    for key, value in document.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
