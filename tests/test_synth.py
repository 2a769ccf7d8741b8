"""Synthetic logs: records and truth agree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from worlds import CAR, PARKED, WALKER, tiny_log, tiny_scene, tiny_table

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.evaluation.road import seen_ground
from log2sim.geometry import NS_PER_S, apply, box_corners, inverse
from log2sim.logs.opening import open_log
from log2sim.synth import shapes
from log2sim.synth.actors import MovingScene, TimedPath
from log2sim.synth.paint import paint
from log2sim.synth.raycast import EGO, GROUND, cast_sweep
from log2sim.synth.scene import AgentSpec, load_scene, scene_from_table
from log2sim.synth.shapes import Mesh
from log2sim.synth.synthesis import synthesize, write_synthetic


def test_points_of_a_turning_lidar_on_a_moving_ego_lie_on_the_agents_at_their_own_time() -> None:
    scene = tiny_scene(gnss={"position_sigma_m": 0.0})
    log, truth = tiny_log(noise_m=0.0)
    moving, spec = MovingScene.of(scene), scene.lidar[0]
    result = cast_sweep(spec, moving, int(log.streams["top"].t_ns[5]), np.random.default_rng(0))
    t_ns = result.sweep.t_ns
    assert t_ns is not None
    poses = moving.map_T_mount("ego", t_ns) @ log.lidars["top"].mount_T_lidar
    points = np.einsum("nij,nj->ni", poses[:, :3, :3], result.sweep.xyz_m.astype(float)) + poses[:, :3, 3]
    assert np.abs(points[result.hit == GROUND, 2]).max() < 0.05
    for index, actor in enumerate(moving.actors):
        rows = np.flatnonzero(result.hit == index)
        assert len(rows) > 20, actor.spec.id
        state = actor.at((t_ns[rows] - scene.start_ns) / NS_PER_S)
        local = apply(inverse(state.map_T_agent()), points[rows])
        # Noise, 2 cm, only moves points along their rays.
        assert np.all(np.abs(local) <= np.array(actor.spec.box_m) / 2 + 0.1)
    assert truth.t0_ns == scene.start_ns


def test_truth_agrees_with_the_waypoints_and_stands_on_the_ground() -> None:
    _, truth = tiny_log(observe=False)
    car = next(a for a in truth.agents if a.id == "car")
    t = car.waypoints.t_s
    # The waypoints guide the rear axle, the truth is the center of the box.
    assert np.allclose(car.waypoints.x_m, 16.0 + 4.0 * t + 0.3 * 4.4, atol=1e-6)
    assert np.allclose(car.waypoints.z_m, 0.75)
    parked = next(a for a in truth.agents if a.id == "parked")
    assert parked.static
    assert np.all(parked.waypoints.speed_mps == 0)
    assert np.allclose(parked.waypoints.yaw_rad, np.deg2rad(10))
    assert truth.ego is not None
    assert np.allclose(truth.ego.waypoints.x_m, 3.0 * t + 1.4, atol=1e-6)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_other_noise() -> None:
    first, truth = tiny_log(seed=3, observe=False)
    again, _ = tiny_log(seed=3, observe=False)
    other, other_truth = tiny_log(seed=4, observe=False)
    again.streams["top"].read(5)  # the order of reading must not matter
    for name in ("top", "front"):
        a, b, c = (log.streams[name].read(2) for log in (first, again, other))
        if name == "top":
            a, b, c = a.xyz_m, b.xyz_m, c.xyz_m
        assert np.array_equal(a, b)
        assert a.shape != c.shape or not np.array_equal(a, c)
    for agent, same in zip(truth.agents, other_truth.agents):
        assert np.array_equal(agent.waypoints.x_m, same.waypoints.x_m)


def test_a_written_log_holds_its_truth_and_nothing_is_replaced_unasked(tmp_path: Path) -> None:
    scene = tiny_scene([CAR, WALKER], duration_s=0.3)
    out = tmp_path / "log"
    write_synthetic(scene, out, seed=1)
    first = {p.relative_to(out): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}
    truth = Scenario.load(out / "truth.json")
    assert {a.id for a in truth.agents} == {"ego", "car", "walker"}
    with pytest.raises(ConfigError, match="exists already"):
        write_synthetic(scene, out, seed=1)
    write_synthetic(scene, out, seed=1, overwrite=True)
    assert first == {p.relative_to(out): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}
    stranger = tmp_path / "mine"
    stranger.mkdir()
    (stranger / "thesis.txt").write_text("years of work", encoding="utf-8")
    with pytest.raises(ConfigError, match="no log folder"):
        write_synthetic(scene, stranger, overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log", "mine"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agnet": []}, r"unknown key 'agnet'; did you mean 'agent'"),
        ({"agent": [{**CAR, "colour": [1, 2, 3]}]}, r"'agent\[0\]\.colour'; did you mean 'agent\[0\]\.color'"),
        ({"agent": [{**CAR, "category": "tram"}]}, r"agent\[0\]\.category.*one of car, truck"),
        ({"agent": [{**CAR, "size_m": [4.0, 2.0]}]}, r"size_m' has 2 values, expected 3"),
        ({"agent": [{**CAR, "pose": [0.0, 0.0, 0.0]}]}, r"either 'waypoints' or 'pose'"),
        ({"agent": [CAR, CAR]}, r"'car' occurs twice"),
        ({"agent": [{**CAR, "id": "ego"}]}, r"belongs to the recording vehicle"),
        ({"agent": [{**CAR, "id": "../x"}]}, r"letters, digits"),
        ({"duration_s": float("nan")}, r"'duration_s' is nan"),
        ({"start_ns": 1.5}, r"'start_ns' is 1\.5, expected a whole number from 0"),
        ({"gnss": {"rate_hz": 0}}, r"'gnss\.rate_hz' is 0, expected a number from 0\.5 to 1000"),
        ({"gnss": 3}, r"'gnss' is 3, expected a table"),
        ({"ego": {}}, r"'ego.waypoints' is missing"),
    ],
)
def test_a_wrong_entry_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        scene_from_table(tiny_table(**changes))


TURN = [[0.0, 0.0, 5.0], [30.0, 0.0, 4.0], [30.0, 30.0, 6.0]]


def test_speed_at_each_waypoint_is_the_one_asked_for() -> None:
    trajectory = TimedPath(TURN, rounding_m=26.0, where="agent 'a'")
    t = np.linspace(0, 20, 20001)
    way = trajectory.at(t).distance_m
    at_turn = np.argmin(np.abs(way - trajectory.path.at_waypoint_m[1]))
    assert trajectory.at(t[at_turn]).speed_mps[0] == pytest.approx(4.0, abs=0.01)


def test_a_stop_keeps_place_and_heading_and_then_goes_on() -> None:
    trajectory = TimedPath(
        [[0.0, 0.0, 4.0], [8.0, 0.0, 0.0], [16.0, 3.0, 4.0]], rounding_m=4.0, wait_s=[(1, 2.0)], where="a"
    )
    standing = trajectory.at(np.linspace(4.0, 5.9, 11))  # nearly 8 m at a mean of 2 m/s take nearly 4 s
    assert np.all(standing.speed_mps == 0)
    assert np.ptp(standing.yaw_rad) == 0
    assert np.ptp(standing.xy_m, axis=0).max() == 0
    assert trajectory.at(7.0).speed_mps[0] > 0.1
    assert trajectory.at(3.0).speed_mps[0] > 0.1


@pytest.mark.parametrize(
    ("waypoints", "message"),
    [
        ([[0, 0, 5], [20, 0, 5], [20, 20, 5]], "bends"),
        ([[0, 0, 10], [5, 0, 0]], "m/s2"),
        ([[0, 0, 0], [5, 0, 0]], "forever"),
        ([[0, 0, 1], [0, 0, 1]], "same point"),
        ([[0, 0, 1], [9, 0, -1]], "negative"),
        ([[0, 0, 1]], "two or more"),
    ],
)
def test_impossible_waypoints_name_the_agent_and_the_reason(waypoints: list[list[float]], message: str) -> None:
    with pytest.raises(ConfigError, match=f"agent 'a'.*{message}"):
        TimedPath(waypoints, rounding_m=5.0, where="agent 'a'")


SAMPLE_MOUNTS = Path(__file__).resolve().parents[1] / "samples" / "scenes" / "roadside.toml"


POLE: dict[str, Any] = {
    "name": "pole",
    "mount": "map",
    "position_m": [10.0, -6.0, 3.6],
    "yaw_deg": 90.0,
    "pitch_deg": -31.25,
    "channels": 16,
    "elevation_deg": [-15.0, 15.0],
    "range_m": 150.0,
    "noise_m": 0.0,
    "dropout": 0.0,
    "resolution_m": 0.0,
}


def in_map(scene: Any, index: int = 0) -> tuple[np.ndarray, np.ndarray]:
    moving, spec = MovingScene.of(scene), scene.lidar[index]
    result = cast_sweep(spec, moving, scene.start_ns + 500_000_000, np.random.default_rng(0))
    log, _ = synthesize(scene, observe=False)
    poses, valid = log.map_T_sensor(spec.name, result.sweep.t_ns)
    assert valid.all()
    xyz = result.sweep.xyz_m.astype(float)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], xyz) + poses[:, :3, 3], result.hit


def test_a_roadside_sensor_sees_the_ego_and_a_sensor_on_the_ego_does_not() -> None:
    table = {"ego": {"waypoints": [[4.0, 0.0, 3.0], [24.0, 0.0, 3.0]], "poses": "poses"}}
    log, _ = tiny_log([PARKED], **table, observe=False)
    scene = tiny_scene(
        [PARKED], **table, lidar=[*[s.model_dump(exclude_defaults=True) for s in tiny_scene().lidar], POLE]
    )
    assert log.ego is not None
    points, hit = in_map(scene, 1)
    on_ego = points[hit == EGO]
    assert len(on_ego) > 20
    ego = MovingScene.of(scene).ego
    assert ego is not None
    local = apply(inverse(ego.at(0.45).map_T_agent()[0]), on_ego)
    assert np.all(np.abs(local) <= np.array(ego.spec.box_m) / 2 + 0.3)  # it drives on during the sweep
    assert np.all(in_map(scene, 0)[1] != EGO)


def test_pictures_of_a_roadside_camera_show_labels_where_the_boxes_project() -> None:
    scene = load_scene(SAMPLE_MOUNTS)
    short = scene.model_copy(update={"duration_s": 0.3, "lidar": ()})
    log, truth = synthesize(short)
    labels, camera = log.image_labels["roadside_camera"], log.cameras["roadside_camera"]
    assert log.ego is None
    assert truth.ego is None
    assert camera.mount == "map"
    assert len(labels.t_ns) >= 4
    pose, valid = log.map_T_sensor("roadside_camera", labels.t_ns)
    assert valid.all()
    hits = 0
    for t_ns, box in zip(labels.t_ns, labels.box_px):
        for agent in truth.agents:
            state = agent.at((t_ns - truth.t0_ns) / 1e9)
            center = [[state.x_m[0], state.y_m[0], state.z_m[0]]]
            p = apply(inverse(pose[0]), box_corners(center, agent.size_m, state.yaw_rad)[0])
            if p[:, 2].min() < 0.5:
                continue
            uv = p[:, :2] / p[:, 2:] * camera.K[0, 0] + camera.K[:2, 2]
            hits += bool(np.all(box[:2] >= uv.min(0) - 1.5) and np.all(box[2:] <= uv.max(0) + 1.5))
    assert hits >= len(labels.t_ns)


def test_a_roadside_log_is_written_and_read_back_with_its_mounts(tmp_path: Path) -> None:
    table = {
        "name": "pole",
        "duration_s": 0.3,
        "lidar": [{**POLE, "azimuth_step_deg": 1.0}],
        "agent": [{**PARKED, "pose": [10.0, 2.0, 0.0]}],
    }
    write_synthetic(scene_from_table(table), tmp_path / "log")
    log = open_log(tmp_path / "log")
    assert log.ego is None
    assert log.lidars["pole"].mount == "map"
    pose = log.lidars["pole"].mount_T_lidar
    assert np.allclose(pose[:3, 3] - pose[:3, 3].round(6), 0, atol=1e-6)
    assert pose[2, 0] == pytest.approx(np.sin(np.deg2rad(-31.25)), abs=1e-9)
    truth = Scenario.load(tmp_path / "log" / "truth.json")
    assert [a.id for a in truth.agents] == ["parked"]
    assert log.labels is not None
    assert set(log.labels.t_ns) == set(log.streams["pole"].t_ns)


def seen(agents: list[dict[str, Any]] | None = None, **changes: Any) -> Any:
    still = {"waypoints": [[0.0, 0.0, 0.0], [20.0, 0.0, 3.0]], "wait_s": [[0, 60.0]]}
    _, truth = tiny_log(agents or [], ego=still, duration_s=0.6, **changes)
    return seen_ground(truth, np.zeros(3))


def test_a_camera_shows_what_is_in_view_within_forty_meters() -> None:
    area = seen(lidar=[])
    # The camera at x = 1.7 looks east, 70 degrees wide: at 20 m to 14 m aside.
    for x, y, expected in (
        (20.5, 0.5, True),
        (20.5, 10.5, True),
        (20.5, 17.5, False),
        (-5.5, 0.5, False),
        (48.5, 0.5, False),
    ):
        assert bool(shapely.contains_xy(area, x, y)) == expected, (x, y)
    half_angle = np.deg2rad(35)
    reach = 40.0**2 * half_angle - 1.7**2  # of the sector, but what lies too low in front of the car
    assert 0.75 * reach < area.area < 1.05 * reach


def test_what_stands_there_hides_the_ground_behind_it() -> None:
    wall = {"center": [12.0, -8.0], "size_m": [1.0, 14.0, 6.0]}
    van = {"id": "van", "category": "car", "size_m": [5.0, 2.0, 2.4], "pose": [12.0, 4.0, 0.0]}
    free, hidden = seen(lidar=[]), seen([van], lidar=[], building=[wall])
    for x, y in ((25.5, -8.5), (18.5, 5.5)):
        assert shapely.contains_xy(free, x, y)
        assert not shapely.contains_xy(hidden, x, y)
    assert shapely.contains_xy(hidden, 9.5, -2.5)
    assert free.buffer(1e-9).contains(hidden)


SIZES = {"car": (4.4, 1.8, 1.5), "truck": (7.2, 2.4, 3.0), "bus": (11.0, 2.5, 3.1), "cyclist": (1.76, 0.6, 1.76)}


def shape(category: str) -> Mesh:
    make = {
        "car": lambda size: shapes.car(size, "sedan"),
        "truck": shapes.truck,
        "bus": shapes.bus,
        "cyclist": lambda size: shapes.cyclist(size, 5),
    }
    return make[category](SIZES[category])


@pytest.mark.parametrize("category", SIZES)
def test_the_shape_touches_its_box_on_all_sides(category: str) -> None:
    vertices = shape(category).vertices_m
    assert np.allclose(vertices.max(0), np.array(SIZES[category]) / 2, atol=1e-9)
    assert np.allclose(vertices.min(0), -np.array(SIZES[category]) / 2, atol=1e-9)


def test_a_walker_touches_its_box_over_a_stride_and_always_the_ground() -> None:
    size = (0.72, 0.58, 1.7)
    poses = [shapes.pedestrian(size, k, False).vertices_m for k in range(shapes.PHASES)]
    assert np.allclose(np.max([p.max(0) for p in poses], axis=0), np.array(size) / 2, atol=1e-9)
    assert np.allclose([p[:, 2].min() for p in poses], -size[2] / 2, atol=1e-9)


@pytest.mark.parametrize("category", SIZES)
def test_every_part_has_a_color(category: str) -> None:
    mesh = shape(category)
    look = AgentSpec.model_construct(category=category, size_m=SIZES[category], color=(200, 30, 30), shape="sedan")
    rng = np.random.default_rng(0)
    face = rng.integers(len(mesh.faces), size=20000)
    weight = rng.dirichlet([1, 1, 1], size=len(face))[:, :, None]
    points, normals = ((x[mesh.faces[face]] * weight).sum(1) for x in (mesh.vertices_m, mesh.normals))
    colors = paint(look, mesh.part[face], points, normals)
    assert colors.albedo.shape == (len(face), 3)
    assert np.all((colors.albedo >= 0) & (colors.albedo <= 1.3))
    assert len(np.unique(colors.albedo.round(2), axis=0)) > 3
