"""Pictures: long roads, what is near and large, and what a second method says about them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from worlds import CAR, PARKED, tiny_log, tiny_scene

from log2sim.datatypes import Log, Scenario
from log2sim.geometry import Camera, apply, inverse, rotation_from_rpy, transform
from log2sim.synth.actors import MovingScene
from log2sim.synth.backdrop import Backdrop
from log2sim.synth.ground import ASPHALT, GROUND_M_PER_PX, MARKING, MEADOW, TILE_PX, Ground, GroundPlan
from log2sim.synth.light import BEAM_HALF_WIDTH, HEADLIGHT_REACH_M, Lamp, lamplight
from log2sim.synth.raycast import AIR, BUILDING, USUAL_REFLECTANCE, cast_sweep
from log2sim.synth.render import SceneInstant, render
from log2sim.synth.returns import BACKSCATTER_SHARE, MIN_SIGNAL, REFERENCE_RANGE_M
from log2sim.synth.scene import Road

FORWARD = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])


def looking(x_m: float, *, height_m: float = 1.5, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    turn = rotation_from_rpy(np.deg2rad(roll_deg), -np.deg2rad(pitch_deg), 0.0) @ FORWARD
    return transform(turn, np.array([x_m, 0.0, height_m]))


def picture(backdrop: Backdrop, map_T_cam: np.ndarray) -> np.ndarray:
    K = np.array([[400.0, 0, 239.5], [0, 400.0, 149.5], [0, 0, 1]])
    return render(
        Camera("c", 480, 300, K, "map", np.eye(4)), map_T_cam, SceneInstant(backdrop, ()), np.random.default_rng(0)
    )


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_markings_lie_where_the_road_says_at_every_level(level: int) -> None:
    step = GROUND_M_PER_PX * 2**level
    road = Road(line=((-500.0, 2.0), (500.0, 2.0)), width_m=7.0, marking="solid", sidewalk_m=0.0)
    image = Ground(GroundPlan([road]), 0).tile(level, 0, 0).astype(float).mean(2)
    y = (np.arange(TILE_PX) + 0.5) * step
    rows = image.mean(1)
    dark = np.flatnonzero(rows < (np.mean(ASPHALT) + np.mean(MEADOW)) / 2)
    assert y[dark[-1]] == pytest.approx(5.5, abs=0.25 + step)  # the line along the side is 0.15 to 0.25 m off
    # The middle line covers 0.14 m, however coarse the pixels: its light over the asphalt's has that width.
    near = np.abs(y - 2.0) < 0.5 + step
    excess = (rows[near] - np.median(rows[near])).sum() * step / (np.mean(MARKING) - np.mean(ASPHALT))
    assert excess == pytest.approx(0.14, abs=0.05)
    assert (y[near] * (rows[near] - rows[near].min())).sum() / (rows[near] - rows[near].min()).sum() == pytest.approx(
        2.0, abs=0.6 * step
    )


def test_a_picture_of_the_ground_agrees_with_the_geometry() -> None:
    road = {"line": [[0.0, 0.0], [80.0, 0.0]], "width_m": 6.0, "marking": "none", "sidewalk_m": 0.0}
    backdrop = Backdrop.of(tiny_scene([], road=[road]), 0)
    for roll in (0.0, 4.0):
        pose = looking(0.0, height_m=4.0, pitch_deg=-12.0, roll_deg=roll)
        image = picture(backdrop, pose).astype(float).mean(2)
        for x, y, asphalt in (
            (12.0, 0.0, True),
            (12.0, 2.4, True),
            (12.0, -3.8, False),
            (40.0, 0.0, True),
            (40.0, 4.5, False),
        ):
            p = apply(inverse(pose), np.array([[x, y, 0.0]]))[0]
            u, v = np.rint(p[:2] / p[2] * 400 + [239.5, 149.5]).astype(int)
            value = image[v - 1 : v + 2, u - 1 : u + 2].mean()
            assert (value < 125) == asphalt, (roll, x, y, value)


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


DENSE: dict[str, Any] = {
    "name": "top",
    "position_m": [1.2, 0.0, 1.9],
    "channels": 64,
    "elevation_deg": [-25.0, -4.0],
    "azimuth_step_deg": 0.25,
    "range_m": 60.0,
    "noise_m": 0.0,
}


def street(**changes: Any) -> tuple[Log, Scenario]:
    road = {"line": [[-60.0, 0.0], [60.0, 0.0]], "width_m": 10.0, "sidewalk_m": 0.0, "marking": "solid"}
    return tiny_log([], observe=False, camera=[], lidar=[DENSE], road=[{**road, **changes.pop("road", {})}], **changes)


def test_intensities_move_no_point_and_come_again_with_the_seed() -> None:
    first, again = (street()[0].streams["top"].read(4) for _ in range(2))
    assert np.array_equal(first.intensity, again.intensity)
    assert first.intensity.min() >= 1
    assert first.intensity.max() <= 255
    painted, bare = (street(road={"marking": kind})[0].streams["top"].read(4) for kind in ("solid", "none"))
    assert np.array_equal(painted.xyz_m, bare.xyz_m)
    assert not np.array_equal(painted.intensity, bare.intensity)


def test_dark_cars_return_less_than_white_ones() -> None:
    means = []
    for color in ([20, 20, 20], [235, 235, 235]):
        car = {"id": "car", "category": "car", "color": color, "pose": [12.0, 0.0, 0.0]}
        log, truth = tiny_log([car], observe=False, camera=[])
        sweep = log.streams["top"].read(3)
        pose = log.map_T_sensor("top", np.array([sweep.stamp_ns]))[0][0]
        high = apply(pose, sweep.xyz_m.astype(float))[:, 2] > 0.3
        means.append(sweep.intensity[high].mean())
        assert truth.others[0].id == "car"
    assert means[1] > 4 * means[0]
