"""What can be wrong with a bag: damage, missing parts, topics that say too little, settings that say something else."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from log_encoders import ros
from log_encoders.ros import Maker, Message, Style
from log_encoders.world import world_log

from log2sim import open_log
from log2sim.datatypes import Log, Stream
from log2sim.errors import ConfigError, LogError, RecordError
from log2sim.geometry import NS_PER_S, transform
from log2sim.logs.ros import bag
from log2sim.logs.ros.bag import open_container
from log2sim.logs.ros.containers import ChunkedFile


def bag_of(folder: Path, style: Style, keep: Callable[[Message], Message | None] = lambda m: m) -> Path:
    """The world's messages, each as `keep` returns it, as a bag."""
    kept = (keep(message) for message in Maker(world_log(), style))
    return ros.write([m for m in kept if m is not None], folder, "world", style)  # type: ignore[arg-type]


def with_settings(path: Path, text: str) -> Path:
    path.with_name(f"{path.stem}.topics.toml").write_text(text)
    return path


def readable(stream: Stream) -> list[bool]:
    found = []
    for i in range(len(stream.t_ns)):
        try:
            stream.read(i)
            found.append(True)
        except RecordError as error:
            # The problem of a record is one line.
            found.append("\n" in str(error))
    return found


def table(log: Log) -> dict[str, tuple[str, str]]:
    return {t["topic"]: (t["role"], t["reason"]) for t in log.details["topics"]}


@pytest.mark.parametrize("style", [Style("bag", "lz4"), Style("mcap", "storage")], ids=["bag", "mcap"])
def test_a_damaged_chunk_costs_its_records_only(style: Style, tmp_path: Path) -> None:
    path = bag_of(tmp_path, style)
    whole = open_log(path)
    data = bytearray(path.read_bytes())
    magic = b"\x04\x22\x4d\x18" if style.container == "bag" else b"\x28\xb5\x2f\xfd"
    starts = [match.start() for match in re.finditer(re.escape(magic), data)]
    assert len(starts) > 1
    data[starts[-1] + 40 : starts[-1] + 60] = bytes(20)
    path.write_bytes(data)
    log = open_log(path)
    lost = 0
    for name, stream in log.streams.items():
        assert len(stream.t_ns) == len(whole.streams[name].t_ns)
        good = np.array(readable(stream))
        lost += int((~good).sum())
        np.testing.assert_array_equal(stream.t_ns[good], whole.streams[name].t_ns[good])
        # What is lost stands where it was, but for what the recorder's delay varies.
        assert np.abs(stream.t_ns - whole.streams[name].t_ns).max() < 0.02 * NS_PER_S
    assert 0 < lost < sum(len(s.t_ns) for s in log.streams.values()) - 4
    assert any("messages are damaged, first at stamp" in note for note in log.notes)


@pytest.mark.parametrize("container", ["bag", "mcap"])
def test_a_truncated_file_keeps_what_is_before_the_cut(container: str, tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style(container))
    whole = open_log(path)
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    log = open_log(path)
    count = sum(sum(readable(stream)) for stream in log.streams.values())
    assert 0 < count < sum(len(s.t_ns) for s in whole.streams.values())
    assert log.notes


@pytest.mark.parametrize("container", ["bag", "mcap"])
def test_a_chunk_that_unpacks_to_more_than_it_says_is_damaged(container: str, tmp_path: Path) -> None:
    """The first chunk says that it ends soon after its first message; nothing is unpacked beyond that."""
    path = bag_of(tmp_path, Style("bag", "bz2") if container == "bag" else Style("mcap", "storage"))
    says = int(open_container(path).entries.place[0]) + 200
    data = bytearray(path.read_bytes())
    if container == "bag":
        place = data.index(b"size=") + 5
        data[place : place + 4] = struct.pack("<I", says)
    else:
        place = 8
        while data[place] != 6:
            place += 9 + struct.unpack_from("<Q", data, place + 1)[0]
        data[place + 25 : place + 33] = struct.pack("<Q", says)
    path.write_bytes(data)
    file = open_container(path)
    assert isinstance(file, ChunkedFile)
    file.message(0, 12)
    assert file._partial is not None
    assert len(file._partial.data) <= says + 1
    with pytest.raises(ValueError, match=f"unpacks to more than {says} bytes"):
        file.message(0)


