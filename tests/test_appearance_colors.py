"""Colors of vehicles: masks, light and paint apart, then whole synthetic scenes with known paints."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib import colors as mcolors

from log2sim.datatypes import COLOR_NAMES, Log, Scenario
from log2sim.datatypes.color_names import name_indices, name_of, name_probabilities, to_lab
from log2sim.perception.lidar.projection import view_of
from log2sim.road.colors import (
    ColorSampler,
    _Scene,
    _to_box,
)
from log2sim.road.light import (
    hit_block,
    hit_vehicle,
)
from log2sim.synth.scene import scene_from_table
from log2sim.synth.synthesis import synthesize

SIZE = np.array([4.5, 1.8, 1.5])


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
    tinted = sampled(log, truth, lambda image: (image * [0.86, 1.0, 0.96]).astype(np.uint8)).colors()
    assert {name: color["name"] for name, color in tinted.items()} == {k: name_of(rgb) for k, rgb in PAINTS.items()}


def test_doors_are_paint_and_windows_and_wheels_are_not() -> None:
    origin = np.array([0.0, -10.0, 0.0])
    door, window, wheel, above = (
        np.array([[x, 10 - SIZE[1] / 2, z]]) for x, z in ((0.3, -0.1), (0.3, 0.4), (1.35, -0.5), (0.0, 1.2))
    )
    weights = [float(hit_vehicle("car", SIZE, origin, ray).weight[0]) for ray in (door, window, wheel, above)]
    assert weights == [1.0, 0.0, 0.0, 0.0]
    assert hit_vehicle("car", SIZE, origin, door).distance[0] == pytest.approx(1.0)
    assert np.isinf(hit_vehicle("car", SIZE, origin, above).distance[0])


def test_rays_enter_a_block_where_a_fine_march_along_them_does() -> None:
    rng = np.random.default_rng(5)
    low, high, origin = np.array([-2.2, -0.9, -0.7]), np.array([2.2, 0.9, 0.7]), np.array([-9.0, -5.0, 0.4])
    rays = np.concatenate([rng.uniform(low, high, (300, 3)) * 1.5 - origin, np.eye(3)])
    entry, axis = hit_block(low, high, origin, rays)
    steps = np.arange(0, 2, 5e-4)
    places = origin + steps[:, None, None] * rays
    inside = ((places > low) & (places < high)).all(axis=2)
    met = inside.any(axis=0)
    assert 100 < met.sum() < 290
    np.testing.assert_array_equal(np.isfinite(entry), met)
    np.testing.assert_allclose(entry[met], steps[inside.argmax(axis=0)][met], atol=1e-3)
    face = (origin + entry[met, None] * rays[met])[np.arange(met.sum()), axis[met]]
    np.testing.assert_allclose(np.minimum(np.abs(face - low[axis[met]]), np.abs(face - high[axis[met]])), 0, atol=1e-9)


def test_agents_of_any_distance_hide_and_those_beside_the_rays_are_not_asked() -> None:
    log, truth = street()
    sampler = ColorSampler(log, truth)
    camera, indices = next(iter(sampler.frames().items()))
    map_T_cam, _ = log.map_T_sensor(camera, int(log.streams[camera].t_ns[indices[0]]))
    origin = map_T_cam[0, :3, 3]
    view = view_of(log, camera, int(log.streams[camera].t_ns[indices[0]]))
    assert view is not None
    boxes = sampler._boxes_in(camera)
    first = boxes.center_m[:, 0]
    none = np.zeros((0, 3), np.uint8)
    scene = _Scene(view, boxes, 0, np.zeros((2, 2, 3), np.uint8), none, none)
    for k, center in enumerate(first):
        ray = (center - origin)[None]
        found = scene._near(origin, ray, np.ones(1))
        assert k in found
        away = scene._others(origin, ray, np.ones(1))
        everyone = [hit_block(-boxes.size_m[j] / 2, boxes.size_m[j] / 2, *_to_box(
            origin, ray, first[j], boxes.yaw_rad[j, 0]))[0] for j in range(len(boxes.agents))]  # fmt: skip
        np.testing.assert_array_equal(away, np.min(everyone, axis=0))
        assert away[0] < 1
    assert len(scene._near(origin, origin - first[0][None], np.ones(1))) < len(boxes.agents)


channel = st.integers(0, 255)


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((0, 0, 0), "black"), ((255, 255, 255), "white"), ((119, 119, 119), "gray"), ((192, 192, 192), "silver"),
        ((255, 0, 0), "red"), ((0, 0, 255), "blue"), ((0, 128, 0), "green"), ((255, 255, 0), "yellow"),
        ((139, 69, 19), "brown"), ((255, 140, 0), "orange"), ((0, 0, 128), "blue"), ((128, 0, 0), "red"),
        ((255, 105, 180), "red"), ((240, 234, 214), "white"), ((28, 29, 31), "black"), ((60, 84, 62), "green"),
    ],
)  # fmt: skip
def test_basic_colors_have_their_names(rgb: tuple[int, int, int], name: str) -> None:
    assert name_of(rgb) == name


def test_the_names_agree_with_a_survey() -> None:
    """XKCD color survey, as matplotlib holds it: names that end with a basic term, such as 'pale olive green'."""
    said = {key: key.removeprefix("xkcd:").split()[-1].replace("grey", "gray") for key in mcolors.XKCD_COLORS}
    known = {key: name for key, name in said.items() if name in COLOR_NAMES}
    lab = to_lab([[255 * v for v in mcolors.to_rgb(mcolors.XKCD_COLORS[key])] for key in known])
    found = [COLOR_NAMES[k] for k in name_indices(lab)]
    assert len(known) > 400
    assert np.mean([a == b for a, b in zip(found, known.values())]) > 0.84


@given(channel, channel, channel)
@settings(max_examples=50, deadline=None)
def test_probabilities_sum_to_one_and_settle_on_the_name(r: int, g: int, b: int) -> None:
    lab = to_lab((r, g, b))[0]
    assert name_probabilities(lab, np.array([9.0, 6.0, 5.0])).sum() == pytest.approx(1.0)
    if len(set(name_indices(lab + np.array(np.meshgrid(*[[-0.1, 0.1]] * 3)).reshape(3, -1).T))) == 1:
        sure = name_probabilities(lab, np.full(3, 1e-3))
        assert COLOR_NAMES[int(np.argmax(sure))] == name_of((r, g, b))
        assert sure.max() == 1.0
