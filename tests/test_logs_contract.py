"""The contract of log readers, on one world with exact truth that is written in every format."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_encoders import argoverse, kitti, kitti_object, native, nuscenes, pandaset, ros, waymo, waymo_parquet
from log_encoders.world import labels_at, world_log

from log2sim.datatypes import CATEGORIES, Labels, Log, Stream, Sweep
from log2sim.errors import ConfigError, Log2SimError, LogError, RecordError
from log2sim.files import plugins
from log2sim.files.images import decode_image
from log2sim.files.processes import map_in_processes
from log2sim.geometry import NS_PER_S, Array, apply, inverse, project
from log2sim.localization.replaced import replace_poses, shift_stream
from log2sim.logs.checks import list_calibration_problems, list_time_problems
from log2sim.logs.opening import Reopening, open_log
from log2sim.perception.lidar.cloud import deskew, transform_rigidly

# Opening may read the index, and where a size is stated nowhere else the first image; images are nearly all of a log.
MAX_SHARE_READ = 0.25
NEAR_M = 0.7
IO = Path("/proc/self/io")


def encode_two_below(encode: Callable[[Log, Path], Path]) -> Callable[[Log, Path], Path]:
    """Several sequences are folders, or files, side by side."""

    def encode_two(log: Log, folder: Path) -> Path:
        for name in ("one", "two"):
            encode(replace(log, name=name), folder)
        return folder

    return encode_two


def encode_two_drives(log: Log, folder: Path) -> Path:
    kitti.encode_raw(log, folder, 1)
    return kitti.encode_raw(log, folder, 2)


def encode_two_sequences(log: Log, folder: Path) -> Path:
    kitti.encode_tracking(log, folder, 0)
    return kitti.encode_tracking(log, folder, 1)


@dataclass(frozen=True)
class Encoder:
    """How the world is written in a format, and what the format cannot hold.

    `encode` returns the path for `open_log`. `sensors` maps the reader's names to those of the world. `records` are globs,
    below that path, of the files with the records of a sensor, one each, in order; none where a file holds many records.
    `stamps` is whether stamps are kept, `motion` whether the ego moves, `labels` whether there are 3D labels.
    `tolerance_m` is how exactly points and boxes are stored. `most_lost` records are lost by damage in a file of many records.
    """

    encode: Callable[[Log, Path], Path]
    sensors: Mapping[str, str] = field(default_factory=lambda: {"front": "front", "top": "top"})
    records: Mapping[str, str] = field(default_factory=dict)
    several: Callable[[Log, Path], Path] | None = None
    stamps: bool = True
    motion: bool = True
    labels: bool = True
    tolerance_m: float = 0.03
    most_lost: int = 2


KITTI = {"image_02": "front", "velodyne": "top"}
ENCODERS: dict[str, Encoder] = {
    "log2sim": Encoder(
        native.encode, records={"front": "front/*.jpg", "top": "top/*.npz"}, several=encode_two_below(native.encode)
    ),
    "kitti": Encoder(
        kitti.encode_raw, KITTI, {"image_02": "*/*/image_02/data/*", "velodyne": "*/*/velodyne_points/data/*"}, encode_two_drives
    ),
    "kitti-tracking": Encoder(
        kitti.encode_tracking, KITTI, {"image_02": "*/image_02/*/*", "velodyne": "*/velodyne/*/*"}, encode_two_sequences,
        stamps=False,
    ),
    "kitti-object": Encoder(
        kitti_object.encode, KITTI, {"image_02": "*/image_2/*", "velodyne": "*/velodyne/*"}, stamps=False, motion=False
    ),
    "pandaset": Encoder(
        pandaset.encode, {"front_camera": "front", "pandar64": "top"},
        {"front_camera": "camera/front_camera/*.jpg", "pandar64": "lidar/*.pkl.gz"}, encode_two_below(pandaset.encode),
    ),
    "waymo": Encoder(waymo.encode, {"FRONT": "front", "LIDAR_TOP": "top"}, several=encode_two_below(waymo.encode)),
    "waymo-parquet": Encoder(
        waymo_parquet.encode, {"FRONT": "front", "LIDAR_TOP": "top"}, several=encode_two_below(waymo_parquet.encode),
        most_lost=10,  # all of a row group, which is compressed as a whole
    ),
    "ros": Encoder(ros.encode, several=encode_two_below(ros.encode), labels=False),
    "nuscenes": Encoder(
        nuscenes.encode_world, records={"front": "samples/front/*", "top": "samples/top/*"},
        several=encode_two_below(nuscenes.encode_world),
    ),
    "argoverse2": Encoder(
        argoverse.encode, {"ring_front_center": "front", "up_lidar": "top"},
        {"ring_front_center": "sensors/cameras/ring_front_center/*.jpg", "up_lidar": "sensors/lidar/*.feather"},
        encode_two_below(argoverse.encode), tolerance_m=0.05,
    ),
}  # fmt: skip


@pytest.fixture(scope="module", params=ENCODERS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def case(name: str) -> Encoder:
    return ENCODERS[name]


@pytest.fixture(scope="module")
def base(name: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp(f"contract-{name}") / "base"


@pytest.fixture(scope="module")
def path(case: Encoder, base: Path) -> Path:
    return case.encode(world_log(), base)


@pytest.fixture(scope="module")
def log(name: str, path: Path) -> Log:
    return open_log(path, format=name)


@pytest.fixture
def copy(base: Path, path: Path, tmp_path: Path) -> Path:
    """The log once more, to be spoiled or to be read for the first time."""
    shutil.copytree(base, tmp_path / "base")
    return tmp_path / "base" / path.relative_to(base)


def files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else [p for p in sorted(path.rglob("*")) if p.is_file()]


def truth_ns(case: Encoder, log: Log, t_ns: Any) -> Any:
    """Stamps of the world for those of a log."""
    if case.stamps:
        return t_ns
    camera = next(n for n, w in case.sensors.items() if w == "front")
    start = int(world_log().streams["front"].t_ns[0])
    if case.motion:
        return t_ns - int(log.streams[camera].t_ns[0]) + start
    return world_log().streams["front"].t_ns[np.searchsorted(log.streams[camera].t_ns, t_ns)]


def points_in_map(log: Log, lidar: str, i: int) -> tuple[Array, np.ndarray]:
    """Points of a sweep in the map frame, each by the pose of its own time, and these times."""
    sweep: Sweep = log.streams[lidar].read(i)
    t_ns = np.full(len(sweep.xyz_m), sweep.stamp_ns) if sweep.t_ns is None else sweep.t_ns
    if sweep.frame == "map":
        return np.asarray(sweep.xyz_m, dtype=np.float64), t_ns
    moving = sweep.t_ns is not None and sweep.compensated_ns is None
    xyz = deskew(log, lidar, sweep, t_ns) if moving else transform_rigidly(log, lidar, sweep)
    assert xyz is not None, f"no pose of sweep {i}"
    return xyz, t_ns


def in_box(points: Array, labels: Labels, track: str, t_ns: Any) -> tuple[Array, Array]:
    """Points (N, 3) in the axes of a track's box at their times (N,), and the size of the box."""
    center, size, yaw = labels_at(labels, t_ns, track)
    d, c, s = points - center, np.cos(yaw), np.sin(yaw)
    return np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]], axis=1), size