def test_files_that_are_no_bags_are_refused_in_one_line(tmp_path: Path) -> None:
    import sqlite3

    for name, data, message in [
        ("a.bag", b"", "is empty"), ("b.bag", b"#ROSBAG V1.2\n", "expected a ROS 1 bag of that version"),
        ("c.mcap", b"words", "neither a ROS 1 bag nor MCAP"), ("d.db3", b"SQLite format 3\0" + bytes(90), "not a readable rosbag2 database"),
    ]:  # fmt: skip
        (tmp_path / name).write_bytes(data)
        with pytest.raises(LogError, match=message):
            open_log(tmp_path / name)
    for number, statement in enumerate(
        ("CREATE TABLE topics(id)", "CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id")
    ):
        path = tmp_path / f"e{number}.db3"
        with sqlite3.connect(path) as database:
            database.execute(statement)
        database.close()
        with pytest.raises(LogError, match=r"no table '(topics|messages)' in it"):
            open_log(path)


def test_topics_have_roles_with_reasons(tmp_path: Path) -> None:
    names = {"/top/points": "/sensing/top/points_raw"}
    path = bag_of(tmp_path, Style("mcap"), lambda m: (m[0], m[1], names.get(m[2], m[2]), *m[3:]))
    roles = table(open_log(path))
    assert roles["/front/image_raw/compressed"] == ("camera front", "by its type, calibrated by /front/camera_info")
    assert roles["/front/camera_info"][0] == "calibration of front"
    assert roles["/sensing/top/points_raw"] == ("lidar top", "by its type, in the frame 'top'")
    assert roles["/tf"][0] == roles["/tf_static"][0] == "tf"


def test_a_camera_without_calibration_is_left_out_and_says_how_to_give_it(tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style("bag"), lambda m: None if m[2] == "/front/camera_info" else m)
    log = open_log(path)
    assert set(log.streams) == {"top"}
    note = next(note for note in log.notes if "no CameraInfo belongs to it" in note)
    assert "cameras.front.intrinsics in the settings" in note
    K = world_log().cameras["front"].K
    given = (
        f"width_px = 480, height_px = 300, fx_px = {K[0, 0]}, fy_px = {K[1, 1]}, cx_px = {K[0, 2]}, cy_px = {K[1, 2]}"
    )
    settings = f'[cameras.eye]\ntopic = "/front/image_raw/compressed"\nintrinsics = {{ {given} }}\n'
    named = open_log(with_settings(path, settings))
    assert set(named.streams) == {"eye", "top"}
    np.testing.assert_array_equal(named.cameras["eye"].K, K)
    np.testing.assert_array_equal(named.streams["eye"].read(0), world_log().streams["front"].read(0))


def test_the_source_of_the_poses_is_chosen_in_order_and_can_be_told(tmp_path: Path) -> None:
    kinds = ("tf", "odometry", "pose")
    messages = [m for kind in kinds for m in Maker(world_log(), Style("bag", poses=kind)) if kind == "tf" or "/" + kind in m[2] or "pose" in m[2]]  # fmt: skip
    path = ros.write(iter(messages), tmp_path, "world", Style("bag"))
    log = open_log(path)
    assert [(c["source"], c["used"]) for c in log.details["poses"]] == [
        ("tf", True),
        ("odometry", False),
        ("pose", False),
    ]
    told = open_log(with_settings(path, '[poses]\nsource = "pose"\n'))
    assert [(c["source"], c["topic"]) for c in told.details["poses"]] == [("pose", "/localization/pose")]
    nothing = open_log(with_settings(path, '[poses]\nsource = "none"\n'))
    assert nothing.ego is None


@pytest.mark.real
@pytest.mark.parametrize(("name", "topic"), [
    ("example-lz4.bag", r"/turtle2/color_sensor \(turtlesim/msg/Color, 1344\)"), ("example-bz2.bag", r"/tf \(tf/msg/tfMessage, 2688\)"),
    ("ego_db3", r"/localization/kinematic_state \(nav_msgs/msg/Odometry, 2130\)"),
])  # fmt: skip
def test_recorded_bags_without_sensors_list_their_topics(name: str, topic: str) -> None:
    source = SHARED / "data" / "ros" / name
    if not source.exists():
        pytest.skip("recorded bags are not beside this checkout (../shared/data/ros)")
    with pytest.raises(LogError, match=topic) as caught:
        open_log(source)
    assert "\n" not in str(caught.value)


