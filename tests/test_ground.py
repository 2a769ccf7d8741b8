"""The ground under a sweep, and clouds: against surfaces and points that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import camera_ahead, scan, standing

from log2sim.datatypes import Lidar, Log, Stream, Sweep
from log2sim.geometry import apply, inverse, rotation_from_rpy, transform
from log2sim.perception.lidar.cloud import assemble_cloud, estimate_ground

T0_NS = 1_700_000_000_000_000_000


def surface_points(height, reach_m=45.0, count=20_000, noise_m=0.02, seed=0):
    """Points on z = height(x, y), denser nearby as a LiDAR has them."""
    rng = np.random.default_rng(seed)
    angle, r = rng.uniform(-np.pi, np.pi, count), reach_m * rng.random(count)
    x, y = r * np.cos(angle), r * np.sin(angle)
    return np.stack([x, y, height(x, y) + rng.normal(0, noise_m, count)], axis=1)


SURFACES = {
    "flat": lambda x, y: 0.0 * x,
    "uphill": lambda x, y: 0.06 * x,
    "cross fall": lambda x, y: 0.03 * y - 0.02 * x,
    "crest": lambda x, y: -0.0008 * x * x,
    "dip": lambda x, y: 0.0008 * x * x + 0.0005 * y * y,
}


@pytest.mark.parametrize("name", SURFACES)
def test_smooth_ground_is_found_where_it_is(name):
    height = SURFACES[name]
    ground = estimate_ground(surface_points(height), np.zeros(2), 0.0)
    asked = surface_points(height, reach_m=40.0, count=2000, noise_m=0.0, seed=1)
    # The second lowest of a cell's points lies a little below their mean: two to three times their noise.
    assert np.abs(ground.at(asked[:, :2]) - asked[:, 2]).max() < 0.15
    assert np.abs(np.median(ground.at(asked[:, :2]) - asked[:, 2])) < 0.06


@pytest.mark.parametrize("name", ["flat", "uphill", "crest"])
def test_objects_and_walls_on_it_do_not_lift_the_ground(name):
    height = SURFACES[name]
    rng = np.random.default_rng(2)
    points = [surface_points(height)]
    for x, y, length, width, tall in [(15, 3, 4.5, 1.9, 1.6), (25, -4, 12, 2.5, 3.2), (10, 12, 30, 1.0, 6.0)]:
        local = rng.uniform([-length / 2, -width / 2, 0.3], [length / 2, width / 2, tall], (3000, 3))
        x_, y_ = local[:, 0] + x, local[:, 1] + y
        points.append(np.stack([x_, y_, local[:, 2] + height(x_, y_)], axis=1))
    # Nothing of the road below them is seen.
    road = points[0]
    for x, y, length, width in [(15, 3, 4.5, 1.9), (25, -4, 12, 2.5), (10, 12, 30, 1.0)]:
        road = road[(np.abs(road[:, 0] - x) > length / 2) | (np.abs(road[:, 1] - y) > width / 2)]
    ground = estimate_ground(np.concatenate([road, *points[1:]]), np.zeros(2), 0.0)
    under = np.array([[15.0, 3.0], [25.0, -4.0], [10.0, 12.0], [0.0, 12.0]])
    np.testing.assert_allclose(ground.at(under), height(under[:, 0], under[:, 1]), atol=0.2)


@pytest.mark.parametrize("z", [-7.0, 0.0, 3.5])
@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.array([[5.0, 5, 2]]), np.array([[5.0, 5, -2]] * 6), np.array([[1e6, 1e6, 0.0]])],
    ids=["none", "one", "few", "far"],
)
def test_without_points_to_speak_of_the_ground_is_flat_at_the_height_expected(points, z):
    ground = estimate_ground(points + np.array([0, 0, z]), np.zeros(2), z)
    far = np.array([[0.0, 0], [-60, 20], [40, -90]])
    np.testing.assert_allclose(ground.at(far), z, atol=1e-5)


# Clouds


def fixed_log(mount_T_lidar, *, ego=None, mount="map", names=("top",)):
    none = np.zeros(0, dtype=np.int64)
    lidars = {n: Lidar(n, mount, mount_T_lidar) for n in names}
    return Log("log", "test", {"a": camera_ahead("a")}, lidars, {n: Stream(n, none, None) for n in names}, ego)


def recorded(world, mount_T_lidar, stamp_ns=T0_NS, t_ns=None):
    return Sweep(stamp_ns, apply(inverse(mount_T_lidar), world), "lidar", t_ns)


@pytest.mark.parametrize("far", [np.zeros(3), np.array([5e5, 5e6, 400.0])], ids=["origin", "UTM"])
def test_a_cloud_holds_the_world_wherever_it_lies(far):
    solids = [standing(12, 3, 30), standing(20, -5, 0)]
    world, owner = scan(solids, noise_m=0.01)
    map_T_lidar = transform(rotation_from_rpy(0.05, -0.03, 2.0), far + np.array([0, 0, 1.9]))
    log = fixed_log(map_T_lidar)
    cloud = assemble_cloud(
        log, {"top": recorded(world + far, map_T_lidar)}, origin=far, ground_z=far[2], max_range_m=80
    )
    kept = np.abs(world[:, :2]).max(axis=1) <= 80
    np.testing.assert_allclose(cloud.xyz.astype(float) + cloud.origin, world[kept] + far, atol=1e-4)
    np.testing.assert_allclose(cloud.sensor, [0, 0, 1.9], atol=1e-5)
    assert cloud.stamp_ns == T0_NS
    near = np.hypot(*world[kept, :2].T) < 40
    road, car = near & (owner[kept] < 0), near & (owner[kept] >= 0) & (world[kept, 2] > 0.3)
    assert cloud.ground[road].mean() > 0.99
    assert not cloud.ground[car].any()
    np.testing.assert_allclose(cloud.height[near], world[kept, 2][near], atol=0.12)


def test_sweeps_of_two_lidars_become_one_cloud_on_one_clock():
    a, b = transform(np.eye(3), np.array([0, 0, 2.0])), transform(rotation_from_rpy(0, 0, 1.0), np.array([4.0, 0, 1.0]))
    log = Log("log", "test", {}, {"a": Lidar("a", "map", a), "b": Lidar("b", "map", b)}, {})
    world = np.random.default_rng(0).uniform([-20, -20, 0], [20, 20, 2], (60, 3))
    later = T0_NS + 30_000_000
    sweeps = {
        "a": recorded(world[:40], a, T0_NS, np.full(40, T0_NS - 5_000_000)),
        "b": recorded(world[40:], b, later, np.full(20, later + 2_000_000)),
    }
    cloud = assemble_cloud(log, sweeps, origin=np.zeros(3), ground_z=0.0, max_range_m=50)
    np.testing.assert_allclose(cloud.xyz, world, atol=1e-5)
    np.testing.assert_allclose(cloud.t_s, np.repeat([-0.005, 0.032], [40, 20]), atol=1e-6)
    np.testing.assert_allclose(cloud.sensor, [2.0, 0, 1.5], atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, 1e30, -1e30])
@pytest.mark.parametrize("column", [0, 1, 2])
def test_a_few_broken_coordinates_do_not_spoil_the_ground(bad, column):
    world, _ = scan([standing(12, 3)])
    broken = world.copy()
    broken[::97, column] = bad
    place = {"origin": np.zeros(3), "ground_z": 0.0, "max_range_m": 60.0}
    sound = assemble_cloud(fixed_log(np.eye(4)), {"top": Sweep(T0_NS, world)}, **place)
    cloud = assemble_cloud(fixed_log(np.eye(4)), {"top": Sweep(T0_NS, broken)}, **place)
    assert abs(cloud.ground.mean() - sound.ground.mean()) < 0.02