def points_on(log: Log, lidar: str, i: int, track: str) -> tuple[Array, Array]:
    """Points on and around a labeled object in its box's axes, clear of the ground, and half the box's size.

    Only where the box is known at the time of the points: no label is extrapolated.
    """
    assert log.labels is not None
    xyz, t_ns = points_in_map(log, lidar, i)
    rows = log.labels.track_id == track
    known = (t_ns >= log.labels.t_ns[rows].min()) & (t_ns <= log.labels.t_ns[rows].max())
    local, size = in_box(xyz[known], log.labels, track, t_ns[known])
    near = (np.abs(local[:, :2]) < size[:2] / 2 + NEAR_M).all(axis=1) & (local[:, 2] > 0.2 - size[2] / 2)
    return local[near], size / 2


@pytest.mark.matrix
def test_a_sound_log_gets_no_line_of_damage(log: Log) -> None:
    assert list_time_problems(log) == []
    assert list_calibration_problems(log) == []


def test_every_sensor_says_where_its_calibration_stands(log: Log, path: Path) -> None:
    assert set(log.calibrations) >= set(log.cameras)
    assert all(Path(path.parts[-1]).stem in place for place in log.calibrations.values())


def test_opening_reads_no_sweep_and_no_image(name: str, path: Path, copy: Path) -> None:
    if not IO.exists():
        pytest.skip("counts the bytes that this process reads by /proc, which Linux has")
    open_log(path, format=name)  # imports the modules of the reader
    before = bytes_read()
    open_log(copy, format=name)
    read = bytes_read() - before
    total = sum(file.stat().st_size for file in files_of(copy))
    assert read < MAX_SHARE_READ * total, f"{read} of {total} bytes"


