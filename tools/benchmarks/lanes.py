"""Lane lines, markings, lanes and colors of vehicles in synthetic scenes, by light, weather and wear.

    python tools/bench.py lanes [--only PATTERN] [--seeds 1] [--detector NAME] [--rig cameras|lidar] [--keep DIR]

Each scene is rendered in its conditions, reconstructed and compared with its truth as `log2sim evaluate` does: precision and
recall of lane lines at 0.3 m within 40 m of the ego's path where a sensor saw the ground, lateral error, kinds, false length,
stop lines and crosswalks, and how much of the true paths lies in a found lane. A second table has the colors of vehicles by
light and weather. `--rig` leaves out the other sensors. `--keep` stores rendered logs and scenarios, and takes the logs that are there.
"""

from __future__ import annotations

import fnmatch
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
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
    "crosswalks", "lanes precision", "recall", "center off by", "paths inside",
]  # fmt: skip
COLORS = ["light and weather", "vehicles", "with color", "name right", "CIEDE2000", "confused"]


@dataclass(frozen=True)
class Case:
    """A scene file under `samples`, and what of its environment is changed."""

    scene: str
    light: str = "noon"
    weather: str = "clear"
    note: str = ""

    @property
    def sky(self) -> str:
        """Light and weather."""
        return self.light if self.weather == "clear" else f"{self.light}, {self.weather}"

    @property
    def condition(self) -> str:
        """What a table calls it."""
        return f"{self.sky}, {self.note}" if self.note else self.sky

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


def log_of(case: Case, seed: int, keep: Path) -> Path:
    """Render a case, unless its log is there."""
    folder = keep / f"{case.name}_{seed}"
    if not folder.exists():
        scene = load_scene(SAMPLES / case.scene)
        light = scene.environment.model_copy(update={"light": case.light, "weather": case.weather})
        write_synthetic(scene.model_copy(update={"environment": light}), folder, seed=seed)
    return folder


def with_rig(log: Log, rig: str) -> Log:
    """Leave out sensors."""
    if rig == "all":
        return log
    left_out = log.lidars if rig == "cameras" else log.cameras
    streams = {name: s for name, s in log.streams.items() if name not in left_out}
    if rig == "cameras":
        return replace(log, lidars={}, streams=streams)
    return replace(log, cameras={}, streams=streams, reference_camera=None, image_labels={})


def measure(case: Case, seed: int, detector: str, rig: Rig, keep: Path) -> dict[str, Any]:
    """Reconstruct one case and compare it with its truth."""
    folder = log_of(case, seed, keep)
    detector = "lidar:labels" if rig == "lidar" else detector
    result = reconstruct(with_rig(open_log(folder), rig), Config.load(detect={"name": detector}))
    result.scenario.save(folder.with_suffix(f".{rig}.json"))
    figures = evaluate(result.scenario, Scenario.load(folder / "truth.json"))
    keys = ("map_features", "colors", "signals")
    return {
        "case": case.name,
        "scene": case.scene,
        "sky": case.sky,
        "condition": case.condition,
        "seed": seed,
        **{k: figures[k] for k in keys},
    }


def mean_of(rows: Sequence[dict[str, Any]], *path: str) -> float | None:
    """Mean of a figure over seeds, None where it was never computed."""
    values = []
    for row in rows:
        value: Any = row["map_features"]
        for key in path:
            value = None if value is None else value[key]
        if value is not None:
            values.append(float(value))
    return float(np.mean(values)) if values else None


def counts(rows: Sequence[dict[str, Any]], kind: str) -> str:
    """How many of a kind were found, of how many, and false ones."""
    total: Counter[str] = Counter()
    for row in rows:
        if row["map_features"] is not None:
            total.update(row["map_features"][kind])
    if not total["true"] and not total["false"]:
        return "-"
    return f"{total['found']} of {total['true']}" + (f" + {total['false']}" if total["false"] else "")


def lane_rows(results: Sequence[dict[str, Any]]) -> list[list[str]]:
    """One row a case, the mean of its seeds."""
    out = []
    for name in dict.fromkeys(r["case"] for r in results):
        rows = [r for r in results if r["case"] == name]
        lines = [mean_of(rows, "lane_lines", key) for key in ("precision", "recall", "recall_20_m")]
        away = [mean_of(rows, "lane_lines", key) for key in ("lateral_median_m", "lateral_p95_m")]
        lanes = [mean_of(rows, "lanes", key) for key in ("precision", "recall")]
        out.append([
            Path(rows[0]["scene"]).stem, rows[0]["condition"], *map(cell, lines), *(cell(v, 3, " m") for v in away),
            cell(mean_of(rows, "lane_lines", "kind_accuracy")),
            cell(mean_of(rows, "lane_lines", "false_m_per_100_m"), 1, " m"), counts(rows, "stop_lines"),
            counts(rows, "crosswalks"), *map(cell, lanes), cell(mean_of(rows, "lanes", "center_median_m"), 2, " m"),
            cell(mean_of(rows, "lanes", "inside")),
        ])  # fmt: skip
    return out


def color_rows(results: Sequence[dict[str, Any]]) -> list[list[str]]:
    """One row for each light and weather, and one for all."""
    out = []
    for sky in [*dict.fromkeys(r["sky"] for r in results), "all"]:
        found = [r["colors"] for r in results if sky in (r["sky"], "all") and r["colors"] is not None]
        total: Counter[str] = Counter()
        confused: Counter[str] = Counter()
        for row in found:
            total.update({key: row[key] for key in ("vehicles", "with_color", "named", "right")})
            confused.update(row["confused"])
        away = [row["ciede2000_median"] for row in found if row["ciede2000_median"] is not None]
        right = f"{total['right']} of {total['named']}" if total["named"] else "-"
        wrong = ", ".join(f"{name} ({n})" for name, n in confused.most_common(4))
        numbers = [str(total["vehicles"]), str(total["with_color"]), right]
        out.append([sky, *numbers, cell(float(np.mean(away)) if away else None, 1), wrong or "-"])
    return out


def main(
    only: str = "*", seeds: list[int] = [1], detector: str = "labels", rig: Rig = "all", keep: Path | None = None
) -> None:
    """Print both tables of the cases that a pattern names, such as 'worn*' or '*_night_*'."""
    results = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for case in (case for case in CASES if fnmatch.fnmatch(case.name, only)):
            for seed in seeds:
                try:
                    results.append(measure(case, seed, detector, rig, folder))
                except Log2SimError as error:
                    print(f"{case.name}, seed {seed}: {error}", file=sys.stderr)
    print(markdown(HEADER, lane_rows(results)) + "\n\n" + markdown(COLORS, color_rows(results)))
