"""Scene files and random variants of the tests of vehicle-road cooperation: they load, repeat, and hide what they promise to hide."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cooperation_worlds.blind_area_measures import STOPPING_M, collides
from cooperation_worlds.draw_blind_area import FIRST_SIGHT_S, ROAD_SIGHT_S, draw_blind_area, keeps_promise
from cooperation_worlds.draw_blind_area import _drawn as draw_first
from cooperation_worlds.draw_overlap import draw_overlap
from cooperation_worlds.draw_range import distances_m, draw_range
from cooperation_worlds.hidden_traffic import HiddenTraffic, row, seen
from cooperation_worlds.hidden_traffic import _drawn as draw_traffic
from cooperation_worlds.hidden_traffic import figures as traffic_figures
from cooperation_worlds.overlap_measures import shares
from cooperation_worlds.perturb import RoadError, disturb
from cooperation_worlds.range_measures import figures as range_figures
from cooperation_worlds.rows import Rows
from cooperation_worlds.runs import Found
from cooperation_worlds.world import ROAD_LIDAR, VEHICLE_LIDAR, World, cast, log_of
from numpy.typing import NDArray

from log2sim.datatypes import Boxes3D
from log2sim.synth.raster import first_hit
from log2sim.synth.scene import Gnss, load_scene
from log2sim.synth.synthesis import synthesize
from log2sim.synth.traffic_data import START_NS

ROOT = Path(__file__).parent.parent

DRAW = {"range": draw_range, "blind_area": draw_blind_area, "overlap": draw_overlap}
SEEDS = (1, 5)  # the first one drawn for 5 shows the walker too early


@cache
def drawn(test: str, seed: int) -> World:
    """Draw a world once for all tests."""
    return DRAW[test](seed)


def points_on_target(world: World, lidar: str, t_s: float) -> int:
    """Count the returns of the target in a sweep that ends at a time; what no ray reaches is hidden."""
    spec = next(s for s in world.scene.lidar if s.name == lidar)
    stamp = world.scene.start_ns + round(t_s * 1e9)
    returns, _ = cast(world, world.moving, spec, stamp, np.random.default_rng(0))
    index = [a.id for a in world.scene.agent].index(world.target)
    return int((returns.hit == index).sum())


@pytest.mark.parametrize("name", list(DRAW))
def test_scene_files_have_a_lidar_at_each_end_with_the_ranges_of_the_paper(name: str) -> None:
    scene = load_scene(ROOT / "samples" / "cooperation" / f"{name}.toml")
    log, truth = synthesize(scene, observe=False)
    by_mount = {spec.mount: spec for spec in scene.lidar}
    assert by_mount["ego"].position_m[2] == 2.0
    assert by_mount["ego"].range_m == 20.0
    assert by_mount["map"].position_m[2] == 3.0
    assert by_mount["map"].range_m == 40.0
    assert set(log.lidars) == {VEHICLE_LIDAR, ROAD_LIDAR}
    assert len(truth.agents) == len(scene.agent) + 1


@pytest.mark.matrix
@pytest.mark.parametrize("name", list(DRAW))
def test_a_seed_draws_the_same_world_again_and_another_one_another(name: str) -> None:
    world, again, other = drawn(name, 1), DRAW[name](1), drawn(name, 5)
    assert world.scene == again.scene
    assert world.scene != other.scene
    streams = [log_of(w)[0].streams[ROAD_LIDAR] for w in (world, again)]
    np.testing.assert_array_equal(streams[0].read(3).xyz_m, streams[1].read(3).xyz_m)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_the_walker_hides_from_the_vehicle_and_not_from_the_pole(seed: int) -> None:
    world = drawn("blind_area", seed)
    # A sweep ends a period after it begins.
    before = np.arange(FIRST_SIGHT_S[1] + 0.1, ROAD_SIGHT_S, 0.6)
    alone = [points_on_target(world, VEHICLE_LIDAR, world.contact_s - b) for b in before]
    road = [points_on_target(world, ROAD_LIDAR, world.contact_s - b) for b in before]
    assert max(alone) <= 5
    assert min(road) >= 8
    assert points_on_target(world, VEHICLE_LIDAR, world.contact_s) > 20


def test_a_world_that_breaks_the_promise_is_drawn_again() -> None:
    assert not keeps_promise(draw_first(5, np.random.default_rng([5, 2, 0])))
    assert keeps_promise(drawn("blind_area", 5))


@pytest.mark.parametrize("seed", SEEDS)
def test_the_ego_reaches_the_walker_unless_it_brakes_in_time(seed: int) -> None:
    world = drawn("blind_area", seed)
    assert collides(world, np.inf)
    assert collides(world, world.contact_s - 0.9)
    assert not collides(world, world.contact_s - STOPPING_M / (30 / 3.6) - 0.05)


def test_the_stopping_distance_is_that_of_the_paper() -> None:
    assert pytest.approx(12.7, abs=0.05) == STOPPING_M


@pytest.mark.parametrize("seed", SEEDS)
def test_the_target_beyond_20_m_is_seen_from_the_pole_alone(seed: int) -> None:
    world = drawn("range", seed)
    t_s = np.arange(0.2, world.scene.duration_s, 0.1)
    away = distances_m(world, t_s)
    for wanted in (30.0, 38.0):
        t = float(t_s[np.abs(away - wanted).argmin()])
        assert points_on_target(world, VEHICLE_LIDAR, t) == 0
        assert points_on_target(world, ROAD_LIDAR, t) > 10


@pytest.mark.parametrize("seed", SEEDS)
def test_both_ends_see_the_target_of_the_overlap(seed: int) -> None:
    world = drawn("overlap", seed)
    for t_s in (0.3, 1.8):
        assert min(points_on_target(world, name, t_s) for name in (VEHICLE_LIDAR, ROAD_LIDAR)) > 30


@pytest.mark.parametrize("seed", [0, 5])
def test_points_lie_on_the_target_in_the_map(seed: int) -> None:
    """The frames of both sensors and the times of points are right, while ego and target move and the target is beside the ego."""
    world = drawn("overlap", seed)
    exact = Gnss(position_sigma_m=0.0, angle_sigma_deg=0.0)
    world = replace(world, scene=world.scene.model_copy(update={"gnss": exact}))
    log, _ = log_of(world)
    actor = next(a for a in world.moving.actors if a.spec.id == world.target)
    for name in (VEHICLE_LIDAR, ROAD_LIDAR):
        sweep = log.streams[name].read(9)
        map_T_lidar, valid = log.map_T_sensor(name, sweep.t_ns)
        assert valid.all()
        xyz = np.einsum("nij,nj->ni", map_T_lidar[:, :3, :3], sweep.xyz_m) + map_T_lidar[:, :3, 3]
        spec = next(spec for spec in world.scene.lidar if spec.name == name)
        rng = np.random.default_rng([seed, 4, world.scene.lidar.index(spec), 9])
        np.testing.assert_allclose(xyz, cast(world, world.moving, spec, sweep.stamp_ns, rng)[0].xyz_m, atol=0.01)
        states = actor.at((sweep.t_ns - world.scene.start_ns) / 1e9)
        off = xyz - states.center_m
        c, s = np.cos(states.yaw_rad), np.sin(states.yaw_rad)
        local = np.abs(np.column_stack([c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0], off[:, 2]]))
        half = np.array(actor.spec.box_m) / 2
        # Noise of 2 cm; the ground below is left out.
        near = (local[:, :2] < half[:2] + 0.5).all(1) & (off[:, 2] > -half[2] + 0.2)
        assert near.sum() > 30
        assert ((local[near] < half + 0.06).all(1)).mean() > 0.97


def test_an_error_of_the_pole_moves_its_points_and_stamps_alone() -> None:
    log, _ = log_of(drawn("overlap", 1))
    wrong = disturb(log, RoadError((0.3, -0.4, 0.0), (0.0, 0.0, 1.0), 0.2))
    pose, moved = (one.lidars[ROAD_LIDAR].mount_T_lidar for one in (log, wrong))
    np.testing.assert_allclose(moved[:3, 3] - pose[:3, 3], [0.3, -0.4, 0.0])
    assert np.rad2deg(np.arccos((np.trace(pose[:3, :3].T @ moved[:3, :3]) - 1) / 2)) == pytest.approx(1.0)
    assert (wrong.streams[ROAD_LIDAR].t_ns - log.streams[ROAD_LIDAR].t_ns == 200_000_000).all()
    np.testing.assert_array_equal(
        wrong.streams[ROAD_LIDAR].read(2).t_ns, log.streams[ROAD_LIDAR].read(2).t_ns + 200_000_000
    )
    assert wrong.lidars[VEHICLE_LIDAR] is log.lidars[VEHICLE_LIDAR]


def test_agents_of_a_scenario_are_where_they_were_at_times_of_the_scene() -> None:
    """A scenario begins with the middle of its first sweep, not with its scene."""
    world = replace(drawn("overlap", 5), every=2)
    log, truth = log_of(world)
    assert np.diff(log.streams[VEHICLE_LIDAR].t_ns).tolist() == [200_000_000] * 9
    later = truth.agents[1].waypoints
    agent = replace(truth.agents[1], waypoints=replace(later, t_s=later.t_s - 0.05))
    state, there = Found(truth, begin_s=0.05).at(agent, np.array([1.0, 9.0]))
    assert there.tolist() == [True, False]
    np.testing.assert_allclose(state[0, :2], world.moving.actors[0].at([1.0]).center_m[0, :2], atol=1e-6)


def test_overlap_and_iou_of_a_box_that_is_twice_as_long() -> None:
    truth = np.array([[1.0, 2.0, 4.0, 2.0, 0.7], [1.0, 2.0, 4.0, 2.0, 0.7]])
    found = truth * [1, 1, 2, 1, 1] + [[0, 0, 0, 0, 0], [50, 0, 0, 0, 0]]
    np.testing.assert_allclose(shares(found, truth), [[1.0, 0.5], [0.0, 0.0]], atol=1e-9)


def test_a_range_ends_where_the_target_is_seen_less_than_half_of_the_time() -> None:
    away = np.arange(11.0, 49.0, 0.5)
    figures = range_figures([np.column_stack([away, away < 31]), np.column_stack([away, away < 29])])
    assert figures["range_m"] == 30.0
    assert figures["recall_30m"] == pytest.approx(0.5)


@pytest.mark.slow
def test_true_boxes_of_random_traffic_score_1_and_those_of_the_vehicle_alone_less() -> None:
    traffic = draw_traffic(3, 0)
    view = seen(traffic)
    stamps = view.log.streams[VEHICLE_LIDAR].t_ns
    boxes = [true_boxes(traffic, int(stamp) - 30_000_000) for stamp in stamps]
    everything = row(view, stamps, boxes)
    hidden = np.concatenate([s["hidden"] for s in everything["vehicle"]])
    counted = ~np.concatenate([s["ignored"] for s in everything["vehicle"]])
    figures = traffic_figures({"all": [everything], "nothing": [row(view, stamps, [Boxes3D.empty()] * len(stamps))]})
    assert figures["ap"]["vehicle"] == {"all": 1.0, "nothing": 0.0}
    assert (hidden & counted).sum() < counted.sum()


def true_boxes(traffic: HiddenTraffic, t_ns: int) -> Boxes3D:
    """Make what a perfect detector finds at a time, as it moved until then."""
    users = [o for o in traffic.run.at((t_ns - START_NS) / 1e9).objects if o.category]
    size = np.array([o.size_m for o in users])
    center = np.array([o.position_m for o in users]) + size * [0, 0, 0.5]
    some, yaw = np.ones(len(users)), np.array([o.yaw_rad for o in users])
    category = np.array([o.category for o in users], dtype="<U16")
    return Boxes3D(np.full(len(users), t_ns), center, size, yaw, some, category, some, some.astype(np.int64))


def test_rows_are_found_again_by_a_later_run(tmp_path: Path) -> None:
    kept = Rows(tmp_path / "rows.jsonl")
    kept["range", 3, "points"] = {"seen": [1.5, None]}
    again = Rows(tmp_path / "rows.jsonl")
    assert ("range", 3, "points") in again
    assert ("range", 4, "points") not in again
    assert again["range", 3, "points"] == {"seen": [1.5, None]}


def test_grouped_triangles_are_hit_as_one_by_one() -> None:
    rng = np.random.default_rng(3)
    corners = rng.uniform(-2, 2, (700, 1, 3)) + rng.normal(0, 0.15, (700, 3, 3))
    origin, target = rng.uniform(-9, 9, (150, 3)), rng.uniform(-2, 2, (150, 3))
    ray = target - origin
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    expected = np.min([one_triangle(origin, ray, triangle) for triangle in corners], axis=0)
    found = first_hit(origin, ray, corners)
    assert 20 < np.isfinite(expected).sum() < 150
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def one_triangle(
    origin: NDArray[np.float64], ray: NDArray[np.float64], corners: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distances (N,) by the system of equations o + t d = a + u (b - a) + v (c - a)."""
    a, b, c = corners
    matrix = np.stack([np.broadcast_to(b - a, ray.shape), np.broadcast_to(c - a, ray.shape), -ray], -1)
    u, v, t = np.linalg.solve(matrix, (origin - a)[..., None])[..., 0].T
    return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