def bytes_read() -> int:
    return int(IO.read_text().split()[1])


def test_its_format_is_recognized(name: str, path: Path) -> None:
    assert open_log(path).format == name


def test_what_was_made_of_a_log_reads_the_same_in_another_process(name: str, copy: Path) -> None:
    """It is opened there again, so that no open file and no lock is sent; another log in its place is refused."""
    cloudpickle = pytest.importorskip("cloudpickle")
    opened = open_log(copy, format=name)
    later = {n: shift_stream(stream, 1000) for n, stream in opened.streams.items()}
    made = replace_poses(opened, opened.ego).changed(streams=later) if opened.ego is not None else opened
    sent = cloudpickle.dumps(made)
    there = pickle.loads(sent)
    for sensor, stream in made.streams.items():
        assert np.array_equal(stream.t_ns, there.streams[sensor].t_ns)
        here, other = stream.read(1), there.streams[sensor].read(1)
        pairs = vars(here).items() if isinstance(here, Sweep) else [("", here)]
        for column, value in pairs:
            assert np.array_equal(value, getattr(other, column) if column else other)
    assert (made.labels is None) == (there.labels is None)
    assert made.labels is None or np.array_equal(made.labels.center_m, there.labels.center_m)
    assert made.ground_z_ego_m == there.ground_z_ego_m
    with pytest.raises(LogError, match="another log"):
        Reopening(str(copy), name, plugins.load("log", name).sequences(copy)[0], False, "of another")()


@pytest.mark.matrix
def test_several_sequences_are_listed_and_each_opens(name: str, case: Encoder, tmp_path: Path) -> None:
    if case.several is None:
        pytest.skip("the layout has one sequence")
    root = case.several(world_log(), tmp_path)
    reader = plugins.load("log", name)
    sequences = reader.sequences(root)
    assert len(sequences) == 2
    assert sequences == sorted(sequences)
    with pytest.raises(ConfigError, match="2 sequences; choose one with --sequence") as caught:
        open_log(root)
    for sequence in sequences:
        assert sequence in str(caught.value)
        assert len(open_log(root, sequence=sequence).streams) >= 2
    with pytest.raises(ConfigError, match="no sequence 'three'"):
        open_log(root, sequence="three")


def test_stamps_are_increasing_whole_nanoseconds_of_the_world(case: Encoder, log: Log) -> None:
    world = world_log()
    for name, stream in log.streams.items():
        assert stream.name == name
        assert stream.t_ns.dtype == np.int64
        assert (np.diff(stream.t_ns) > 0).all()
        known = case.sensors.get(name)
        if known is not None:
            assert len(stream.t_ns) == len(world.streams[known].t_ns)
    if case.stamps:
        camera = next(n for n, w in case.sensors.items() if w == "front")
        # Float seconds of some formats keep a quarter of a microsecond.
        assert np.abs(log.streams[camera].t_ns - world.streams["front"].t_ns).max() <= 1000


def test_sensors_and_streams_have_the_same_names(case: Encoder, log: Log) -> None:
    assert set(log.streams) == set(log.cameras) | set(log.lidars)
    assert set(case.sensors) <= set(log.streams)
    assert all(camera.name == name for name, camera in log.cameras.items())
    assert all(lidar.name == name for name, lidar in log.lidars.items())
    assert log.reference_camera is None or log.reference_camera in log.cameras


