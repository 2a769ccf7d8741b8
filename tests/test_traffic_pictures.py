"""Pictures and data of random traffic: what the camera shows, the LiDAR measures and the labels say is one world."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import run
from scipy.spatial import ConvexHull

from log2sim.errors import ConfigError
from log2sim.geometry import apply, box_corners, inverse
from log2sim.logs.opening import open_log
from log2sim.synth.backdrop import draw_terrain, sampled_ground
from log2sim.synth.ground import Ground, GroundPlan
from log2sim.synth.light import FAR_M, NOON, RenderCamera
from log2sim.synth.polytopes import Material, meshes_of
from log2sim.synth.raster import nearest_of
from log2sim.synth.render import Body, SceneInstant, samples_of, segment
from log2sim.synth.returns import ReturnModel, Weather
from log2sim.synth.traffic import TrafficObject, TrafficScene, rig_of
from log2sim.synth.traffic_data import TrafficSettings, draw_traffic, frame_of, run_of, write_traffic
from log2sim.synth.traffic_picture import TrafficPainter

CLEAR = ReturnModel(noise_m=0.0, dropout=0.0, mixed=0.0, weather=Weather())
SEE_THROUGH = (Material.GLASS, Material.LEAVES, Material.MESH)


def drawn(seed: int, mount: str = "vehicle") -> TrafficScene:
    settings = TrafficSettings(mount, seed=seed, sensor="vlp16", light="noon", weather="clear")  # type: ignore[arg-type]
    return draw_traffic(settings, 0)[0]


def test_meshes_of_polytopes_have_the_volume_of_their_hulls_and_look_outward() -> None:
    parts = [part for item in drawn(1).objects for part in item.parts][:250]
    meshes = meshes_of([(part,) for part in parts], [0.0] * len(parts))
    checked = 0
    for part, mesh in zip(parts, meshes):
        corners = part.vertices()
        if len(corners) < 4:
            continue
        a, b, c = mesh.vertices_m[mesh.faces].transpose(1, 0, 2)
        volume = np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6
        assert volume == pytest.approx(ConvexHull(corners).volume, rel=2e-3, abs=1e-6)
        assert np.all(np.einsum("fi,fi->f", np.cross(b - a, c - a), mesh.normals[mesh.faces[:, 0]]) > 0)
        checked += 1
    assert checked > 200


@pytest.mark.parametrize(("seed", "mount"), [(3, "vehicle"), (4, "roadside")])
def test_points_of_the_cloud_lie_on_what_the_picture_shows(seed: int, mount: str) -> None:
    """The z-buffer of the picture at the pixels of LiDAR points, seen from the LiDAR's own place, has their depths."""
    scene = drawn(seed, mount)
    still = tuple(replace(o, speed_mps=0.0) for o in scene.objects)
    solid = tuple(o for o in still if o.kind != "own car" and all(p.material not in SEE_THROUGH for p in o.parts))
    sensor = replace(scene.sensor, velocity_mps=np.zeros(2))
    scene = replace(scene, objects=solid, sensor=sensor, returns=CLEAR)
    rig = rig_of(scene)
    map_T_cam = rig.map_T_cam.copy()
    map_T_cam[:3, 3] = scene.sensor.position_m
    view = RenderCamera.of(rig.camera, map_T_cam)
    instant, _ = TrafficPainter(scene, 0).instant(scene, NOON, rig.camera, map_T_cam)
    color = np.zeros((view.height_px, view.width_px, 3), np.float32)
    depth = np.full(color.shape[:2], FAR_M, np.float32)
    draw_terrain(view, instant.backdrop.ground, scene.surface, NOON, color, depth)
    for body in instant.bodies:
        fragments = nearest_of(samples_of(view, body))
        pixel = fragments.pixel(view.width_px)
        depth.ravel()[pixel] = np.minimum(depth.ravel()[pixel], fragments.depth_m)
    p = apply(inverse(map_T_cam), scene.cast(np.random.default_rng(0)).xyz_m.astype(float))
    p = p[(p[:, 2] > 2.0) & (p[:, 2] < 40.0)]
    u, v = np.rint(p[:, :2] / p[:, 2:] * np.diag(rig.camera.K)[:2] + rig.camera.K[:2, 2]).astype(int).T
    inside = (u >= 0) & (u < view.width_px) & (v >= 0) & (v < view.height_px)
    error = np.abs(depth[v[inside], u[inside]] - p[inside, 2])
    assert inside.sum() > 300
    # A point near an outline rounds to a pixel beside it; a grazing ray meets the ground half a pixel off.
    assert np.mean(error < 0.02 * p[inside, 2] + 0.1) > 0.97
    assert np.median(error) < 0.05


