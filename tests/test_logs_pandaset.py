"""PandaSet reader: labels, map frame, and geometry on the recorded sequence."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_encoders.pandaset import encode
from log_encoders.world import world_log

from log2sim.errors import LogError, RecordError
from log2sim.geometry import apply, inverse, points_in_box, project, rotation_from_rpy, wrap_angle
from log2sim.logs.opening import open_log
from log2sim.logs.pandaset.reader import PERIOD_NS, SweepFiles, georeference, read_labels
from log2sim.logs.stamps import compute_scan_offset_ns


def test_a_label_is_timed_by_its_direction() -> None:
    """Clockwise, the rear at the stamp: right 25 ms, front 50 ms, left 75 ms before."""
    xyz = np.array([[-1.0, -1e-12, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0], [-1, 1e-12, 0]])
    offset_ns = compute_scan_offset_ns(xyz, PERIOD_NS)
    np.testing.assert_array_equal(offset_ns, [0, -25_000_000, -50_000_000, -75_000_000, -100_000_000])


def cuboids(path: Path, rows: list[dict[str, object]], without: Sequence[str] = ()) -> None:
    pandas = pytest.importorskip("pandas")
    whole = {
        "uuid": "u", "label": "Car", "yaw": 0.0, "position.x": 0.0, "position.y": 0.0, "position.z": 0.0, "dimensions.x": 1.8,
        "dimensions.y": 4.4, "dimensions.z": 1.5, "attributes.rider_status": np.nan, "cuboids.sibling_id": "-",
        "cuboids.sensor_id": -1,
    }  # fmt: skip
    pandas.DataFrame([whole | row for row in rows]).drop(columns=list(without)).to_pickle(path)


def test_cuboids_become_one_row_an_object_with_rising_stamps(tmp_path: Path) -> None:
    """Two sweeps: a car crosses the line behind the ego; a bicycle is seen by both LiDARs, then by the PandarGT only."""
    twin = {"uuid": "gt", "label": "Bicycle", "cuboids.sibling_id": "spin", "cuboids.sensor_id": 1, "position.x": 9.0}
    spin = {"uuid": "spin", "label": "Bicycle", "cuboids.sibling_id": "gt", "cuboids.sensor_id": 0, "position.x": 9.1}
    rider = {"attributes.rider_status": "With Rider"}
    files = {k: tmp_path / f"{k:02d}.pkl.gz" for k in range(2)}
    behind = {"uuid": "car", "position.x": -8.0}
    cuboids(files[0], [behind | {"position.y": -0.01}, twin | rider, spin | rider, {"uuid": "cone", "label": "Cones"}])
    cuboids(files[1], [behind | {"position.y": 0.01}, twin | rider, {"uuid": "ufo", "label": "Saucer"}])
    notes: list[str] = []
    t_ns = np.array([10**9, 10**9 + 100_000_000])
    labels = read_labels(files, t_ns, t_ns + 30_000_000, np.eye(4)[None].repeat(2, 0), notes)
    assert labels.track_id.tolist() == ["car", "spin", "spin"]
    assert labels.category.tolist() == ["car", "cyclist", "cyclist"]
    np.testing.assert_allclose(labels.t_ns, [10**9, 10**9 - 50_000_000, 10**9 + 130_000_000], atol=50_000)
    np.testing.assert_allclose(labels.center_m[1:, 0], [9.1, 9.0])
    np.testing.assert_allclose(labels.size_m[0], [4.4, 1.8, 1.5])
    np.testing.assert_allclose(labels.yaw_rad, np.pi / 2)
    assert notes == [
        "labels left out because they are no road users: Cones (1)",
        "labels left out because their kind is not known: Saucer (1)",
    ]


def test_of_two_cuboids_of_an_object_one_naming_the_other_is_enough(tmp_path: Path) -> None:
    file = {0: tmp_path / "00.pkl.gz"}
    cuboids(
        file[0],
        [
            {"uuid": "gt-1", "cuboids.sibling_id": "spin-", "cuboids.sensor_id": 1},
            {"uuid": "spin-1", "cuboids.sibling_id": "gt-1", "cuboids.sensor_id": 0},
            {"uuid": "gt-2", "cuboids.sibling_id": "spin-2", "cuboids.sensor_id": 1},
            {"uuid": "spin-2", "cuboids.sibling_id": "-", "cuboids.sensor_id": 0},
        ],
    )
    t_ns = np.array([10**9])
    labels = read_labels(file, t_ns, t_ns, np.eye(4)[None], [])
    assert labels.track_id.tolist() == ["spin-1", "spin-2"]


def test_a_column_of_attributes_may_be_absent(tmp_path: Path) -> None:
    """The second sweep says nothing on riders, as frame 79 of sequence 002; the third neither on the two LiDARs."""
    columns = ("attributes.rider_status", "cuboids.sibling_id", "cuboids.sensor_id")
    files = {k: tmp_path / f"{k:02d}.pkl.gz" for k in range(3)}
    objects = [("ridden", "With Rider"), ("pushed", "Without Rider"), ("parked", np.nan)]
    rows = [{"uuid": name, "label": "Bicycle", "attributes.rider_status": rider} for name, rider in objects]
    for k, file in files.items():
        cuboids(file, rows, without=columns[: [0, 1, 3][k]])
    notes: list[str] = []
    t_ns = np.arange(3) * 100_000_000 + 10**9
    labels = read_labels(files, t_ns, t_ns, np.eye(4)[None].repeat(3, 0), notes)
    assert labels.track_id.tolist() == ["ridden", "pushed", "parked"] * 3
    assert labels.category.tolist() == ["cyclist", "bicycle", "bicycle"] * 3
    assert notes == ["1 bicycle taken as unridden: no sweep states whether somebody rides them"]


def test_a_needed_column_of_the_cuboids_is_named(tmp_path: Path) -> None:
    cuboids(tmp_path / "00.pkl.gz", [{}], without=("position.x",))
    with pytest.raises(LogError, match=r"00\.pkl\.gz: no column 'position\.x'"):
        read_labels({0: tmp_path / "00.pkl.gz"}, np.array([1]), np.array([1]), np.eye(4)[None], [])


def test_times_of_the_second_lidar_are_interpolated_over_missing_sweeps(tmp_path: Path) -> None:
    """It is 30 ms late at first and 36 ms at last; the second file is missing, the third is no table."""
    pandas = pytest.importorskip("pandas")
    t_ns = np.arange(5) * 100_000_000 + 10**9
    files = {k: tmp_path / f"{k:02d}.pkl.gz" for k in (0, 2, 4)}
    for k in (0, 4):
        late_s = t_ns[k] / 1e9 + 0.030 + 0.0015 * k
        times = np.array([t_ns[k] / 1e9, late_s - 0.05, late_s + 0.05])
        place = np.zeros(3)
        pandas.DataFrame({"x": place, "y": place, "z": place, "t": times, "d": [0, 1, 1]}).to_pickle(files[k])
    files[2].write_bytes(b"no table")
    stamps = SweepFiles(files, t_ns, []).gt_stamps
    np.testing.assert_allclose(stamps - t_ns, [30e6, 31.5e6, 33e6, 34.5e6, 36e6], atol=1000)


def track(turn_rad: float, length_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Fixes and map positions of a drive to the north-east; the map is turned by `turn_rad` against east and north."""
    from pyproj import Geod

    s = np.linspace(0, length_m, 30)
    lon, lat, _ = Geod(ellps="WGS84").fwd(np.full(30, -122.4), np.full(30, 37.7), np.full(30, 30.0), s)
    east_north = np.stack([s * np.sin(np.radians(30)), s * np.cos(np.radians(30)), np.zeros(30)], axis=1)
    return np.stack([lat, lon, np.full(30, 5.0)], axis=1), east_north @ rotation_from_rpy(0, 0, turn_rad).T + [
        3.0,
        -2.0,
        1.0,
    ]


