"""Pictures and data of random traffic: what the camera shows, the LiDAR measures and the labels say is one world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from log2sim.geometry import apply, inverse
from log2sim.synth.backdrop import draw_terrain
from log2sim.synth.light import FAR_M, NOON, RenderCamera
from log2sim.synth.polytopes import Material, meshes_of
from log2sim.synth.raster import nearest_of
from log2sim.synth.render import Body, SceneInstant, samples_of, segment
from log2sim.synth.returns import ReturnModel, Weather
from log2sim.synth.traffic import TrafficScene, rig_of
from log2sim.synth.traffic_data import TrafficSettings, draw_traffic, write_traffic
from log2sim.synth.traffic_picture import TrafficPainter

CLEAR = ReturnModel(noise_m=0.0, dropout=0.0, mixed=0.0, weather=Weather())
SEE_THROUGH = (Material.GLASS, Material.LEAVES, Material.MESH)


def drawn(seed: int, mount: str = "vehicle") -> TrafficScene:
    settings = TrafficSettings(mount, seed=seed, sensor="vlp16", light="noon", weather="clear")  # type: ignore[arg-type]
    return draw_traffic(settings, 0)[0]


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
