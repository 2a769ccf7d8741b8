"""Random traffic and its fast LiDAR: against the mesh caster, closed forms and invariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from log2sim.geometry import rotation_from_rpy
from log2sim.synth.polytope_caster import SensorState, Solid, cast_polytopes
from log2sim.synth.polytopes import Material, box
from log2sim.synth.returns import (
    LidarModel,
    ReturnModel,
    Weather,
    reflected,
)
from log2sim.synth.traffic import Surface, draw_scene, labeled_cloud

FLAT = Surface(np.zeros(5), np.zeros((0, 4)), (), 0.0)
EXACT = ReturnModel(noise_m=0.0, dropout=0.0, mixed=0.0)
FINE = LidarModel(elevation_deg=tuple(np.linspace(-30, 10, 41)), azimuth_step_deg=0.5, noise_m=0.0)


def sensor(height: float = 2.0, pitch_deg: float = 0.0, velocity: tuple[float, float] = (0.0, 0.0)) -> SensorState:
    return SensorState(rotation_from_rpy(0, np.deg2rad(pitch_deg), 0), np.array([0, 0, height]), np.array(velocity))


def solid(parts, xy, yaw, velocity=(0.0, 0.0), **more) -> Solid:
    return Solid(tuple(parts), np.array([*xy, 0.0]), yaw, np.array(velocity, float), **more)


@settings(max_examples=25, deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(-np.pi, np.pi), st.floats(6, 30), st.floats(0, 35))
def test_rays_meet_the_faces_of_a_box_of_any_pose(yaw: float, bearing: float, distance: float, pitch: float) -> None:
    """Every point lies on the surface of the box or of the ground, and every ray that a slab test says hits does."""
    half = np.array([2.2, 0.9, 0.75])
    thing = solid(
        [box((-2.2, -0.9, 0), (2.2, 0.9, 1.5), Material.WALL)],
        distance * np.array([np.cos(bearing), np.sin(bearing)]),
        yaw,
    )
    state = sensor(3.6, pitch)
    cloud = cast_polytopes(FINE, state, [thing], FLAT, np.random.default_rng(0), EXACT)
    local = (cloud.xyz_m - thing.position_m - [0, 0, 0.75]) @ rotation_from_rpy(0, 0, yaw)
    on_box = cloud.hit == 0
    assert np.abs((np.abs(local[on_box]) - half).max(axis=1)).max(initial=0) < 2e-3
    assert (np.abs(local[~on_box]) > half - 2e-3).any(axis=1).all()
    # The oracle: slabs, in double precision, for every ray.
    e, a = np.meshgrid(FINE.elevations_rad(), FINE.azimuths_rad(), indexing="ij")
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3) @ state.rotation.T
    turned = rays @ rotation_from_rpy(0, 0, yaw)
    origin = (state.position_m - thing.position_m - [0, 0, 0.75]) @ rotation_from_rpy(0, 0, yaw)
    with np.errstate(all="ignore"):
        near, far = np.sort([(-half - origin) / turned, (half - origin) / turned], axis=0)
    enter, leave = near.max(axis=1), far.min(axis=1)
    sure = (leave - enter > 1e-3) & (enter > 0.5)
    ambiguous = (np.abs(leave - enter) <= 1e-3) | (
        (near[:, 2] >= enter - 1e-3) & (np.abs(origin[2] + enter * turned[:, 2] + 0.75) < 1e-3)
    )
    assert sure.sum() - ambiguous.sum() <= on_box.sum() <= (sure | ambiguous).sum()


def test_distances_equal_those_of_the_mesh_caster() -> None:
    """A parked car as a box: both casters, the same rays, within a centimeter."""
    from log2sim.synth import raycast
    from log2sim.synth.actors import MovingScene
    from log2sim.synth.scene import scene_from_table

    table = {
        "name": "box", "duration_s": 1.0, "ego": {"waypoints": [[-50, 0, 0.0], [-40, 0, 1.0]], "start_s": 5.0},
        "building": [{"center": [-38, 3], "size_m": [4, 2, 3], "yaw_deg": 30.0}, {"center": [-44, -9], "size_m": [3, 5, 2.15]}],
        "lidar": [{"name": "l", "position_m": [0, 0, 2.0], "channels": 41, "elevation_deg": [-30, 10], "azimuth_step_deg": 0.5,
                   "noise_m": 0.0, "dropout": 0.0, "resolution_m": 0.0, "range_m": 100}],
    }  # fmt: skip
    scene = scene_from_table(table)
    moving = MovingScene.of(scene)
    stamp = int(raycast.sweep_stamps(scene.lidar[0], scene)[0])
    mesh = raycast.cast_sweep(scene.lidar[0], moving, stamp, np.random.default_rng(0))
    solids = [
        solid([box((-b.size_m[0] / 2, -b.size_m[1] / 2, 0), (b.size_m[0] / 2, b.size_m[1] / 2, b.size_m[2]), Material.WALL)],
              np.array(b.center) - [-50, 0], np.deg2rad(b.yaw_deg))
        for b in scene.building
    ]  # fmt: skip
    fast = cast_polytopes(FINE, sensor(), solids, FLAT, np.random.default_rng(0), EXACT)
    walls = mesh.sweep.xyz_m[mesh.hit == raycast.BUILDING]
    ours = fast.xyz_m[fast.hit >= 0]
    assert abs(len(walls) - len(ours)) <= 0.01 * len(walls)

    def by_angle(points):
        points = points - [0, 0, 0] if points is walls else points - [0, 0, 2.0]
        azimuth = np.floor(2 * np.rad2deg(np.arctan2(points[:, 1], points[:, 0])))
        elevation = np.round(np.rad2deg(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))))
        angles = np.column_stack([azimuth, elevation])
        return {tuple(a): float(np.linalg.norm(p)) for a, p in zip(angles.tolist(), points, strict=True)}

    a, b = by_angle(walls), by_angle(ours)
    shared = a.keys() & b.keys()
    assert len(shared) > 0.95 * len(a)
    assert max(abs(a[k] - b[k]) for k in shared) < 0.01


def test_an_object_that_moves_during_the_sweep_is_drawn_out() -> None:
    """A wall that runs across the seam is met half a turn apart in time."""
    wall = solid([box((-0.1, -6, 0), (0.1, 6, 3), Material.WALL)], (-8, 0), 0.0, velocity=(10.0, 0.0))
    cloud = cast_polytopes(FINE, sensor(), [wall], FLAT, np.random.default_rng(0), EXACT)
    on = cloud.hit == 0
    x, y = cloud.xyz_m[on, 0], cloud.xyz_m[on, 1]
    assert np.abs(x - (-8 + 10 * cloud.t_s[on]) - 0.1).max() < 0.01
    assert x[y > 1].mean() - x[y < -1].mean() == pytest.approx(10 * 0.1, abs=0.35) or x[y < -1].mean() - x[
        y > 1
    ].mean() == pytest.approx(10 * 0.1, abs=0.35)


def test_a_scene_depends_on_its_seed_alone() -> None:
    clouds = []
    for seed in (1, 1, 2):
        rng = np.random.default_rng(seed)
        clouds.append(labeled_cloud(draw_scene("roadside", rng), rng).xyz_m)
    assert np.array_equal(clouds[0], clouds[1])
    assert clouds[0].shape != clouds[2].shape or not np.array_equal(clouds[0], clouds[2])


def test_fog_extinguishes_as_koschmieder_says() -> None:
    fog = Weather("fog", visibility_m=100.0)
    assert np.exp(-fog.extinction_per_m * 100) == pytest.approx(0.02, rel=1e-3)
    one = np.ones(1, np.float32)
    ratio = reflected(50 * one, one, one, fog) / reflected(50 * one, one, one, Weather())
    assert ratio[0] == pytest.approx(np.exp(-2 * fog.extinction_per_m * 50), rel=1e-4)
