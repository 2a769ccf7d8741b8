"""PandaSet reader: labels, map frame, geometry on the recorded sequence, and the unpickler of its tables."""

from __future__ import annotations

import gzip
import json
import os
import pickle
import re
import shutil
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_encoders.pandaset import encode
from log_encoders.world import world_log

from log2sim.errors import LogError, RecordError
from log2sim.geometry import apply, inverse, rotation_from_rpy, wrap_angle
from log2sim.logs.opening import open_log
from log2sim.logs.pandaset import unpickle
from log2sim.logs.pandaset.reader import PERIOD_NS, georeference, read_labels
from log2sim.logs.pandaset.unpickle import read_pickled_table
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


@pytest.fixture(scope="module")
def sequence(real_data: Path) -> Path:
    return real_data / "pandaset" / "002"


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


def test_sweeps_and_cuboids_are_read_when_they_are_used(world: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(world, tmp_path / "copy"))
    for file in root.glob("**/*.pkl.gz"):
        file.write_bytes(b"no table")
    log = open_log(root)
    # Without readable points the PandarGT has the stamps of the other LiDAR.
    np.testing.assert_array_equal(log.streams["pandargt"].t_ns, log.streams["pandar64"].t_ns)
    with pytest.raises(RecordError, match=r"lidar/00\.pkl\.gz"):
        log.streams["pandar64"].read(0)
    with pytest.raises(LogError, match=r"cuboids/00\.pkl\.gz"):
        _ = log.labels


DIGITS_40, DIGITS_400 = int("9" * 40), int("9" * 400)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("lidar/timestamps.json", lambda d: d.__setitem__(2, d[2] * 1000), r"lidar/timestamps\.json: record 2: '\d+\.?\d*', expected a stamp in seconds"),
        ("lidar/timestamps.json", lambda d: d.__setitem__(2, DIGITS_400), r"lidar/timestamps\.json: \[2\] is 9+, expected a finite number"),
        ("lidar/timestamps.json", lambda d: d.__setitem__(2, "noon"), r"lidar/timestamps\.json: record 2: 'noon', expected a stamp"),
        ("lidar/timestamps.json", lambda d: d.__setitem__(2, [1.0]), r"lidar/timestamps\.json: record 2: .*expected a stamp"),
        ("lidar/poses.json", lambda d: d[1]["position"].update(x=DIGITS_40), r"lidar/poses\.json: record 1: position \[1e\+40"),
        ("lidar/poses.json", lambda d: d[1]["position"].update(x=DIGITS_400), r"lidar/poses\.json: \[1\]\.position\.x is 9+, expected a finite"),
        ("camera/front_camera/intrinsics.json", lambda d: d.update(fx=DIGITS_400), r"intrinsics\.json: fx is 9+, expected a finite number"),
        ("meta/gps.json", lambda d: d[0].update(lat=DIGITS_400), r"gps\.json: \[0\]\.lat is 9+"),
    ],
)  # fmt: skip
def test_impossible_numbers_are_refused_by_the_file_that_holds_them(
    world: Path, tmp_path: Path, name: str, change: Callable[[Any], None], words: str
) -> None:
    with pytest.raises(LogError, match=words):
        _ = open_log(changed(world, tmp_path, name, change)).labels


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


@pytest.mark.parametrize("name", ["plain.pkl", "packed.pkl.gz"])
@pytest.mark.parametrize("strings", [False, True])
def test_a_table_of_todays_pandas_is_read_without_it(tmp_path: Path, name: str, strings: bool) -> None:
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame(
        {
            "x": [1.5, 2.5, np.nan],
            "t": [1.5e9, 1.5e9 + 0.1, 1.5e9],
            "d": np.array([0, 1, 0]),
            "flag": [True, False, True],
            "word": np.array(["a", np.nan, "ü"], dtype=object),
        }
    )
    if strings:
        table["word"] = table["word"].astype("str")
    table.to_pickle(tmp_path / name)
    columns = read_pickled_table(tmp_path / name)
    assert set(columns) == set(table.columns)
    for key in ("x", "t", "d", "flag"):
        np.testing.assert_array_equal(columns[key], table[key].to_numpy())
    assert [columns["word"][0], columns["word"][2]] == ["a", "ü"]


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_every_pickle_protocol_is_read(tmp_path: Path, protocol: int) -> None:
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame({"x": np.arange(4.0), "y": np.arange(4.0) * 2, "d": np.arange(4)})
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(table, protocol=protocol))
    if protocol == 2:
        # Bytes were stored through a codec then; that is a call which a table does not need.
        with pytest.raises(RecordError, match="_codecs"):
            read_pickled_table(tmp_path / "a.pkl")
        return
    columns = read_pickled_table(tmp_path / "a.pkl")
    for key in "xyd":
        np.testing.assert_array_equal(columns[key], table[key])


class Bomb:
    def __reduce__(self) -> tuple:
        return os.system, ("touch exploded",)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (pickle.dumps(Bomb()), "system, which a table does not need"),
        (pickle.dumps({"a": 1}), "holds a dict, expected a DataFrame"),
        (pickle.dumps(np.zeros(3)), "holds a"),
        (b"\x80\x04c__builtin__\neval\n(S'1'\ntR.", "eval, which a table does not need"),
        # A memo, and an array of bytes, that would take all memory.
        (b"\x80\x04]r" + struct.pack("<I", 2**31 - 1) + b".", "holds a list"),
        (b"\x80\x05" + pickle.BYTEARRAY8 + struct.pack("<Q", 2**40) + b".", "truncated"),
        (b"", "not a pickled table"),
        (b"hello", "not a pickled table"),
        (gzip.compress(b"\0" * 3_000_000), "unpacks to more than"),
        (gzip.compress(os.urandom(1000))[:-100], "truncated"),
        (pickle.dumps(Path("/tmp/x")), "which a table does not need"),
    ],
)
def test_anything_but_a_table_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: bytes, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.pkl").write_bytes(data)
    with pytest.raises(RecordError, match=r"x\.pkl") as caught:
        read_pickled_table(tmp_path / "x.pkl", limit_bytes=2_000_000)
    assert words in str(caught.value)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("part", [slice(None), slice(-4), slice(40), slice(11)])
def test_either_library_unpacks_the_same_and_refuses_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: slice
) -> None:
    pandas, isal_zlib = pytest.importorskip("pandas"), pytest.importorskip("isal.isal_zlib")
    path, found = tmp_path / "x.pkl.gz", list[object]()
    pandas.DataFrame({"x": np.random.default_rng(0).normal(size=2000)}).to_pickle(path)
    path.write_bytes(path.read_bytes()[part])
    for library, error in ((zlib, zlib.error), (isal_zlib, isal_zlib.IsalError)):
        monkeypatch.setattr(unpickle, "decompressobj", library.decompressobj)
        monkeypatch.setattr(unpickle, "GzipError", error)
        try:
            found.append(read_pickled_table(path)["x"].tolist())
        except RecordError as problem:
            found.append(str(problem))
    assert found[0] == found[1]
    assert isinstance(found[0], list) is (part == slice(None))
