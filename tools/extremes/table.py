"""The table of extremes: named cases with the outcome that each must have. `stability.py` runs all of them, tests those that are theirs.

A case says what it found and whether that is what is required; it never raises for a wrong outcome.
"""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from worlds import tiny_scene, tiny_table

from log2sim import Config, Scenario, open_log
from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.logs.native.writer import write_log
from log2sim.pipeline import infer_scenario, observe_log, start
from log2sim.plan import Decision, Stage
from log2sim.report import Result
from log2sim.synth.synthesis import synthesize

RunBy = Literal["tests", "slow tests", "tool"]
FAR_M = np.array([691_000.0, 5_334_000.0])


@dataclass(frozen=True)
class Outcome:
    """What a case found: whether it is as required, in words, and the condition number and error where there are any."""

    ok: bool
    found: str
    condition: float | None = None
    error: float | None = None
    unit: str = "m"


@dataclass(frozen=True)
class Case:
    """A named extreme, what is required of it, how to run it, and by what: of the cases that take long, tests run some."""

    name: str
    required: str
    run: Callable[[], Outcome]
    run_by: RunBy = "tests"


CASES: list[Case] = []


def outcome_of(case: Case) -> Outcome:
    """Run a case; an exception that it does not expect is an outcome too, and never the required one."""
    try:
        return case.run()
    except Exception as error:
        return Outcome(False, f"raised {type(error).__name__}: {error}")


def case(
    name: str, required: str, *, run_by: RunBy = "tests"
) -> Callable[[Callable[[], Outcome]], Callable[[], Outcome]]:
    """Put a function into the table."""

    def add(run: Callable[[], Outcome]) -> Callable[[], Outcome]:
        CASES.append(Case(name, required, run, run_by))
        return run

    return add


LABELS = Config.load(detect={"name": "labels"})
Row = dict[str, str]


@lru_cache
def small_log() -> Log:
    """Six ticks of a street with a car, a parked car and a pedestrian."""
    (camera,), (lidar,) = tiny_table()["camera"], tiny_table()["lidar"]
    sensors = {
        "camera": [{**camera, "size_px": [320, 200]}], "lidar": [{**lidar, "channels": 20, "azimuth_step_deg": 0.6}],
    }  # fmt: skip
    return synthesize(tiny_scene(name="extreme", duration_s=0.6, **sensors), seed=0)[0]


@lru_cache
def files_of_small_log() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "log"
        write_log(small_log(), folder)
        return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


@contextmanager
def folder_of(change: Callable[[Path], object]) -> Iterator[Path]:
    """A folder with the small log, changed."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "log"
        for name, content in files_of_small_log().items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        change(folder)
        yield folder


def result_of(change: Callable[[Path], object], *, decode_images: bool = False) -> Result:
    """Reconstruct the changed log, whose images are decoded only where asked for: boxes come from its labels."""
    with folder_of(change) as folder:
        run = start(open_log(folder), LABELS)
        if decode_images:
            run = replace(run, plan=run.plan.variant(Decision(Stage.IMAGE_DECODING, True, "images are asked for")))
        return infer_scenario(replace(run, plan=run.plan.only_agents()), observe_log(run))


@lru_cache
def sound() -> Result:
    """What the small log gives when nothing is done to it."""
    return result_of(lambda folder: None)


def rows_changed(folder: Path, change: Callable[[Row], object]) -> None:
    """Change every row of every table."""
    for file in folder.rglob("*.csv"):
        with file.open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        for row in rows:
            change(row)
        with file.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


def farthest_m(a: Scenario, b: Scenario, shift_m: tuple[float, ...] = (0.0, 0.0)) -> float:
    """Largest distance of the waypoints of two scenarios in the world; infinite where they do not hold the same agents."""
    if [(x.id, len(x.waypoints)) for x in a.agents] != [(x.id, len(x.waypoints)) for x in b.agents]:
        return float("inf")
    move = np.array(b.map.offset_m[:2]) - np.array(a.map.offset_m[:2]) - np.array(shift_m[:2])
    apart = [
        np.hypot(x.waypoints.x_m - (y.waypoints.x_m + move[0]), x.waypoints.y_m - (y.waypoints.y_m + move[1])).max()
        for x, y in zip(a.agents, b.agents)
    ]
    return float(max(apart))


def same(result: Result, within_m: float, shift_m: tuple[float, ...] = (0.0, 0.0)) -> Outcome:
    error = farthest_m(sound().scenario, result.scenario, shift_m)
    return Outcome(error <= within_m, "the same" if error <= within_m else "another scenario", None, error)


def refused(run: Callable[[], object], words: str) -> Outcome:
    """A log, of files or in memory as a reader of others may make it, is refused with a message of ours that holds the words."""
    try:
        run()
    except LogError as error:
        return Outcome(words in str(error), f"refused: {str(error).split('/')[-1][:90]}")
    return Outcome(False, "accepted")


def known_and_finite(result: Result, least_agents: int) -> tuple[bool, str]:
    agents = result.scenario.others
    ways = [a.waypoints for a in result.scenario.agents]
    finite = all(np.isfinite(getattr(way, k)).all() for way in ways for k in ("x_m", "y_m", "yaw_rad"))
    return finite and len(agents) >= least_agents, f"{len(agents)} agents"
