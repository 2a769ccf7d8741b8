"""Simulated sweeps and pictures: without ghosts, what was left out, edited scenarios, and where none are made."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from log2sim.datatypes import Log, Scenario
from log2sim.errors import ConfigError, LogError
from log2sim.geometry import NS_PER_S
from log2sim.logs.opening import open_log
from log2sim.resim.alignment import Alignment
from log2sim.resim.cameras import Pictures
from log2sim.resim.rays import all_shots, find_pattern, poses_of, recorded_shots
from log2sim.resim.simulate import MASKS, Simulation, resimulate, seeing, simulate, with_sensors
from log2sim.resim.surfels import SurfelGrid, Tile, local_surface
from log2sim.resim.world import World, _add_sweep, build_world
from log2sim.simulation.policy import Controls, Observation
from log2sim.simulation.runner import open_world, replay
from log2sim.synth import Scene, load_scene, synthesize
from log2sim.visualization.plot.encoding import choose_film_file
from log2sim.visualization.sensor_film import write_film

SCENES = Path(__file__).resolve().parents[1] / "samples" / "scenes"
CAMERA = "front"


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A street with houses and cars, 1.5 s long, with a small camera and a LiDAR of fewer rays."""
    bare = load_scene(SCENES / "bare.toml")
    lidar = bare.lidar[0].model_copy(update={"azimuth_step_deg": 0.8})
    camera = next(c for c in bare.camera if c.name == CAMERA).model_copy(update={"size_px": (448, 260)})
    return bare.model_copy(update={"camera": (camera,), "lidar": (lidar,), "duration_s": 1.5})


@pytest.fixture(scope="module")
def recorded(scene: Scene) -> tuple[Log, Scenario]:
    log, truth = synthesize(scene, observe=False)
    for stream in log.streams.values():  # each record is made once
        object.__setattr__(stream, "read", cache(stream.read))
    return log, truth


@pytest.fixture(scope="module")
def world(recorded: tuple[Log, Scenario]) -> World:
    log, truth = recorded
    return build_world(log, truth, list(log.lidars), leave_out=lambda _, i: i % 5 == 2)


def in_map(log: Log, name: str, t_ns: np.ndarray, xyz_m: np.ndarray) -> np.ndarray:
    """Points of a sweep, each by the pose at its time."""
    poses, moment, _ = poses_of(log, name, t_ns)
    return np.einsum("nij,nj->ni", poses[moment, :3, :3], xyz_m) + poses[moment, :3, 3]


def points_of(simulation: Simulation, name: str, i: int, log: Log) -> np.ndarray:
    sweep = simulation.sweep(name, i)
    return in_map(log, name, sweep.t_ns, sweep.xyz_m)


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
    gone = without(truth, there.id)
    assert count_in_box(points_of(Simulation(log, world, gone), name, 12, log), truth, there.id, t_s[12]) <= 2
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
        true = in_map(log, name, sweep.t_ns, sweep.xyz_m)
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
    points = in_map(log, name, shots.t_ns, shots.direction * shots.range_m[:, None])
    t_s = (log.streams[name].t_ns[12] - truth.t0_ns) / NS_PER_S - 0.05
    seen = max(truth.others, key=lambda a: count_in_box(points, truth, a.id, t_s))
    length, width, height = seen.size_m
    reach = {}
    for category in ("cyclist", "car"):
        short = replace(seen, category=category, size_m=(length - 0.6, width, height))
        grids: dict[Tile | str, SurfelGrid] = {}
        alignments, sightings = {short.id: Alignment(short)}, {short.id: []}
        only = replace(truth, agents=(short,))
        _add_sweep(log, log, only, name, shots, pattern, 1.0, world.shift_m, grids, alignments, sightings)
        reach[category] = np.abs(grids[short.id].surfels().center_m[:, 0]).max() - short.size_m[0] / 2
    assert reach["car"] < 0.15 < 0.25 < reach["cyclist"] < 0.35


