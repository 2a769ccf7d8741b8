"""What can be wrong with a bag: damage, missing parts, topics that say too little, settings that say something else."""

from __future__ import annotations

import bz2
import re
import shutil
import sqlite3
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import SHARED
from log_encoders import ros
from log_encoders.ros import Maker, Message, Style
from log_encoders.world import world_log
from typer.testing import CliRunner

from log2sim import open_log
from log2sim.cli import app
from log2sim.datatypes import Log, Stream, Sweep
from log2sim.errors import ConfigError, LogError, MissingExtra, RecordError
from log2sim.geometry import NS_PER_S, RollingShutter, transform
from log2sim.logs.ros import bag, containers, frames
from log2sim.logs.ros import messages as ros_messages
from log2sim.logs.ros.bag import Topic, find_recordings, open_container
from log2sim.logs.ros.containers import Chunk, ChunkedFile, decompress
from log2sim.logs.ros.frames import measure_ground_m
from log2sim.logs.ros.messages import TopicSettings, decode_bytes, definition_fields, note_other_clocks
from log2sim.logs.ros.roles import assign_roles

CONTAINERS = ("bag", "db3", "mcap")


def bag_of(folder: Path, style: Style, keep: Callable[[Message], Message | None] = lambda m: m) -> Path:
    """The world's messages, each as `keep` returns it, as a bag."""
    kept = (keep(message) for message in Maker(world_log(), style))
    return ros.write([m for m in kept if m is not None], folder, "world", style)  # type: ignore[arg-type]


def without(*topics: str) -> Callable[[Message], Message | None]:
    return lambda m: None if m[2] in topics else m


def renamed(names: dict[str, str]) -> Callable[[Message], Message]:
    return lambda m: (m[0], m[1], names.get(m[2], m[2]), *m[3:])


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


def file_of(path: Path) -> Path:
    return path if path.is_file() else next(path.glob("*.db3"))


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


@pytest.mark.parametrize("compression", ["", "lz4"])
def test_a_bag_that_was_not_closed_is_read_whole(compression: str, tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style("bag", compression))
    whole = open_log(path)
    data = bytearray(path.read_bytes())
    place = data.index(b"index_pos=") + len(b"index_pos=")
    data[place : place + 8] = bytes(8)
    path.write_bytes(data)
    log = open_log(path)
    assert {n: s.t_ns.tolist() for n, s in log.streams.items()} == {
        n: s.t_ns.tolist() for n, s in whole.streams.items()
    }
    assert any("its index is missing or damaged (the recording was not closed)" in note for note in log.notes)


@pytest.mark.parametrize("container", ["bag", "mcap"])
def test_a_truncated_file_keeps_what_is_before_the_cut(container: str, tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style(container))
    whole = open_log(path)
    file = file_of(path)
    file.write_bytes(file.read_bytes()[: int(0.6 * file.stat().st_size)])
    log = open_log(path)
    count = sum(sum(readable(stream)) for stream in log.streams.values())
    assert 0 < count < sum(len(s.t_ns) for s in whole.streams.values())
    assert log.notes


def test_a_database_with_damaged_pages_loses_what_is_on_them(tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style("db3"))
    whole, file = open_log(path), file_of(path)
    data = bytearray(file.read_bytes())
    middle = len(data) // 2 // 4096 * 4096
    data[middle : middle + 40 * 4096] = b"\xff" * 40 * 4096
    file.write_bytes(data)
    log = open_log(path)
    count = sum(sum(readable(stream)) for stream in log.streams.values())
    assert 0 < count < sum(len(s.t_ns) for s in whole.streams.values())
    # SQLite refuses a file that is shorter than it says.
    file.write_bytes(data[:middle])
    with pytest.raises(LogError, match="not a readable rosbag2 database: database disk image is malformed"):
        open_log(path)


def test_a_wrong_crc_is_an_error_of_the_records_of_that_chunk(tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style("mcap"))
    data = bytearray(path.read_bytes())
    # The last chunk: opcode 6, length, two stamps, size, CRC. The static transforms are in the first.
    place, chunks = 8, []
    while data[place] != 15:
        chunks += [place] * (data[place] == 6)
        place += 9 + struct.unpack_from("<Q", data, place + 1)[0]
    data[chunks[-1] + 9 + 24 : chunks[-1] + 9 + 28] = b"\1\2\3\4"
    path.write_bytes(data)
    log = open_log(path)
    assert [all(readable(stream)) for stream in log.streams.values()] == [False, False]
    with pytest.raises(RecordError, match="the CRC of the chunk at byte"):
        log.streams["front"].read(9)
    assert len(log.streams["front"].read(0))


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


