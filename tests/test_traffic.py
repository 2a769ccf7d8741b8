"""Random traffic and its fast LiDAR: against the mesh caster, closed forms and invariances."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import tiny_log, tiny_scene

from log2sim import open_log
from log2sim.errors import ConfigError
from log2sim.geometry import apply, inverse, rotation_from_rpy
from log2sim.perception.lidar.projection import project_boxes_in_view, view_of
from log2sim.synth import returns
from log2sim.synth.actors import MovingScene
from log2sim.synth.backdrop import draw_terrain
from log2sim.synth.light import FAR_M, NOON, RenderCamera
from log2sim.synth.polytope_caster import SensorState, Solid, cast_polytopes
from log2sim.synth.polytopes import Material, box, column, meshes_of
from log2sim.synth.raster import nearest_of
from log2sim.synth.raycast import BUILDING, cast_sweep
from log2sim.synth.render import DEPTH_M, LENS_SPACING_M, WIDTH_M, Body, SceneInstant, samples_of, segment, signals_of
from log2sim.synth.returns import LidarModel, ReturnModel, lidar_model, reflected
from log2sim.synth.scene import Environment
from log2sim.synth.terrain import Surface
from log2sim.synth.traffic import TrafficScene, draw_scene, rig_of
from log2sim.synth.traffic_data import TrafficSettings, draw_traffic, write_traffic
from log2sim.synth.traffic_picture import TrafficPainter
from log2sim.synth.traffic_shapes import KINDS, building

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
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(returns, "MIN_SIGNAL", 0.0)  # of what is far and dark some rays do not come back
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
        clouds.append(draw_scene("roadside", rng).cast(rng).xyz_m)
    assert np.array_equal(clouds[0], clouds[1])
    assert clouds[0].shape != clouds[2].shape or not np.array_equal(clouds[0], clouds[2])


def test_fog_extinguishes_as_koschmieder_says() -> None:
    fog = Environment(weather="fog", visibility_m=100.0)
    assert np.exp(-fog.extinction_per_m * 100) == pytest.approx(0.02, rel=1e-3)
    one = np.ones(1, np.float32)
    ratio = reflected(50 * one, one, one, fog) / reflected(50 * one, one, one, Environment())
    assert ratio[0] == pytest.approx(np.exp(-2 * fog.extinction_per_m * 50), rel=1e-4)


LIGHT: dict[str, Any] = {
    "id": "a",
    "position": [14.0, 0.0, 2.4],
    "yaw_deg": 180.0,
    "program": [["red", 0.3], ["red_yellow", 0.2], ["green", 0.3], ["yellow", 0.2]],
}


def test_a_program_runs_again_and_again_from_its_begin() -> None:
    scene = tiny_scene([], duration_s=2.4, traffic_light=[{**LIGHT, "start_s": -0.1}])
    (signal,) = signals_of(scene)
    assert signal.t_s == pytest.approx([0.0, 0.2, 0.4, 0.7, 0.9, 1.2, 1.4, 1.7, 1.9, 2.2])
    assert list(signal.state[:5]) == ["red", "red_yellow", "green", "yellow", "red"]
    assert list(signal.at([0.0, 0.25, 0.5, 2.39])) == ["red", "red_yellow", "green", "red_yellow"]
    constant = signals_of(tiny_scene([], traffic_light=[{**LIGHT, "program": [["green", 0.1], ["green", 0.2]]}]))[0]
    assert list(constant.state) == ["green"]
    assert constant.heading_rad == pytest.approx(-np.pi)


@pytest.mark.parametrize("light", ["noon", "night"])
def test_the_lit_lamp_is_the_one_of_the_state_and_has_its_color(light: str) -> None:
    brightest = {}
    for state in ("red", "yellow", "green", "off"):
        spec = {**LIGHT, "program": [[state, 5.0]]}
        log, truth = tiny_log([], observe=False, traffic_light=[spec], environment={"light": light})
        assert truth.signals[0].state[0] == state
        image = log.streams["front"].read(0).astype(float)
        camera = log.cameras["front"]
        pose = log.map_T_sensor("front", log.streams["front"].t_ns[:1])[0][0]
        lenses = np.array([[14.0 - DEPTH_M / 2, 0.0, 2.4 + k * LENS_SPACING_M] for k in (1, 0, -1)])
        p = apply(inverse(pose), lenses)
        uv = np.rint(p[:, :2] / p[:, 2:] @ camera.K[:2, :2] + camera.K[:2, 2]).astype(int)
        shown = np.array([image[v - 1 : v + 2, u - 1 : u + 2].mean((0, 1)) for u, v in uv])
        brightest[state] = int(shown.max(1).argmax())
        blue, green, red = shown[brightest[state]]
        if state == "red":
            assert red > 1.5 * green
        if state == "green":
            assert green > 1.3 * red
        if state == "yellow":
            assert red > 1.5 * blue
            assert green > 1.2 * blue
        if state == "off":
            assert shown.max() < 120
    assert (brightest["red"], brightest["yellow"], brightest["green"]) == (0, 1, 2)


def test_beams_meet_the_housing_and_the_pole_and_no_other_return_moves() -> None:
    scene = tiny_scene([], traffic_light=[{**LIGHT, "position": [10.0, 1.0, 1.6]}])
    plain = tiny_scene([])
    stamp = scene.start_ns + 500_000_000
    sweeps = [cast_sweep(s.lidar[0], MovingScene.of(s), stamp, np.random.default_rng(0)) for s in (scene, plain)]
    hit = sweeps[0].hit == BUILDING
    assert hit.sum() > 5
    own = sweeps[0].sweep.xyz_m[hit]
    assert np.ptp(own[:, 1]) < WIDTH_M + 0.1
    assert np.ptp(own[:, 0]) < DEPTH_M + 0.4  # of the pole behind it, and noise
    theirs = {tuple(p) for p in sweeps[1].sweep.xyz_m.tolist()}
    assert all(tuple(p) in theirs for p in sweeps[0].sweep.xyz_m[~hit].tolist())


CLEAR = ReturnModel(noise_m=0.0, dropout=0.0, mixed=0.0, weather=Environment())
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


@pytest.mark.matrix
@pytest.mark.parametrize("mount", ["vehicle", "roadside"])
def test_boxes_in_space_project_into_boxes_in_the_picture(
    tmp_path: Path, mount: Literal["vehicle", "roadside"]
) -> None:
    write_traffic(TrafficSettings(mount, 3, 5, light="overcast", weather="clear"), tmp_path)
    log = open_log(tmp_path)
    labels, seen, fills = log.labels, log.image_labels["image_02"], []
    size_px = np.array([log.cameras["image_02"].width_px, log.cameras["image_02"].height_px] * 2)
    for t_ns in np.unique(seen.t_ns):
        rows = labels.t_ns == t_ns
        view = view_of(log, "image_02", int(t_ns))
        around = project_boxes_in_view(view, labels.center_m[rows], labels.size_m[rows], labels.yaw_rad[rows])
        assert around.valid.all()
        silhouette = seen.box_px[seen.t_ns == t_ns]
        # The silhouette of a vehicle lies within the projected box but for rounding and mirrors close by; what people push or pull is in theirs.
        vehicle = np.isin(labels.category[rows], ("car", "truck", "bus"))
        assert (silhouette >= -1).all()
        assert (silhouette <= size_px).all()
        outside = 2 + 0.01 * (around.box_px[vehicle, 2:] - around.box_px[vehicle, :2])
        assert (silhouette[vehicle, :2] > around.box_px[vehicle, :2] - outside).all()
        assert (silhouette[vehicle, 2:] < around.box_px[vehicle, 2:] + outside).all()
        area = [(box[:, 2:] - box[:, :2]).prod(axis=1) for box in (silhouette, around.box_px)]
        fills += (area[0] / area[1])[vehicle].tolist()
    assert len(fills) >= 4
    assert np.median(fills) > 0.5


def test_scenes_are_the_same_by_any_number_of_processes(tmp_path: Path) -> None:
    settings = TrafficSettings("roadside", 3, 5, layout="log2sim", duration_s=0.5, pictures=False)
    for jobs in (1, 2):
        write_traffic(settings, tmp_path / str(jobs), jobs=jobs)
    one, two = (
        {p.relative_to(f): p.read_bytes() for p in f.rglob("*") if p.is_file()} for f in sorted(tmp_path.iterdir())
    )
    assert one == two
    assert len(json.loads((tmp_path / "1" / "traffic.json").read_text())["scenes"]) == 3


def test_rays_meet_what_is_in_the_recess_of_an_entrance() -> None:
    """Beside the entrance the front is whole; in it rays go on to what fills it and to the wall behind, no farther."""
    places, depths = [], []
    for seed in range(12):
        house = Solid(
            building(8.0, [0.0], np.random.default_rng(seed)),
            np.array([0.0, 10.0, 0.0]),
            0.0,
            np.zeros(2),
            glass_passes=1.0,
        )
        cloud = cast_polytopes(FINE, sensor(), [house], FLAT, np.random.default_rng(0), EXACT)
        x, y, z = cloud.xyz_m[cloud.hit == 0].T
        places.append(np.abs(x[(z > 0.8) & (z < 1.8)]))
        depths.append(y[(z > 0.8) & (z < 1.8)] - 10.0)
    place, depth = np.concatenate(places), np.concatenate(depths)
    assert depth[place > 2.0].max() < 0.1
    assert 0.1 < np.median(depth[place < 0.4]) < 2.5
    assert depth.max() < 2.6


def test_distances_err_where_an_outline_cuts_beams_and_hardly_on_a_wall() -> None:
    """By 0.1 m on a post, as in KITTI's sweeps, by the noise and the lines on a wall; never beyond what is behind."""
    post = solid([column(0.05, (0, 1.2), Material.METAL)], (12.0, 0.0), 0.0)
    wall = solid([box((0, -8, 0), (0.2, 8, 4), Material.WALL)], (12.5, 0.0), 0.0)
    errs = ReturnModel(noise_m=0.02, dropout=0.0, mixed=0.0, line_m=0.03, walk_m=0.02, edge_m=0.1)
    exact, found = (
        cast_polytopes(lidar_model("hdl64e"), sensor(1.7), [post, wall], FLAT, np.random.default_rng(0), returns)
        for returns in (EXACT, errs)
    )
    assert (found.hit == exact.hit).all()
    error = np.linalg.norm(found.xyz_m - [0, 0, 1.7], axis=1) - np.linalg.norm(exact.xyz_m - [0, 0, 1.7], axis=1)
    on_post, inside = found.hit == 0, (found.hit == 1) & (np.abs(np.abs(exact.xyz_m[:, 1]) - 3) < 2)
    assert on_post.sum() > 30
    assert 0.03 < error[inside].std() < 0.05
    assert 0.06 < error[on_post].std() < 0.15
    assert error[on_post].mean() > 0.02
    assert error[on_post].max() < 0.5 + 4 * 0.036 + 0.05


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


