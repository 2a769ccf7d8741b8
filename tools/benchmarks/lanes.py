"""Lane lines, markings and lanes in synthetic scenes, by light, weather and wear.

    python tools/bench.py lanes [--only PATTERN] [--rig cameras|lidar]
    python tools/bench.py lanes --roads 40 --seed 1

Each scene is rendered in its conditions, reconstructed and compared with its truth as `log2sim evaluate` does: precision and
recall of lane lines at 0.3 m within 40 m of the ego's path where a sensor saw the ground, the same recall where they stand out of the map,
lateral error, kinds, false length, stop lines and crosswalks, borders of the roads, and how much of the true paths lies in a found lane.
`--rig` leaves out the other sensors. `--roads` takes so many random roads (`fits/line_maps.py`) instead, from a seed that no fit used.
"""

from __future__ import annotations

import fnmatch
import sys
import tempfile
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from entry import SAMPLES
from fits.line_maps import MAPS_OF_SEED, draw_scene
from scipy.ndimage import uniform_filter1d

from benchmarks.table import cell, markdown
from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import Log, Scenario
from log2sim.errors import Log2SimError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.road import MATCH_M, Area, RoadSamples, nearest_road
from log2sim.road.builder import map_ground
from log2sim.road.ground_map import GroundMap
from log2sim.road.samples import sample
from log2sim.synth.scene import Scene, load_scene
from log2sim.synth.synthesis import write_synthetic

Rig = Literal["all", "cameras", "lidar"]
HEADER = [
    "scene", "condition", "precision", "recall", "within 20 m", "where it stands out", "off by, median", "95 %", "kind right", "false per 100 m", "stop lines",
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
    if rig == "all":
        return log
    left_out = log.lidars if rig == "cameras" else log.cameras
    streams = {name: s for name, s in log.streams.items() if name not in left_out}
    if rig == "cameras":
        return replace(log, lidars={}, streams=streams)
    return replace(log, cameras={}, streams=streams, reference_camera=None, image_labels={})


# A line stands out where the means along 8 m of it are brighter than the road on both sides by five sigmas of the same means around and by a least
# logarithm, of color or of LiDAR intensity, and by more than anything else across 1.5 m, such as a curb.
ALONG_M, STEP_M, REACH_M = 8.0, 0.05, 1.5
MIN_SIGMAS, MIN_COLOR, MIN_INTENSITY, MORE_THAN_AROUND = 5.0, 0.05, 0.1, 1.2
LINE_M, AROUND_M, MIN_NOISE, MIN_OBSERVED = 0.2, 0.4, 0.01, 0.25


def stands_out(ground: GroundMap, line: RoadSamples) -> np.ndarray:
    """Say at which points (S, 2) of a true line it stands out of a map (S,)."""
    across = np.arange(-REACH_M, REACH_M + STEP_M / 2, STEP_M)
    xy, normal = line.xy_m, np.stack([-np.sin(line.heading_rad), np.cos(line.heading_rad)])
    profile = sample(ground, *(xy[:, k, None] + normal[k][:, None] * across for k in range(2)))
    inside, around = np.abs(across) <= LINE_M, np.abs(across) > AROUND_M
    out, window = np.zeros(len(xy), dtype=bool), max(round(ALONG_M / line.length_m.max(initial=STEP_M)), 3)
    for values, least in ((profile.paint, MIN_COLOR), (profile.intensity, MIN_INTENSITY)):
        observed = np.isfinite(values).astype(np.float64)
        count, total = (uniform_filter1d(a, window, axis=0) for a in (observed, np.nan_to_num(values)))
        mean = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > MIN_OBSERVED)
        middle = (mean[:, 5:-5] + mean[:, 4:-6] + mean[:, 6:-4]) / 3
        left, right = (mean[:, :-10] + mean[:, 1:-9]) / 2, (mean[:, 9:-1] + mean[:, 10:]) / 2  # 0.2 and 0.25 m away
        contrast = np.pad(middle - np.fmax(left, right), ((0, 0), (5, 5)), constant_values=np.nan)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # where nothing is observed
            outside = contrast[:, around]
            noise = np.nanmedian(np.abs(outside - np.nanmedian(outside, axis=1, keepdims=True)), axis=1) / 0.6745
            own, most = np.nanmax(contrast[:, inside], axis=1), np.nanmax(outside, axis=1)
            out |= (own > least) & (own > MIN_SIGMAS * np.maximum(noise, MIN_NOISE)) & (own > MORE_THAN_AROUND * most)
    return out


