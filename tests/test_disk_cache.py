"""The cache folder: entries come back as they were or not at all, the size keeps its limit, and no process disturbs another."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from log2sim.errors import ConfigError
from log2sim.files.cache import DIGITS, DiskCache

ROOT = Path(__file__).resolve().parents[1]


def name(k: int, group: str = "model.1234") -> str:
    return f"{group}.{k:015x}{k % 16:x}"


def files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def test_the_entries_that_were_not_used_for_longest_are_dropped(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path, max_bytes=16 * 1000)
    same_folder = [name(16 * k) for k in range(10)]  # a share of 1000 bytes
    old = time.time() - 10 * 3600
    for k, entry in enumerate(same_folder[:9]):
        assert cache.put(entry, b"x" * 100)
        os.utime(tmp_path / "0" / entry, (old + 60 * k, old + 60 * k))
    assert cache.get(same_folder[0]) is not None  # which is a use
    cache.put(same_folder[9], b"x" * 200)
    cache.finish({})
    kept = [entry for entry in same_folder if cache.get(entry) is not None]
    assert kept == [same_folder[0], *same_folder[3:]]  # 900 bytes


def test_the_limit_holds_over_all_folders_and_while_a_run_goes_on(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path, max_bytes=160_000)
    for k in range(1000):
        cache.put(name(k), b"x" * 1000)
    assert sum(p.stat().st_size for p in files(tmp_path)) <= 160_000 * (1 + 1 / 16) + 16 * 1000
    assert all(any((tmp_path / digit).iterdir()) for digit in DIGITS)
    cache.finish({"found": 3})
    assert sum(size for _, size in DiskCache(tmp_path).usage().values()) <= 160_000
    assert cache.last_run == {"found": 3}


def test_a_full_disk_costs_one_remark_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path))

    cache = DiskCache(tmp_path)
    monkeypatch.setattr(os, "replace", full)
    assert not cache.put(name(1), b"x")
    assert cache.problem == f"{tmp_path}: No space left on device"
    with pytest.raises(ConfigError, match="limit of the cache cannot be kept"):
        DiskCache(tmp_path).set_limit(5)
    assert files(tmp_path) == []


def test_processes_share_a_folder_that_is_too_small_for_them(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from log2sim.files.cache import DiskCache\n"
        "cache = DiskCache(Path(sys.argv[1]), max_bytes=16 * 4000)\n"
        "for k in range(400):\n"
        "    entry, content = f'model.{k % 40 * 16:016x}', bytes([k % 40]) * 1000\n"
        "    found = cache.get(entry)\n"
        "    assert found in (None, content), (entry, found[:9])\n"
        "    cache.put(entry, content)\n"
        "cache.finish({})\n"
        "assert cache.problem is None, cache.problem\n"
    )
    running = [subprocess.Popen([sys.executable, "-c", code, tmp_path], cwd=ROOT) for _ in range(2)]
    assert [process.wait() for process in running] == [0, 0]
    cache = DiskCache(tmp_path, max_bytes=16 * 4000)
    cache.put(name(0), b"")
    cache.finish({})
    assert 0 < sum(size for _, size in cache.usage().values()) <= 4000