class Frame:
    """A minimal reader of KITTI's object layout, written from its development kit's description alone."""

    def __init__(self, folder: Path, index: int) -> None:
        name = f"{index:06d}"
        self.image = cv2.imread(str(folder / "image_2" / f"{name}.png"))
        self.points = np.fromfile(folder / "velodyne" / f"{name}.bin", dtype=np.float32).reshape(-1, 4)
        lines = (folder / "calib" / f"{name}.txt").read_text().splitlines()
        values = {k: np.array(v.split(), float) for k, v in (line.split(":") for line in lines if line)}
        self.P2, self.R0 = values["P2"].reshape(3, 4), values["R0_rect"].reshape(3, 3)
        self.Tr = values["Tr_velo_to_cam"].reshape(3, 4)
        rows = [line.split() for line in (folder / "label_2" / f"{name}.txt").read_text().splitlines()]
        assert all(len(row) == 15 for row in rows)
        self.labels = [(row[0], np.array(row[1:], float)) for row in rows]

    def rectified(self) -> np.ndarray:
        return (self.points[:, :3] @ self.Tr[:, :3].T + self.Tr[:, 3]) @ self.R0.T

    def projected(self, points: np.ndarray) -> np.ndarray:
        homogeneous = np.column_stack([points, np.ones(len(points))]) @ self.P2.T
        return homogeneous[:, :2] / homogeneous[:, 2:]

    @staticmethod
    def corners(values: np.ndarray) -> np.ndarray:
        h, w, length, x, y, z, ry = values[7:14]
        box = np.array([[sx * length / 2, sy, sz * w / 2] for sx in (1, -1) for sy in (0, -h) for sz in (1, -1)])
        turn = np.array([[np.cos(ry), 0, np.sin(ry)], [0, 1, 0], [-np.sin(ry), 0, np.cos(ry)]])
        return box @ turn.T + [x, y, z]


