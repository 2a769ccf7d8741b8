"""nuScenes: scanning of tables, missing files, points and labels of a world with exact truth, the recorded scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from conftest import SHARED
from hypothesis import given, settings
from hypothesis import strategies as st
from log_encoders.nuscenes import TURN_NS, encode, hdl32_world
from log_encoders.world import labels_at
from plain_settings import AGENTS_ALONE

from log2sim import Config, reconstruct
from log2sim.datatypes import Labels, Log
from log2sim.errors import LogError
from log2sim.geometry import NS_PER_S, apply, inverse
from log2sim.logs.nuscenes import scene as tables
from log2sim.logs.nuscenes.scene import FIRING_NS
from log2sim.logs.opening import open_log
from log2sim.logs.stamps import compute_scan_offset_ns
from log2sim.perception.lidar.cloud import deskew, transform_rigidly

KEY_EVERY = 5


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The world with every fifth sweep a key frame; tests only read it."""
    return encode(hdl32_world(), tmp_path_factory.mktemp("nuscenes"), key_every=KEY_EVERY)


@pytest.fixture
def spoilable(root: Path, tmp_path: Path) -> Path:
    """The tables to be changed, beside the images and sweeps of `root`."""
    folder = tmp_path / "data"
    (folder / "v1.0-mini").mkdir(parents=True)
    for file in (root / "v1.0-mini").iterdir():
        (folder / "v1.0-mini" / file.name).write_bytes(file.read_bytes())
    for file in root.glob("s*/*/*"):
        target = folder / file.relative_to(root)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.hardlink_to(file)
    return folder


def edit(root: Path, table: str, change: Callable[[list[dict[str, Any]]], object]) -> None:
    """Change the rows of a table."""
    path = root / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    change(rows)
    path.write_text(json.dumps(rows))


words = st.text(st.sampled_from('ab{}[]",:\\/ \n\tü\u2028"token"'), max_size=8)
values = st.one_of(words, st.integers(), st.booleans(), st.none(), st.lists(st.floats(allow_nan=False), max_size=3))
records = st.fixed_dictionaries(
    {"token": words}, optional={"sample_token": words, "x": values, "{": values, "b\\": words}
)


@given(st.lists(records, max_size=12), st.sets(words, max_size=4), st.data())
@settings(max_examples=150, deadline=None)
def test_scanning_finds_what_parsing_the_whole_table_finds(
    tmp_path_factory: pytest.TempPathFactory, rows: list[dict[str, Any]], wanted: set[str], data: st.DataObject
) -> None:
    form = data.draw(
        st.sampled_from([{}, {"indent": 0}, {"indent": 3}, {"separators": (",", ":")}, {"separators": (" , ", " : ")}])
    )
    text = json.dumps(rows, ensure_ascii=data.draw(st.booleans()), **form)
    path = tmp_path_factory.mktemp("scan") / "table.json"
    path.write_text(
        data.draw(st.sampled_from(["", "\n", " "])) + text + data.draw(st.sampled_from(["", "\n\n"])), "utf-8"
    )
    longest = max((len(json.dumps(row, **form).encode()) for row in rows), default=0)
    with patch.object(tables, "MAX_RECORD_BYTES", longest + 64):
        for key in ("token", "sample_token"):
            found = list(tables.scan_records(path, key, wanted, chunk_bytes=data.draw(st.integers(1, 400))))
            assert found == [row for row in rows if row.get(key) in wanted]


def test_points_are_where_and_when_the_world_has_them(root: Path) -> None:
    """The file order gives the times; rays without a return are not points."""
    log, world = open_log(root), hdl32_world()
    for i in (0, 4, 8):
        ours, truth = log.streams["top"].read(i), world.streams["top"].read(i)
        assert ours.compensated_ns == ours.stamp_ns == truth.stamp_ns
        in_map, expected = transform_rigidly(log, "top", ours), deskew(world, "top", truth, truth.t_ns)
        assert ours.t_ns is not None
        assert len(in_map) == len(expected)
        assert np.abs(ours.t_ns - np.sort(truth.t_ns)).max() < 1000
        # The order within a firing is that of the rings, for both.
        order = np.argsort(truth.t_ns, kind="stable")
        assert np.abs(in_map - expected[order]).max() < 5e-3