def lengths_that_stand_out(ground: GroundMap, scenario: Scenario, truth: Scenario) -> tuple[float, float]:
    """Return the length of true lane lines that stand out of a map, and of those of them that are matched, m."""
    moved = truth.aligned_to(scenario)
    area = Area.of(scenario, moved, truth.shift_to(scenario))
    ours, true = (
        [m for m in s.map_features.markings if m.is_lane_line] if s.map_features else [] for s in (scenario, moved)
    )
    shown_m = matched_m = 0.0
    for line in true:
        whole = RoadSamples.of([line], lambda xy_m: np.ones(len(xy_m), dtype=bool))
        shown = area.expects(whole.xy_m) & stands_out(ground, whole)
        near = nearest_road(whole, ours)[1] <= MATCH_M
        shown_m, matched_m = shown_m + float(whole.length_m @ shown), matched_m + float(whole.length_m @ (shown & near))
    return shown_m, matched_m


def scene_of(case: Case) -> Scene:
    """Load the scene of a case in its conditions."""
    scene = load_scene(SAMPLES / case.scene)
    light = scene.environment.model_copy(update={"light": case.light, "weather": case.weather})
    return scene.model_copy(update={"environment": light})


def measure(scene: Scene, rig: Rig, folder: Path, seed: int = 1) -> dict[str, Any]:
    """Render a scene, reconstruct it by its labels and compare the map with its truth."""
    write_synthetic(scene, folder, seed=seed)
    log = with_rig(open_log(folder), rig)
    detector = "labels" if log.cameras else "lidar:labels"
    scenario = reconstruct(log, Config.load(detect={"name": detector})).scenario
    truth = Scenario.load(folder / "truth.json")
    figures = evaluate(scenario, truth)["map_features"] or {}
    return figures | {"standing_out_m": lengths_that_stand_out(map_ground(log, scenario), scenario, truth)}


def summary(all_found: list[dict[str, Any]]) -> str:
    """Precision and recall of the lane lines and borders of all cases by their length, and counts of other markings."""
    shown_m, matched_m = np.sum([f["standing_out_m"] for f in all_found], axis=0)

    def mean(of: str, name: str, length: str) -> float:
        lines = [f[of] for f in all_found if f.get(of)]
        total = sum(line[length] for line in lines)
        return sum((line[name] or 0.0) * line[length] for line in lines) / max(total, 1e-9)

    lines, borders = (
        (mean(of, "precision", "found_m"), mean(of, "recall", "true_m")) for of in ("lane_lines", "borders")
    )
    counts = [f"{name.replace('_', ' ')} {count(all_found, name)}" for name in ("stop_lines", "crosswalks", "others")]
    text = "All lane lines: precision {:.3f}, recall {:.3f}, where they stand out {:.3f}; borders {:.3f}, {:.3f}; "
    return text.format(*lines, matched_m / max(shown_m, 1e-9), *borders) + ", ".join(counts) + "."


def count(all_found: list[dict[str, Any]], kind: str) -> str:
    """Count markings of a kind that were found, that there are, and that are false."""
    n = {key: sum((found.get(kind) or {}).get(key) or 0 for found in all_found) for key in ("found", "true", "false")}
    if not n["true"] and not n["false"]:
        return "-"
    return f"{n['found']} of {n['true']}" + (f" + {n['false']}" if n["false"] else "")


def row(case: Case, found: dict[str, Any]) -> list[str]:
    lines, borders, lanes = (found.get(name) or {} for name in ("lane_lines", "borders", "lanes"))
    shown_m, matched_m = found["standing_out_m"]
    return [
        Path(case.scene).stem, case.condition, *(cell(lines.get(k)) for k in ("precision", "recall", "recall_20_m")), cell(matched_m / shown_m if shown_m else None),
        *(cell(lines.get(k), 3, " m") for k in ("lateral_median_m", "lateral_p95_m")), cell(lines.get("kind_accuracy")),
        cell(lines.get("false_m_per_100_m"), 1, " m"), count([found], "stop_lines"), count([found], "crosswalks"),
        *(cell(of.get(k)) for of in (borders, lanes) for k in ("precision", "recall")), cell(lanes.get("center_median_m"), 2, " m"), cell(lanes.get("inside")),
    ]  # fmt: skip


def main(only: str = "*", rig: Rig = "all", roads: int = 0, seed: int = 1) -> None:
    """Print the table of the cases that a pattern names, such as 'worn*' or '*_night_*', or the summary of random roads."""
    cases = {case.name: case for case in CASES if fnmatch.fnmatch(case.name, only) and not roads}
    scenes = {name: (scene_of(case), 1) for name, case in cases.items()}
    for number in range(MAPS_OF_SEED * seed, MAPS_OF_SEED * seed + roads):
        scenes[f"road-{number}"] = draw_scene(number), number
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, (scene, of) in scenes.items():
            try:
                found[name] = measure(scene, rig, Path(folder) / name, of)
            except Log2SimError as error:
                print(f"{name}: {error}", file=sys.stderr)
    if cases:
        print(markdown(HEADER, [row(cases[name], figures) for name, figures in found.items()]), end="\n\n")
    if found:
        print(summary(list(found.values())))