@pytest.fixture(scope="module", params=["vehicle", "roadside"])
def kitti(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / request.param
    # Seeds with road users near and far.
    settings = TrafficSettings(request.param, 3, 5, light="overcast", weather="clear")
    write_traffic(settings, out)
    return out


def test_boxes_in_space_project_into_boxes_in_the_picture(kitti: Path) -> None:
    checked = 0
    for index in range(3):
        frame = Frame(kitti / "training", index)
        h, w = frame.image.shape[:2]
        for kind, values in frame.labels:
            if kind == "DontCare":
                assert np.all(values[7:] < 0)
                continue
            corners = frame.corners(values)
            assert 0 <= values[0] <= 1
            assert values[1] in (0, 1, 2)
            view = np.arctan2(values[10], values[12])
            assert (values[13] - view - values[2] + np.pi) % (2 * np.pi) - np.pi == pytest.approx(0, abs=0.02)
            if values[0] > 0 or (frame.P2 @ np.append(corners[0], 1))[2] < 1:
                continue
            uv = frame.projected(corners)
            left, top, right, bottom = values[3:7]
            assert -1 <= left < right <= w
            assert -1 <= top < bottom <= h
            # The silhouette lies within the projected box and fills most of it.
            assert np.all(uv.min(0) < [left + 2, top + 2])
            assert np.all(uv.max(0) > [right - 2, bottom - 2])
            filled = (right - left) * (bottom - top) / np.prod(uv.max(0) - uv.min(0))
            assert filled > 0.3, (index, kind, filled)
            checked += 1
    assert checked >= 4


def test_points_of_the_cloud_are_in_the_boxes_of_visible_cars(kitti: Path) -> None:
    inside_total = 0
    for index in range(3):
        frame = Frame(kitti / "training", index)
        assert frame.points[:, 3].min() >= 0
        assert frame.points[:, 3].max() <= 1
        points = frame.rectified()
        for kind, values in frame.labels:
            if kind != "Car" or values[1] > 0 or values[12] > 25:
                continue
            h, w, length, x, y, z, ry = values[7:14]
            local = points - [x, y, z]
            along = local[:, 0] * np.cos(ry) - local[:, 2] * np.sin(ry)
            across = local[:, 0] * np.sin(ry) + local[:, 2] * np.cos(ry)
            box = (np.abs(along) < length / 2) & (np.abs(across) < w / 2) & (local[:, 1] < -0.15) & (local[:, 1] > -h)
            inside_total += int(box.sum())
            ahead = points[box & (points[:, 2] > 1.0)]
            uv = frame.projected(ahead)
            h_px, w_px = frame.image.shape[:2]
            uv = uv[np.all((uv >= 0) & (uv < [w_px, h_px]), axis=1)]
            near = np.all((uv > values[3:5] - 4) & (uv < values[5:7] + 4), axis=1)
            assert len(near) == 0 or near.mean() > 0.9
    assert inside_total > 100


@pytest.mark.slow
def test_the_same_seed_writes_the_same_bytes_and_conditions_stand_beside_the_data(tmp_path: Path) -> None:
    settings = TrafficSettings("vehicle", 2, 9, sensor="vlp16", light="dusk")
    for name in ("a", "b"):
        write_traffic(settings, tmp_path / name)
    first, second = (
        {p.relative_to(tmp_path / name): p.read_bytes() for p in sorted((tmp_path / name).rglob("*")) if p.is_file()}
        for name in ("a", "b")
    )
    assert first == second
    manifest = json.loads((tmp_path / "a" / "traffic.json").read_text())
    assert [s["environment"]["light"] for s in manifest["scenes"]] == ["dusk", "dusk"]
    assert manifest["scenes"][0]["lidar"] == "vlp16"
    lists = [(tmp_path / "a" / "ImageSets" / f"{n}.txt").read_text().split() for n in ("train", "val", "trainval")]
    assert sorted(lists[0] + lists[1]) == lists[2] == ["000000", "000001"]
    # Scene 1 of two is scene 1 of many, and fixing the light leaves the traffic as it was.
    alone, _ = draw_traffic(replace(settings, scenes=7, light=None), 1)
    again, _ = draw_traffic(settings, 1)
    assert [o.category for o in alone.objects] == [o.category for o in again.objects]


def test_data_is_not_replaced_unasked_and_an_unknown_sensor_is_named(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(ConfigError, match="no data of random traffic"):
        write_traffic(TrafficSettings("vehicle", 1), tmp_path / "mine", overwrite=True)
    with pytest.raises(ConfigError, match="no LiDAR 'hdl65e'"):
        write_traffic(TrafficSettings("vehicle", 1, sensor="hdl65e"), tmp_path / "new")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine"]


@pytest.mark.slow
@pytest.mark.parametrize("mount", ["vehicle", "roadside"])
def test_a_log_of_traffic_is_read_back_with_boxes_on_its_points(mount: str, tmp_path: Path) -> None:
    settings = TrafficSettings(
        mount, 1, 11, sensor="hdl32e", layout="log2sim", duration_s=0.3, light="noon", weather="clear"
    )  # type: ignore[arg-type]
    write_traffic(settings, tmp_path / "out")
    log = open_log(tmp_path / "out" / "scene_000000")
    assert {s.mount for s in (*log.cameras.values(), *log.lidars.values())} == {"ego" if mount == "vehicle" else "map"}
    assert (log.ego is None) == (mount == "roadside")
    labels = log.labels
    assert labels is not None
    stamp = log.streams["camera"].t_ns[2]
    rows = np.flatnonzero(labels.t_ns == stamp)
    sweep = log.streams["lidar"].read(2)
    assert abs(int(sweep.stamp_ns) - 50_000_000 - int(stamp)) < 10_000_000
    pose, valid = log.map_T_sensor("lidar", [sweep.stamp_ns])
    assert valid.all()
    xyz = sweep.xyz_m.astype(float) if sweep.frame == "map" else apply(pose[0], sweep.xyz_m)
    hits = 0
    for k in rows:
        local = xyz - labels.center_m[k]
        c, s = np.cos(labels.yaw_rad[k]), np.sin(labels.yaw_rad[k])
        flat = local[:, :2] @ np.array([[c, -s], [s, c]])
        half = labels.size_m[k] / 2
        hits += int(
            (np.all(np.abs(flat) < half[:2], axis=1) & (local[:, 2] > -half[2] + 0.2) & (local[:, 2] < half[2])).sum()
        )
    assert hits > 100
    assert len(box_corners(labels.center_m[rows], labels.size_m[rows], labels.yaw_rad[rows])) == len(rows)


def test_who_drives_up_to_a_standing_car_stops_behind_it() -> None:
    scene = drawn(2, "roadside")

    def user(x: float, speed: float) -> TrafficObject:
        return TrafficObject("car", np.array([x, 0.0, 0.0]), 0.0, (4.5, 1.8, 1.5), (), speed)

    scene = replace(
        scene, objects=(user(0.0, 12.0), user(30.0, 0.0), replace(user(0.0, 9.0), position_m=np.array([0, 20.0, 0])))
    )
    run = run_of(scene, 10.0)
    at_end = run.at(10.0).objects
    assert 30.0 - 4.5 - 3.0 < at_end[0].position_m[0] < 30.0 - 4.5
    assert at_end[0].speed_mps < 0.5
    assert at_end[2].position_m[0] == pytest.approx(90.0, abs=0.5)  # nobody in its way
    assert np.all(np.diff(run.distance_m, axis=0) >= 0)


def test_a_body_behind_another_is_hidden_and_a_net_is_seen_through() -> None:
    scene = drawn(1)
    rig = rig_of(scene)
    car = next(o for o in scene.objects if o.category == "car")
    forward = scene.sensor.rotation[:, 0]
    mesh = meshes_of([car.parts], [car.size_m[2] / 2])[0]

    def body(away_m: float, passes: float) -> Body:
        pose = np.eye(4)
        pose[:3, 3] = rig.map_T_cam[:3, 3] + away_m * forward
        share = np.full(len(car.parts), passes, np.float32)
        return Body(mesh, pose, car.size_m, lambda *_: None, passes=share)  # type: ignore[arg-type,return-value]

    backdrop = TrafficPainter(scene, 0).backdrop
    alone, hidden = (
        segment(rig.camera, rig.map_T_cam, SceneInstant(backdrop, [body(12.0, passes), body(24.0, 0.0)]))
        for passes in (0.65, 0.0)
    )
    assert alone[1] is not None
    assert alone[1].visible_px == pytest.approx(0.65 * alone[1].silhouette_px, rel=0.1)
    assert hidden[1] is None or hidden[1].visible_px < 0.1 * hidden[1].silhouette_px


def test_a_frame_of_a_scene_without_road_users_has_no_labels() -> None:
    scene = drawn(6)
    empty = replace(scene, objects=tuple(o for o in scene.objects if not o.category))
    _, environment = draw_traffic(TrafficSettings("vehicle", seed=6), 0)
    frame = frame_of(empty, environment, 0)
    assert frame.labels == ""
    assert len(frame.points) > 1000


def test_our_own_reader_of_the_layout_finds_the_boxes_on_the_points(kitti: Path) -> None:
    log = open_log(kitti)
    labels = log.labels
    assert log.format == "kitti-object"
    assert labels is not None
    assert log.ego is not None
    stated = [k for i in range(3) for k, _ in Frame(kitti / "training", i).labels if k != "DontCare"]
    assert len(labels.t_ns) == len(stated)
    inside = 0
    for i, stamp in enumerate(log.streams["velodyne"].t_ns):
        sweep = log.streams["velodyne"].read(i)
        assert sweep.frame == "map"
        for k in np.flatnonzero(labels.t_ns == stamp):
            local = sweep.xyz_m - labels.center_m[k]
            c, s = np.cos(labels.yaw_rad[k]), np.sin(labels.yaw_rad[k])
            flat, half = local[:, :2] @ np.array([[c, -s], [s, c]]), labels.size_m[k] / 2
            above = (local[:, 2] > -half[2] + 0.2) & (local[:, 2] < half[2])
            inside += int((np.all(np.abs(flat) < half[:2], axis=1) & above).sum())
    assert inside > 100


def test_a_row_of_a_picture_may_see_near_and_far_ground() -> None:
    """On a slope the rays of one row meet the ground from a meter to two kilometers away, more than fits at one resolution."""
    ground = Ground(GroundPlan(), 0)
    x = np.linspace(1, 2000, 400, dtype=np.float32)[None].repeat(3, axis=0)
    colors = sampled_ground(ground, 0, x, np.zeros_like(x), np.ones(x.shape, bool))
    assert colors.shape == (3, 400, 3)
    assert np.ptp(colors.reshape(-1, 3).astype(int), axis=0).max() < 60  # a meadow all over


def test_without_pictures_sweeps_and_labels_are_those_with_pictures(tmp_path: Path) -> None:
    settings = TrafficSettings("roadside", 1, seed=2, layout="log2sim", duration_s=0.5)
    write_traffic(settings, tmp_path / "with")
    write_traffic(replace(settings, pictures=False), tmp_path / "without")
    both = [open_log(tmp_path / name / "scene_000000") for name in ("with", "without")]
    assert [len(log.cameras) for log in both] == [1, 0]
    for a, b in zip(*(log.streams["lidar"].t_ns for log in both), strict=True):
        assert a == b
    np.testing.assert_array_equal(*(log.streams["lidar"].read(1).xyz_m for log in both))
    np.testing.assert_array_equal(*(log.labels.center_m for log in both))
    assert sorted(p.name for p in (tmp_path / "without").rglob("*.jpg")) == []
    with pytest.raises(ConfigError, match="log2sim"):
        write_traffic(replace(settings, pictures=False, layout="kitti"), tmp_path / "kitti")


def test_a_scene_is_written_without_its_cameras(tmp_path: Path) -> None:
    scene = Path(__file__).parents[1] / "samples" / "scenes" / "roadside.toml"
    short = tmp_path / "short.toml"
    short.write_text(scene.read_text().replace("duration_s = 8.0", "duration_s = 0.5"))
    assert run("synth", short, "--no-pictures", "-o", tmp_path / "log", "--quiet").code == 0
    log = open_log(tmp_path / "log")
    assert (list(log.cameras), list(log.lidars)) == ([], ["roadside_lidar"])
    assert log.labels is not None
    assert run("synth", "--traffic", "vehicle", "--no-pictures", "--layout", "kitti", "-o", tmp_path / "k").code == 2
