"""Simulated sweeps: closed forms of the caster, worlds without ghosts, sweeps that were left out, edited scenarios."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from log2sim.datatypes import Log, Scenario
from log2sim.errors import ConfigError, LogError
from log2sim.geometry import NS_PER_S, rotation_from_rpy
from log2sim.logs.opening import open_log
from log2sim.resim.alignment import Alignment
from log2sim.resim.caster import first_hits, grid_of, meetings
from log2sim.resim.rays import Shots, all_shots, find_pattern, poses_of, rays_in_map, recorded_shots
from log2sim.resim.sightings import Sighting, choose_sighting, sighting, thinned, with_sightings
from log2sim.resim.simulate import Simulation, resimulate, seeing, simulate, with_sensors
from log2sim.resim.surfels import SurfelGrid, Surfels, joined, local_surface, smallest_axis
from log2sim.resim.world import Seen, World, _add_sweep, body_of, build_world, ground_below
from log2sim.simulation.policy import Controls, Observation
from log2sim.simulation.runner import open_world, replay
from log2sim.synth import Scene, load_scene, synthesize
from log2sim.visualization.plot.encoding import choose_film_file
from log2sim.visualization.sensor_film import write_film

SCENES = Path(__file__).resolve().parents[1] / "samples" / "scenes"


def shots_toward(direction: np.ndarray) -> Shots:
    unit = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    nothing = np.full(len(unit), np.nan, np.float32)
    return Shots(unit, np.zeros(len(unit), np.int64), nothing, nothing)


def disc_surfels(center: np.ndarray, normal: np.ndarray, radius: float) -> Surfels:
    one = np.ones(len(center), np.float32)
    return Surfels(center.astype(np.float32), normal.astype(np.float32), radius * one, one, one, one)


def cast(shots: Shots, surfels: Surfels, seed: int = 0) -> np.ndarray:
    rays = rays_in_map(shots, np.eye(4)[None], np.zeros(len(shots.t_ns), np.intp))
    met = meetings(rays, grid_of(rays), surfels, surfels.center_m, surfels.normal)
    return first_hits(met, surfels, len(shots.t_ns), np.random.default_rng(seed)).range_m


def test_a_plane_of_discs_is_met_where_the_plane_is() -> None:
    grid = np.stack(np.meshgrid(np.arange(-20, 20, 0.25), np.arange(-20, 20, 0.25)), -1).reshape(-1, 2)
    normal = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    height = -1.8 - (grid @ normal[:2]) / normal[2]
    plane = disc_surfels(np.column_stack([grid, height]), np.tile(normal, (len(grid), 1)), 0.25)
    rng = np.random.default_rng(1)
    # All around, the seam at the back included.
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 3000), rng.uniform(-0.9, -0.35, 3000)
    ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    expected = -1.8 * normal[2] / (ray @ normal)
    near = (expected > 0) & (expected < 15)
    np.testing.assert_allclose(cast(shots_toward(ray[near]), plane)[:], expected[near], rtol=1e-4)


def test_rays_that_start_apart_meet_a_plane_as_those_that_start_where_others_do() -> None:
    """Of an ego that turns: LiDARs that spin, and one that looks everywhere all the time."""
    grid = np.stack(np.meshgrid(np.arange(-13, 16, 0.25), np.arange(-13, 13, 0.25)), -1).reshape(-1, 2)
    plane = disc_surfels(np.column_stack([grid, -1.8 + 0 * grid[:, 0]]), np.tile([0.0, 0, 1], (len(grid), 1)), 0.25)
    wall = np.stack(np.meshgrid(np.arange(-10, 10, 0.1), np.arange(-1.8, 2, 0.1)), -1).reshape(-1, 2)
    wall = np.column_stack([0 * wall[:, 0] + 8, wall])  # across the way, so that every start counts
    plane = joined([plane, disc_surfels(wall, np.tile([-1.0, 0, 0], (len(wall), 1)), 0.1)])
    rng = np.random.default_rng(2)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 6000), rng.uniform(-0.6, 0.1, 6000)
    ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    spinning = (azimuth + np.pi) / (2 * np.pi) * 0.1
    for speed_mps, t_s, tolerance_m in (
        (15, spinning, 0.01),
        (30, spinning, 1e-4),
        (30, rng.uniform(0, 0.1, 6000), 1e-4),
    ):
        moment = (t_s / 0.0002).astype(int)
        poses = np.tile(np.eye(4), (501, 1, 1))
        yaw, x = 0.3 * np.arange(501) * 0.0002, speed_mps * np.arange(501) * 0.0002
        poses[:, :3, :3], poses[:, 0, 3] = rotation_from_rpy(0.0, 0.0, yaw), x
        shots = replace(shots_toward(ray), t_ns=(t_s * NS_PER_S).astype(np.int64))
        rays = rays_in_map(shots, poses, moment)
        met = meetings(rays, grid_of(rays), plane, plane.center_m - rays.shift_m.astype(np.float32), plane.normal)
        found = first_hits(met, plane, len(ray), rng).range_m
        world = np.einsum("nij,nj->ni", poses[moment, :3, :3], ray)
        with np.errstate(divide="ignore"):
            down, ahead = -1.8 / world[:, 2], (8 - x[moment]) / world[:, 0]
        expected = np.minimum(np.where(down > 0, down, np.inf), np.where(ahead > 0, ahead, np.inf))
        there = expected < 12
        there &= np.abs(azimuth) < np.deg2rad(178)  # what the first and the last rays see has two places
        assert there.sum() > 2000
        off = np.abs(found[there] - expected[there])
        assert np.isfinite(off).mean() > 0.98
        assert np.quantile(off, 0.97) < tolerance_m


def test_the_nearer_of_two_discs_stops_a_ray_and_one_of_a_fence_its_share() -> None:
    wall, near = np.array([[10.0, 0, 0]]), np.array([[4.0, 0, 0]])
    axis = np.tile([-1.0, 0, 0], (2, 1))
    both = disc_surfels(np.vstack([wall, near]), axis, 0.5)
    rays = shots_toward(np.column_stack([np.ones(4000), np.linspace(-0.01, 0.01, 4000), np.zeros(4000)]))
    assert np.allclose(cast(rays, both), 4, atol=1e-2)
    fence = replace(both, share=np.array([1, 0.3], np.float32))
    ended = cast(rays, fence)
    assert np.isclose((ended < 5).mean(), 0.3, atol=0.03)
    assert np.allclose(ended[ended > 5], 10, atol=1e-2)


def test_smallest_axes_are_those_of_an_eigenvalue_solver() -> None:
    a = np.random.default_rng(0).normal(size=(200, 3, 3))
    a = a @ a.transpose(0, 2, 1)
    values, axis = smallest_axis(a)
    expected, vectors = np.linalg.eigh(a)
    np.testing.assert_allclose(values, expected, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", axis, vectors[:, :, 0])), 1, atol=1e-6)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A street with houses and cars, 1.5 s long, its LiDAR of fewer rays."""
    bare = load_scene(SCENES / "bare.toml")
    lidar = bare.lidar[0].model_copy(update={"azimuth_step_deg": 0.8})
    return bare.model_copy(update={"camera": (), "lidar": (lidar,), "duration_s": 1.5})


