"""A run shared out over processes gives what one process gives, and leaves none of them behind."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plain_settings import AGENTS_ALONE
from test_first_pass import STAMPS, TICKS, Truth, driving_log, with_records
from worlds import tiny_log, tiny_table

from log2sim import Config, reconstruct
from log2sim.datatypes import Log
from log2sim.errors import Log2SimError, PluginError, RecordError
from log2sim.files.processes import in_background, map_in_processes
from log2sim.files.stages import StageClock
from log2sim.perception import first_pass
from log2sim.perception.first_pass import Observations, observe
from log2sim.perception.run_detectors import Detectors
from log2sim.perception.sync import synchronize
from log2sim.pipeline import observe_log, start
from log2sim.plan import make_plan, select_sensors
from log2sim.road import map_parts

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
ROOT = Path(__file__).resolve().parents[1]


def content(value: Any) -> Any:
    """All numbers and texts in a value, bit for bit."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: content(getattr(value, f.name)) for f in fields(value) if f.name not in ("points", "records")}
    if isinstance(value, Mapping):
        return {str(key): content(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [content(item) for item in value]
    return value if isinstance(value, (str, int, bool, type(None))) else repr(value)


def seen(log: Log, jobs: int) -> Observations:
    config = Config()
    sensors = select_sensors(log, config)
    schedule = synchronize(log, sensors.cameras)
    plan = make_plan(log, config, sensors, schedule.t_ns)
    detectors = Detectors(Truth(log, looks=True), None)
    return observe(log, schedule, plan, detectors=detectors, config=config, clock=StageClock(), jobs=jobs)


def damaged() -> Log:
    """A log whose pictures are copies from the second on, of which one cannot be read, and whose third sweep repeats the second."""
    log, _ = driving_log(cameras=("front", "left"))
    random = np.random.default_rng(0).integers(0, 255, (TICKS, 60, 120, 3), dtype=np.uint8)
    sweep = log.streams["top"].read

    def left(i: int) -> Any:
        if i == 2:
            raise RecordError("left 2: torn")
        return random[i].repeat(10, 0).repeat(10, 1)

    return with_records(
        log, front=lambda i: random[0].repeat(10, 0).repeat(10, 1), left=left, top=lambda i: sweep((0, 1, 1, 3)[i])
    )


@pytest.mark.parametrize(("jobs", "ticks"), [(2, 1), (3, 2), (3, 3)])
def test_records_that_repeat_are_told_alike_by_any_number_of_processes(
    jobs: int, ticks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(first_pass, "PART_TICKS", ticks)
    alone, shared = seen(damaged(), 1), seen(damaged(), jobs)
    assert content(alone) == content(shared)
    assert alone.unseen == {"front": [1, 2, 3], "left": [2]}
    assert [f.start_s for f in shared.faults if f.kind == "repeated_sweeps"] == [(STAMPS[2] - STAMPS[0]) / 1e9]
    assert shared.unreadable == alone.unreadable == {"left": {"count": 1, "first": "left 2: torn"}}


@pytest.mark.matrix
@pytest.mark.parametrize(("detector", "settings"), [("lidar:vehicle", AGENTS_ALONE), ("labels+lidar:vehicle", {})])
def test_scenarios_of_any_number_of_processes_are_the_same(
    detector: str, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(first_pass, "PART_TICKS", 2)
    monkeypatch.setattr("log2sim.agents.estimate.ROWS_A_PROCESS", 1)
    monkeypatch.setattr("log2sim.road.map_parts.PART_CELLS", 500)
    config = Config.load(settings=["lidar.sweeps=2"], detect={"name": detector}, **settings)
    made = [reconstruct(tiny_log()[0], config, jobs=jobs) for jobs in (1, 3)]
    assert len({json.dumps(result.scenario.to_dict(), sort_keys=True) for result in made}) == 1
    assert len({str(result.report["detections"]) for result in made}) == 1
    assert all(stage["seconds"] > 0 for stage in made[1].report["stages"] if stage["stage"] in ("cloud", "measure"))
    if not settings:  # the map is drawn in parts, which processes share
        assert len(map_parts.parts_of(made[0].log, made[0].scenario, Config().map.cell_m)) > 1
        assert made[1].scenario.map_features is not None
        assert made[1].scenario.map_features.markings


def test_frames_are_skipped_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    small = [{**tiny_table()["camera"][0], "size_px": [240, 150]}]
    log, _ = tiny_log(duration_s=1.2, camera=small)

    def find(image: Any) -> list[Any]:
        return [(10.0, 10.0, 60.0, 50.0, 0.9, "car")] if image[::7].mean() % 1 < 0.3 else []

    monkeypatch.setattr(first_pass, "PART_TICKS", 1)
    config = Config.load(calibration={"check": False}, **AGENTS_ALONE)
    alone, shared = (observe_log(start(log, config, detector=find, cache=False, jobs=jobs)) for jobs in (1, 2))
    assert content(alone) == content(shared)
    assert sum(alone.frames_skipped.values()) > 0


# --- processes


def test_results_come_in_order_and_tasks_are_made_when_they_are_needed() -> None:
    asked: list[int] = []

    def tasks() -> Iterator[int]:
        for k in range(40):
            asked.append(k)
            yield k

    results = map_in_processes(lambda k: (k, os.getpid()), tasks(), 2)
    first = next(results)
    assert len(asked) < 40
    found = [first, *results]
    assert [k for k, _ in found] == list(range(40))
    assert os.getpid() not in {process for _, process in found}


def test_errors_come_back_as_what_they_are_and_no_process_is_left() -> None:
    def fail(k: int) -> int:
        if k == 8:
            raise PluginError("detector 'mine': broken")
        return os.getpid()

    results, known = map_in_processes(fail, range(9), 2), set[int]()
    with pytest.raises(PluginError) as raised:
        known.update(results)
    assert str(raised.value) == "detector 'mine': broken"
    assert "in fail" in raised.value.__notes__[0]
    assert known
    assert not any(Path(f"/proc/{process}").exists() for process in known)


def test_a_process_that_dies_is_an_error_and_no_endless_wait() -> None:
    with pytest.raises(Log2SimError, match="a process of this run ended"):
        list(map_in_processes(lambda k: os.kill(os.getpid(), signal.SIGKILL), range(4), 2))


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_is_done_in_the_background_comes_back_with_its_error_and_leaves_no_process(jobs: int) -> None:
    with in_background(lambda: os.getpid(), jobs) as result:
        process = result()
    assert (process == os.getpid()) == (jobs == 1)
    with pytest.raises(PluginError, match="broken"), in_background(lambda: broken("broken"), jobs) as result:
        result()
    with pytest.raises(KeyError), in_background(lambda: time.sleep(60), jobs):
        raise KeyError  # left before it is done
    assert multiprocessing.active_children() == []


def broken(reason: str) -> None:
    raise PluginError(reason)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_processes_end_with_the_one_that_started_them(number: int) -> None:
    code = (
        "import os, sys, time\n"
        "from log2sim.files.processes import map_in_processes\n"
        "def work(k):\n"
        "    if k > 1: time.sleep(2)\n"
        "    return os.getpid()\n"
        "for process in map_in_processes(work, range(100), 2):\n"
        "    print(process, flush=True)\n"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=ROOT) as started:
        assert started.stdout is not None
        children = [Path(f"/proc/{int(started.stdout.readline())}") for _ in range(2)]
        started.send_signal(number)
        assert started.wait(timeout=20) == -number
    deadline = time.monotonic() + 20
    while any(child.exists() for child in children) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(child.exists() for child in children)


@pytest.mark.slow
def test_a_script_without_a_guard_may_use_processes(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from log2sim import Config, open_log, reconstruct\n"
        f"log = open_log({str(ROOT / 'samples' / 'crossing')!r})\n"
        "config = Config.load(detect={'name': 'lidar:labels'}, stop_s=1.0, map={'lanes': False})\n"
        "print(len(reconstruct(log, config, jobs=2).scenario.agents))\n"
    )
    ran = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, cwd=ROOT)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert int(ran.stdout) > 1