def test_messages_of_mcap_between_chunks_are_found(tmp_path: Path) -> None:
    """One message that no index leads to is inserted behind the last chunk; the statistics count it."""
    path = write_mcap(tmp_path / "world.mcap", False)
    before = open_container(path)
    data = path.read_bytes()
    place, last = 8, 0
    while data[place] != 15:
        place += 9 + struct.unpack_from("<Q", data, place + 1)[0]
    content = before.message(0)
    record = struct.pack("<BQHIQQ", 5, 22 + len(content), 1, 0, 77, 77) + content
    summary, offsets = struct.unpack_from("<QQ", data, len(data) - 28)
    grown = bytearray(data[:place] + record + data[place:])
    struct.pack_into("<QQ", grown, len(grown) - 28, summary + len(record), offsets + len(record))
    last = summary + len(record)
    while grown[last] != 11:
        last += 9 + struct.unpack_from("<Q", grown, last + 1)[0]
    struct.pack_into("<Q", grown, last + 9, len(before.entries.t_ns) + 1)
    path.write_bytes(grown)
    after = open_container(path)
    assert len(after.entries.t_ns) == len(before.entries.t_ns) + 1
    k = int(np.flatnonzero(after.entries.t_ns == 77)[0])
    assert after.message(k) == content


def test_data_that_unpack_to_more_than_they_say_are_refused() -> None:
    bomb = bz2.compress(bytes(16 << 20))
    assert len(bomb) < 200
    with pytest.raises(ValueError, match="unpacks to more than 1000 bytes, expected 1000"):
        decompress(bomb, "bz2", 1000)
    with pytest.raises(ValueError, match="unpacks to 1000 bytes, expected 1125899906842624"):
        decompress(bz2.compress(bytes(1000)), "bz2", 1 << 50)
    with pytest.raises(ValueError, match="damaged compressed data"):
        decompress(b"no zstd at all", "zstd", 100)
    with pytest.raises(ValueError, match="unknown compression 'rar'"):
        decompress(b"", "rar", 100)


@pytest.mark.matrix
@pytest.mark.parametrize(
    "style",
    [Style("bag"), Style("bag", "lz4"), Style("mcap", "storage"), Style("db3")],
    ids=lambda s: f"{s.container}-{s.compression}",
)
def test_any_damage_is_told_in_one_line(style: Style, tmp_path: Path) -> None:
    """Random bytes at random places, most of them where headers and indexes are."""
    rng = np.random.default_rng(7)
    path = bag_of(tmp_path, style)
    file = file_of(path)
    data = np.frombuffer(file.read_bytes(), np.uint8)
    for _ in range(12):
        places = np.concatenate([rng.integers(0, len(data), 8), rng.integers(0, 6000, 4), -rng.integers(1, 6000, 4)])
        damaged = data.copy()
        damaged[places] = rng.integers(0, 256, len(places))
        file.write_bytes(damaged.tobytes())
        try:
            log = open_log(path)
        except LogError as error:
            lines = str(error).splitlines()
        else:
            lines = [""]
            assert all("\n" not in note for note in log.notes)
            for stream in log.streams.values():
                readable(stream)
        assert len(lines) == 1


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


def test_a_missing_part_of_a_split_bag_is_a_gap(tmp_path: Path) -> None:
    """Three parts, the middle one missing; the static transforms are in the first part alone."""
    messages = sorted(Maker(world_log(), Style("bag")), key=lambda m: m[1])
    third = len(messages) // 3
    for k in range(3):
        part = messages[k * third : (k + 1) * third if k < 2 else None]
        ros.write(iter(part), tmp_path, f"drive_2024-05-01-10-0{k}-00_{k}", Style("bag"))
    whole = open_log(tmp_path)
    assert whole.name == "drive"
    assert [len(s.t_ns) for s in whole.streams.values()] == [len(s.t_ns) for s in world_log().streams.values()]
    next(tmp_path.glob("*_1.bag")).unlink()
    log = open_log(tmp_path)
    assert set(log.streams) == set(whole.streams)
    assert any("1 of 3 files of the recording are missing, first part 1" in note for note in log.notes)