def test_road_users_of_every_kind_stand_on_the_ground_in_their_boxes() -> None:
    """Wheels and feet touch the ground, a box is as high as its user, who is in its middle; what people hold may be beside it."""
    rng = np.random.default_rng(8)
    for category, kinds in KINDS.items():
        for kind, (_, draw) in kinds.items():
            for _ in range(4):
                (length, _, height), parts = draw(rng)
                low, high = np.min([p.low for p in parts], 0), np.max([p.high for p in parts], 0)
                assert -0.1 < low[2] < 0.16, kind
                assert kind == "umbrella" or abs(high[2] - height) < 0.35, kind
                if category not in ("pedestrian", "seated", "trailer") and kind != "child trailer":
                    assert max(abs(low[0] + length / 2), abs(high[0] - length / 2)) < 0.7, kind


def test_scenes_to_train_on_lack_the_kinds_that_are_left_out() -> None:
    """So that what is reported on them was never seen."""
    left_out = frozenset({"walking", "upright", "stall", "tree", "excavator"})
    for seed in range(6):
        kinds = {o.kind for o in draw_scene("vehicle", np.random.default_rng(seed), without=left_out).objects}
        assert not kinds & left_out
    assert {o.kind for s in range(6) for o in draw_scene("vehicle", np.random.default_rng(s)).objects} >= {
        "walking",
        "upright",
        "tree",
    }
