"""Argoverse 2 reader: frames and times of both LiDARs, labels, the city's place on Earth, partial and damaged logs."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SHARED
from log_encoders import argoverse
from worlds import tiny_log

from log2sim.datatypes import Log, Sweep
from log2sim.errors import LogError, RecordError
from log2sim.geometry import PoseTrack, apply, points_in_box
from log2sim.logs.argoverse import (
    ANNOTATIONS,
    CATEGORY_OF,
    CITIES,
    INTRINSICS,
    MOUNTS,
    NO_ROAD_USERS,
    POSES,
    map_frame_of,
    read_labels,
)
from log2sim.logs.opening import open_log

feather = pytest.importorskip("pyarrow.feather")
SAMPLE = SHARED / "data" / "argoverse2" / "sensor" / "val" / "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
EARTH_M_PER_DEG = 111_000.0


@pytest.fixture(scope="module")
def world() -> Log:
    return tiny_log(noise_m=0.0)[0]


@pytest.fixture(scope="module")
def encoded(world: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return argoverse.encode(world, tmp_path_factory.mktemp("av2"))


@pytest.fixture
def folder(encoded: Path, tmp_path: Path) -> Path:
    """A copy to be spoiled."""
    return Path(shutil.copytree(encoded, tmp_path / "log"))


def change(path: Path, edit: Callable[[dict[str, Any]], None]) -> None:
    """Rewrite a table after `edit` of its columns as lists."""
    table = feather.read_table(path)
    columns = table.to_pydict()
    edit(columns)
    feather.write_feather(type(table).from_pydict(columns), path)


def test_points_of_both_lidars_are_those_of_the_world_to_half_precision(world: Log, encoded: Path) -> None:
    """In the frame of each LiDAR where it was at the start of the sweep; times are those at which they were measured."""
    log = open_log(encoded)
    for i in range(len(world.streams["top"].t_ns)):
        whole = world.streams["top"].read(i)
        found: list[tuple[np.ndarray, np.ndarray]] = []
        for name in ("up_lidar", "down_lidar"):
            sweep: Sweep = log.streams[name].read(i)
            assert sweep.compensated_ns == sweep.stamp_ns == world.streams["top"].t_ns[i] - argoverse.TURN_NS
            mount = log.map_T_sensor(name, sweep.stamp_ns)[0][0]
            found.append((apply(mount, sweep.xyz_m.astype(np.float64)), sweep.t_ns))
            # The lower LiDAR hangs upside down: what is below it has a positive z there.
            below = sweep.xyz_m[np.abs(sweep.xyz_m[:, 0]) < 20][:, 2]
            assert np.sign(np.median(below)) == (-1 if name == "up_lidar" else 1)
        lower = np.arange(len(whole.xyz_m)) % argoverse.LOWER_SHARE == 0
        poses = world.map_T_sensor("top", whole.t_ns)[0]
        expected = np.einsum("nij,nj->ni", poses[:, :3, :3], whole.xyz_m) + poses[:, :3, 3]
        shift = np.array([170.0, 420.0, 60.0])  # the map's origin is whole kilometers from that of the city
        reach = np.linalg.norm(whole.xyz_m, axis=1)
        for mask, (xyz, t_ns) in zip((~lower, lower), found):
            np.testing.assert_array_equal(t_ns, whole.t_ns[mask])
            off = np.abs(xyz - expected[mask] - shift).max(axis=1)
            assert (off <= 0.001 + reach[mask] * 2.0**-11 + 2.0**-9).all()


# City coordinates and their places by the tests of the data set's development kit, and the origins that it states.
PLACES = [
    ("ATX", (1745.37, -1421.37), (30.261642967615092, -97.72246957081633)),
    ("WDC", (2139.70, 4606.14), (38.931286945069985, -77.0120195048271)),
    ("DTW", (0.0, 0.0), (42.29993066912924, -83.17555750783717)),
    ("MIA", (0.0, 0.0), (25.77452579915163, -80.19656914449405)),
    ("PAO", (0.0, 0.0), (37.416065, -122.13571963362166)),
    ("PIT", (0.0, 0.0), (40.44177902989321, -80.01294377242584)),
]


@pytest.mark.parametrize(("city", "xy", "place"), PLACES)
def test_city_frames_lie_where_the_development_kit_says(
    city: str, xy: tuple[float, float], place: tuple[float, float]
) -> None:
    frame = map_frame_of(city, (*xy, 0.0), [])
    assert frame.latitude_deg is not None
    assert frame.longitude_deg is not None
    assert abs(frame.latitude_deg - place[0]) * EARTH_M_PER_DEG < 0.1
    assert abs(frame.longitude_deg - place[1]) * EARTH_M_PER_DEG < 0.1
    assert set(CITIES) == {row[0] for row in PLACES}


def box(kind: str, x: float, z: float = 0.5, **other: object) -> dict[str, object]:
    row = {
        "timestamp_ns": 10**9, "track_uuid": kind.lower(), "category": kind, "length_m": 1.8, "width_m": 0.6, "height_m": 1.0,
        "qw": np.cos(0.25), "qx": 0.0, "qy": 0.0, "qz": np.sin(0.25), "tx_m": x, "ty_m": 0.0, "tz_m": z, "num_interior_pts": 5,
    }  # fmt: skip
    return row | other


def labels_of(tmp_path: Path, rows: list[dict[str, object]]) -> tuple[Any, list[str]]:
    path = tmp_path / ANNOTATIONS
    argoverse.write_table(path, {key: [row[key] for row in rows] for key in rows[0]})
    ego = PoseTrack(np.array([0, 2 * 10**9]), np.repeat(np.eye(4)[None], 2, 0), max_gap_s=10.0)
    notes: list[str] = []
    return read_labels(path, ego, np.zeros(2), np.array([10**9]), notes), notes


def test_kinds_become_categories_and_what_is_no_road_user_is_told(tmp_path: Path) -> None:
    """All 30 classes of the taxonomy, the sign by both its names, and one that does not exist; 5 m apart."""
    kinds = [*CATEGORY_OF, *sorted(NO_ROAD_USERS), "SAUCER"]
    assert len(kinds) == 32
    labels, notes = labels_of(tmp_path, [box(kind, 5.0 * k) for k, kind in enumerate(kinds)])
    found = dict(zip(labels.kind.tolist(), labels.category.tolist()))
    assert found == CATEGORY_OF
    assert labels.track_id.tolist() == [kind.lower() for kind in CATEGORY_OF]
    np.testing.assert_allclose(labels.yaw_rad, 0.5)
    assert len(notes) == 2
    assert notes[0].startswith("labels left out because they are no road users: ANIMAL (1), BOLLARD (1), ")
    assert notes[1] == "labels left out because their kind is not known: SAUCER (1)"


def test_labels_tell_what_was_seen_and_when(tmp_path: Path) -> None:
    rows = [
        box("TRUCK", 10.0, num_interior_pts=0),
        box("BUS", 20.0),
        box("BUS", 21.0),
        box("BUS", 20.0, timestamp_ns=11 * 10**8),
        box("BUS", 20.0, timestamp_ns=10**11),
    ]
    labels, notes = labels_of(tmp_path, rows)
    assert labels.visible.tolist() == [False, True, True]
    np.testing.assert_array_equal(labels.t_ns, np.array([10, 10, 11]) * 10**8 + 65_000_000)
    np.testing.assert_array_equal(labels.labeled_ns, np.array([10, 11, 1000]) * 10**8 + 50_000_000)
    assert notes == [
        "1 labels left out because the ego's pose is not known at their stamps",
        "sweeps are missing at 2 of the 3 stamps that were labeled",
    ]


def set_cell(name: str, row: int, value: object) -> Callable[[dict[str, Any]], None]:
    def edit(columns: dict[str, Any]) -> None:
        columns[name][row] = value

    return edit


@pytest.mark.parametrize(
    ("file", "edit", "words"),
    [
        (POSES, set_cell("qw", 3, 9.0), "row 3: position"),
        (POSES, set_cell("tx_m", 2, float("nan")), "row 2: position"),
        (POSES, set_cell("timestamp_ns", 0, None), "column 'timestamp_ns': is int64 with 1 missing values"),
        (POSES, lambda c: c.update({k: [] for k in c}), "expected"),
        (MOUNTS, set_cell("sensor_name", 1, "roof"), "no sensor 'up_lidar'; expected up_lidar, down_lidar"),
        (INTRINSICS, set_cell("fx_px", 0, 0.0), "row 0 ('ring_front_center')"),
        (ANNOTATIONS, set_cell("length_m", 4, 0.0), "row 4: size [0.0,"),
        (ANNOTATIONS, set_cell("category", 1, None), "row 1: no 'category'"),
        (ANNOTATIONS, set_cell("qz", 0, float("inf")), "row 0: position"),
        (ANNOTATIONS, lambda c: c.pop("num_interior_pts"), "no column 'num_interior_pts'"),
    ],
)
def test_faults_of_tables_are_named(
    folder: Path, file: str, edit: Callable[[dict[str, Any]], None], words: str
) -> None:
    change(folder / file, edit)
    with pytest.raises(LogError) as caught:
        _ = open_log(folder).labels
    assert str(caught.value).startswith(str(folder / file))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (set_cell("laser_number", 5, 64), "column 'laser_number': 0 to 64, expected 0 to 63"),
        (set_cell("offset_ns", 5, -2_000_000_000), "column 'offset_ns': -2000000000 to"),
        (lambda c: c.update(x=["far"] * len(c["y"])), "column 'x': is string, expected numbers"),
    ],
)
def test_a_faulty_sweep_is_lost_alone(folder: Path, edit: Callable[[dict[str, Any]], None], words: str) -> None:
    files = sorted((folder / "sensors" / "lidar").iterdir())
    change(files[2], edit)
    log = open_log(folder)
    for name in ("up_lidar", "down_lidar"):
        with pytest.raises(RecordError) as caught:
            log.streams[name].read(2)
        assert str(caught.value).startswith(str(files[2]))
        assert words in str(caught.value)
        assert len(log.streams[name].read(3).xyz_m) > 100


@pytest.fixture(scope="module")
def sample() -> Log:
    if not SAMPLE.is_dir():
        pytest.skip("the Argoverse 2 log is not beside this checkout (../shared/data/argoverse2)")
    return open_log(SAMPLE)


def points_of(log: Log, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of both LiDARs in the map, and their times."""
    sweeps = [(name, log.streams[name].read(i)) for name in log.lidars]
    xyz = [apply(log.map_T_sensor(name, s.compensated_ns)[0][0], s.xyz_m.astype(np.float64)) for name, s in sweeps]
    return np.concatenate(xyz), np.concatenate([s.t_ns for _, s in sweeps])


