"""Light and weather of scenes, in pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from worlds import CAR, PARKED, tiny_log, tiny_scene

from log2sim.geometry import transform
from log2sim.synth.actors import MovingScene
from log2sim.synth.lamps import (
    BEAM_HALF_WIDTH,
    HEADLIGHT_REACH_M,
    STREET_HEIGHT_M,
    Lamp,
    headlights,
    lamplight,
    street_lights,
)
from log2sim.synth.light import NIGHT, NOON, light_of
from log2sim.synth.raycast import AIR, BUILDING, GROUND, USUAL_REFLECTANCE, cast_sweep
from log2sim.synth.returns import BACKSCATTER_SHARE, MIN_SIGNAL, REFERENCE_RANGE_M
from log2sim.synth.scene import Environment
from log2sim.synth.scene_places import Road


def image(seed: int = 0, index: int = 4, **environment: Any) -> np.ndarray:
    log, _ = tiny_log([CAR, PARKED], environment=environment, seed=seed, observe=False)
    return log.streams["front"].read(index).astype(float)


def test_at_the_visibility_a_black_target_has_two_percent_of_contrast_against_the_fog() -> None:
    light = light_of(Environment(weather="fog", visibility_m=150.0))
    black = light.hazy(np.zeros((3, 3), np.float32), np.array([0.0, 75.0, 150.0], np.float32))
    contrast = 1 - black / np.array(light.horizon)
    assert np.allclose(contrast[:, 0], [1.0, np.sqrt(0.02), 0.02], atol=1e-5)
    rain = light_of(Environment(weather="rain", rain_mm_h=10.0))
    # 1.076 * 10^0.67 = 5.03 dB/km more than in clear air.
    assert rain.extinction_per_m - NOON.extinction_per_m == pytest.approx(5.03 / 4.343 / 1000, rel=0.01)
    assert light_of(Environment()) == NOON


def test_fog_takes_contrast_the_more_the_farther_and_leaves_what_is_near() -> None:
    clear, thin, thick = image(), image(weather="fog", visibility_m=200.0), image(weather="fog", visibility_m=40.0)
    near, far = slice(260, 300), slice(152, 160)
    assert clear[far].std() > 2 * thick[far].std()
    assert thin[near].std() > 0.4 * clear[near].std()
    assert thin[far].std() > thick[far].std()


def test_night_is_dark_but_where_lamps_shine_and_noisier() -> None:
    noon, dusk, night = (image(light=name) for name in ("noon", "dusk", "night"))
    assert noon.mean() > dusk.mean() > night.mean()
    assert night[:60].mean() < 60  # the sky
    lit, beside = night[200:260, 200:280].mean(), night[200:260, :30].mean()
    assert lit > beside + 10  # the ego's headlights on the road
    sky = slice(5, 60)
    assert night[sky].std() > noon[sky, :].std(axis=(1, 2)).mean()
    # The sky of dusk is warmer than that of noon.
    assert dusk[sky, :, 2].mean() / dusk[sky, :, 0].mean() > 1.15 * noon[sky, :, 2].mean() / noon[sky, :, 0].mean()


def test_rain_streaks_differ_from_frame_to_frame_and_come_again_with_the_seed() -> None:
    first, again, other = (image(seed=s, weather="rain", rain_mm_h=50.0) for s in (1, 1, 2))
    assert np.array_equal(first, again)
    assert (np.abs(first - other).max(2) > 15).mean() > 0.002


def test_the_beam_of_a_headlight_is_cut_off_above_and_fades_to_the_side_and_with_distance() -> None:
    lamp = (Lamp(np.array([0.0, 0.0, 0.65]), np.array([1.0, 0.0])),)

    def at(x: float, y: float, z: float) -> float:
        return float(lamplight(lamp, 1.0, np.array([[x, y, z]], np.float32), None)[0].sum())

    assert at(10, 0, 0.0) > 3 * at(10, 0, 2.0)
    assert at(10, 0, 0.2) > at(30, 0, 0.2) > 0
    assert at(10, 10 * BEAM_HALF_WIDTH, 0.0) == pytest.approx(at(10, 0, 0.0) * np.exp(-1), rel=0.15)
    assert at(-5, 0, 0.0) == 0
    # Along one ray, twice the reach gives (1 + 1) / (1 + 4) of what the reach gives.
    near, far = (at(k * HEADLIGHT_REACH_M, 0, 0.65 - 0.05 * k * HEADLIGHT_REACH_M) for k in (1, 2))
    assert far / near == pytest.approx(2 / 5, rel=1e-3)


def test_lamps_are_at_the_front_of_vehicles_and_over_the_road() -> None:
    left, right = headlights(transform(np.eye(3), np.array([5.0, 1.0, 0.0])), 3.2, 1.8)
    assert left.position_m[0] == right.position_m[0] == pytest.approx(8.2)
    assert abs(left.position_m[1] - right.position_m[1]) == pytest.approx(0.72 * 1.8)
    lights = street_lights([Road(line=((0.0, 2.0), (5000.0, 2.0)))], np.array([2500.0, 0.0]))
    assert 4 < len(lights) < 10  # only near the camera, however long the road is
    assert all(abs(lamp.position_m[0] - 2500) < 100 and lamp.position_m[2] == STREET_HEIGHT_M for lamp in lights)


def test_an_unknown_light_is_an_error() -> None:
    with pytest.raises(Exception, match="light"):
        tiny_scene(environment={"light": "midnight"})
    assert NIGHT.exposure > NOON.exposure


def sweep(seed: int = 0, **environment: Any) -> tuple[np.ndarray, np.ndarray]:
    scene = tiny_scene([], environment=environment, building=[{"center": [31.0, 0.0], "size_m": [2.0, 80.0, 12.0]}])
    moving = MovingScene.of(scene)
    result = cast_sweep(scene.lidar[0], moving, scene.start_ns + 500_000_000, np.random.default_rng(seed))
    return np.linalg.norm(result.sweep.xyz_m, axis=1), result.hit


def test_fog_takes_returns_by_the_square_of_what_it_lets_through() -> None:
    clear, hit = sweep()
    previous = 1.0
    for visibility in (400.0, 100.0, 60.0, 30.0):
        fog, fog_hit = sweep(weather="fog", visibility_m=visibility)
        share = (fog_hit == BUILDING).sum() / (hit == BUILDING).sum()
        assert share <= previous + 0.02
        previous = share
        # A return is lost where reflectance * exp(-2 * 3.912 / V * r) / (r / 60)^2 falls below the threshold.
        r = clear[hit == BUILDING]
        signal = USUAL_REFLECTANCE * np.exp(-2 * 3.912 / visibility * r) / (r / REFERENCE_RANGE_M) ** 2
        air = BACKSCATTER_SHARE * (1 - np.exp(-3.912 / visibility * 15.0))
        expected = (np.clip(1.15 - MIN_SIGNAL / signal, 0, 1) * (1 - air)).mean()
        assert share == pytest.approx(expected, abs=0.03)
        assert (fog_hit == AIR).any()
        assert fog[fog_hit == AIR].max() < 15.2
    assert previous < 0.2
    assert np.all(hit != AIR)


def test_rain_takes_less_than_fog_and_clear_weather_nothing() -> None:
    clear, hit = sweep()
    again, same = sweep(visibility_m=30.0)  # a key of fog in clear weather
    assert np.array_equal(clear, again)
    assert np.array_equal(hit, same)
    _, rain = sweep(weather="rain", rain_mm_h=30.0)
    _, fog = sweep(weather="fog", visibility_m=50.0)
    assert (fog >= GROUND).sum() < (rain >= GROUND).sum()
    assert len(rain) > 0.9 * len(hit)
