"""ROS bags and MCAP: the same log in every container as the one that was written, and the same scenario."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_encoders import ros
from log_encoders.ros import Style
from log_encoders.world import world_log
from plain_settings import AGENTS_ALONE
from rosbags.highlevel import AnyReader

from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import Log, Stream, Sweep
from log2sim.geometry import rotation_from_rpy, transform
from log2sim.logs.kitti.labels import EGO_T_IMU as EGO_T_KITTI_IMU
from log2sim.logs.ros.bag import Bag, find_recordings
from log2sim.logs.stamps import transverse_mercator

CONTAINERS = [
    Style("bag"), Style("bag", "lz4"), Style("bag", "bz2"), Style("db3"), Style("db3", "message"), Style("mcap"),
    Style("mcap", "storage"),
]  # fmt: skip
IDS = [f"{s.container}-{s.compression or 'plain'}" for s in CONTAINERS]
EGO_T_IMU = transform(rotation_from_rpy(0.02, -0.03, 0.5), [0.4, -0.3, 0.9])


def written(log: Log, folder: Path, style: Style, settings: str = "") -> Path:
    path = ros.encode_as(log, folder, style)
    (folder / f"{path.stem}.topics.toml").write_text(settings or ros.settings_of(log, style))
    return path


def geodetic_world() -> Log:
    log = world_log()
    placed = replace(
        log.map, latitude_deg=48.1, longitude_deg=11.6, altitude_m=510.0, projection=transverse_mercator(48.1, 11.6)
    )
    return replace(log, map=placed)


def assert_same_log(ours: Log, theirs: Log, tolerance: float = 1e-9) -> None:
    assert set(ours.streams) == set(theirs.streams)
    for name, stream in theirs.streams.items():
        np.testing.assert_array_equal(ours.streams[name].t_ns, stream.t_ns)
        for i in (0, 3, len(stream.t_ns) - 1):
            assert_same_record(ours.streams[name].read(i), stream.read(i))
        mine, _ = ours.map_T_sensor(name, stream.t_ns)
        np.testing.assert_allclose(mine, theirs.map_T_sensor(name, stream.t_ns)[0], atol=tolerance)
    for name, camera in theirs.cameras.items():
        np.testing.assert_array_equal(ours.cameras[name].K, camera.K)
        assert (ours.cameras[name].width_px, ours.cameras[name].height_px) == (camera.width_px, camera.height_px)
    assert ours.ego is not None
    assert theirs.ego is not None
    np.testing.assert_array_equal(ours.ego.t_ns, theirs.ego.t_ns)
    np.testing.assert_allclose(ours.ego.map_T_ego, theirs.ego.map_T_ego, atol=tolerance)


def assert_same_record(ours: Any, theirs: Any) -> None:
    if isinstance(theirs, Sweep):
        assert ours.stamp_ns == theirs.stamp_ns
        np.testing.assert_array_equal(ours.xyz_m, theirs.xyz_m)
        np.testing.assert_array_equal(ours.t_ns, theirs.t_ns)
    else:
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.matrix
@pytest.mark.parametrize("style", CONTAINERS, ids=IDS)
def test_every_container_gives_back_the_log_that_was_written(style: Style, tmp_path: Path) -> None:
    assert_same_log(open_log(written(world_log(), tmp_path, style)), world_log())


@pytest.mark.matrix
@pytest.mark.parametrize("style", CONTAINERS, ids=IDS)
def test_messages_are_those_that_another_library_reads(style: Style, tmp_path: Path) -> None:
    path = ros.encode_as(world_log(), tmp_path, style)
    bag = Bag(next(iter(find_recordings(path).values())))
    count: dict[str, int] = {}
    with AnyReader([path]) as reader:
        for connection, recorded, raw in reader.messages():
            i = count[connection.topic] = count.get(connection.topic, -1) + 1
            topic = bag.topics[connection.topic]
            assert (topic.msgtype, topic.recorded_ns[i]) == (connection.msgtype, recorded)
            assert bag.read(topic, i) == bytes(raw)
            assert bag.read(topic, i, 12) == bytes(raw)[:12]
    assert {name: len(topic) - 1 for name, topic in bag.topics.items()} == count


@pytest.mark.parametrize("poses", ["odometry", "pose", "covariance", "gnss"])
def test_every_source_of_poses_gives_the_poses_that_were_written(poses: str, tmp_path: Path) -> None:
    style = Style(poses=poses, ego_T_base=transform(np.eye(3), EGO_T_IMU[:3, 3]))
    log = open_log(written(geodetic_world(), tmp_path, style))
    # GNSS keeps micrometers: PROJ there and back, heading by a difference of 1 m.
    assert_same_log(log, geodetic_world(), 1e-5 if poses == "gnss" else 1e-9)
    assert [c["source"] for c in log.details["poses"] if c["used"]] == ["pose" if poses == "covariance" else poses]


def assert_close(ours: Any, theirs: Any, tolerance: float = 1e-6) -> None:
    """Numbers differ by less than what poses lose as quaternions."""
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys()
        for key in theirs:
            assert_close(ours[key], theirs[key], tolerance)
    elif isinstance(theirs, list):
        assert len(ours) == len(theirs)
        for a, b in zip(ours, theirs):
            assert_close(a, b, tolerance)
    elif isinstance(theirs, float):
        assert ours == pytest.approx(theirs, abs=tolerance)
    else:
        assert ours == theirs


@pytest.mark.slow
@pytest.mark.real
def test_a_recorded_drive_gives_the_same_scenario_from_bags_of_both_kinds(real_data: Path, tmp_path: Path) -> None:
    """A KITTI drive as GNSS, IMU, LiDAR with times of its points, and a camera; settings tell ego and map."""
    places = sorted((real_data / "kitti_raw").glob("*/*_sync"))
    assert places
    drive = open_log(places[0])
    style = Style(poses="gnss", ego_T_base=EGO_T_KITTI_IMU)
    short = replace(drive, streams={name: first(stream, 15) for name, stream in drive.streams.items()}, name="drive")
    config = Config.load(detect={"name": "lidar:vehicle"}, **AGENTS_ALONE)
    expected = plain_scenario(short, config)
    found = []
    for container, compression in (("bag", "lz4"), ("mcap", "storage")):
        log = open_log(
            written(short, tmp_path / container, replace(style, container=container, compression=compression))
        )
        found.append(plain_scenario(log, config))
    assert found[0] == found[1]
    assert len(expected["agents"]) > 3
    # PROJ and quaternions keep 2 nm of a position; the smallest singular value of a fit amplifies that.
    assert_close(found[0]["agents"], expected["agents"], 1e-4)


def first(stream: Stream, count: int) -> Stream:
    return Stream(stream.name, stream.t_ns[:count], stream.read, stream.encoded)


def plain_scenario(log: Log, config: Config) -> dict[str, Any]:
    document = reconstruct(replace(log, name="log", digest=""), config).scenario.to_dict()
    document.pop("provenance")
    return document