def test_the_map_is_tied_to_earth_only_where_gnss_shows_its_north() -> None:
    from pyproj import Proj

    geodetic, xyz = track(0.0, 80.0)
    frame, reason = georeference(geodetic, xyz, "gps")
    assert reason == ""
    x, y = Proj(frame.projection)(geodetic[:, 1], geodetic[:, 0])
    np.testing.assert_allclose(np.stack([x, y], 1), xyz[:, :2], atol=0.01)
    assert frame.altitude_m == pytest.approx(4.0, abs=1e-3)
    for turn, length, words in ((0.1, 80.0, "differ by"), (0.0, 5.0, "moves less than")):
        frame, reason = georeference(*track(turn, length), "gps")
        assert words in reason
        assert frame.projection is None


@pytest.fixture(scope="module")
def sequence(real_data: Path) -> Path:
    return real_data / "pandaset" / "002"


@pytest.mark.slow
@pytest.mark.real
def test_label_boxes_hold_the_points_of_their_cars_at_their_own_time(sequence: Path) -> None:
    log = open_log(sequence)
    inside, around, off_ns = [], [], []
    labels, stream = log.labels, log.streams["pandar64"]
    for i in (5, 20, 35):
        sweep = stream.read(i)
        ego = log.ego.at(stream.t_ns[i])[0][0, :3, 3]
        now = (labels.t_ns <= stream.t_ns[i]) & (labels.t_ns > stream.t_ns[i] - 99_000_000) & (labels.category == "car")
        for k in np.flatnonzero(now & (np.linalg.norm(labels.center_m - ego, axis=1) < 30)):
            args = labels.center_m[k], labels.size_m[k], labels.yaw_rad[k]
            mask = points_in_box(sweep.xyz_m, *args, margin_m=0.1)
            inside.append(mask.sum())
            around.append(points_in_box(sweep.xyz_m, args[0], args[1] + np.array([1.0, 1.0, 0.0]), args[2]).sum())
            if mask.sum() > 20:
                off_ns.append(np.median(sweep.t_ns[mask]) - labels.t_ns[k])
    assert len(inside) > 40
    assert np.mean(np.array(inside) > 20) > 0.85
    assert np.sum(inside) / np.sum(around) > 0.85
    assert np.median(np.abs(off_ns)) < 2e6


