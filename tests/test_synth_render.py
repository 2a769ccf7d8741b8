"""Pictures: long roads, what is near and large, and what a second method says about them."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import tiny_scene

from log2sim.geometry import Camera, apply, inverse, rotation_from_rpy, transform
from log2sim.synth.backdrop import Backdrop
from log2sim.synth.ground import ASPHALT, GROUND_M_PER_PX, MARKING, MEADOW, TILE_PX, Ground, GroundPlan
from log2sim.synth.render import SceneInstant, render
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
    backdrop = Backdrop(tiny_scene([], road=[road]), 0)
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