@pytest.mark.real
def test_moving_cars_are_in_their_boxes_at_the_times_of_the_labels(sample: Log) -> None:
    """Points moved by the car's speed to the stamp of its label, or to that of the sweep."""
    labels = sample.labels
    assert labels is not None
    inside, total = np.zeros(2), 0
    for i, stamp in enumerate(sample.streams["up_lidar"].t_ns.tolist()):
        xyz, t_ns = points_of(sample, i)
        for k in np.flatnonzero((labels.t_ns >= stamp) & (labels.t_ns < stamp + argoverse.TURN_NS)).tolist():
            near = (labels.track_id == labels.track_id[k]) & (np.abs(labels.t_ns - labels.t_ns[k]) < 350_000_000)
            if labels.category[k] != "car" or near.sum() < 5:
                continue
            velocity = np.polyfit((labels.t_ns[near] - labels.t_ns[k]) / 1e9, labels.center_m[near], 1)[0]
            speed = float(np.linalg.norm(velocity[:2]))
            if speed < 5.0:
                continue
            args = labels.size_m[k], labels.yaw_rad[k]
            mine = points_in_box(xyz, labels.center_m[k] + [0, 0, 0.3], args[0] + [0.3 * speed, 0.6, 0.0], args[1])
            total += mine.sum()
            for which, then in enumerate((labels.t_ns[k], stamp)):
                moved = xyz[mine] - ((t_ns[mine] - then) / 1e9)[:, None] * velocity
                inside[which] += points_in_box(moved, labels.center_m[k], *args, margin_m=0.05).sum()
    assert total > 2000
    assert inside[0] / total > 0.98
    assert inside[1] / total < 0.92


@pytest.mark.parametrize(
    ("gone", "streams", "words"),
    [
        ("sensors/cameras", {"up_lidar", "down_lidar"}, "no images: sensors/cameras/ holds none"),
        (INTRINSICS, {"up_lidar", "down_lidar"}, f"images of 1 cameras left out: {INTRINSICS} is missing"),
        ("sensors/lidar", {"ring_front_center"}, "no sweeps: sensors/lidar/ holds none"),
        (ANNOTATIONS, {"ring_front_center", "up_lidar", "down_lidar"}, f"no labels: {ANNOTATIONS} is missing"),
    ],
)
def test_parts_may_be_missing(folder: Path, gone: str, streams: set[str], words: str) -> None:
    if (folder / gone).is_dir():
        shutil.rmtree(folder / gone)
    else:
        (folder / gone).unlink()
    log = open_log(folder)
    assert set(log.streams) == streams
    assert any(note.startswith(words) for note in log.notes), log.notes
    assert (log.labels is None) == (gone == ANNOTATIONS)