def test_a_world_of_which_most_waits_in_a_file_is_the_same(
    recorded: tuple[Log, Scenario], monkeypatch: pytest.MonkeyPatch
) -> None:
    log, truth = recorded
    (name,) = log.lidars
    log = log.changed(streams={name: replace(log.streams[name], t_ns=log.streams[name].t_ns[:4])})
    worlds = [build_world(log, truth, [name])]
    for limit in ("world.GRIDS_BYTES", "world.COUNTS_BYTES", "surfels.TILES_BYTES"):
        monkeypatch.setattr(f"log2sim.resim.{limit}", 1)
    worlds += [build_world(log, truth, [name]), pickle.loads(pickle.dumps(worlds[0]))]
    expected, *others = (Simulation(log, w, truth).sweep(name, 1).xyz_m for w in worlds)
    assert len(worlds[1].background) > 20
    for world, sweep in zip(worlds[1:], others):
        assert set(world.background) == set(worlds[0].background)
        np.testing.assert_array_equal(sweep, expected)


def test_surfaces_of_an_agent_lie_on_each_other_though_its_trajectory_is_off(recorded: tuple[Log, Scenario]) -> None:
    """Off by 0.2 m and 2 degrees to and fro: sweeps are as recorded, and where it is moved it is in its box."""
    log, truth = recorded
    (name,), car = log.lidars, truth["ahead_gray"]
    log = log.changed(streams={name: replace(log.streams[name], t_ns=log.streams[name].t_ns[:11])})
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
        every.append(on_car(in_map(log, name, sweep.t_ns, sweep.xyz_m), i))
    tree = cKDTree(np.concatenate(every))
    for scenario, aside_m in ((source, 0.0), (edited, 2.0)):
        found = [on_car(points_of(Simulation(log, built, scenario), name, i, log), i, aside_m) for i in (2, 7)]
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


def test_a_simulated_log_opens_with_its_truth(recorded: tuple[Log, Scenario], tmp_path: Path) -> None:
    log, truth = recorded
    short = log.changed(streams={k: replace(s, t_ns=s.t_ns[:4]) for k, s in log.streams.items()})
    film = choose_film_file(tmp_path / "film.webm")
    gone = without(truth, truth.others[0].id)
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


# --- pictures


def psnr_db(a: np.ndarray, b: np.ndarray, where: np.ndarray | None = None) -> float:
    off = (a.astype(float) - b)[... if where is None else where]
    return float(10 * np.log10(255**2 / max((off**2).mean(), 1e-3)))


def without(scenario: Scenario, id: str) -> Scenario:
    return replace(scenario, agents=tuple(a for a in scenario.agents if a.id != id))


def rendered_without(scene: Scene, id: str, i: int) -> np.ndarray:
    rest = scene.model_copy(update={"agent": tuple(a for a in scene.agent if a.id != id)})
    return synthesize(rest, observe=False)[0].streams[CAMERA].read(i)