@pytest.mark.real
def test_cars_move_where_their_boxes_point_and_tracks_increase(sequence: Path) -> None:
    labels = open_log(sequence).labels
    differences = []
    for name in np.unique(labels.track_id):
        rows = labels.track_id == name
        assert np.all(np.diff(labels.t_ns[rows]) > 0)
        move = np.ptp(labels.center_m[rows], axis=0)
        if labels.category[rows][0] == "car" and np.linalg.norm(move) > 10:
            way = labels.center_m[rows][-1] - labels.center_m[rows][0]
            differences.append(wrap_angle(np.arctan2(way[1], way[0]) - np.median(labels.yaw_rad[rows])))
    assert len(differences) > 10
    assert np.abs(differences).max() < np.radians(3)


@pytest.mark.real
def test_cameras_look_where_their_names_say_and_the_road_lies_at_zero(sequence: Path) -> None:
    log = open_log(sequence)
    ahead = {
        "front_camera": [1, 0], "front_left_camera": [0.7, 0.7], "left_camera": [0, 1],
        "front_right_camera": [0.7, -0.7], "right_camera": [0, -1], "back_camera": [-1, 0],
    }  # fmt: skip
    assert set(log.cameras) == set(ahead)
    for name, direction in ahead.items():
        axis = log.cameras[name].mount_T_cam[:3, 2]
        assert axis[:2] @ np.array(direction) > 0.9, name
        assert abs(axis[2]) < 0.15
        assert log.cameras[name].mount_T_cam[2, 1] < -0.95  # the image's down is the map's down
    sweep = log.streams["pandar64"].read(10)
    points = apply(inverse(log.ego.at(sweep.stamp_ns)[0][0]), sweep.xyz_m)
    road = (np.abs(points[:, :2] - [3, 0]) < [9, 2.5]).all(1) & (points[:, 2] < 0.4)
    assert abs(np.median(points[road, 2])) < 0.12
    assert (
        np.mean(np.einsum("ij,ij->i", log.ego.map_T_ego[1:, :2, 0], np.diff(log.ego.map_T_ego[:, :2, 3], axis=0))) > 0
    )


@pytest.mark.real
def test_frame_by_frame_camera_poses_agree_with_the_one_mount(sequence: Path) -> None:
    """Project a point 20 m ahead through the pose file of each frame and through our mount."""
    log = open_log(sequence)
    camera, t_ns = log.cameras["front_camera"], log.streams["front_camera"].t_ns
    records = json.loads((sequence / "camera" / "front_camera" / "poses.json").read_text())
    from scipy.spatial.transform import Rotation

    ours, _ = log.map_T_sensor("front_camera", t_ns)
    places = np.array([[r["position"][k] for k in "xyz"] for r in records])
    assert np.median(np.linalg.norm(ours[:, :3, 3] - places, axis=1)) < 0.004
    for k in range(1, len(t_ns), 6):
        q, p = records[k]["heading"], records[k]["position"]
        point = apply(ours[k], np.array([[2.0, 1.0, 20.0]]))
        seen = Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]]).inv().apply(point - [p["x"], p["y"], p["z"]])
        uv, uv_ours = project(camera, seen)[0], project(camera, np.array([[2.0, 1.0, 20.0]]))[0]
        assert np.linalg.norm(uv - uv_ours) < 3.0