def test_labels_between_key_frames_are_those_of_the_world(root: Path) -> None:
    """Objects move straight on, so that interpolation is exact at every turn of the LiDAR."""
    log, world = open_log(root), hdl32_world()
    labels = log.labels
    assert labels is not None
    key_ns = world.streams["top"].t_ns[::KEY_EVERY]
    np.testing.assert_array_equal(labels.labeled_ns, key_ns - TURN_NS // 2)
    assert len(labels.t_ns) > 3 * len(np.unique(labels.track_id)) * len(key_ns)
    for token in np.unique(labels.track_id):
        rows = labels.track_id == token
        t_ns = labels.t_ns[rows]
        assert (np.diff(t_ns) >= 10_000_000).all()
        assert (np.diff(t_ns) <= 1.3 * TURN_NS).all()
        track = track_like(world.labels, labels, rows)
        center, size, yaw = labels_at(world.labels, t_ns, track)
        np.testing.assert_allclose(labels.center_m[rows], center, atol=1e-3)
        np.testing.assert_allclose(labels.size_m[rows], np.tile(size, (rows.sum(), 1)))
        np.testing.assert_allclose(labels.yaw_rad[rows], yaw, atol=1e-6)
        map_T_lidar = log.map_T_sensor("top", t_ns)[0]
        offset = compute_scan_offset_ns(apply(inverse(map_T_lidar), labels.center_m[rows]), TURN_NS)
        assert np.abs((t_ns - offset)[:, None] - key_ns).min(axis=0).max() < 1_000_000


def track_like(truth: Labels, labels: Labels, rows: np.ndarray) -> str:
    """The track of the world that has the size of a track of the log."""
    sizes = {str(track): truth.size_m[truth.track_id == track][0] for track in np.unique(truth.track_id)}
    return min(sizes, key=lambda track: np.abs(sizes[track] - labels.size_m[rows][0]).sum())


def test_categories_follow_kinds_and_attributes(root: Path, spoilable: Path) -> None:
    def kinds(rows: list[dict[str, Any]]) -> None:
        names = {row["name"]: row for row in rows}
        names["vehicle.car"]["name"], names["human.pedestrian.adult"]["name"] = "vehicle.bicycle", "animal"

    def riders(rows: list[dict[str, Any]]) -> None:
        token = json.loads((spoilable / "v1.0-mini" / "attribute.json").read_text())[0]["token"]
        for row in rows:
            ridden = abs(row["size"][1] - 4.4) < 0.1
            row.update(attribute_tokens=[token] if ridden else [], visibility_token="" if ridden else "1")

    edit(spoilable, "category", kinds)
    edit(spoilable, "sample_annotation", riders)
    log = open_log(spoilable)
    labels = log.labels
    assert labels is not None
    moving = np.abs(labels.size_m[:, 0] - 4.4) < 0.1
    assert set(labels.category[moving]) == {"cyclist"}
    assert set(labels.category[~moving]) == {"bicycle"}
    assert set(labels.kind) == {"vehicle.bicycle"}
    np.testing.assert_array_equal(labels.visible, moving)
    assert "animal (2)" in " ".join(log.notes)


def test_files_of_a_partial_download_are_left_out_and_counted(root: Path, spoilable: Path) -> None:
    whole = open_log(root)
    for file in [*spoilable.glob("sweeps/top/*"), *spoilable.glob("s*/front/*")]:
        file.unlink()
    log = open_log(spoilable)
    np.testing.assert_array_equal(log.streams["top"].t_ns, whole.streams["top"].t_ns[::KEY_EVERY])
    assert set(log.streams) == {"top"}
    assert log.reference_camera is None
    sweeps, frames = (len(whole.streams[name].t_ns) for name in ("top", "front"))
    assert f"top: {sweeps - len(log.streams['top'].t_ns)} of {sweeps} records are missing" in log.notes
    assert f"front: {frames} of {frames} records are missing; the sensor is left out" in log.notes
    assert any(note.endswith("RADAR_FRONT") for note in log.notes)
    np.testing.assert_array_equal(log.ego.t_ns, whole.ego.t_ns)
    for file in spoilable.glob("samples/top/*"):
        file.unlink()
    with pytest.raises(LogError, match="none of the 20 images and sweeps of scene 'world' is there"):
        open_log(spoilable)


def remove(root: Path, table: str) -> None:
    (root / "v1.0-mini" / f"{table}.json").unlink()


def cut(root: Path, table: str) -> None:
    path = root / "v1.0-mini" / f"{table}.json"
    path.write_text(path.read_text()[:-200])


def spoil_first(key: str, value: Any) -> Callable[[Path, str], None]:
    def change(root: Path, table: str) -> None:
        edit(root, table, lambda rows: rows[0].update({key: value}))

    return change


def break_first(root: Path, table: str) -> None:
    path = root / "v1.0-mini" / f"{table}.json"
    path.write_text(path.read_text().replace('"timestamp": ', '"timestamp": oops', 1))


@pytest.mark.parametrize(
    ("table", "spoil", "expected"),
    [
        ("ego_pose", remove, "ego_pose.json: cannot be read: No such file"),
        ("sensor", remove, "sensor.json: no such file"),
        ("sample_annotation", remove, "sample_annotation.json: cannot be read: No such file"),
        ("sample_data", cut, "sample_data.json: not valid JSON: it does not end with ']'"),
        ("scene", cut, "scene.json: not valid JSON at line"),
        ("sample_data", break_first, "sample_data.json, byte"),
        ("calibrated_sensor", lambda r, t: edit(r, t, list.pop), "no record with token '"),
        ("category", lambda r, t: edit(r, t, list.clear), "category.json: no record with token '"),
        ("sample", lambda r, t: edit(r, t, list.clear), "sample.json: no sample of scene 'world'"),
        ("sample_annotation", spoil_first("instance_token", "x" * 2000), "expected a text in one line of at most 1024"),
        (
            "ego_pose",
            spoil_first("translation", [1e300, 0, 0]),
            "'translation' is [1e+300, 0, 0], expected 3 finite numbers",
        ),
        ("sample_data", spoil_first("timestamp", 1.5), "'timestamp' is 1.5, expected whole microseconds"),
        ("sample_data", spoil_first("filename", "../../etc/passwd"), "leaves the log folder"),
        ("sample_data", spoil_first("filename", 7), "'filename' is 7, expected a text"),
        ("sample_data", spoil_first("ego_pose_token", "\ud800"), "expected a text in one line"),
        ("sensor", spoil_first("channel", "../x"), "channel '../x', expected letters, digits, _ and -"),
        ("ego_pose", spoil_first("rotation", [1, 1, 0, 0]), "expected a unit quaternion"),
        ("ego_pose", spoil_first("translation", [0, 0]), "'translation' is [0, 0], expected 3 finite numbers"),
        (
            "calibrated_sensor",
            lambda r, t: edit(r, t, lambda rows: rows[1].update(camera_intrinsic=[])),
            "expected 3 x 3",
        ),
        ("sample_annotation", spoil_first("instance_token", "nobody"), "no record with token 'nobody'"),
    ],
)
def test_errors_name_the_table_and_what_was_expected(
    spoilable: Path, table: str, spoil: Callable[[Path, str], None], expected: str
) -> None:
    spoil(spoilable, table)
    with pytest.raises(LogError) as caught:
        _ = open_log(spoilable).labels
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_key_frames_alone_give_a_scenario(tmp_path: Path) -> None:
    """Ticks of a download without sweeps are its key frames, here five in a second."""
    root = encode(hdl32_world(), tmp_path, key_every=2)
    for file in root.glob("sweeps/*/*"):
        file.unlink()
    log, world = open_log(root), hdl32_world()
    assert {len(stream.t_ns) for stream in log.streams.values()} == {5}
    scenario = reconstruct(log, Config.load(detect={"name": "lidar:labels"}, **AGENTS_ALONE)).scenario
    cars = [agent for agent in scenario.others if agent.category == "car"]
    assert len(cars) == 2
    moving = max(cars, key=lambda agent: float(agent.waypoints.speed_mps.max()))
    assert moving.waypoints.speed_mps == pytest.approx(4.0, abs=0.3)
    t_ns = scenario.t0_ns + np.round(moving.waypoints.t_s * NS_PER_S).astype(np.int64)
    center, _, _ = labels_at(world.labels, t_ns, "car")
    np.testing.assert_allclose(np.stack([moving.waypoints.x_m, moving.waypoints.y_m], axis=1), center[:, :2], atol=0.2)


@pytest.fixture(scope="module")
def scene() -> Log:
    folder = SHARED / "data" / "nuscenes_mini"
    if not folder.is_dir():
        pytest.skip("the recorded scene is not beside this checkout (../shared/data)")
    return open_log(folder)


@pytest.mark.real
def test_the_recorded_scene_has_what_its_tables_say(scene: Log) -> None:
    assert scene.format == "nuscenes"
    assert scene.reference_camera == "CAM_FRONT"
    assert {name: len(stream.t_ns) for name, stream in scene.streams.items() if name != "LIDAR_TOP"} == {
        f"CAM_{name}": 2 for name in ("BACK", "BACK_LEFT", "BACK_RIGHT", "FRONT", "FRONT_LEFT", "FRONT_RIGHT")
    }
    assert len(scene.ego.t_ns) == 281
    assert len(scene.labels.labeled_ns) == 40
    assert len(np.unique(scene.labels.track_id)) > 100
    assert "LIDAR_TOP: 40 of 41 records are missing" in scene.notes
    assert any("last 0.5 s of the 19.4 s" in note for note in scene.notes)


@pytest.mark.real
@pytest.mark.parametrize(("folder", "speed_mps"), [("nuscenes_mini/sweeps/LIDAR_TOP", 8.56), ("nuscenes_frame", None)])
def test_recorded_points_are_compensated_to_the_end_of_their_turn(folder: str, speed_mps: float | None) -> None:
    """Rays without a return lie where the sensor was: the first ones a turn's way behind, the last at the origin."""
    file = next((SHARED / "data" / folder).glob("*.pcd.bin"), None)
    if file is None:
        pytest.skip("the recorded sweep is not beside this checkout (../shared/data)")
    firings = np.fromfile(file, "<f4").reshape(-1, 32, 5)[..., :3].astype(float)
    chosen = np.linspace(0, len(firings) - 1, 5).astype(int)
    several = [np.unique(firings[k], axis=0, return_counts=True) for k in chosen]
    path = np.array([rows[np.argmax(count)] for rows, count in several])
    assert [max(count) > 1 for _, count in several] == [True] * 5
    assert np.linalg.norm(path[-1]) < 1e-4
    np.testing.assert_allclose(path, np.linspace(1, 0, 5)[:, None] * path[0], atol=0.01)
    assert np.abs(path[:, [0, 2]]).max() < 0.03
    assert path[0, 1] < -0.4
    if speed_mps is not None:  # of the CAN bus
        assert -path[0, 1] == pytest.approx(speed_mps * len(firings) * FIRING_NS / NS_PER_S, rel=0.02)
