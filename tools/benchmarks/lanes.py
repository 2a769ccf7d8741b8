"""Lane lines, markings and lanes in synthetic scenes, by light, weather and wear.

    python tools/bench.py lanes [--only PATTERN] [--rig cameras|lidar]

Each scene is rendered in its conditions, reconstructed and compared with its truth as `log2sim evaluate` does: precision and
recall of lane lines at 0.3 m within 40 m of the ego's path where a sensor saw the ground, lateral error, kinds, false length,
stop lines and crosswalks, borders of the roads, and how much of the true paths lies in a found lane. `--rig` leaves out the other sensors.
"""

from __future__ import annotations

import fnmatch
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from entry import SAMPLES

from benchmarks.table import cell, markdown
from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import Log, Scenario
from log2sim.errors import Log2SimError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import write_synthetic

Rig = Literal["all", "cameras", "lidar"]
HEADER = [
    "scene", "condition", "precision", "recall", "within 20 m", "off by, median", "95 %", "kind right", "false per 100 m", "stop lines",
    "crosswalks", "borders precision", "recall", "lanes precision", "recall", "center off by", "paths inside",
]  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A scene file under `samples`, and what of its environment is changed."""

    scene: str
    light: str = "noon"
    weather: str = "clear"
    note: str = ""

    @property
    def condition(self) -> str:
        """What a table calls it."""
        return ", ".join(part for part in (self.light, self.weather, self.note) if part not in ("", "clear"))

    @property
    def name(self) -> str:
        """Of its folder."""
        return "_".join([Path(self.scene).stem, self.light, self.weather])


CASES = (
    Case("crossing.toml"),
    Case("scenes/markings.toml"),
    Case("scenes/markings.toml", "overcast"),
    Case("scenes/markings.toml", "dusk"),
    Case("scenes/markings.toml", "night"),
    Case("scenes/markings.toml", "noon", "rain"),
    Case("scenes/markings.toml", "noon", "fog"),
    Case("scenes/motorway_markings.toml"),
    Case("scenes/motorway_markings.toml", "overcast", "rain"),
    Case("scenes/bend.toml", note="yellow, left-hand"),
    Case("scenes/bend.toml", "dusk", note="yellow, left-hand"),
    Case("scenes/left_hand.toml", note="left-hand"),
    Case("scenes/worn.toml", note="worn, old lines, shadows"),
    Case("scenes/worn.toml", "overcast", note="worn, old lines"),
    Case("scenes/night_wet.toml", "night", note="wet, glare"),
    Case("scenes/bare.toml", note="no markings"),
    Case("scenes/signals.toml", note="traffic lights"),
)


def with_rig(log: Log, rig: str) -> Log:
    """Leave out sensors."""
    if rig == "all":
        return log
    left_out = log.lidars if rig == "cameras" else log.cameras
    streams = {name: s for name, s in log.streams.items() if name not in left_out}
    if rig == "cameras":
        return replace(log, lidars={}, streams=streams)
    return replace(log, cameras={}, streams=streams, reference_camera=None, image_labels={})


def measure(case: Case, rig: Rig, folder: Path) -> dict[str, Any]:
    """Render one case, reconstruct it by its labels and compare the map with its truth."""
    scene = load_scene(SAMPLES / case.scene)
    light = scene.environment.model_copy(update={"light": case.light, "weather": case.weather})
    write_synthetic(scene.model_copy(update={"environment": light}), folder, seed=1)
    detector = "lidar:labels" if rig == "lidar" else "labels"
    result = reconstruct(with_rig(open_log(folder), rig), Config.load(detect={"name": detector}))
    return evaluate(result.scenario, Scenario.load(folder / "truth.json"))["map_features"] or {}


def row(case: Case, found: dict[str, Any]) -> list[str]:
    """A row of the table."""
    lines, borders, lanes = (found.get(name) or {} for name in ("lane_lines", "borders", "lanes"))

    def count(kind: str) -> str:
        n = found.get(kind) or {}
        false = f" + {n['false']}" if n.get("false") else ""
        return f"{n['found']} of {n['true']}{false}" if n.get("true") or false else "-"

    return [
        Path(case.scene).stem, case.condition, *(cell(lines.get(k)) for k in ("precision", "recall", "recall_20_m")),
        *(cell(lines.get(k), 3, " m") for k in ("lateral_median_m", "lateral_p95_m")), cell(lines.get("kind_accuracy")),
        cell(lines.get("false_m_per_100_m"), 1, " m"), count("stop_lines"), count("crosswalks"),
        *(cell(of.get(k)) for of in (borders, lanes) for k in ("precision", "recall")), cell(lanes.get("center_median_m"), 2, " m"), cell(lanes.get("inside")),
    ]  # fmt: skip


def main(only: str = "*", rig: Rig = "all") -> None:
    """Print the table of the cases that a pattern names, such as 'worn*' or '*_night_*'."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for case in (case for case in CASES if fnmatch.fnmatch(case.name, only)):
            try:
                rows.append(row(case, measure(case, rig, Path(folder) / case.name)))
            except Log2SimError as error:
                print(f"{case.name}: {error}", file=sys.stderr)
    print(markdown(HEADER, rows))
