"""Batches on worker processes: one that is killed, Ctrl-C in the middle, and where the processes listen."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from batch_logs import FAST, install_reader, lay_out_logs, tell

from log2sim.batch.discovery import find_logs
from log2sim.batch.folder import BatchFolder
from log2sim.batch.jobs import make_jobs
from log2sim.batch.rows import Row

ROOT = Path(__file__).resolve().parents[1]
LIMIT_S = 300

pytestmark = pytest.mark.slow


def start(root: Path, out: Path, site: Path) -> subprocess.Popen[str]:
    """Start a batch on two workers in a group of processes of its own, as a terminal does."""
    pytest.importorskip("distributed")
    path = os.pathsep.join([str(site), str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", "log2sim", "batch", str(root), "--out", str(out), "--jobs", "2", *FAST],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip


def wait_until(is_so: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not is_so():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def rows_of(root: Path, out: Path) -> dict[str, Row | None]:
    folder = BatchFolder.load(out)
    return {job.log: folder.read_row(job.name) for job in make_jobs(find_logs(root), out, "")}


def listening_addresses(pids: list[int]) -> set[str]:
    psutil = pytest.importorskip("psutil")
    found = [c for pid in pids for c in psutil.Process(pid).net_connections("inet")]
    return {c.laddr.ip for c in found if c.status == psutil.CONN_LISTEN}


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    install_reader(tmp_path / "site")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    return tmp_path / "site"


def test_a_log_that_kills_its_worker_is_repeated_and_the_others_do_not_suffer(
    tiny_folder: Path, tmp_path: Path, site: Path
) -> None:
    psutil = pytest.importorskip("psutil")
    root, out = lay_out_logs(tmp_path / "root", tiny_folder, "a", "z"), tmp_path / "out"
    tell(root / "killed", "die-once", tiny_folder)
    tell(root / "killer", "die", tiny_folder)
    process = start(root, out, site)
    wait_until(lambda: len(psutil.Process(process.pid).children(recursive=True)) >= 3, process)
    workers = [child.pid for child in psutil.Process(process.pid).children(recursive=True)]
    wait_until(lambda: (out / "logs" / "a" / "row.json").exists(), process)
    assert listening_addresses([process.pid, *(w for w in workers if psutil.pid_exists(w))]) == {"127.0.0.1"}
    _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 7, errors
    found = {log: (row.status, row.attempts, row.error_kind) for log, row in rows_of(root, out).items() if row}
    assert found == {
        "a": ("done", 1, ""),
        "z": ("done", 1, ""),
        "killed": ("done", 2, ""),
        "killer": ("failed", 2, "WorkerDied"),
    }
    assert "Traceback" not in errors


def test_a_worker_that_is_killed_from_outside_loses_nothing(tiny_folder: Path, tmp_path: Path, site: Path) -> None:
    psutil = pytest.importorskip("psutil")
    root, out = lay_out_logs(tmp_path / "root", tiny_folder, *"abcdef"), tmp_path / "out"
    process = start(root, out, site)
    wait_until(lambda: any(out.glob("logs/[a-f]/row.json")), process)
    spawned = [c for c in psutil.Process(process.pid).children() if "spawn_main" in " ".join(c.cmdline())]
    assert len(spawned) == 2
    os.kill(spawned[0].pid, signal.SIGKILL)
    _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, errors
    assert {row.status for row in rows_of(root, out).values() if row} == {"done"}
    assert len(list(out.glob("logs/*/scenario.json"))) == 6


def test_after_ctrl_c_a_table_is_there_and_the_same_command_goes_on(
    tiny_folder: Path, tmp_path: Path, site: Path
) -> None:
    root, out = lay_out_logs(tmp_path / "root", tiny_folder, *"abcdef"), tmp_path / "out"
    process = start(root, out, site)
    wait_until(lambda: any(out.glob("logs/[a-f]/row.json")), process)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert errors.rstrip().splitlines()[-1].startswith("log2sim: interrupted")
    assert sorted(p.name for p in out.iterdir()) == ["batch.json", "logs", "table.html", "table.parquet"]
    assert [p for p in (out / "logs").iterdir() if p.name.startswith(".")] == []
    first = {path: path.stat().st_mtime_ns for path in out.glob("logs/*/row.json")}
    assert 1 <= len(first) < 6

    again = start(root, out, site)
    printed, errors = again.communicate(timeout=LIMIT_S)
    assert again.returncode == 0, errors
    assert f"{len(first)} of them done before" in printed
    assert {path: path.stat().st_mtime_ns for path in first} == first
    assert all(row is not None and row.is_done for row in rows_of(root, out).values())
