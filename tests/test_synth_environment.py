"""Light and weather of scenes, in pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from worlds import CAR, PARKED, tiny_log, tiny_scene

from log2sim.synth.actors import MovingScene
from log2sim.synth.light import (
    BEAM_HALF_WIDTH,
    HEADLIGHT_REACH_M,
    Lamp,
    lamplight,
)
from log2sim.synth.raycast import AIR, BUILDING, USUAL_REFLECTANCE, cast_sweep
from log2sim.synth.returns import BACKSCATTER_SHARE, MIN_SIGNAL, REFERENCE_RANGE_M


def image(seed: int = 0, index: int = 4, **environment: Any) -> np.ndarray:
    log, _ = tiny_log([CAR, PARKED], environment=environment, seed=seed, observe=False)
    return log.streams["front"].read(index).astype(float)


def test_fog_takes_contrast_the_more_the_farther_and_leaves_what_is_near() -> None:
    clear, thin, thick = image(), image(weather="fog", visibility_m=200.0), image(weather="fog", visibility_m=40.0)
    near, far = slice(260, 300), slice(152, 160)
    assert clear[far].std() > 2 * thick[far].std()
    assert thin[near].std() > 0.4 * clear[near].std()
    assert thin[far].std() > thick[far].std()


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