def test_a_missing_file_of_a_rosbag2_folder_is_named(tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style("db3"))
    metadata = path / "metadata.yaml"
    name = file_of(path).name
    metadata.write_text(metadata.read_text().replace(f"- {name}", f"- {name}\n  - /etc/world_1.db3"))
    log = open_log(path)
    assert any("1 of 2 files of the recording are missing: world_1.db3" in note for note in log.notes)
    outside = tmp_path / "world_1.db3"
    shutil.copy(path / name, outside)
    metadata.write_text(metadata.read_text().replace("/etc/world_1.db3", str(outside)))
    assert len(open_log(path).streams["top"].t_ns) == len(log.streams["top"].t_ns)
    metadata.write_text(metadata.read_text().replace(f"- {name}", "- gone.db3"))
    with pytest.raises(LogError, match=r"none of the files that it names is there: gone\.db3"):
        open_log(path)
    metadata.write_text("rosbag2_bagfile_information: [1, 2")
    with pytest.raises(LogError, match="not the metadata of a rosbag2 recording"):
        open_log(path)


def test_several_bags_of_a_folder_are_several_sequences(tmp_path: Path) -> None:
    for name in ("run_1.bag", "run_2.bag", "other.mcap", "part_0.db3", "part_1.db3"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "metadata.yaml").write_text("")
    (tmp_path / "folder" / "folder_0.db3").write_bytes(b"x")
    found = find_recordings(tmp_path)
    assert set(found) == {"run_1", "run_2", "other", "part", "folder"}
    assert [p.name for p in found["part"].files] == ["part_0.db3", "part_1.db3"]
    assert find_recordings(tmp_path / "nothing") == {}


def test_topics_have_roles_with_reasons(tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style("mcap"), renamed({"/top/points": "/sensing/top/points_raw"}))
    roles = table(open_log(path))
    assert roles["/front/image_raw/compressed"] == ("camera front", "by its type, calibrated by /front/camera_info")
    assert roles["/front/camera_info"][0] == "calibration of front"
    assert roles["/sensing/top/points_raw"] == ("lidar top", "by its type, in the frame 'top'")
    assert roles["/tf"][0] == roles["/tf_static"][0] == "tf"


def several_images(log: Log) -> Iterator[Message]:
    """A camera that is also recorded raw, a depth image, a second cloud of the same frame, a map of points."""
    for message in Maker(log, Style("bag", raw="rgb8")):
        yield message
        t_ns, recorded, topic, kind, content = message
        if kind.endswith("/Image"):
            yield t_ns, recorded, "/front/depth/image_rect", kind, content
        if kind.endswith("PointCloud2"):
            yield t_ns, recorded, "/top/filtered_points", kind, content
            yield t_ns, recorded, "/top/points_also", kind, content
            shifted = replace(content, header=replace(content.header, frame_id="map"))
            yield t_ns, recorded, "/whole_world", kind, shifted
            joined = replace(content, header=replace(content.header, frame_id="base_link"))
            yield t_ns, recorded, "/concatenated", kind, joined
    for t_ns, recorded, topic, kind, content in Maker(log, Style("bag")):
        if "compressed" in topic:
            yield t_ns, recorded, topic, kind, content


def test_of_several_topics_of_one_sensor_the_best_is_taken(tmp_path: Path) -> None:
    path = ros.write(several_images(world_log()), tmp_path, "world", Style("bag"))
    log = open_log(path)
    assert set(log.streams) == {"front", "top"}
    roles = table(log)
    assert roles["/front/image_raw/compressed"] == ("unused", "image of the same camera as /front/image_raw")
    assert roles["/front/depth/image_rect"] == ("unused", "by its name no picture of a camera")
    assert roles["/top/points_also"] == ("unused", "cloud of the same frame as /top/points")
    assert roles["/top/filtered_points"] == ("unused", "by its name no cloud of a sensor")
    assert "fixed frame 'map'" in roles["/whole_world"][1]
    assert roles["/concatenated"] == ("unused", "its points are in 'base_link', so they are of several sensors")


def test_a_camera_without_calibration_is_left_out_and_says_how_to_give_it(tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style("bag"), without("/front/camera_info"))
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


