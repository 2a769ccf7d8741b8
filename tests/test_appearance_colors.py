"""Colors of vehicles: masks, light and paint apart, then whole synthetic scenes with known paints."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from log2sim.datatypes import Log, Scenario
from log2sim.datatypes.color_names import name_of, to_lab
from log2sim.perception.lidar.projection import view_of
from log2sim.road.colors import (
    ColorSampler,
    _Scene,
    _to_box,
    choose_views,
    find_paint,
    geometric_median,
    lab_of_linear,
    linear_of_lab,
)
from log2sim.road.light import (
    CAMERA_WHITE,
    estimate_light,
    hit_block,
    hit_vehicle,
    linear_values,
    mirrored_share,
    reflectances,
    veil_of,
)
from log2sim.synth.scene import scene_from_table
from log2sim.synth.synthesis import synthesize

SIZE = np.array([4.5, 1.8, 1.5])
PAINTS = {"a": (160, 28, 30), "b": (232, 233, 232), "c": (28, 29, 31), "d": (40, 66, 140), "e": (90, 94, 98)}


def linear(rgb: tuple[int, int, int]) -> np.ndarray[Any, Any]:
    return linear_values(np.array(rgb, np.uint8))


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


def test_gray_pictures_give_no_color_and_say_so() -> None:
    log, truth = street()
    sampler = sampled(log, truth, lambda image: np.repeat(image[..., :1], 3, axis=2))
    assert sampler.colors() == {}
    assert sampler.gray == {"front"}
    assert "front are gray" in sampler.notes()[0]


@pytest.mark.slow
def test_what_is_hidden_is_not_looked_at() -> None:
    log, truth = street()
    red = next(agent for agent in truth.others if agent.id == "a")
    w = red.waypoints
    wall = replace(red, id="wall", category="other", waypoints=replace(w, y_m=w.y_m - 1.6), size_m=(30.0, 1.0, 4.0))
    both = replace(truth, agents=(*truth.agents, wall))
    assert "a" in sampled(log, truth).colors()
    assert "a" not in sampled(log, both).colors()
    sampler = ColorSampler(log, both)
    sampler._views = choose_views(log, truth, ["a"])  # even where a frame was chosen
    for camera, frames in sampler._views.items():
        for index in frames:
            sampler.add(camera, index, log.streams[camera].read(index))
    assert sampler.colors() == {}


def test_no_frame_is_chosen_from_which_a_vehicle_is_tiny_or_outside() -> None:
    log, truth = street()
    views = choose_views(log, truth, ["e"])
    assert set(views) == {"front"}
    far = replace(truth, agents=tuple(
        replace(a, waypoints=replace(a.waypoints, x_m=a.waypoints.x_m + 500)) for a in truth.others))  # fmt: skip
    assert choose_views(log, far, ["e"]) == {}


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


def test_a_hue_prevails_over_gray_things_and_shading() -> None:
    rng = np.random.default_rng(0)
    red = linear((170, 30, 30)) * rng.uniform(0.2, 1.0, (450, 1))
    gray = np.repeat(rng.uniform(0.0, 1.0, (550, 1)), 3, axis=1)
    paint = find_paint(lab_of_linear(np.concatenate([red, gray])), np.ones(1000))
    hue = np.arctan2(*paint.mean[[2, 1]])
    assert hue == pytest.approx(np.arctan2(*to_lab((170, 30, 30))[0, [2, 1]]), abs=0.1)


def test_the_most_frequent_lightness_is_that_of_a_gray_paint() -> None:
    rng = np.random.default_rng(1)
    body, glass = np.full((600, 1), 0.7) * rng.uniform(0.95, 1.05, (600, 1)), rng.uniform(0.0, 0.3, (400, 1))
    paint = find_paint(lab_of_linear(np.repeat(np.concatenate([body, glass]), 3, axis=1)), np.ones(1000))
    assert paint.mean[0] == pytest.approx(lab_of_linear(np.full((1, 3), 0.7))[0, 0], abs=1.5)


def test_lab_of_linear_light_is_that_of_its_srgb() -> None:
    rgb = np.random.default_rng(2).integers(0, 256, (100, 3)).astype(np.uint8)
    np.testing.assert_allclose(lab_of_linear(linear_values(rgb)), to_lab(rgb), atol=0.02)
    np.testing.assert_allclose(linear_of_lab(lab_of_linear(linear_values(rgb))), linear_values(rgb), atol=1e-6)


def test_light_without_surroundings_is_that_of_a_usual_camera() -> None:
    none = np.zeros((0, 3))
    light = estimate_light(none, none, none)
    np.testing.assert_allclose(light.white, CAMERA_WHITE)
    dim = estimate_light(np.full((100, 3), 0.01), none, np.full((100, 3), 0.01))
    assert dim.white.max() < 0.1 < light.white.min()
    assert dim.exposure_sigma > light.exposure_sigma / 2


def test_a_clear_coat_and_haze_are_taken_off() -> None:
    light = estimate_light(np.full((100, 3), 0.1), np.full((100, 3), 0.5), np.zeros((0, 3)))
    facing = np.full(1, 0.9)
    seen = 0.2 * light.white + mirrored_share(facing)[0] * light.around
    np.testing.assert_allclose(reflectances(seen[None], light, facing, np.zeros(3))[0], 0.2)
    hazy = np.concatenate([np.full((10, 3), 0.02), np.full((90, 3), 0.5)]) * light.white + 0.05
    np.testing.assert_allclose(veil_of(hazy, light), 0.05, atol=1e-6)


def test_the_geometric_median_ignores_a_far_look() -> None:
    points = np.array([[50.0, 1, 1], [51, 0, 1], [49, 1, 0], [50, 0, 0], [95, 40, 40]])
    assert np.linalg.norm(geometric_median(points, np.ones(5)) - [50, 0.5, 0.5]) < 1.5
