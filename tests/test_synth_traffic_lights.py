"""Traffic lights of scenes: their programs, how they look, and what a LiDAR gets back from them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from worlds import tiny_log, tiny_scene

from log2sim.geometry import apply, inverse
from log2sim.synth.actors import MovingScene
from log2sim.synth.raycast import BUILDING, cast_sweep
from log2sim.synth.render import DEPTH_M, LENS_SPACING_M, WIDTH_M, signals_of

LIGHT: dict[str, Any] = {
    "id": "a",
    "position": [14.0, 0.0, 2.4],
    "yaw_deg": 180.0,
    "program": [["red", 0.3], ["red_yellow", 0.2], ["green", 0.3], ["yellow", 0.2]],
}


def test_a_program_runs_again_and_again_from_its_begin() -> None:
    scene = tiny_scene([], duration_s=2.4, traffic_light=[{**LIGHT, "start_s": -0.1}])
    (signal,) = signals_of(scene)
    assert signal.t_s == pytest.approx([0.0, 0.2, 0.4, 0.7, 0.9, 1.2, 1.4, 1.7, 1.9, 2.2])
    assert list(signal.state[:5]) == ["red", "red_yellow", "green", "yellow", "red"]
    assert list(signal.at([0.0, 0.25, 0.5, 2.39])) == ["red", "red_yellow", "green", "red_yellow"]
    constant = signals_of(tiny_scene([], traffic_light=[{**LIGHT, "program": [["green", 0.1], ["green", 0.2]]}]))[0]
    assert list(constant.state) == ["green"]
    assert constant.heading_rad == pytest.approx(-np.pi)


@pytest.mark.parametrize("light", ["noon", "night"])
def test_the_lit_lamp_is_the_one_of_the_state_and_has_its_color(light: str) -> None:
    brightest = {}
    for state in ("red", "yellow", "green", "off"):
        spec = {**LIGHT, "program": [[state, 5.0]]}
        log, truth = tiny_log([], observe=False, traffic_light=[spec], environment={"light": light})
        assert truth.signals[0].state[0] == state
        image = log.streams["front"].read(0).astype(float)
        camera = log.cameras["front"]
        pose = log.map_T_sensor("front", log.streams["front"].t_ns[:1])[0][0]
        lenses = np.array([[14.0 - DEPTH_M / 2, 0.0, 2.4 + k * LENS_SPACING_M] for k in (1, 0, -1)])
        p = apply(inverse(pose), lenses)
        uv = np.rint(p[:, :2] / p[:, 2:] @ camera.K[:2, :2] + camera.K[:2, 2]).astype(int)
        shown = np.array([image[v - 1 : v + 2, u - 1 : u + 2].mean((0, 1)) for u, v in uv])
        brightest[state] = int(shown.max(1).argmax())
        blue, green, red = shown[brightest[state]]
        if state == "red":
            assert red > 1.5 * green
        if state == "green":
            assert green > 1.3 * red
        if state == "yellow":
            assert red > 1.5 * blue
            assert green > 1.2 * blue
        if state == "off":
            assert shown.max() < 120
    assert (brightest["red"], brightest["yellow"], brightest["green"]) == (0, 1, 2)


def test_beams_meet_the_housing_and_the_pole_and_no_other_return_moves() -> None:
    scene = tiny_scene([], traffic_light=[{**LIGHT, "position": [10.0, 1.0, 1.6]}])
    plain = tiny_scene([])
    stamp = scene.start_ns + 500_000_000
    sweeps = [cast_sweep(s.lidar[0], MovingScene.of(s), stamp, np.random.default_rng(0)) for s in (scene, plain)]
    hit = sweeps[0].hit == BUILDING
    assert hit.sum() > 5
    own = sweeps[0].sweep.xyz_m[hit]
    assert np.ptp(own[:, 1]) < WIDTH_M + 0.1
    assert np.ptp(own[:, 0]) < DEPTH_M + 0.4  # of the pole behind it, and noise
    theirs = {tuple(p) for p in sweeps[1].sweep.xyz_m.tolist()}
    assert all(tuple(p) in theirs for p in sweeps[0].sweep.xyz_m[~hit].tolist())