def test_a_sensor_without_a_transform_is_left_out_and_says_how_to_give_it(tmp_path: Path) -> None:
    def lacks_top(message: Message) -> Message:
        if message[2] == "/tf_static":
            message[4].transforms = [t for t in message[4].transforms if t.child_frame_id != "top"]
        return message

    path = bag_of(tmp_path, Style("mcap"), lacks_top)
    log = open_log(path)
    assert set(log.streams) == {"front"}
    note = next(note for note in log.notes if "no fixed transform" in note)
    assert "its frame 'top' to 'base_link'; give one as [[static_transforms]]" in note
    x, y, z = world_log().lidars["top"].mount_T_lidar[:3, 3].tolist()
    settings = f'[[static_transforms]]\nparent = "base_link"\nchild = "top"\ntranslation_m = [{x}, {y}, {z}]\n'
    again = open_log(with_settings(path, settings))
    np.testing.assert_allclose(again.lidars["top"].mount_T_lidar, world_log().lidars["top"].mount_T_lidar, atol=1e-12)


def test_a_bag_of_one_lidar_alone_has_its_frame_and_the_road_below_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[Sweep] = []
    monkeypatch.setattr(frames, "measure_ground_m", lambda s, T: (measured.append(s), measure_ground_m(s, T))[1])
    path = bag_of(tmp_path, Style("bag"), lambda m: m if m[2] == "/top/points" else None)
    log = open_log(path)
    assert not measured  # opening reads no sweep
    assert log.ego is None
    np.testing.assert_array_equal(log.lidars["top"].mount_T_lidar, np.eye(4))
    height = world_log().lidars["top"].mount_T_lidar[2, 3]
    assert log.ground_z_ego_m == pytest.approx(-height, abs=0.05)
    assert any(note.startswith("no poses of 'top' in the recording") for note in log.notes)
    assert any("measured in the first sweep" in note for note in log.notes)
    assert len(measured) == 1


def test_sensors_that_stand_still_are_mounted_in_the_map(tmp_path: Path) -> None:
    def at_the_roadside(message: Message) -> Message | None:
        for link in message[4].transforms if message[2] == "/tf_static" else ():
            link.header = replace(link.header, frame_id="world")
        return None if message[2] == "/tf" else message

    log = open_log(bag_of(tmp_path, Style("bag"), at_the_roadside))
    assert log.ego is None
    assert log.cameras["front"].mount == log.lidars["top"].mount == "map"
    np.testing.assert_allclose(log.lidars["top"].mount_T_lidar, world_log().lidars["top"].mount_T_lidar, atol=1e-12)


def test_an_unknown_layout_of_a_known_type_is_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bag_of(tmp_path, Style("bag"))
    data = path.read_bytes()
    old, new = b"uint32 point_step", b"uint32 point_dist"
    assert old in data
    path.write_bytes(data.replace(old, new))
    log = open_log(path)
    assert set(log.streams) == {"front"}
    note = next(note for note in log.notes if note.startswith("/top/points: not used"))
    assert "has the fields header, height, width, fields, is_bigendian, point_dist" in note


def test_fields_of_a_definition_are_found() -> None:
    text = (
        "# words\nint8 GREEN=1\nstring NAME = x\nstd_msgs/Header header\nfloat64[36] c # row\nint32[<=4] d\n"
        + "=" * 80
        + "\nMSG: a\nint8 e"
    )
    assert definition_fields(text) == ["header", "c", "d"]


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


def test_one_wrong_stamp_costs_its_record_only(tmp_path: Path) -> None:
    def at_zero(m: Message) -> Message:
        if m[2] == "/top/points" and m[0] == second:
            m[4].header.stamp.sec = 0
        return m

    second = int(world_log().streams["top"].t_ns[1])
    log = open_log(bag_of(tmp_path, Style(), at_zero))
    assert second not in log.streams["top"].t_ns
    assert len(log.streams["top"].t_ns) == len(world_log().streams["top"].t_ns) - 1
    # Poses cover the log all the same.
    assert log.ego is not None
    assert any("/top/points: 1 of 10 records have stamps more than" in note for note in log.notes)


def test_values_of_other_types_in_a_database_cost_their_messages_only(tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style("db3"))
    whole = open_log(path)
    with sqlite3.connect(file_of(path)) as database:
        last = "SELECT max(id) FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name = '/top/points')"
        database.execute(f"UPDATE messages SET timestamp = 'noon' WHERE id = ({last})")
    database.close()
    log = open_log(path)
    assert log.streams["top"].t_ns.tolist() == whole.streams["top"].t_ns[:-1].tolist()
    assert any("1 of 132 messages have no whole number as topic or stamp" in note for note in log.notes), log.notes


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