def test_images_have_the_size_of_their_calibration(log: Log) -> None:
    for name, camera in log.cameras.items():
        stream = log.streams[name]
        for i in (0, len(stream.t_ns) - 1):
            image = stream.read(i)
            assert image.shape == (camera.height_px, camera.width_px, 3)
            assert image.dtype == np.uint8
            if stream.encoded is not None:
                decoded = decode_image(stream.encoded(i), name, (camera.width_px, camera.height_px))
                np.testing.assert_array_equal(decoded, image)


def test_sweeps_are_finite_points_with_times_of_their_turn(log: Log) -> None:
    for name in log.lidars:
        stream = log.streams[name]
        for i in range(len(stream.t_ns)):
            sweep = stream.read(i)
            assert sweep.stamp_ns == stream.t_ns[i]
            assert sweep.xyz_m.ndim == 2
            assert sweep.xyz_m.shape[1] == 3
            assert sweep.xyz_m.dtype in (np.float32, np.float64)
            assert len(sweep.xyz_m) > 100
            assert np.isfinite(sweep.xyz_m).all()
            assert sweep.frame in ("lidar", "map")
            assert sweep.frame == "lidar" or sweep.compensated_ns is None
            if sweep.t_ns is not None:
                assert sweep.t_ns.dtype == np.int64
                assert sweep.t_ns.shape == (len(sweep.xyz_m),)
                assert np.abs(sweep.t_ns - sweep.stamp_ns).max() <= 0.11 * NS_PER_S


def test_sensors_move_as_in_the_world(case: Encoder, log: Log) -> None:
    """From its place at its first record, as the map frames of log and world differ."""
    if not case.motion:
        pytest.skip("the layout has single frames")
    for name, known in case.sensors.items():
        t_ns = log.streams[name].t_ns[1:-1]
        ours, valid = log.map_T_sensor(name, t_ns)
        assert valid.all()
        theirs, _ = world_log().map_T_sensor(known, truth_ns(case, log, t_ns))
        if known == "top":  # the mounts of some formats are fixed: positions alone
            ours, theirs = ours[:, :3, 3], theirs[:, :3, 3]
            np.testing.assert_allclose(distances(ours), distances(theirs), atol=0.03)
        else:
            np.testing.assert_allclose(inverse(ours[:1]) @ ours, inverse(theirs[:1]) @ theirs, atol=0.02)


def distances(points: Array) -> Array:
    return np.asarray(np.linalg.norm(points[:, None] - points, axis=-1))


def test_the_road_is_where_the_ego_stands(case: Encoder, log: Log) -> None:
    assert log.ego is not None
    for name in case.sensors.keys() & log.lidars.keys():
        xyz, _ = points_in_map(log, name, 4)
        map_T_ego = log.ego.at(log.streams[name].t_ns[4])[0][0]
        ego = apply(inverse(map_T_ego), xyz)
        around = np.hypot(ego[:, 0], ego[:, 1]) < 15
        assert np.median(ego[around, 2]) == pytest.approx(log.ground_z_ego_m, abs=0.05)


def test_labels_are_of_the_world(case: Encoder, log: Log) -> None:
    if not case.labels:
        assert log.labels is None or len(log.labels.t_ns) == 0
        return
    labels = log.labels
    assert labels is not None
    assert labels.t_ns.dtype == np.int64
    assert (labels.size_m > 0).all()
    assert set(labels.category.tolist()) <= set(CATEGORIES)
    assert {"car", "pedestrian"} <= set(labels.category.tolist())
    for track in np.unique(labels.track_id):
        assert (np.diff(labels.t_ns[labels.track_id == track]) > 0).all()
    for column in (labels.center_m, labels.size_m, labels.yaw_rad):
        assert np.isfinite(column).all()
    sizes = {tuple(np.round(size, 1)) for size in labels.size_m}
    assert {(4.4, 1.8, 1.5), (4.2, 1.7, 1.6)} <= sizes