@pytest.mark.real
def test_two_lidars_with_their_own_times(sequence: Path) -> None:
    log = open_log(sequence)
    for name in ("pandar64", "pandargt"):
        sweep = log.streams[name].read(7)
        assert sweep.frame == "map"
        assert np.ptp(sweep.t_ns) == pytest.approx(0.1e9, rel=0.05)
        assert len(sweep.xyz_m) > 50_000
    gt = log.streams["pandargt"]
    middle = [(int(s.t_ns.min()) + int(s.t_ns.max())) // 2 - s.stamp_ns for s in (gt.read(0), gt.read(20))]
    assert np.abs(middle).max() < 1e6


@pytest.mark.real
def test_faults_of_a_sequence_are_named(sequence: Path, tmp_path: Path) -> None:
    broken = tmp_path / "003"
    for folder in ("lidar", "camera/front_camera", "meta", "annotations/cuboids"):
        (broken / folder).mkdir(parents=True)
        for file in (sequence / folder).iterdir():
            if not file.name[:2].isdigit() or int(file.name[:2]) < 3:
                (broken / folder / file.name).symlink_to(file.resolve())
    cloud = broken / "lidar" / "01.pkl.gz"
    cut = cloud.read_bytes()[:10_000]
    cloud.unlink()
    cloud.write_bytes(cut)
    log = open_log(broken)
    assert len(log.streams["pandar64"].t_ns) == 3
    with pytest.raises(RecordError, match=r"01.pkl.gz.*truncated"):
        log.streams["pandar64"].read(1)
    log.streams["pandar64"].read(2)
    poses = broken / "lidar" / "poses.json"
    records = json.loads(poses.read_text())
    records[4]["heading"]["w"] = 3.0
    poses.unlink()
    poses.write_text(json.dumps(records))
    with pytest.raises(LogError, match=r"lidar/poses.json: record 4.*unit quaternion"):
        open_log(broken)


def linked_part(sequence: Path, folder: Path, count: int = 5) -> Path:
    """The first records of two cameras and of the LiDARs, as links."""
    for name in ("lidar", "camera/front_camera", "camera/back_camera", "meta", "annotations/cuboids"):
        (folder / name).mkdir(parents=True)
        for file in (sequence / name).iterdir():
            if not file.name[:2].isdigit() or int(file.name[:2]) < count:
                (folder / name / file.name).symlink_to(file.resolve())
    return folder


@pytest.mark.real
def test_missing_records_are_gaps(sequence: Path, tmp_path: Path) -> None:
    part = linked_part(sequence, tmp_path / "003")
    (part / "lidar" / "02.pkl.gz").unlink()
    for file in (part / "camera" / "back_camera").glob("*.jpg"):
        file.unlink()
    log = open_log(part)
    assert list(log.cameras) == ["front_camera"]
    steps = np.diff(log.streams["pandar64"].t_ns) / 1e8
    np.testing.assert_allclose(steps, [1, 2, 1], atol=0.02)
    # The PandarGT's first two sweeps of this sequence are one and the same.
    np.testing.assert_allclose(np.diff(log.streams["pandargt"].t_ns)[1:] / 1e8, [2, 1], atol=0.1)
    stamps = log.labels.t_ns
    # The cuboids of the missing sweep are still labels.
    assert np.sum((stamps > log.ego.t_ns[1] + 5_000_000) & (stamps <= log.ego.t_ns[2])) > 20
    for words in (r"lidar: \d+ of \d+ records are missing, first number 02", "camera/back_camera: "):
        assert any(re.match(words, note) for note in log.notes), words
    for file in (part / "lidar").glob("*.gz"):
        file.unlink()
    log = open_log(part)
    assert list(log.streams) == ["front_camera"]
    assert not log.lidars
    assert len(log.labels.t_ns) > 100


@pytest.mark.real
def test_opening_reads_neither_sweeps_nor_cuboids(sequence: Path, tmp_path: Path) -> None:
    part = linked_part(sequence, tmp_path / "003")
    for file in (*(part / "lidar").glob("*.gz"), *(part / "annotations" / "cuboids").glob("*.gz")):
        file.unlink()
        file.write_bytes(b"not a table")
    log = open_log(part)
    assert log.streams["front_camera"].read(0).shape == (1080, 1920, 3)
    with pytest.raises(LogError, match=r"\d\d\.pkl\.gz: not a pickled table"):
        _ = log.labels


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return encode(world_log(), tmp_path_factory.mktemp("world"))


def changed(world: Path, tmp_path: Path, name: str, change: Callable[[Any], None]) -> Path:
    """The world with one JSON file changed."""
    path = tmp_path / "changed"
    shutil.copytree(world, path)
    document = json.loads((path / name).read_text())
    change(document)
    (path / name).write_text(json.dumps(document))
    return path


DIGITS_40, DIGITS_400 = int("9" * 40), int("9" * 400)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("lidar/timestamps.json", lambda d: d.__setitem__(2, d[2] * 1000), r"lidar/timestamps\.json: record 2: '\d+\.?\d*', expected a stamp in seconds"),
        ("lidar/timestamps.json", lambda d: d.__setitem__(2, DIGITS_40), r"lidar/timestamps\.json: record 2: '9+', expected a stamp"),
        ("lidar/timestamps.json", lambda d: d.__setitem__(2, DIGITS_400), r"lidar/timestamps\.json: \[2\] is 9+, expected a finite number"),
        ("lidar/timestamps.json", lambda d: d.__setitem__(2, "noon"), r"lidar/timestamps\.json: record 2: 'noon', expected a stamp"),
        ("lidar/timestamps.json", lambda d: d.__setitem__(2, None), r"lidar/timestamps\.json: record 2: 'None', expected a stamp"),
        ("lidar/timestamps.json", lambda d: d.__setitem__(2, [1.0]), r"lidar/timestamps\.json: record 2: .*expected a stamp"),
        ("lidar/poses.json", lambda d: d[1]["position"].update(x=DIGITS_40), r"lidar/poses\.json: record 1: position \[1e\+40"),
        ("lidar/poses.json", lambda d: d[1]["position"].update(x=DIGITS_400), r"lidar/poses\.json: \[1\]\.position\.x is 9+, expected a finite"),
        ("lidar/poses.json", lambda d: d[1]["heading"].update(w=DIGITS_40), r"lidar/poses\.json: record 1: heading"),
        ("camera/front_camera/intrinsics.json", lambda d: d.update(fx=DIGITS_400), r"intrinsics\.json: fx is 9+, expected a finite number"),
        ("meta/gps.json", lambda d: d[0].update(lat=DIGITS_400), r"gps\.json: \[0\]\.lat is 9+"),
    ],
)  # fmt: skip
def test_impossible_numbers_are_refused_by_the_file_that_holds_them(
    world: Path, tmp_path: Path, name: str, change: Callable[[Any], None], words: str
) -> None:
    with pytest.raises(LogError, match=words):
        _ = open_log(changed(world, tmp_path, name, change)).labels