@pytest.fixture(scope="module")
def recorded(scene: Scene) -> tuple[Log, Scenario]:
    return synthesize(scene, observe=False)


@pytest.fixture(scope="module")
def world(recorded: tuple[Log, Scenario]) -> World:
    log, truth = recorded
    return build_world(log, truth, list(log.lidars), leave_out=lambda _, i: i % 5 == 2)


def points_of(simulation: Simulation, name: str, i: int, log: Log) -> np.ndarray:
    sweep = simulation.sweep(name, i)
    poses, moment, _ = poses_of(log, name, sweep.t_ns)
    return np.einsum("nij,nj->ni", poses[moment, :3, :3], sweep.xyz_m) + poses[moment, :3, 3]


def count_in_box(points: np.ndarray, scenario: Scenario, id: str, t_s: float) -> int:
    agent = scenario[id]
    at = agent.trajectory.at(np.array([t_s]))
    c, s = np.cos(at.yaw_rad[0]), np.sin(at.yaw_rad[0])
    offset = points - [at.x_m[0], at.y_m[0], at.z_m[0]]
    local = np.column_stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]])
    half = np.array(agent.size_m) / 2
    return int(((np.abs(local) < half + 0.2).all(axis=1) & (local[:, 2] > 0.3 - half[2])).sum())