def test_of_two_clocks_that_of_the_recorder_is_right() -> None:
    notes: list[str] = []
    note_other_clocks({"/camera": 0.06, "/lidar": 1.5e9, "/told": None}, notes)
    assert [note.split(":")[0] for note in notes] == ["/lidar"]
    note_other_clocks({"/camera": 3600.02, "/lidar": 3600.1}, notes)  # recorded anew an hour later
    assert len(notes) == 1


@pytest.mark.parametrize(("raw", "message"), [
    (b"", "encapsulation missing"), (b"\0\7" + bytes(20), "encapsulation 0007, only plain CDR"), (b"\0\1" + b"\xff" * 9, "not a readable"),
])  # fmt: skip
def test_bytes_that_are_no_message_are_an_error_of_the_record(raw: bytes, message: str) -> None:
    topic = SimpleNamespace(name="/t", msgtype="sensor_msgs/msg/Image", encoding="cdr")
    with pytest.raises(RecordError, match=f"^here: {message}"):
        decode_bytes(topic, raw, "here")


def test_offsets_and_shutters_are_as_told(plain: Path) -> None:
    settings = (
        '[cameras.front]\ntopic = "/front/image_raw/compressed"\noffset_s = -0.01\n'
        'rolling_shutter = { direction = "down", readout_s = 0.02 }\n[lidars.top]\ntopic = "/top/points"\noffset_s = 0.5\n'
    )
    log, world = open_log(with_settings(plain, settings)), world_log()
    plain.with_name("world.topics.toml").unlink()
    np.testing.assert_array_equal(log.streams["front"].t_ns, world.streams["front"].t_ns - 10_000_000)
    assert log.cameras["front"].rolling_shutter == RollingShutter("down", 0.02)
    ours, theirs = (one.streams["top"].read(3) for one in (log, world))
    assert ours.stamp_ns == log.streams["top"].t_ns[3] == theirs.stamp_ns + 500_000_000
    np.testing.assert_array_equal(ours.t_ns, theirs.t_ns + 500_000_000)


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
    '[lidars.top]\ntopic = "/top/points"\ntime_unit = "minutes"': "'lidars.top.time_unit' is 'minutes', expected one of",
    '[poses]\nsource = "gnss"': "asks for source 'gnss', which gives none",
    "[ego]\norigin_m = [1.0, 2.0]": "'ego.origin_m' has 2 values",
    'reference_camera = "rear"': "'reference_camera' is 'rear'; there are: front",
    "[ego\n": "not valid TOML",
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


def test_a_bag_without_sensors_says_what_it_has(tmp_path: Path) -> None:
    path = bag_of(tmp_path, Style("bag"), lambda m: m if m[2] == "/tf" else None)
    with pytest.raises(
        LogError, match=r"no images .* and no point clouds in it; its topics are /tf \(tf2_msgs/msg/TFMessage"
    ):
        open_log(path)


@pytest.mark.parametrize("module", ["rosbags.typesys", "lz4.frame", "ruamel.yaml"])
def test_a_missing_library_names_the_extra(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bag_of(tmp_path, Style("db3") if module == "ruamel.yaml" else Style("bag", "lz4"))
    ros_messages.typestore.cache_clear()
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtra, match="needs the extra 'ros'"):
        open_log(path)
    ros_messages.typestore.cache_clear()


def test_inspect_and_validate_take_the_file_of_a_bag(plain: Path) -> None:
    shown = CliRunner().invoke(app, ["inspect", str(plain)])
    assert shown.exit_code == 0
    assert re.search(r"/top/points +\d+ +lidar top ", shown.output), shown.output
    assert CliRunner().invoke(app, ["validate", str(plain)]).exit_code == 0


@pytest.mark.real
@pytest.mark.parametrize(("name", "topic"), [
    ("example-lz4.bag", r"/turtle2/color_sensor \(turtlesim/msg/Color, 1344\)"), ("example-bz2.bag", r"/tf \(tf/msg/tfMessage, 2688\)"),
    ("ego_db3", r"/localization/kinematic_state \(nav_msgs/msg/Odometry, 2130\)"),
])  # fmt: skip
def test_recorded_bags_without_sensors_list_their_topics(name: str, topic: str, tmp_path: Path) -> None:
    source = SHARED / "data" / "ros" / name
    if not source.exists():
        pytest.skip("recorded bags are not beside this checkout (../shared/data/ros)")
    with pytest.raises(LogError, match=topic) as caught:
        open_log(source)
    assert "\n" not in str(caught.value)


