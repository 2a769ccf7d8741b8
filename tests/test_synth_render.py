"""Pictures: long roads, what is near and large, and what a second method says about them."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import tiny_log, tiny_scene

from log2sim.datatypes import Log
from log2sim.geometry import Camera, apply, inverse, rotation_from_rpy, transform
from log2sim.synth.backdrop import Backdrop
from log2sim.synth.ground import ASPHALT, GROUND_M_PER_PX, MARKING, MAX_TILES, MEADOW, TILE_PX, Ground, GroundPlan
from log2sim.synth.raster import NEAR_M, Samples, first_hit, nearest_of
from log2sim.synth.render import Body, SceneInstant, render
from log2sim.synth.scene import Road
from log2sim.synth.shapes import block

FORWARD = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])


def looking(x_m: float, *, height_m: float = 1.5, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    turn = rotation_from_rpy(np.deg2rad(roll_deg), -np.deg2rad(pitch_deg), 0.0) @ FORWARD
    return transform(turn, np.array([x_m, 0.0, height_m]))


def picture(backdrop: Backdrop, map_T_cam: np.ndarray) -> np.ndarray:
    K = np.array([[400.0, 0, 239.5], [0, 400.0, 149.5], [0, 0, 1]])
    return render(
        Camera("c", 480, 300, K, "map", np.eye(4)), map_T_cam, SceneInstant(backdrop, ()), np.random.default_rng(0)
    )


def long_road() -> Log:
    road = {"line": [[-50.0, 0.0], [3000.0, 0.0]], "width_m": 8.0, "marking": "none", "sidewalk_m": 0.0}
    ego = {"waypoints": [[0.0, 0.0, 30.0], [3000.0, 0.0, 30.0]], "poses": "poses"}
    return tiny_log([], road=[road], ego=ego, duration_s=90.0, lidar=[], observe=False)[0]


def test_a_road_of_three_kilometers_looks_the_same_wherever_the_ego_is() -> None:
    stream = long_road().streams["front"]
    means = []
    for index in (0, len(stream.t_ns) // 3, len(stream.t_ns) - 10):
        image = stream.read(index).astype(float)
        means.append([image[-60:, 200:280].mean(), image[-60:, :20].mean(), image[160:180].mean()])
    assert np.ptp(means, axis=0).max() < 10.0  # by stains; a meadow is 45 brighter
    # The road is darker than the meadow beside it.
    backdrop = Backdrop.of(tiny_scene([], road=[{"line": [[-50, 0], [3000, 0]], "width_m": 4.0, "sidewalk_m": 0.0}]), 0)
    image = picture(backdrop, looking(2500.0, height_m=3.0)).astype(float)
    assert image[250:, 225:255].mean() < image[250:, :40].mean() - 20


def test_painted_ground_is_bounded_in_memory() -> None:
    ground = Ground(GroundPlan([Road(line=((0.0, 0.0), (3000.0, 0.0)))]), 0)
    for i in range(MAX_TILES + 50):
        ground.tile(0, i, 0)
    assert len(ground._tiles) == MAX_TILES


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


def test_a_wall_beside_the_camera_that_reaches_behind_it_is_drawn_whole() -> None:
    box = block([-1.0, 1.0, -1.0], [12.0, 3.0, 2.0], 0)
    vertices = (box.vertices_m - [4.0, 0.0, 0.0]) @ FORWARD  # from 5 m behind to 8 m ahead, 1 m to the left
    K = np.array([[120.0, 0, 80], [0, 120.0, 60], [0, 0, 1]])
    seen = nearest_of(Samples.of(vertices, box.faces, K, 160, 120))
    v, u = np.divmod(np.arange(160 * 120), 160)
    rays = np.column_stack([(u - 80) / 120, (v - 60) / 120, np.ones(len(u))])
    expected = first_hit(np.zeros_like(rays), rays, vertices[box.faces])
    expected[expected < NEAR_M] = np.inf
    found = np.full(len(rays), np.inf)
    found[seen.pixel(160)] = seen.depth_m
    same = np.isclose(found, expected, rtol=1e-4) | (np.isinf(found) & np.isinf(expected))
    assert same.mean() > 0.999
    assert np.isfinite(found).sum() > 3000


def test_the_outline_of_a_body_is_soft_and_its_middle_hides_what_is_behind() -> None:
    scene = tiny_scene([{"id": "a", "category": "truck", "pose": [15.0, 0.0, 90.0], "color": [250, 250, 250]}])
    from log2sim.synth.actors import actors_of

    backdrop = Backdrop.of(scene, 0)
    empty = picture(backdrop, looking(0.0)).astype(float)
    K = np.array([[400.0, 0, 239.5], [0, 400.0, 149.5], [0, 0, 1]])
    bodies = [Body.of(actor, 0.0) for actor in actors_of(scene)]
    full = render(
        Camera("c", 480, 300, K, "map", np.eye(4)),
        looking(0.0),
        SceneInstant(backdrop, bodies),
        np.random.default_rng(0),
    ).astype(float)
    change = np.abs(full - empty).max(2)
    assert (change > 30).sum() > 5000
    assert change[:40].max() < 2.0  # the sky far above is the same
