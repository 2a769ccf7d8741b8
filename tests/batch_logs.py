"""Logs below a folder for tests of batches, and a log format of another package that fails as it is told."""

from __future__ import annotations

import shutil
from pathlib import Path

from plain_settings import AGENTS_ONLY

FAST = ("--detector", "lidar:labels", *AGENTS_ONLY)

READER_MODULE = '''
"""Folders with a file told.txt: the log of a path, and what happens when it is opened for the first time."""
import os
import signal
import time
from pathlib import Path

from log2sim.logs.native.reader import READER as NATIVE


class ToldReader:
    name, looks_for, suffixes = "told", "told.txt", ()

    def matches(self, path):
        return (path / "told.txt").is_file()

    def sequences(self, path):
        return [path.resolve().name] if self.matches(path) else []

    def open(self, path, sequence):
        word, place = (path / "told.txt").read_text().split()
        marker = path / "opened"
        while word == "wait" and not (path / "go").exists():
            marker.write_text("")
            time.sleep(0.05)
        if word not in ("good", "wait") and not (word.endswith("once") and marker.exists()):
            marker.write_text("")
            if word.startswith("die"):
                os.kill(os.getpid(), signal.SIGKILL)
            raise MemoryError("told to")
        return NATIVE.open(Path(place), Path(place).name)


READER = ToldReader()
'''


def lay_out_logs(root: Path, log: Path, *names: str) -> Path:
    """Copy a log to several places below a folder."""
    for name in names:
        shutil.copytree(log, root / name)
    return root


def damage(log: Path) -> None:
    """Spoil the index of a log."""
    (log / "log.json").write_text('{"log_version": 1, "name": ')


def tell(folder: Path, word: str, log: Path) -> None:
    """Make a log of the format "told": "good", or "fail", "fail-once", "die" or "die-once" at its opening, or "wait" for a file "go"."""
    folder.mkdir(parents=True)
    (folder / "told.txt").write_text(f"{word} {log}")


def install_reader(site: Path) -> None:
    """Put a distribution with the reader and its entry point into a folder for `sys.path`."""
    site.mkdir()
    (site / "told_format.py").write_text(READER_MODULE)
    info = site / "told_format-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: told-format\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[log2sim.log]\ntold = told_format:READER\n")
