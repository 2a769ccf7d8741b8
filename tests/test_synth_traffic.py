"""Random traffic and its fast LiDAR: against the mesh caster, closed forms and invariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from log2sim.errors import ConfigError
from log2sim.geometry import rotation_from_rpy
from log2sim.synth.polytope_caster import GROUND, SensorState, Solid, cast_polytopes
from log2sim.synth.polytopes import Material, box, column, ellipsoid, prism, tube, wheel
from log2sim.synth.returns import (
    LIDAR_MODELS,
    LidarModel,
    ReturnModel,
    Weather,
    backscattered,
    detected,
    lidar_model,
    reflected,
)
from log2sim.synth.traffic import Road, Surface, draw_scene, labeled_cloud
from log2sim.synth.traffic_shapes import ROAD_USERS

FLAT = Surface(np.zeros(5), np.zeros((0, 4)), (), 0.0)
EXACT = ReturnModel(noise_m=0.0, dropout=0.0, mixed=0.0)
FINE = LidarModel(elevation_deg=tuple(np.linspace(-30, 10, 41)), azimuth_step_deg=0.5, noise_m=0.0)


def sensor(height: float = 2.0, pitch_deg: float = 0.0, velocity: tuple[float, float] = (0.0, 0.0)) -> SensorState:
    return SensorState(rotation_from_rpy(0, np.deg2rad(pitch_deg), 0), np.array([0, 0, height]), np.array(velocity))


def solid(parts, xy, yaw, velocity=(0.0, 0.0), **more) -> Solid:
    return Solid(tuple(parts), np.array([*xy, 0.0]), yaw, np.array(velocity, float), **more)


def test_a_flat_ground_is_met_where_the_ray_goes_down_to_it() -> None:
    cloud = cast_polytopes(FINE, sensor(), [], FLAT, np.random.default_rng(0), EXACT)
    assert (cloud.hit == GROUND).all()
    assert np.abs(cloud.xyz_m[:, 2]).max() < 1e-3
    distance = np.hypot(cloud.xyz_m[:, 0], cloud.xyz_m[:, 1])
    assert np.allclose(distance, 2.0 / np.tan(-np.deg2rad(np.array(FINE.elevation_deg)[cloud.line])), rtol=1e-4)


def test_a_slope_is_met_on_its_surface() -> None:
    surface = Surface(np.array([0.05, -0.03, 2e-4, 0, 1e-4]), np.zeros((0, 4)), (), 0.0)
    cloud = cast_polytopes(FINE, sensor(), [], surface, np.random.default_rng(0), EXACT)
    assert len(cloud.xyz_m) > 10_000
    assert np.abs(cloud.xyz_m[:, 2] - surface.height(*cloud.xyz_m[:, :2].T)).max() < 0.031


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


def test_a_nearer_object_hides_a_farther_one() -> None:
    front = solid([box((-1, -5, 0), (1, 5, 4), Material.WALL)], (8, 0), 0.0)
    behind = solid([box((-1, -2, 0), (1, 2, 2), Material.WALL)], (20, 0), 0.0)
    cloud = cast_polytopes(FINE, sensor(), [behind, front], FLAT, np.random.default_rng(0), EXACT)
    assert (cloud.hit == 1).any()
    assert not (cloud.hit == 0).any()


def test_windows_let_as_many_rays_through_as_they_are_told() -> None:
    pane = solid([box((-0.1, -5, 0), (0.1, 5, 4), Material.GLASS)], (8, 0), 0.0, glass_passes=0.7)
    wall = solid([box((-0.1, -9, 0), (0.1, 9, 9), Material.WALL)], (12, 0), 0.0)
    cloud = cast_polytopes(FINE, sensor(), [pane, wall], FLAT, np.random.default_rng(0), EXACT)
    through = np.abs(cloud.xyz_m[:, 1]) < 4
    panes, walls = (cloud.hit[through] == 0).sum(), (cloud.hit[through] == 1).sum()
    assert panes > 100
    assert walls > panes


def test_leaves_return_from_inside_their_volume() -> None:
    crown = ellipsoid((1.5, 1.5, 1.5), (0, 0, 1.5), Material.LEAVES)
    cloud = cast_polytopes(FINE, sensor(), [solid([crown], (8, 0), 0.0)], FLAT, np.random.default_rng(0), EXACT)
    depth = cloud.xyz_m[cloud.hit == 0, 0] - 8
    assert depth.max() > 0.3
    assert depth.min() < -0.9


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


def test_relative_motion_alone_matters() -> None:
    """A sensor and an object that move together see each other as at rest, but for the ground they passed."""
    thing = [box((-2, -1, 0), (2, 1, 1.5), Material.WALL)]
    rest = cast_polytopes(FINE, sensor(), [solid(thing, (10, 3), 0.4)], FLAT, np.random.default_rng(0), EXACT)
    both = cast_polytopes(
        FINE, sensor(velocity=(20.0, 0)), [solid(thing, (10, 3), 0.4, (20.0, 0))], FLAT, np.random.default_rng(0), EXACT
    )
    a, b = rest.xyz_m[rest.hit == 0], both.xyz_m[both.hit == 0] - [20, 0, 0] * both.t_s[both.hit == 0, None]
    assert np.allclose(a, b, atol=2e-3)


@pytest.mark.parametrize("category", ROAD_USERS)
def test_road_users_fill_their_boxes(category: str) -> None:
    for seed in range(20):
        (length, width, height), parts = ROAD_USERS[category](np.random.default_rng(seed))
        corners = np.concatenate([p.vertices() for p in parts])
        low, high = corners.min(axis=0), corners.max(axis=0)
        # Mirrors, handlebars and feet may stand out by a hand's breadth.
        assert low[2] > -0.06, (category, seed)
        assert abs(high[2] - height) < 0.2, (category, seed)
        assert np.all(np.abs((high - low)[:2] - (length, width)) < (0.35, 0.35)), (category, seed)


@pytest.mark.parametrize(
    "part",
    [
        box((-1, -2, 0), (1, 2, 3), Material.WALL),
        column(0.4, (0.0, 2.0), Material.METAL, at=(1.0, -2.0)),
        tube(0.8, (-3, 2), 1.5, Material.METAL),
        wheel(0.35, 0.2, 1.2, 0.8),
        ellipsoid((1.0, 0.5, 2.0), (0.3, 0.2, 2.0), Material.LEAVES),
        prism([(-2, 0.2), (2, 0.2), (1.5, 1.0), (-1.8, 1.1)], 1.6, Material.PAINT, taper=0.1),
    ],
)
def test_bounds_hold_all_corners(part) -> None:
    corners = part.vertices()
    assert len(corners) >= 8
    assert (corners >= part.low - 1e-4).all()
    assert (corners <= part.high + 1e-4).all()
    assert np.allclose(np.linalg.norm(part.normals, axis=1), 1, atol=1e-5)


@pytest.mark.slow
def test_labels_are_where_the_points_are() -> None:
    """Of every road user, points lie in its box, at any speed and on any slope."""
    for seed in range(6):
        for mount in ("vehicle", "roadside"):
            rng = np.random.default_rng([3, seed])
            cloud = labeled_cloud(draw_scene(mount, rng), rng)
            users = [k for k, o in enumerate(cloud.scene.objects) if o.category]
            for row, k in enumerate(users):
                x, y, z, length, width, height, yaw = cloud.boxes[row]
                local = (cloud.xyz_m[cloud.hit == k] - [x, y, z]) @ rotation_from_rpy(0, 0, yaw)
                if len(local) >= 5:
                    inside = (np.abs(local) < np.array([length, width, height]) / 2 + 0.25).all(axis=1)
                    assert inside.mean() > 0.85, (seed, mount, cloud.category[row])


def test_a_scene_depends_on_its_seed_alone() -> None:
    clouds = []
    for seed in (1, 1, 2):
        rng = np.random.default_rng(seed)
        clouds.append(labeled_cloud(draw_scene("roadside", rng), rng).xyz_m)
    assert np.array_equal(clouds[0], clouds[1])
    assert clouds[0].shape != clouds[2].shape or not np.array_equal(clouds[0], clouds[2])


def test_positions_on_a_road_come_back_as_offsets() -> None:
    road = Road(np.array([3.0, -2.0]), 0.7, 0.01, 4.0, 2)
    for s, d in ((-30.0, 2.0), (0.0, -3.0), (45.0, 5.5)):
        xy, _ = road.at(s, d)
        assert road.offset(np.float32(xy[:1]), np.float32(xy[1:]))[0] == pytest.approx(d, abs=1e-3)


def test_motion_on_an_arc_keeps_its_radius() -> None:
    rng = np.random.default_rng(0)
    item = next(o for o in draw_scene("vehicle", rng).objects if o.category)
    from dataclasses import replace

    item = replace(item, speed_mps=10.0, turn_radps=0.5, yaw_rad=0.0, position_m=np.zeros(3))
    for t in (0.1, 1.0, 3.0):
        position, yaw = item.pose_at(t)
        assert np.hypot(position[0], position[1] - 20.0) == pytest.approx(20.0)
        assert yaw == pytest.approx(0.5 * t)


def test_fog_extinguishes_as_koschmieder_says() -> None:
    fog = Weather("fog", visibility_m=100.0)
    assert np.exp(-fog.extinction_per_m * 100) == pytest.approx(0.02, rel=1e-3)
    one = np.ones(1, np.float32)
    ratio = reflected(50 * one, one, one, fog) / reflected(50 * one, one, one, Weather())
    assert ratio[0] == pytest.approx(np.exp(-2 * fog.extinction_per_m * 50), rel=1e-4)


def test_a_signal_falls_with_the_square_of_the_distance() -> None:
    one = np.ones(1, np.float32)
    assert reflected(40 * one, one, one, Weather())[0] == pytest.approx(4 * reflected(80 * one, one, one, Weather())[0])


def test_weak_returns_are_lost_and_strong_ones_are_not() -> None:
    rng = np.random.default_rng(0)
    weak, strong = np.full(2000, 0.01, np.float32), np.full(2000, 1.0, np.float32)
    assert detected(weak, EXACT, rng).mean() == 0
    assert detected(strong, EXACT, rng).mean() == 1


def test_fog_returns_come_from_close_by_and_clear_air_sends_none() -> None:
    rng = np.random.default_rng(0)
    far = np.full(20_000, 80.0, np.float32)
    assert not np.isfinite(backscattered(far, Weather(), rng)).any()
    early = backscattered(far, Weather("fog", visibility_m=100.0), rng)
    assert 0.01 < np.isfinite(early).mean() < 0.08
    assert early[np.isfinite(early)].max() <= 15.0


def test_every_sensor_of_the_table_casts() -> None:
    for name, model in LIDAR_MODELS.items():
        cloud = cast_polytopes(model, sensor(), [], FLAT, np.random.default_rng(0))
        rays = len(model.elevation_deg) * len(model.azimuths_rad())
        assert 0 < len(cloud.xyz_m) <= rays, name


def test_a_sensor_that_points_at_the_sky_sees_nothing() -> None:
    cloud = cast_polytopes(LIDAR_MODELS["rslidar-m1"], sensor(pitch_deg=-60), [], FLAT, np.random.default_rng(0))
    assert len(cloud.xyz_m) == 0


def test_sensors_of_ones_own(tmp_path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("elevation_deg = [-10, -5, 0]\nazimuth_deg = [-30, 30]\nrange_m = 40\n")
    model = lidar_model(str(path))
    assert model.name == "mine"
    assert len(model.azimuths_rad()) == 300
    for text, word in (("elevation = [1]", "elevation"), ("elevation_deg = [100]", "elevation_deg"), ("x = [", "TOML")):
        path.write_text(text)
        with pytest.raises(ConfigError, match=word):
            lidar_model(str(path))
    with pytest.raises(ConfigError, match="vlp16"):
        lidar_model("vpl16")
