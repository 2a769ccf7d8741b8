"""Scene files: what is wrong in them is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from worlds import CAR, tiny_table

from log2sim.errors import ConfigError
from log2sim.synth.scene import load_scene, scene_from_table

SAMPLE = Path(__file__).resolve().parent.parent / "samples" / "crossing.toml"


def test_the_sample_has_the_agents_that_a_junction_needs() -> None:
    scene = load_scene(SAMPLE)
    assert len(scene.agent) >= 8
    assert {a.category for a in scene.agent} >= {"car", "pedestrian", "cyclist", "bus"}
    assert len(scene.camera) >= 3
    assert any(a.wait_s for a in scene.agent)
    assert any(a.pose for a in scene.agent)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agnet": []}, r"unknown key 'agnet'; did you mean 'agent'"),
        ({"agent": [{**CAR, "colour": [1, 2, 3]}]}, r"'agent\[0\]\.colour'; did you mean 'agent\[0\]\.color'"),
        ({"agent": [{**CAR, "category": "tram"}]}, r"agent\[0\]\.category.*one of car, truck"),
        ({"agent": [{**CAR, "size_m": [4.0, 2.0]}]}, r"size_m' has 2 values, expected 3"),
        ({"agent": [{**CAR, "color": [300, 0, 0]}]}, r"color\[0\]' is 300"),
        ({"agent": [{**CAR, "pose": [0.0, 0.0, 0.0]}]}, r"either 'waypoints' or 'pose'"),
        ({"agent": [CAR, CAR]}, r"'car' occurs twice"),
        ({"agent": [{**CAR, "id": "ego"}]}, r"belongs to the recording vehicle"),
        ({"agent": [{**CAR, "id": "../x"}]}, r"letters, digits"),
        ({"duration_s": float("nan")}, r"'duration_s' is nan"),
        ({"duration_s": "long"}, r"'duration_s' is 'long', expected a number"),
        ({"start_ns": 1.5}, r"'start_ns' is 1\.5, expected a whole number from 0"),
        ({"road": [{"line": [[0.0, 0.0]]}]}, r"line' has 1 values, expected 2 or more"),
        ({"gnss": {"rate_hz": 0}}, r"'gnss\.rate_hz' is 0, expected a number from 0\.5 to 1000"),
        ({"gnss": 3}, r"'gnss' is 3, expected a table"),
        ({"ego": {}}, r"'ego.waypoints' is missing"),
        ({"camera": {}}, r"'camera' is \{\}, expected a list"),
        ({"camera": [{"name": "c", "position_m": [0, 0, 1], "size_px": [1e5, 5]}]}, r"size_px\[0\]"),
    ],
)
def test_a_wrong_entry_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        scene_from_table(tiny_table(**changes))