@pytest.mark.matrix
def test_points_of_labeled_objects_lie_in_their_boxes(case: Encoder, log: Log) -> None:
    if not case.labels or log.labels is None:
        pytest.skip("the format has no labels")
    for name in case.sensors.keys() & log.lidars.keys():
        found: dict[str, list[float]] = {}
        for i in range(1, len(log.streams[name].t_ns) - 1):
            for track in np.unique(log.labels.track_id):
                local, half = points_on(log, name, i, str(track))
                kind = str(log.labels.category[log.labels.track_id == track][0])
                found.setdefault(kind, []).extend((np.abs(local) - half).max(axis=1))
        assert len(found["car"]) > 200
        # Interpolation of labels on a curve, and storage, move them a little.
        assert max(found["car"]) < case.tolerance_m, f"{max(found['car']):.3f} m outside of its box"
        assert np.mean(np.array(found["pedestrian"]) < case.tolerance_m) > 0.95


def test_the_image_shows_cars_where_lidar_points_are_on_them(case: Encoder, log: Log) -> None:
    if not case.labels or log.labels is None:
        pytest.skip("the format has no labels")
    camera = next(n for n, w in case.sensors.items() if w == "front")
    lidar = next(n for n, w in case.sensors.items() if w == "top")
    seen = above = total = 0
    for i in range(2, len(log.streams[camera].t_ns) - 2):
        t_ns, image = int(log.streams[camera].t_ns[i]), log.streams[camera].read(i)
        sweep = int(np.argmin(np.abs(log.streams[lidar].t_ns - t_ns)))
        for track in cars(log.labels):
            local, half = points_on(log, lidar, sweep, track)
            # Between the wheels' middle and the windows.
            paint = np.abs(local[:, 2] + 0.15 * half[2]) < 0.35 * half[2]
            uv = on_image(log, camera, t_ns, local[paint], track)
            air = on_image(log, camera, t_ns, local[paint] + [0.0, 0.0, 2 * half[2]], track)
            if len(uv) < 10:
                continue
            total += len(uv)
            seen += is_red(image, uv).sum()
            above += is_red(image, air).sum()
            for box in image_boxes(log, camera, t_ns, uv):
                assert (uv > box[:2] - 4).all()
                assert (uv < box[2:] + 4).all()
    assert total > 200
    # The rest are wheels, lights and who walks in front.
    assert seen > 0.7 * total
    assert above < 0.05 * total


def cars(labels: Labels) -> list[str]:
    return [str(t) for t in np.unique(labels.track_id[labels.category == "car"])]


def on_image(log: Log, camera: str, t_ns: int, local: Array, track: str) -> Array:
    """Pixels (n, 2) of points that are fixed to an object, where it is at a stamp."""
    assert log.labels is not None
    center, _, yaw = labels_at(log.labels, t_ns, track)
    c, s = np.cos(yaw[0]), np.sin(yaw[0])
    xyz = local @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + center
    map_T_cam = log.map_T_sensor(camera, t_ns)[0][0]
    uv, valid = project(log.cameras[camera], apply(inverse(map_T_cam), xyz))
    return uv[valid]


def is_red(image: np.ndarray, uv: Array) -> np.ndarray:
    rows, columns = np.clip(uv[:, 1], 0, image.shape[0] - 1), np.clip(uv[:, 0], 0, image.shape[1] - 1)
    blue, green, red = image[rows.astype(int), columns.astype(int)].astype(float).T
    return np.asarray(red > 1.6 * np.maximum(blue, green))


def image_boxes(log: Log, camera: str, t_ns: int, uv: Array) -> list[Array]:
    """The labeled image box around the middle of points, if there is one."""
    labels = log.image_labels.get(camera)
    if labels is None:
        return []
    middle = np.median(uv, axis=0)
    boxes = labels.box_px[(labels.t_ns == t_ns) & (labels.category == "car")]
    around = [b for b in boxes if (middle > b[:2]).all() and (middle < b[2:]).all()]
    assert len(around) >= 1
    return around[:1] if len(around) == 1 else []


