"""Batches on worker processes: some that are killed, Ctrl-C in the middle, a scheduler of others, and where they listen."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from batch_logs import FAST, install_reader, lay_out_logs, tell
from benchmarks.tag_worlds import traffic
from command_line import run

from log2sim import open_log, reconstruct
from log2sim.batch.discovery import find_logs
from log2sim.batch.folder import BatchFolder, Row, make_jobs
from log2sim.errors import ConfigError
from log2sim.files.cluster import Sent

ROOT = Path(__file__).resolve().parents[1]
LIMIT_S = 120
Start = Callable[[Path, Path], subprocess.Popen[str]]
# Ends when its standard input does, so that it never outlives the test.
SCHEDULER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    options = {"n_workers": 1, "threads_per_worker": 1, "host": "127.0.0.1", "protocol": "tcp://"}
    with LocalCluster(dashboard_address=None, worker_dashboard_address=None, **options) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""

pytestmark = pytest.mark.slow


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
    """Addresses at which processes wait for connections."""
    psutil = pytest.importorskip("psutil")
    found = [c for pid in pids for c in psutil.Process(pid).net_connections("inet")]
    return {c.laddr.ip for c in found if c.status == psutil.CONN_LISTEN}


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    psutil = pytest.importorskip("psutil")
    return [c.pid for c in psutil.Process(process.pid).children() if "spawn_main" in " ".join(c.cmdline())]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("batch") / "site"
    install_reader(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        yield folder


@pytest.fixture
def start(site: Path, interruptible: None) -> Iterator[Start]:
    """Start a batch on two workers in a group of processes of its own, as a terminal does; none outlives the test."""
    pytest.importorskip("distributed")
    path = os.pathsep.join([str(site), str(ROOT), os.environ.get("PYTHONPATH", "")])
    started: list[subprocess.Popen[str]] = []

    def begin(root: Path, out: Path) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "log2sim", "batch", str(root), "--out", str(out), "--jobs", "2", *FAST]
        (out.parent / "temporary").mkdir()
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
            env={**os.environ, "PYTHONPATH": path, "TMPDIR": str(out.parent / "temporary")},
        )  # fmt: skip
        started.append(process)
        return process

    yield begin
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def test_workers_that_die_lose_no_log_but_the_one_that_kills_them(
    tiny_folder: Path, tmp_path: Path, start: Start
) -> None:
    root, out = tmp_path / "root", tmp_path / "out"
    for name, word in {"a": "wait", "b": "wait", "y-killed-once": "die-once", "z-killer": "die"}.items():
        tell(root / name, word, tiny_folder)
    process = start(root, out)
    wait_until(lambda: all((root / name / "opened").exists() for name in "ab"), process)
    workers = workers_of(process)
    assert len(workers) == 2
    assert listening_addresses([process.pid, *workers]) == {"127.0.0.1"}
    os.kill(workers[0], signal.SIGKILL)
    for name in "ab":
        (root / name / "go").touch()
    _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 7, errors
    assert "Traceback" not in errors
    rows = {log: row for log, row in rows_of(root, out).items() if row}
    assert {log: row.status for log, row in rows.items()} == {
        **dict.fromkeys("ab", "done"), "y-killed-once": "done", "z-killer": "failed",
    }  # fmt: skip
    # Of the worker that was killed from outside, and of those that logs killed: what ran or waited there begins once more.
    assert max(rows[log].attempts for log in "ab") <= 2
    assert (rows["y-killed-once"].attempts, rows["z-killer"].error_kind) == (2, "WorkerDied")
    assert len(list(out.glob("logs/*/scenario.json"))) == 3


def test_after_ctrl_c_a_table_is_there_and_the_same_command_goes_on(
    tiny_folder: Path, tmp_path: Path, start: Start
) -> None:
    root, out = lay_out_logs(tmp_path / "root", tiny_folder, *"abc"), tmp_path / "out"
    waiting = [root / name for name in ("x-waits", "y-waits", "z-waits")]
    for log in waiting:
        tell(log, "wait", tiny_folder)
    process = start(root, out)
    # Both workers are at a log that does not end: interrupted, the batch does not wait for them.
    wait_until(lambda: sum((log / "opened").exists() for log in waiting) == 2, process)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert errors.rstrip().splitlines()[-1].startswith("log2sim: interrupted")
    assert sorted(p.name for p in out.iterdir()) == ["batch.json", "logs", "table.html", "table.parquet"]
    assert [p for p in (out / "logs").iterdir() if p.name.startswith(".")] == []
    assert list((tmp_path / "temporary").iterdir()) == []
    first = {path: path.stat().st_mtime_ns for path in out.glob("logs/*/row.json")}
    assert len(first) == 3

    for log in waiting:
        (log / "go").touch()
    again = run("batch", root, "--out", out, "--jobs", 1, *FAST)
    assert again.code == 0, again.err
    assert f"{len(first)} of them done before" in again.out
    assert {path: path.stat().st_mtime_ns for path in first} == first
    assert all(row is not None and row.is_done for row in rows_of(root, out).values())


@pytest.fixture(scope="module")
def scheduler(site: Path) -> Iterator[str]:
    """Address of a Dask scheduler with one worker, both of somebody else; the worker is started again when it dies."""
    pytest.importorskip("distributed")
    program = site.parent / "scheduler.py"
    program.write_text(SCHEDULER)
    path = os.pathsep.join([str(site), str(ROOT), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        stderr=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": path, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"},
    )  # fmt: skip
    assert process.stdout is not None
    yield process.stdout.readline().strip()
    process.communicate("", timeout=LIMIT_S)
    assert process.returncode == 0


def test_the_workers_of_a_scheduler_run_a_batch_and_go_on_for_others(
    tiny_folder: Path, tmp_path: Path, scheduler: str
) -> None:
    root, out = lay_out_logs(tmp_path / "root", tiny_folder, "a"), tmp_path / "out"
    tell(root / "b-killed-once", "die-once", tiny_folder)
    ran = run("batch", root, "--out", out, "--scheduler", scheduler, *FAST)
    assert ran.code == 0, ran.err
    rows = {log: (row.status, row.attempts) for log, row in rows_of(root, out).items() if row}
    assert rows == {"a": ("done", 1), "b-killed-once": ("done", 2)}
    assert len(list(out.glob("logs/*/scenario.json"))) == 2
    from distributed import Client

    with Client(scheduler, timeout=LIMIT_S) as client:
        assert client.submit(sum, [1, 2]).result(timeout=LIMIT_S) == 3


def test_the_workers_of_a_scheduler_find_situations_drive_a_policy_and_replay(tmp_path: Path, scheduler: str) -> None:
    pytest.importorskip("duckdb")
    for seed in range(4):
        traffic(seed, count=8, duration_s=12.0).scenario.save(tmp_path / "found" / f"{seed}" / "scenario.json")
    (tmp_path / "mine.py").write_text(
        "from log2sim.simulation.policy import Controls\n\n\ndef full(seen):\n"
        "    if seen.t_s < 0.1 and seen.ego.speed_mps > 26.0:\n        raise ValueError('mine')\n"
        "    return Controls(2.5, 0.0)\n"
    )
    ran = run("find", tmp_path / "found", "cut_in", "--scheduler", scheduler)
    assert ran.code == 0, ran.err
    about = []
    for name, workers in (("there", ("--scheduler", scheduler)), ("here", ("--jobs", 1))):
        policy, worst = f"{tmp_path / 'mine.py'}:full", int(name == "here")
        ran = run("test", policy, tmp_path / "found", "cut_in", "-o", tmp_path / name, "--runs", 40, "--worst", worst, *workers)  # fmt: skip
        assert ran.code == 0, ran.err
        about.append(json.loads((tmp_path / name / "test.json").read_text()))
    assert about[0] == about[1]
    assert about[0]["runs"] == 40
    assert about[0]["failures"] > about[0]["errors"] > 0
    p = about[0]["probability"]
    assert 0 <= p["low"] <= p["probability"] <= p["high"] <= 1
    (shown,) = (tmp_path / "here").glob("run-*/replay.json")
    assert shown.with_name("view.html").exists()
    assert shown.parent.name in (tmp_path / "here" / "report.html").read_text()
    ran = run("batch", tmp_path / "found", "-o", tmp_path / "replays", "--format", "scenario", "--scheduler", scheduler)
    assert ran.code == 0, ran.err
    assert len(list((tmp_path / "replays").glob("logs/*/replay.json"))) == 4


def test_the_workers_of_a_scheduler_share_the_ticks_of_one_log(
    tiny_folder: Path, tmp_path: Path, scheduler: str
) -> None:
    made = []
    for name, workers in (("there", ("--scheduler", scheduler)), ("here", ("--jobs", 1))):
        out = tmp_path / f"{name}.json"
        options = ("--report", tmp_path / f"{name}-report.json", "--no-cache", *workers)
        ran = run("reconstruct", tiny_folder, "-o", out, "--detector", "labels+lidar:labels", *options)
        assert ran.code == 0, ran.err
        made.append(json.loads(out.read_text()))
    assert made[0] == made[1]
    assert len(made[0]["agents"]) > 1
    with pytest.raises(ConfigError, match="only detectors of log2sim"):
        reconstruct(open_log(tiny_folder), detector=lambda image: [], scheduler=scheduler)


def test_a_worker_refuses_what_another_version_sent_and_says_which_folder_it_lacks(
    log_folder: Path, site: Path
) -> None:
    pytest.importorskip("cloudpickle")
    sent = Sent.of(open_log(log_folder))
    shutil.rmtree(log_folder)
    with pytest.raises(ConfigError, match=rf"worker on .*{log_folder.name}: no such folder.*same folders"):
        sent.received()
    with pytest.raises(ConfigError, match=r"worker on .*: has log2sim .*, and this is 0\.0"):
        replace(sent, version="0.0").received()