def test_what_happened_is_seen_again_as_it_was_recorded(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    t_ns = int(log.streams[CAMERA].t_ns[8])
    image, unknown = Pictures(log, world, truth).make(log, truth, world.agents, CAMERA, t_ns)
    same = (image == log.streams[CAMERA].read(8)).all(axis=2)
    assert same.mean() > 0.995
    assert unknown.mean() < 0.002


def test_pictures_that_were_left_out_come_back_better_than_the_nearest(
    recorded: tuple[Log, Scenario], world: World
) -> None:
    log, truth = recorded
    pictures = Pictures(log, world, truth, leave_out=lambda _, i: i % 4 == 2)
    for i in (6,):
        image, _ = Simulation(log, world, truth, 0, pictures).picture(CAMERA, int(log.streams[CAMERA].t_ns[i]))
        true, nearest = (log.streams[CAMERA].read(k) for k in (i, i - 1))
        assert psnr_db(image, true) > psnr_db(nearest, true) + 4


def test_who_is_removed_is_gone_and_the_street_behind_is_there(
    scene: Scene, recorded: tuple[Log, Scenario], world: World
) -> None:
    log, truth = recorded
    i, id = 9, "ahead_gray"
    there, gone = log.streams[CAMERA].read(i), rendered_without(scene, id, i)
    shown = np.abs(there.astype(int) - gone).max(axis=2) > 20
    simulation = Simulation(log, world, without(truth, id), 0, Pictures(log, world, truth))
    image, unknown = simulation.picture(CAMERA, int(log.streams[CAMERA].t_ns[i]))
    changed = cv2.dilate(shown.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert psnr_db(image, gone, changed) > psnr_db(there, gone, changed) + 2.5
    assert psnr_db(image, gone, changed & ~unknown) > psnr_db(there, gone, changed & ~unknown) + 3
    assert unknown[~changed].mean() < 0.02


def test_an_agent_without_pictures_is_drawn_and_told(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    (source,) = (a for a in truth.others if a.id == "ahead_gray")
    w = source.waypoints
    new = replace(
        source,
        id="new",
        color={"rgb": [20, 200, 40], "name": "green"},
        waypoints=replace(w, x_m=w.x_m - 3, y_m=w.y_m + 3),
    )
    added = replace(truth, agents=(*truth.agents, new))
    t_ns = int(log.streams[CAMERA].t_ns[8])
    pictures = Pictures(log, world, truth)
    before = Simulation(log, world, truth, 0, pictures).picture(CAMERA, t_ns)[0].astype(int)
    image, unknown = Simulation(log, world, added, 0, pictures).picture(CAMERA, t_ns)
    green = (image[..., 1] > image[..., 2] + 25) & (image[..., 1] > image[..., 0] + 25)
    assert (green & unknown).sum() > 50
    far = cv2.dilate(unknown.astype(np.uint8), np.ones((61, 61), np.uint8)) == 0
    assert (np.abs(image - before).max(axis=2)[far] <= 2).mean() > 0.98


def test_pictures_are_refused_far_off_the_path_and_nothing_is_written(
    recorded: tuple[Log, Scenario], tmp_path: Path
) -> None:
    log, truth = recorded
    ego = truth.ego
    assert ego is not None
    aside = replace(ego, waypoints=replace(ego.waypoints, y_m=ego.waypoints.y_m + 5))
    with pytest.raises(ConfigError, match="off the path"):
        resimulate(log, truth, replace(truth, agents=(aside, *truth.others)), tmp_path / "out", cameras=True)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_how_much_of_pictures_is_made_up_is_told(recorded: tuple[Log, Scenario], tmp_path: Path) -> None:
    """From 2 m aside and turned by 60 degrees, which no camera looked to."""
    log, truth = recorded
    short = log.changed(streams={k: replace(s, t_ns=s.t_ns[:2]) for k, s in log.streams.items()})
    ego = truth.ego
    assert ego is not None
    w = ego.waypoints
    turned = replace(ego, waypoints=replace(w, y_m=w.y_m + 2, yaw_rad=w.yaw_rad + np.deg2rad(60)))
    now = replace(truth, agents=(turned, *truth.others))
    (note,) = (n for n in resimulate(short, truth, now, tmp_path / "out", sensors=[CAMERA]) if "recorded picture" in n)
    masks = [
        cv2.imread(str(m), cv2.IMREAD_GRAYSCALE) > 0 for m in sorted((tmp_path / "out" / MASKS / CAMERA).iterdir())
    ]
    assert f"shows {np.mean(masks):.0%} of what {CAMERA} sees" in note
    assert np.mean(masks) > 0.4


@pytest.mark.slow
def test_a_log_with_pictures_has_a_mask_for_each(recorded: tuple[Log, Scenario], tmp_path: Path) -> None:
    log, truth = recorded
    short = log.changed(streams={k: replace(s, t_ns=s.t_ns[:4]) for k, s in log.streams.items()})
    resimulate(short, truth, truth, tmp_path / "out", sensors=[CAMERA])
    back = open_log(tmp_path / "out")
    assert list(back.cameras) == [CAMERA]
    assert not back.lidars
    assert psnr_db(back.streams[CAMERA].read(2), log.streams[CAMERA].read(2)) > 30
    masks = sorted((tmp_path / "out" / MASKS / CAMERA).iterdir())
    assert [m.name for m in masks] == [f"{i:06d}.png" for i in range(4)]
    assert cv2.imread(str(masks[0]), cv2.IMREAD_GRAYSCALE).shape == (260, 448)


def test_a_policy_looks_through_a_camera(recorded: tuple[Log, Scenario], world: World) -> None:
    log, truth = recorded
    images: list[np.ndarray] = []

    def drive(observation: Observation) -> Controls:
        if not images and observation.t_s >= 0.6:
            images.append(observation.image(CAMERA))
            with pytest.raises(ConfigError, match="sweep 'front': no such sensor"):
                observation.sweep(CAMERA)
        return Controls(0.0, 0.0)

    replay(truth, ego=with_sensors(drive, Simulation(log, world, truth, 0, Pictures(log, world, truth))), dt_s=0.1)
    nearest = int(np.abs(log.streams[CAMERA].t_ns - truth.t0_ns - 600_000_000).argmin())
    assert psnr_db(images[0], log.streams[CAMERA].read(nearest)) > 18