def test_a_damaged_record_costs_that_record_only(name: str, case: Encoder, log: Log, copy: Path) -> None:
    if not case.records:
        pytest.skip("a file holds many records")
    for stream, pattern in case.records.items():
        files = sorted(copy.glob(pattern))
        assert len(files) == len(log.streams[stream].t_ns)
        files[3].write_bytes(files[3].read_bytes()[: files[3].stat().st_size // 2 - 1])
        files[5].unlink()
    damaged = open_log(copy, format=name)
    assert damaged.digest != log.digest
    for stream in case.records:
        failed = {
            int(t) for i, t in enumerate(damaged.streams[stream].t_ns) if not is_readable(damaged.streams[stream], i)
        }
        t_ns = log.streams[stream].t_ns
        assert int(t_ns[3]) in failed
        # A file that is not there is a gap or a record that cannot be read.
        assert failed <= {int(t_ns[3]), int(t_ns[5])}
        assert set(t_ns.tolist()) - set(damaged.streams[stream].t_ns.tolist()) <= {int(t_ns[5])}


def test_damage_within_a_file_of_many_records_costs_a_few_of_them(
    name: str, case: Encoder, log: Log, copy: Path
) -> None:
    if case.records:
        pytest.skip("a file holds one record")
    largest = max(files_of(copy), key=lambda file: file.stat().st_size)
    data = bytearray(largest.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(255 - b for b in data[middle : middle + 64])
    largest.write_bytes(data)
    damaged = open_log(copy, format=name)
    lost = 0
    for stream in log.streams:
        for i, t_ns in enumerate(log.streams[stream].t_ns.tolist()):
            where = np.flatnonzero(damaged.streams[stream].t_ns == t_ns)
            if len(where) and is_readable(damaged.streams[stream], int(where[0])):
                same = content(damaged.streams[stream].read(int(where[0]))), content(log.streams[stream].read(i))
                # Nothing but the damaged bytes themselves may differ, where the format has no check sum.
                lost += not np.array_equal(*same)
            else:
                lost += 1
    assert 1 <= lost <= case.most_lost


def is_readable(stream: Stream, i: int) -> bool:
    try:
        stream.read(i)
    except RecordError as error:
        return "\n" in str(error)  # the problem of a record is one line
    return True


@pytest.mark.parametrize("share", ["threads", "processes"])
def test_records_that_are_read_at_once_are_those_that_are_read_one_by_one(
    name: str, path: Path, log: Log, share: str
) -> None:
    fresh = open_log(path, format=name)
    asked = [(s, i) for s, stream in fresh.streams.items() for i in range(0, len(stream.t_ns), 2)]
    for stream in fresh.streams.values():  # a process that is forked has the files open that this one opened
        stream.read(0)

    def read(record: tuple[str, int]) -> np.ndarray:
        return content(fresh.streams[record[0]].read(record[1]))

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(read, 2 * asked) if share == "threads" else map_in_processes(read, 2 * asked, 3))
    expected = [content(log.streams[s].read(i)) for s, i in asked]
    assert all(np.array_equal(a, b) for a, b in zip(found, 2 * expected, strict=True))


def content(record: Any) -> np.ndarray:
    return np.asarray(record.xyz_m if isinstance(record, Sweep) else record)


def test_other_folders_and_files_are_refused_in_one_line(name: str, case: Encoder, path: Path, tmp_path: Path) -> None:
    reader = plugins.load("log", name)
    (tmp_path / "empty").mkdir()
    (tmp_path / "words.txt").write_text("no log")
    for other in (tmp_path / "empty", tmp_path / "words.txt", tmp_path / "nothing"):
        if not other.is_file():
            assert not reader.matches(other)
            assert reader.sequences(other) == []
        with pytest.raises(LogError) as caught:
            open_log(other, format=name)
        assert str(other) in str(caught.value)
        assert "\n" not in str(caught.value)
    for suffix in reader.suffixes:
        file = tmp_path / f"words{suffix}"
        file.write_text("no log")
        with pytest.raises(Log2SimError) as refused:
            open_log(file, format=name)
        assert "\n" not in str(refused.value)