def test_a_sweep_whose_stamp_is_far_off_is_left_out_with_its_labels(world: Path, tmp_path: Path) -> None:
    sound = open_log(world)
    log = open_log(changed(world, tmp_path, "lidar/timestamps.json", lambda d: d.__setitem__(2, 2.0)))
    assert len(log.streams["pandar64"].t_ns) == len(sound.streams["pandar64"].t_ns) - 1
    assert sound.labels is not None
    assert log.labels is not None
    lasts_ns = np.ptp(log.streams["pandar64"].t_ns)
    assert np.abs(log.labels.t_ns - log.streams["pandar64"].t_ns[0]).max() < 2 * lasts_ns
    assert 0 < len(log.labels.t_ns) < len(sound.labels.t_ns)
    assert any("lidar/timestamps.json: 1 of" in note and "left out" in note for note in log.notes)


def test_images_that_cannot_be_used_are_counted(world: Path, tmp_path: Path) -> None:
    """Without intrinsics, or without a stamp."""
    shutil.copytree(world, tmp_path / "log")
    camera = tmp_path / "log" / "camera" / "front_camera"
    count = len(list(camera.glob("*.jpg")))
    shutil.copytree(camera, camera.parent / "back_camera")
    (camera.parent / "back_camera" / "intrinsics.json").unlink()
    shutil.copy(camera / "00.jpg", camera / "77.jpg")
    log = open_log(tmp_path / "log")
    assert set(log.cameras) == {"front_camera"}
    assert f"camera/back_camera: {count} images left out: it has no intrinsics.json" in log.notes
    assert f"camera/front_camera: 1 of {count + 1} records left out: there are stamps for {count}" in log.notes


@pytest.mark.parametrize("seconds", [18.0, -3600.0])
def test_images_of_another_clock_are_told_with_it(world: Path, tmp_path: Path, seconds: float) -> None:
    shutil.copytree(world, tmp_path / "log")
    path = tmp_path / "log" / "camera" / "front_camera" / "timestamps.json"
    path.write_text(json.dumps([stamp + seconds for stamp in json.loads(path.read_text())]))
    words = "GPS time against UTC" if seconds > 0 else "1 h, a time zone"
    with pytest.raises(LogError, match=rf"front_camera/timestamps.json .*they do not overlap .*{words}"):
        open_log(tmp_path / "log")