def test_header_stamps_that_are_zero_or_of_another_clock_are_noted(tmp_path: Path) -> None:
    def spoiled(message: Message) -> Message:
        header = getattr(message[4], "header", None)
        if message[2].startswith("/front/image"):
            header.stamp = replace(header.stamp, sec=0, nanosec=0)
        if message[2] == "/top/points":
            header.stamp = replace(header.stamp, sec=header.stamp.sec - 1000)
        return message

    path = bag_of(tmp_path, Style("mcap", poses="odometry"), spoiled)
    log = open_log(path)
    assert any("/front/image_raw/compressed: its header stamps are all 0" in note for note in log.notes)
    assert any("/top/points: its header stamps are" in note and "not synchronized" in note for note in log.notes)
    np.testing.assert_array_equal(log.streams["front"].t_ns, world_log().streams["front"].t_ns + ros.IMAGE_DELAY_NS)
    settings = '[lidars.top]\ntopic = "/top/points"\nstamps = "recorded"\n'
    told = open_log(with_settings(path, settings))
    np.testing.assert_array_equal(told.streams["top"].t_ns, world_log().streams["top"].t_ns + ros.OTHER_DELAY_NS)


def test_no_more_than_a_limit_is_kept_of_what_is_read_at_opening(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = bag_of(tmp_path, Style())
    monkeypatch.setattr(bag, "MAX_COLLECTED_BYTES", 5000)
    log = open_log(path)
    assert any("have more than 5000 bytes; the rest is not read" in note for note in log.notes)
    monkeypatch.setattr(bag, "MAX_INDEX_BYTES", 40)
    damaged = open_log(path)
    assert any("/tf_static: 1 of 1 messages are damaged" in note for note in damaged.notes)


def test_an_imu_whose_heading_is_not_the_course_is_noted(tmp_path: Path) -> None:
    def turned(message: Message) -> Message:
        if message[2] == "/gnss/imu":
            q = message[4].orientation
            q.w, q.x, q.y, q.z = (0.7071067811865476 * v for v in (q.w - q.z, q.x - q.y, q.y + q.x, q.z + q.w))
        return message

    placed = replace(
        world_log().map, latitude_deg=48.0, longitude_deg=11.0, altitude_m=0.0, projection="+proj=utm +zone=32"
    )
    world = replace(world_log(), map=placed)
    style = Style("bag", poses="gnss", ego_T_base=transform(np.eye(3), [0.3, 0.0, 0.9]))
    for turn, expected in ((lambda m: m, False), (turned, True)):
        folder = tmp_path / str(expected)
        path = ros.write((turn(m) for m in Maker(world, style)), folder, "world", style)
        log = open_log(path)
        assert any("degrees off the direction of travel" in note for note in log.notes) == expected


WRONG_SETTINGS = {
    '[cameras.front]\ntopic = "/front/image"': "'cameras.front.topic' is '/front/image', but .*did you mean '/front/image_raw/compressed'",
    '[lidars.top]\ntopic = "/front/camera_info"': "holds sensor_msgs/msg/CameraInfo, expected .*sensor_msgs/msg/PointCloud2",
    '[lidars.top]\ntopik = "/top/points"': "unknown key 'lidars.top.topik'; did you mean 'lidars.top.topic'",
    '[poses]\nsource = "gnss"': "asks for source 'gnss', which gives none",
    "[ego]\norigin_m = [1.0, 2.0]": "'ego.origin_m' has 2 values",
    'reference_camera = "rear"': "'reference_camera' is 'rear'; there are: front",
    '[[static_transforms]]\nparent = "a"\nchild = "b"\nrotation_wxyz = [1.0, 1.0, 0.0, 0.0]': "has norm 1.41421",
}  # fmt: skip


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bag_of(tmp_path_factory.mktemp("plain"), Style("bag"))


@pytest.mark.parametrize("text", WRONG_SETTINGS)
def test_wrong_settings_are_named(text: str, plain: Path) -> None:
    with pytest.raises(ConfigError, match=WRONG_SETTINGS[text]) as caught:
        open_log(with_settings(plain, text))
    assert "\n" not in str(caught.value)
    assert "world.topics.toml" in str(caught.value)
    plain.with_name("world.topics.toml").unlink()
