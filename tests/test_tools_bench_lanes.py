"""The bench of lanes: rigs, means over seeds, counts, and colors by light."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from benchmarks import lanes as bench_lanes

pytestmark = pytest.mark.slow


def result(seed: int, precision: float | None, **colors: Any) -> dict[str, Any]:
    lines = {
        "precision": precision, "recall": 0.5, "recall_20_m": 0.75, "lateral_median_m": 0.04, "lateral_p95_m": 0.1,
        "kind_accuracy": 1.0, "false_m_per_100_m": 2.0,
    }  # fmt: skip
    shapes = {"true": 2, "found": 1, "false": seed}
    lanes = {"precision": None, "recall": None, "center_median_m": None, "inside": 0.9}
    features = {
        "lane_lines": lines,
        "stop_lines": shapes,
        "crosswalks": {"true": 0, "found": 0, "false": 0},
        "lanes": lanes,
    }
    named = {
        "vehicles": 3,
        "with_color": 2,
        "named": 2,
        "right": 1,
        "ciede2000_median": 6.0,
        "confused": {"red as brown": 1},
    }
    case = bench_lanes.Case("scenes/worn.toml", "dusk", "rain", "worn")
    return {
        "case": case.name, "scene": case.scene, "sky": case.sky, "condition": case.condition, "seed": seed,
        "map_features": features, "colors": {**named, **colors}, "signals": None,
    }  # fmt: skip


def test_rows_hold_means_over_seeds_and_sums_of_counts() -> None:
    ((scene, condition, precision, *rest),) = bench_lanes.lane_rows([result(1, 0.8), result(2, 0.6), result(3, None)])
    assert (scene, condition, precision) == ("worn", "dusk, rain, worn", "0.70")
    assert rest[:2] == ["0.50", "0.75"]
    assert rest[6:8] == ["3 of 6 + 6", "-"]
    assert rest[-1] == "0.90"
    assert rest[8] == "-"