def write_mcap(path: Path, ros1: bool, **options: Any) -> Path:
    """The world by the writer of the format's authors, its messages in the encoding of ROS 1 or 2."""
    from mcap.writer import Writer

    store, style = ros.typestore(ros1), Style("bag" if ros1 else "mcap")
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200_000, **options)
        writer.start(profile="ros1" if ros1 else "ros2")
        channels: dict[str, int] = {}
        for t_ns, recorded, topic, kind, message in sorted(Maker(world_log(), style), key=lambda m: m[1]):
            if topic not in channels:
                definition, _ = store.generate_msgdef(kind, ros_version=1 if ros1 else 2)
                name = kind.replace("/msg/", "/") if ros1 else kind
                schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", definition.encode())
                channels[topic] = writer.register_channel(topic, "ros1" if ros1 else "cdr", schema)
            data = bytes(store.serialize_ros1(message, kind) if ros1 else store.serialize_cdr(message, kind))
            writer.add_message(channels[topic], recorded, data, t_ns)
        writer.finish()
    return path


@pytest.mark.matrix
@pytest.mark.parametrize("options", ["chunks", "lz4", "no chunks", "no index", "no summary"])
@pytest.mark.parametrize("ros1", [True, False], ids=["ros1", "ros2"])
def test_mcap_files_of_its_own_writer_are_read(ros1: bool, options: str, tmp_path: Path) -> None:
    from mcap.writer import CompressionType, IndexType

    plain = {"compression": CompressionType.NONE}
    chosen: dict[str, Any] = {
        "chunks": plain, "lz4": {"compression": CompressionType.LZ4}, "no chunks": {"use_chunking": False},
        "no index": plain | {"index_types": IndexType.NONE},
        "no summary": plain | {"index_types": IndexType.NONE, "use_statistics": False, "repeat_channels": False,
                       "repeat_schemas": False, "use_summary_offsets": False},
    }[options]  # fmt: skip
    log = open_log(write_mcap(tmp_path / "world.mcap", ros1, **chosen))
    for name, stream in world_log().streams.items():
        np.testing.assert_array_equal(log.streams[name].t_ns, stream.t_ns)
    np.testing.assert_array_equal(log.streams["top"].read(5).xyz_m, world_log().streams["top"].read(5).xyz_m)
    np.testing.assert_array_equal(log.streams["front"].read(5), world_log().streams["front"].read(5))
    assert not any("damaged" in note or "missing" in note for note in log.notes)


def test_a_chunk_that_says_to_unpack_to_what_no_sensor_measures_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few bytes for 250 MB, thirty of which kept the reader busy for more than a minute."""
    sound = bz2.compress(bytes(8 << 20))
    bomb = bz2.compress(bytes(1000))
    (tmp_path / "a.bag").write_bytes(sound + bomb)
    file = ChunkedFile(tmp_path / "a.bag")
    file.chunks = [Chunk(0, len(sound), 8 << 20, "bz2"), Chunk(len(sound), len(bomb), 250_000_000, "bz2")]
    assert len(file.unpacked(0)) == 8 << 20
    monkeypatch.setattr(containers, "unpack_part", lambda *_: pytest.fail("it is unpacked"))
    for read in (lambda: file.unpacked(1), lambda: file.within(1, 0, 100, ahead=True), lambda: file.within(1, 0, 100)):
        with pytest.raises(ValueError, match="says to unpack to 250000000, more than 256 times as many"):
            read()


def test_thousands_of_sensor_topics_are_refused_unless_the_settings_choose() -> None:
    none = np.zeros(3, dtype=np.int64)
    topics = {
        name: Topic(name, "sensor_msgs/msg/PointCloud2", "cdr", "", none, none, none)
        for name in (f"/lidar_{k}/points" for k in range(1001))
    }
    bag = SimpleNamespace(place=Path("a.mcap"), topics=topics, frame_id=lambda topic: topic.name)
    with pytest.raises(LogError, match=r"^a\.mcap: 1001 topics of the kind 'lidar', more than the 1000"):
        assign_roles(bag, TopicSettings(), None)
    chosen = TopicSettings.model_validate({"lidars": {"top": {"topic": "/lidar_7/points"}}})
    assert list(assign_roles(bag, chosen, None).lidars) == ["top"]