def test_sweeps_that_were_left_out_come_back_as_recorded(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    simulation, (name,) = Simulation(log, world, truth), log.lidars
    for i in (7, 12):
        shots = simulation.shots(name, i)
        sweep, rows = simulation.cast(name, shots, log, 0, np.random.default_rng(0))
        simulated = np.full(len(shots.t_ns), np.nan)
        simulated[rows] = np.linalg.norm(sweep.xyz_m, axis=1)
        came, comes = np.isfinite(shots.range_m), np.isfinite(simulated)
        error = np.abs(simulated - shots.range_m)[came & comes & (shots.range_m < 40)]
        assert np.median(error) < 0.045
        assert np.quantile(error, 0.9) < 0.15
        assert (came == comes).mean() > 0.93


def test_an_agent_leaves_no_copy_and_stands_where_it_is_moved(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    (name,) = log.lidars
    t_s = (log.streams[name].t_ns - truth.t0_ns) / NS_PER_S - 0.05
    there = max(
        truth.others,
        key=lambda a: count_in_box(points_of(Simulation(log, world, truth), name, 12, log), truth, a.id, t_s[12]),
    )
    before = count_in_box(points_of(Simulation(log, world, truth), name, 12, log), truth, there.id, t_s[12])
    assert before > 50
    without = replace(truth, agents=tuple(a for a in truth.agents if a.id != there.id))
    assert count_in_box(points_of(Simulation(log, world, without), name, 12, log), truth, there.id, t_s[12]) <= 2
    w = there.waypoints
    aside = replace(there, waypoints=replace(w, y_m=w.y_m + 3.0))
    edited = replace(truth, agents=tuple(aside if a.id == there.id else a for a in truth.agents))
    points = points_of(Simulation(log, world, edited), name, 12, log)
    assert count_in_box(points, edited, there.id, t_s[12]) > 0.5 * before
    assert count_in_box(points, truth, there.id, t_s[12]) <= 2


def test_agents_have_about_as_many_points_as_recorded(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    (name,) = log.lidars
    counts = np.zeros((2, len(truth.others)))
    for i in (2, 7, 12):
        t_s = (log.streams[name].t_ns[i] - truth.t0_ns) / NS_PER_S - 0.05
        sweep = log.streams[name].read(i)
        poses, moment, _ = poses_of(log, name, sweep.t_ns)
        true = np.einsum("nij,nj->ni", poses[moment, :3, :3], sweep.xyz_m) + poses[moment, :3, 3]
        for row, points in enumerate((true, points_of(Simulation(log, world, truth), name, i, log))):
            counts[row] += [count_in_box(points, truth, agent.id, t_s) for agent in truth.others]
    seen = counts[0] >= 20
    assert seen.sum() >= 3
    assert (np.abs(counts[1] - counts[0])[seen] <= 0.15 * counts[0, seen] + 1).all()  # one point at its outline


def test_the_noise_of_ranges_is_that_of_the_sensor(scene: Scene, recorded: tuple[Log, Scenario]) -> None:
    log, _ = recorded
    (name,) = log.lidars
    found = local_surface(recorded_shots(log, name, log.streams[name].read(12)), find_pattern(log, name)).noise_m
    assert found == pytest.approx(scene.lidar[0].noise_m, rel=0.15)


def test_wheels_that_reach_out_of_a_short_box_are_kept(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    (name,) = log.lidars
    shots, pattern = recorded_shots(log, name, log.streams[name].read(12)), world.models[name].pattern
    poses, moment, _ = poses_of(log, name, shots.t_ns)
    points = np.einsum("nij,nj->ni", poses[moment, :3, :3], shots.direction * shots.range_m[:, None])
    points += poses[moment, :3, 3]
    t_s = (log.streams[name].t_ns[12] - truth.t0_ns) / NS_PER_S - 0.05
    seen = max(truth.others, key=lambda a: count_in_box(points, truth, a.id, t_s))
    length, width, height = seen.size_m
    reach = {}
    for category in ("cyclist", "car"):
        short = replace(seen, category=category, size_m=(length - 0.6, width, height))
        own = {short.id: Seen(SurfelGrid(), Alignment(short), [])}
        only = replace(truth, agents=(short,))
        _add_sweep(log, log, only, name, shots, pattern, 1.0, world.shift_m, SurfelGrid(), own)
        reach[category] = np.abs(own[short.id].surfaces.surfels().center_m[:, 0]).max() - short.size_m[0] / 2
    assert reach["car"] < 0.15 < 0.25 < reach["cyclist"] < 0.35


def test_surfaces_of_an_agent_lie_on_each_other_though_its_trajectory_is_off(recorded: tuple[Log, Scenario]) -> None:
    """Off by 0.2 m and 2 degrees to and fro: sweeps are as recorded, and where it is moved it is in its box."""
    log, truth = recorded
    (name,), car = log.lidars, truth["ahead_gray"]
    off = np.sin(9 * car.waypoints.t_s)
    w = car.waypoints
    shaken = replace(w, x_m=w.x_m + 0.2 * off, y_m=w.y_m - 0.2 * off, yaw_rad=w.yaw_rad + np.deg2rad(2) * off)
    source = replace(truth, agents=tuple(replace(a, waypoints=shaken) if a is car else a for a in truth.agents))
    built = build_world(log, source, [name], leave_out=lambda _, i: i % 5 == 2)
    aside = replace(car, waypoints=replace(w, y_m=w.y_m + 2.0))
    edited = replace(truth, agents=tuple(aside if a is car else a for a in truth.agents))
    t_s = (log.streams[name].t_ns - truth.t0_ns) / NS_PER_S - 0.05

    def on_car(points: np.ndarray, i: int, aside_m: float = 0.0) -> np.ndarray:
        """Return points above its wheels in the frame of the car."""
        at = car.trajectory.at(t_s[i : i + 1])
        c, s = np.cos(at.yaw_rad[0]), np.sin(at.yaw_rad[0])
        v = points - [at.x_m[0], at.y_m[0] + aside_m, at.z_m[0]]
        local = np.column_stack([c * v[:, 0] + s * v[:, 1], c * v[:, 1] - s * v[:, 0], v[:, 2]])
        return local[(np.abs(local) < np.array(car.size_m) / 2 + [0.5, 0.5, -0.2]).all(axis=1)]

    every = []
    for i in range(len(t_s)):
        sweep = log.streams[name].read(i)
        poses, moment, _ = poses_of(log, name, sweep.t_ns)
        every.append(on_car(np.einsum("nij,nj->ni", poses[moment, :3, :3], sweep.xyz_m) + poses[moment, :3, 3], i))
    tree = cKDTree(np.concatenate(every))
    for scenario, aside_m in ((source, 0.0), (edited, 2.0)):
        found = [on_car(points_of(Simulation(log, built, scenario), name, i, log), i, aside_m) for i in (2, 7, 12)]
        assert np.median(tree.query(np.concatenate(found))[0]) < 0.08  # 0.11 where surfaces are not aligned


def test_the_same_seed_gives_the_same_sweep(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    (name,) = log.lidars
    one, two, other = (Simulation(log, world, truth, seed).sweep(name, 9) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.xyz_m, two.xyz_m)
    assert len(one.xyz_m) != len(other.xyz_m) or not np.array_equal(one.xyz_m, other.xyz_m)


def test_rays_that_did_not_return_are_found_between_those_that_did(recorded: tuple[Log, Scenario]) -> None:
    log, _ = recorded
    (name,) = log.lidars
    shots, pattern = recorded_shots(log, name, log.streams[name].read(12)), find_pattern(log, name)
    whole = all_shots(shots, pattern)
    kept = np.random.default_rng(0).random(len(shots.t_ns)) < 0.8
    assert len(all_shots(shots.take(kept), pattern).t_ns) == pytest.approx(len(whole.t_ns), rel=0.02)


def test_a_body_fills_its_box(recorded: tuple[Log, Scenario]) -> None:
    for category, size in (
        ("car", (4.5, 1.8, 1.5)),
        ("truck", (8, 2.4, 3)),
        ("bus", (12, 2.5, 3)),
        ("pedestrian", (0.6, 0.6, 1.7)),
        ("cyclist", (1.8, 0.6, 1.7)),
    ):
        agent = replace(recorded[1].others[0], category=category, size_m=size)
        np.testing.assert_allclose(np.ptp(body_of(agent).center_m, axis=0), size, atol=0.25)


def test_the_ground_goes_on_below_what_stands(recorded: tuple[Log, Scenario]) -> None:
    grid = np.stack(np.meshgrid(np.arange(-6, 6, 0.1), np.arange(-6, 6, 0.1)), -1).reshape(-1, 2)
    grid = grid[(np.abs(grid) > [2.2, 0.9]).any(axis=1)]
    slope = np.column_stack([grid, 0.05 * grid[:, 0] - 0.03 * grid[:, 1]])
    normal = np.array([-0.05, 0.03, 1]) / np.linalg.norm([-0.05, 0.03, 1])
    at = replace(
        recorded[1].others[0].waypoints.take([0]), x_m=np.array([100.0]), y_m=np.array([50.0]), z_m=np.array([7.75])
    )
    car = replace(
        recorded[1].others[0], size_m=(4.4, 1.8, 1.5), static=True, waypoints=replace(at, yaw_rad=np.zeros(1))
    )
    below = ground_below(car, disc_surfels(slope, np.tile(normal, (len(slope), 1)), 0.1), np.array([100.0, 50, 7]))
    assert np.ptp(below.center_m[:, :2], axis=0) == pytest.approx([4.2, 1.6], abs=0.3)
    np.testing.assert_allclose(below.center_m @ normal, 0, atol=1e-5)
    np.testing.assert_allclose(below.normal @ normal, 1, atol=1e-5)


def test_a_simulated_log_opens_with_its_truth(recorded: tuple[Log, Scenario], tmp_path: Path) -> None:
    log, truth = recorded
    short = log.changed(streams={k: replace(s, t_ns=s.t_ns[:4]) for k, s in log.streams.items()})
    film = choose_film_file(tmp_path / "film.webm")
    gone = replace(truth, agents=tuple(a for a in truth.agents if a.id != truth.others[0].id))
    resimulate(
        short, truth, truth, tmp_path / "out", then=lambda made: write_film(replace(made, scenario=gone), truth, film)
    )
    frames = cv2.VideoCapture(str(tmp_path / "film.webm"))
    shown = [image for _ in range(4) for found, image in [frames.read()] if found]
    assert len(shown) == 4
    recorded_rows, simulated_rows, now_rows = np.split(shown[3].astype(float), 3)
    # What is simulated looks as what was recorded, more than what happens without an agent.
    apart = [np.abs(rows - recorded_rows)[20:].mean() for rows in (simulated_rows, now_rows)]
    assert 0 < apart[0] < apart[1]
    back = open_log(tmp_path / "out")
    (name,) = back.lidars
    assert list(back.streams[name].t_ns) == list(short.streams[name].t_ns)
    assert len(back.streams[name].read(3).xyz_m) == pytest.approx(len(log.streams[name].read(3).xyz_m), rel=0.1)
    assert Scenario.load(tmp_path / "out" / "truth.json").digest == truth.digest


def test_what_cannot_be_simulated_is_said_and_nothing_written(recorded: tuple[Log, Scenario], tmp_path: Path) -> None:
    log, truth = recorded
    with pytest.raises(LogError, match="no LiDAR"):
        resimulate(log.changed(lidars={}, streams={}), truth, truth, tmp_path / "out")
    with pytest.raises(ConfigError, match="'tower' is not in the log"):
        simulate(log, truth, truth, sensors=["tower"])
    gone = truth.ego
    assert gone is not None
    late = replace(gone, waypoints=replace(gone.waypoints, t_s=gone.waypoints.t_s + 1000))
    with pytest.raises(ConfigError, match="ego is not there"):
        resimulate(log, truth, replace(truth, agents=(late, *truth.others)), tmp_path / "out")
    assert not any(tmp_path.iterdir())


def test_what_was_not_recorded_is_told(recorded: tuple[Log, Scenario], tmp_path: Path) -> None:
    log, truth = recorded
    short = log.changed(streams={k: replace(s, t_ns=s.t_ns[:3]) for k, s in log.streams.items()})
    w, ego = truth.others[0].waypoints, truth.ego
    assert ego is not None
    far = replace(truth.others[0], id="far", waypoints=replace(w, x_m=w.x_m + 500))
    aside = replace(ego, waypoints=replace(ego.waypoints, y_m=ego.waypoints.y_m + 8))
    source, now = (replace(truth, agents=agents) for agents in ((*truth.agents, far), (aside, *truth.others)))
    source = replace(source, provenance={"log": {"name": "elsewhere", "digest": "0" * 64}, "edits": [{}]})
    notes = resimulate(short, source, now, tmp_path / "out")
    assert notes[0].startswith("no point of")
    assert "far" in notes[0]
    assert "reconstructed from log 'elsewhere', whose data are not those" in notes[1]
    assert "was edited" in notes[2]
    assert "ego is 8.0 m from where anything was recorded" in notes[3]


def test_a_policy_sees_from_where_it_drives(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    (name,) = log.lidars
    ahead: list[float] = []
    first: list[np.ndarray] = []

    def drive(observation: Observation) -> Controls:
        if len(ahead) < 2 and observation.t_s >= len(ahead):
            # The house beside the street: 10 m to the left of the path, wherever along it the ego is.
            points = observation.sweep(name).xyz_m
            first.append(points)
            beside = (np.abs(points[:, 0]) < 5) & (points[:, 1] > 3) & (points[:, 2] > 0)
            ahead.append(float(np.median(points[beside, 1])))
        return Controls(0.0, 0.0)

    simulation = Simulation(log, world, truth)
    replay(truth, ego=with_sensors(drive, simulation), dt_s=0.05)
    assert len(ahead) == 2
    stepped = open_world(truth, dt_s=0.05)
    np.testing.assert_array_equal(seeing(stepped.observe(), simulation).sweep(name).xyz_m, first[0])
    np.testing.assert_allclose(ahead, 10 + 1.8, atol=0.3)
    with pytest.raises(ConfigError, match="no sensors are simulated"):
        replay(truth, ego=lambda observation: observation.sweep(name), dt_s=0.05)  # type: ignore[arg-type,return-value]


@pytest.mark.parametrize("below", [1, 3])
def test_legs_stay_apart_and_what_was_hidden_is_a_body(recorded: tuple[Log, Scenario], below: int) -> None:
    """Two legs of 0.1 m, 0.3 m apart, 10 m ahead: their picture is sampled again by rays between those that saw them.

    Below the horizon lines may be three times as far apart.
    """
    half = np.array([0.3, 0.3, 0.9])
    step = np.deg2rad(0.2)
    lines = np.append(np.arange(-33, 0, below), np.arange(31))

    def fan(shift: float) -> np.ndarray:
        a, e = np.meshgrid((np.arange(-20, 21) + shift) * step, (lines + shift * np.gradient(lines)) * step)
        return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)

    def on_legs(at: np.ndarray) -> np.ndarray:
        """Whether points on the plane of the legs are on them."""
        return (np.abs(np.abs(at[:, 1]) - 0.15) < 0.05) & (np.abs(at[:, 2]) < 0.9)

    ray = fan(0.0)
    at = ray * (10 / ray[:, :1])
    ends = on_legs(at)
    away = np.where(ends, 10 / ray[:, 0], 30).astype(np.float32)
    away[at[:, 2] < -0.5] = 5.0  # a wall before the feet
    ends &= at[:, 2] >= -0.5
    lost = ends & (np.abs(at[:, 2] - 0.3) < 0.06)  # a dark stripe of three rays
    away[lost], ends[lost] = np.nan, False
    seen = sighting(
        0.0, np.array([-10.0, 0, 0]), ray, range_m=away, on=ends, intensity=np.ones(len(ray), np.float32), half_m=half,
        step_rad=step, line_rad=np.append(lines, 31) * step,
    )  # fmt: skip
    assert seen is not None
    w = recorded[1].others[0].waypoints.take([0])
    zero = np.zeros(1)
    still = replace(w, t_s=zero, x_m=zero + 10, y_m=zero, z_m=zero, yaw_rad=zero, speed_mps=zero)
    person = replace(recorded[1].others[0], category="pedestrian", size_m=tuple(2 * half), static=True, waypoints=still)
    now = replace(recorded[1], agents=(person,), t0_ns=0)
    shots = shots_toward(fan(0.37))
    rays = rays_in_map(shots, np.eye(4)[None], np.zeros(len(shots.t_ns), np.intp))
    body = disc_surfels(np.array([[10.0, 0, -0.7], [10, 0, 0.5]]), np.tile([-1.0, 0, 0], (2, 1)), 0.15)
    met = meetings(rays, grid_of(rays), body, body.center_m, body.normal)
    met, discs = with_sightings(
        met, body, first=np.array([0, 0, 2]), ids=[person.id], rays=rays, scenario=now, sightings={person.id: [seen]}
    )
    hits = first_hits(met, discs, len(shots.t_ns), np.random.default_rng(0))
    ended = hits.range_m
    at = shots.direction * (10 / shots.direction[:, :1])
    high = (at[:, 2] > -0.48) & (np.abs(at[:, 2] - 0.3) > 0.1)
    legs = on_legs(at)
    stripe = (np.abs(np.abs(at[:, 1]) - 0.15) < 0.02) & (np.abs(at[:, 2] - 0.3) < 0.07)
    assert (hits.returned[stripe] == 0).sum() >= 3
    assert not (hits.returned[stripe] > 0).any()
    assert (hits.returned[np.isfinite(ended) & high] == 1).all()
    assert (np.isfinite(ended) & high).sum() == pytest.approx((legs & high).sum(), rel=0.1)
    # Not further from a leg than half the gap between rays, 3.5 cm, and not on the disc between the legs.
    wide = np.abs(np.abs(at[:, 1]) - 0.15)
    assert np.all(wide[np.isfinite(ended) & high] < 0.09)
    np.testing.assert_allclose(ended[np.isfinite(ended)], np.linalg.norm(at, axis=1)[np.isfinite(ended)], atol=0.02)
    assert np.isfinite(ended[(np.abs(at[:, 1]) < 0.05) & (np.abs(at[:, 2] + 0.7) < 0.1)]).all()


def test_sightings_that_stay_are_those_that_differ() -> None:
    """A person is seen from one place for long and from all around in a moment; the other one once."""
    side = np.append(np.zeros(192), np.linspace(0, 2 * np.pi, 18, endpoint=False))
    many = [
        Sighting(
            0.1 * k, np.array([10 * np.cos(a), 10 * np.sin(a), 0]), np.zeros((20, 3), np.float32),
            np.ones(20, np.int8), np.ones(20, np.float32), 0.003, np.zeros(10),
        )
        for k, a in enumerate(side)
    ]  # fmt: skip
    of = {"often": list(many), "once": many[:1]}
    size = sum(s.size for some in of.values() for s in some)
    assert thinned(of, size) == 0
    assert thinned(of, size // 2) == len(many) - len(of["often"]) > 0
    assert sum(s.size for some in of.values() for s in some) <= size / 4
    assert of["once"] == many[:1]
    # Each side is still seen, and so is the whole time.
    for a in side:
        assert choose_sighting(of["often"], 0.0, 10 * np.array([np.cos(a), np.sin(a), 0])) is not None
    assert np.diff([s.t_s for s in of["often"]]).max() < 3.0


def test_a_surface_that_is_seen_for_long_takes_no_more_memory() -> None:
    grid, rng, held = SurfelGrid(), np.random.default_rng(0), []
    for _ in range(200):
        points = rng.uniform(-1, 1, (1000, 3)) * [2, 1, 0]
        grid.add(
            points, np.tile(np.float32([0, 0, 1]), (1000, 1)), np.full(1000, 0.1, np.float32), np.ones(1000, np.float32)
        )
        held.append(len(grid._key) + sum(len(key) for key, _ in grid._pending))
    assert max(held) < 30_000  # of 200 times 600
    assert grid.surfels().center_m[:, 2] == pytest.approx(0)
