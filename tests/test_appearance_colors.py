"""Colors of vehicles: names, what the network sees, and whole synthetic scenes with known paints."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib import colors as mcolors

from log2sim.datatypes import COLOR_NAMES, Log, Scenario
from log2sim.datatypes.color_names import name_indices, name_of, to_lab
from log2sim.errors import ConfigError
from log2sim.geometry import Camera
from log2sim.perception.detect3d import network as lidar
from log2sim.road.colors import SIDE_PX, ColorSampler, _clear_heights, crop, open_color_network, shipped_network
from log2sim.synth.scene import scene_from_table
from log2sim.synth.synthesis import synthesize

LIDAR_FILE = Path(lidar.__file__).with_name("weights") / "vehicle.onnx"
PAINTS = {"a": (160, 28, 30), "b": (232, 233, 232), "c": (28, 29, 31), "d": (40, 66, 140), "e": (90, 94, 98)}


@lru_cache(maxsize=4)
def street(light: str = "noon") -> tuple[Log, Scenario]:
    cars = [
        {"id": name, "category": "car", "color": list(rgb), "pose": [12.0 * k, -5.2 if k % 2 else 5.2, 0.0]}
        for k, (name, rgb) in enumerate(PAINTS.items())
    ]
    camera = {"name": "front", "position_m": [1.6, 0, 1.5], "fov_deg": 75, "size_px": [480, 300], "rate_hz": 2}
    table = {
        "name": "street", "duration_s": 4.0, "environment": {"light": light}, "agent": cars, "camera": [camera],
        "road": [{"line": [[-60, 0], [120, 0]], "width_m": 13.0}], "ego": {"waypoints": [[-14, 0, 9], [80, 0, 9]]},
    }  # fmt: skip
    return synthesize(scene_from_table(table), observe=False)


def sampled(log: Log, scenario: Scenario, change: Any = lambda image: image) -> ColorSampler:
    sampler = ColorSampler(log, scenario)
    for camera, indices in sampler.frames().items():
        for index in indices.tolist():
            sampler.add(camera, index, change(log.streams[camera].read(index)))
    return sampler


@pytest.mark.parametrize("light", ["noon", "overcast"])
def test_painted_cars_get_the_names_of_their_paints(light: str) -> None:
    log, truth = street(light)
    colors = sampled(log, truth).colors()
    assert {name: color["name"] for name, color in colors.items()} == {k: name_of(rgb) for k, rgb in PAINTS.items()}
    assert all(0.3 < color["confidence"] <= 1 and color["frames"] >= 1 for color in colors.values())


def test_the_cast_of_a_camera_does_not_change_names() -> None:
    log, truth = street()
    tinted = sampled(log, truth, lambda image: np.clip(image * [0.92, 1.06, 1.02], 0, 255).astype(np.uint8)).colors()
    names = {name: color["name"] for name, color in tinted.items()}
    # White and silver differ by brightness alone.
    assert names.pop("b") in ("white", "silver")
    assert names == {k: name_of(rgb) for k, rgb in PAINTS.items() if k != "b"}


@pytest.mark.parametrize("aside_m", [0.0, 1.0, 2.9, 9.0])
def test_a_vehicle_of_which_most_is_hidden_is_not_looked_at(aside_m: float) -> None:
    camera = Camera("ahead", 800, 600, np.array([[500.0, 0, 400], [0, 500.0, 300], [0, 0, 1]]), "map", np.eye(4))
    # Both are as wide as the mean of length and width, 3 m.
    centers = np.array([[0.0, 0.0, 20.0], [aside_m * 0.75, 0.0, 15.0]])
    heights = _clear_heights(camera, np.eye(4), centers, np.full((2, 3), 3.0))
    left = 500 * (aside_m * 0.75 - 1.5) / 15
    right_of_far = 500 * 1.5 / 20
    hidden = np.clip((right_of_far - max(left, -right_of_far)) / (2 * right_of_far), 0, 1)
    expected = 0.0 if hidden > 0.5 else 500 * 3 / 20 * (1 - hidden)
    assert heights == pytest.approx([expected, 500 * 3 / 15])


def test_a_crop_shows_the_box_with_its_context_and_goes_on_beyond_the_picture() -> None:
    image = np.random.default_rng(1).integers(0, 256, (200, 300, 3)).astype(np.uint8)
    box = np.array([100.0, 60.0, 180.0, 120.0])
    whole = image[51:129, 88:192]
    np.testing.assert_array_equal(crop(image, box), cv2.resize(whole, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA))
    beyond = crop(image, np.array([-40.0, 60.0, 40.0, 120.0]))
    np.testing.assert_array_equal(beyond[:, 0], beyond[:, 10])
    assert (crop(image, np.array([290.0, 190.0, 320.0, 220.0])).shape) == (SIDE_PX, SIDE_PX, 3)


def test_more_pictures_of_the_same_make_a_color_surer_but_less_than_independent_ones_would() -> None:
    network = shipped_network()
    log, truth = street()
    (camera, indices), *_ = ColorSampler(log, truth).frames().items()
    image = log.streams[camera].read(int(indices[0]))
    raw = network.raw([crop(image, np.array([200.0, 130.0, 280.0, 190.0]))])
    one, four = (network.decide(np.repeat(raw, n, axis=0))[1] for n in (1, 4))
    assert one.sum() == pytest.approx(1.0)
    assert four.sum() == pytest.approx(1.0)
    independent = one**4 / (one**4).sum()
    assert one.max() <= four.max() < independent.max()


def test_a_file_that_is_no_network_of_colors_is_refused(tmp_path: Path) -> None:
    (tmp_path / "broken.onnx").write_bytes(b"not a network")
    with pytest.raises(ConfigError, match=r"broken\.onnx"):
        open_color_network(tmp_path / "broken.onnx")
    with pytest.raises(ConfigError, match="no network of colors"):
        open_color_network(LIDAR_FILE)


def test_the_names_agree_with_a_survey() -> None:
    """XKCD color survey, as matplotlib holds it: names that end with a basic term, such as 'pale olive green'."""
    said = {key: key.removeprefix("xkcd:").split()[-1].replace("grey", "gray") for key in mcolors.XKCD_COLORS}
    known = {key: name for key, name in said.items() if name in COLOR_NAMES}
    lab = to_lab([[255 * v for v in mcolors.to_rgb(mcolors.XKCD_COLORS[key])] for key in known])
    found = [COLOR_NAMES[k] for k in name_indices(lab)]
    assert len(known) > 400
    assert np.mean([a == b for a, b in zip(found, known.values())]) > 0.84
