"""Light and weather of scenes, in pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from worlds import CAR, PARKED, tiny_log, tiny_scene

from log2sim.geometry import transform
from log2sim.synth.actors import MovingScene
from log2sim.synth.backdrop import Backdrop
from log2sim.synth.light import (
    BEAM_HALF_WIDTH,
    HEADLIGHT_REACH_M,
    NIGHT,
    NOON,
    STREET_HEIGHT_M,
    Lamp,
    headlights,
    lamplight,
    light_of,
    street_lights,
)
from log2sim.synth.raycast import AIR, BUILDING, GROUND, USUAL_REFLECTANCE, cast_sweep
from log2sim.synth.returns import BACKSCATTER_SHARE, MIN_SIGNAL, REFERENCE_RANGE_M
from log2sim.synth.scene import Environment, Road


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


def test_a_shadow_has_a_sharp_edge_that_lies_where_its_outline_does() -> None:
    outline = [[8.0, -6.0], [8.0, 6.0], [14.0, 6.0], [14.0, -6.0]]
    plain = {"road": [{"line": [[-10.0, 0.0], [60.0, 0.0]], "width_m": 14.0, "marking": "none"}]}
    pictures = []
    for changes in ({}, {"shadow": [{"outline": outline}]}):
        log, _ = tiny_log([], observe=False, **plain, **changes)
        pictures.append(log.streams["front"].read(0).astype(float).mean(2))
    ratio = pictures[1] / pictures[0]
    camera = log.cameras["front"]
    pose = log.map_T_sensor("front", log.streams["front"].t_ns[:1])[0][0]

    def at(x: float, y: float) -> float:
        p = np.linalg.inv(pose) @ [x, y, 0.0, 1.0]
        u, v = np.rint(camera.K[:2, :2].diagonal() * p[:2] / p[2] + camera.K[:2, 2]).astype(int)
        return float(ratio[v - 1 : v + 2, u - 1 : u + 2].mean())

    # Light falls to what the sky gives; a picture has its 2.2nd root, and haze is added.
    dark = (1 - NOON.sun_share()) ** (1 / 2.2)
    assert at(9.0, 0.0) == pytest.approx(dark, abs=0.05)
    assert at(12.0, 2.0) == pytest.approx(dark, abs=0.05)
    assert at(6.5, 0.0) == pytest.approx(1.0, abs=0.03)
    assert at(7.75, 0.0) > 0.97 > at(8.25, 0.0) + 0.1


def test_buildings_throw_shadows_away_from_the_sun_where_they_are_asked_to() -> None:
    building = {"center": [20.0, -15.0], "size_m": [10.0, 10.0, 12.0]}
    without, thrown = (
        Backdrop.of(tiny_scene([], building=[{**building, "shadow": on}]), 0).shadows for on in (False, True)
    )
    assert without == ()
    reach = np.array([20.0, -15.0]) - np.array(NOON.sun[:2]) / NOON.sun[2] * 12.0
    low, high = thrown[0].min(0), thrown[0].max(0)
    assert np.allclose(low, [15.0, -20.0])
    assert np.allclose(high, reach + 5.0, atol=1e-4)


def test_wet_ground_glares_below_headlights_that_come_and_only_where_it_is_asked_to() -> None:
    oncoming = {"id": "car", "category": "car", "waypoints": [[25.0, 2.0, 3.0], [0.0, 2.0, 3.0]]}
    pictures = []
    for wet in ({}, {"wetness": 1.0}, {"wetness": 1.0, "glare": True}):
        log, _ = tiny_log([oncoming], observe=False, environment={"light": "night", **wet})
        pictures.append(log.streams["front"].read(0).astype(float).mean(2))
    dry, wet, glaring = pictures
    assert wet[200:].mean() < dry[200:].mean()  # a wet road is darker
    added = glaring - wet
    rows, columns = np.nonzero(added > 60)
    assert len(rows) > 50
    assert rows.min() > 150  # below the horizon
    assert np.ptp(rows) > 1.5 * np.ptp(columns)  # a streak toward the camera
    assert added.min() > -30
