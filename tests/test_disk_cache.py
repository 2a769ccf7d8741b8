"""The cache folder: entries come back as they were or not at all, the size keeps its limit, and no process disturbs another."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from log2sim.errors import ConfigError
from log2sim.files.cache import DIGITS, MAX_ENTRY_BYTES, DiskCache, cache_folder

ROOT = Path(__file__).resolve().parents[1]
needs_posix = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="permissions of POSIX")
no_root = pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() == 0, reason="root may write everywhere")


def name(k: int, group: str = "model.1234") -> str:
    return f"{group}.{k:015x}{k % 16:x}"


def files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def test_an_entry_comes_back_and_is_of_this_user_alone(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path / "c")
    assert cache.get(name(1)) is None
    assert cache.put(name(1), b"one")
    assert cache.put(name(1), b"other")
    assert DiskCache(tmp_path / "c").get(name(1)) == b"other"
    (path,) = files(tmp_path)
    assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0
    assert stat.S_IMODE((tmp_path / "c").stat().st_mode) & 0o077 == 0


@pytest.mark.parametrize(
    "wrong", ["../../x.0123456789abcdef", "a/b.0123456789abcdef", "model.xyz", ".0123456789abcdef", ""]
)
def test_a_name_cannot_leave_the_folder(wrong: str, tmp_path: Path) -> None:
    cache = DiskCache(tmp_path)
    with pytest.raises(ValueError, match="name of an entry"):
        cache.put(wrong, b"")
    with pytest.raises(ValueError, match="name of an entry"):
        cache.get(wrong)


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
    assert sum(DiskCache(tmp_path).usage().bytes.values()) <= 160_000
    assert cache.last_run == {"found": 3}


def test_a_lower_limit_holds_at_once_and_for_later_runs(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path)
    for k in range(64):
        cache.put(name(k), b"x" * 50_000)
    assert cache.usage().entries == {"model.1234": 64}
    cache.set_limit(1)
    assert sum(cache.usage().bytes.values()) <= 1024**2
    assert DiskCache(tmp_path).max_bytes == 1024**2
    (tmp_path / "settings.json").write_text('{"max_mb": "many"}')
    assert DiskCache(tmp_path).max_mb == 2048
    (tmp_path / "settings.json").write_text("[" * 100_000)
    assert DiskCache(tmp_path).max_mb == 2048


def test_only_entries_are_cleared(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path)
    for k in range(5):
        cache.put(name(k), b"x")
    (tmp_path / "0" / "a letter.txt").write_text("of the user")
    assert cache.clear() == 5
    assert cache.usage().entries == {}
    assert [p.name for p in files(tmp_path)] == ["a letter.txt"]


def test_what_is_no_file_of_fair_size_is_no_entry(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path)
    for k in range(4):
        cache.put(name(16 * k), b"x")
    paths = [tmp_path / "0" / name(16 * k) for k in range(4)]
    for path in paths[:3]:
        path.unlink()
    paths[0].mkdir()
    os.mkfifo(paths[1])
    with paths[2].open("wb") as file:
        file.truncate(MAX_ENTRY_BYTES + 1)
    assert [cache.get(path.name) for path in paths] == [None, None, None, b"x"]
    assert not cache.put(name(1), b"x" * (MAX_ENTRY_BYTES + 1))


@needs_posix
def test_entries_of_others_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = DiskCache(tmp_path)
    cache.put(name(1), b"x")
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert cache.get(name(1)) is None


@needs_posix
@no_root
def test_a_folder_that_may_not_be_written_costs_one_remark(tmp_path: Path) -> None:
    DiskCache(tmp_path).put(name(1), b"x")
    (tmp_path / "1").chmod(0o500)
    cache = DiskCache(tmp_path)
    assert cache.get(name(1)) == b"x"
    assert not cache.put(name(17), b"y")
    assert cache.problem is not None
    assert "Permission denied" in cache.problem
    assert not cache.put(name(2), b"y")
    cache.finish({})
    (tmp_path / "1").chmod(0o700)


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


def test_a_file_in_the_place_of_the_folder_costs_one_remark(tmp_path: Path) -> None:
    (tmp_path / "c").write_text("")
    cache = DiskCache(tmp_path / "c")
    assert not cache.put(name(1), b"x")
    assert cache.problem is not None
    assert cache.get(name(1)) is None


def test_what_killed_runs_left_is_removed_an_hour_later(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path)
    cache.put(name(0), b"x")
    left, fresh = tmp_path / "0" / ".writing-1-aa", tmp_path / "0" / ".writing-2-bb"
    for path in (left, fresh):
        path.write_bytes(b"half")
    os.utime(left, (time.time() - 7200, time.time() - 7200))
    cache.finish({})
    assert not left.exists()
    assert fresh.exists()
    assert cache.get(name(0)) == b"x"


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
    assert 0 < sum(cache.usage().bytes.values()) <= 4000


@pytest.mark.parametrize(
    ("system", "variables", "expected"),
    [
        ("linux", {}, "/home/me/.cache/log2sim"),
        ("linux", {"XDG_CACHE_HOME": "/fast"}, "/fast/log2sim"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, "/home/me/.cache/log2sim"),
        ("linux", {"XDG_CACHE_HOME": "/fast", "LOG2SIM_CACHE": "/mine"}, "/mine"),
        ("darwin", {}, "/home/me/Library/Caches/log2sim"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/log2sim/Cache"),
    ],
)
def test_the_folder_is_where_the_system_keeps_such_files(
    system: str, variables: dict[str, str], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("LOG2SIM_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(variable, raising=False)
    for variable, value in variables.items():
        monkeypatch.setenv(variable, value)
    monkeypatch.setenv("HOME", "/home/me")
    monkeypatch.setattr(sys, "platform", system)
    assert cache_folder() == Path(expected)
