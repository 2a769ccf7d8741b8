"""Synchronization: which records belong to a tick, by how much they miss it, and sweeps moved to one moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worlds import camera_ahead

from log2sim.datatypes import Lidar, Log, Stream, Sweep
from log2sim.errors import ConfigError
from log2sim.geometry import PoseTrack, apply, rotation_from_rpy, transform
from log2sim.perception.lidar.cloud import sweep_to_map
from log2sim.perception.sync import nearest_records, sweep_middle_ns, synchronize

T0_NS = 1_700_000_000_000_000_000
MS = 1_000_000


def stamps(start_ms, step_ms, count):
    return T0_NS + np.round(start_ms * MS + np.arange(count) * step_ms * MS).astype(np.int64)


def log_of(cameras, lidars=None, *, read=None, **changes):
    """A log whose streams have the stamps given; sweeps are empty unless `read` makes them."""
    nothing = read or (lambda i: Sweep(0, np.zeros((0, 3))))
    streams = {name: Stream(name, t, lambda i: None) for name, t in cameras.items()}
    streams |= {name: Stream(name, t, nothing) for name, t in (lidars or {}).items()}
    return Log(
        "log",
        "test",
        {name: camera_ahead(name) for name in cameras},
        {name: Lidar(name, "map", np.eye(4)) for name in lidars or {}},
        streams,
        **changes,
    )


@pytest.mark.parametrize(("off_ns", "taken"), [(0, True), (1, False), (-1, True)])
def test_the_tolerance_itself_is_still_near_and_a_nanosecond_more_is_not(off_ns, taken):
    index, residual = nearest_records(stamps(0, 100, 1), np.array([T0_NS + 20 * MS + off_ns]), 20 * MS)
    assert (index[0] == 0) == taken
    assert residual[0] == -(20 * MS + off_ns) / 1e9 if taken else np.isnan(residual[0])


def test_every_camera_gets_the_sweep_nearest_to_its_own_frame():
    cameras = {"ref": stamps(0, 100, 4), "offset": stamps(40, 100, 4)}
    schedule = synchronize(log_of(cameras, {"top": stamps(0, 50, 10)}), ("ref", "offset"))
    assert schedule.sweeps["top"][0].tolist() == [0, 2, 4, 6]
    assert schedule.sweeps["top"][1].tolist() == [1, 3, 5, 7]
    assert not schedule.residuals_s["top"].any()


def test_a_sweep_counts_by_the_middle_of_its_points_not_by_its_stamp():
    t = stamps(0, 100, 5)

    def read(i):
        return Sweep(int(t[i]), np.zeros((3, 3)), "lidar", t[i] + np.array([0, 10, 80], dtype=np.int64) * MS)

    log = log_of({"ref": stamps(90, 100, 4)}, {"top": t}, read=read)
    assert sweep_middle_ns(log, "top") == 40 * MS
    schedule = synchronize(log, ("ref",))
    # Frame at 90 ms: the sweep from 0 to 80 ms has its middle 50 ms before it, that from 100 ms has it 50 ms after it.
    assert schedule.sweeps["top"][0].tolist() == [0, 1, 2, 3]
    assert synchronize(log_of({"ref": stamps(90, 100, 4)}, {"top": t}), ("ref",)).sweeps["top"][0].tolist() == [
        1,
        2,
        3,
        4,
    ]


def test_start_and_stop_keep_the_ticks_between_them_ends_included():
    log = log_of({"ref": stamps(0, 100, 11)})
    kept = synchronize(log, ("ref",), start_s=0.2, stop_s=0.5)
    np.testing.assert_array_equal(kept.t_ns, log.streams["ref"].t_ns[2:6])
    assert kept.frames["ref"].tolist() == [2, 3, 4, 5]
    with pytest.raises(ConfigError, match=r"leave no frame of 'ref', which lasts 1\.000 s"):
        synchronize(log, ("ref",), start_s=1.1)


# Motion compensation: the world stands still, so whatever the ego did, every point must come out where it is.

SPEED_MPS, YAW_RATE, ORIGIN = 20.0, 0.4, np.array([5e5, 5e6, 120.0])


def on_circle(t_s):
    """Poses (N, 4, 4) of an ego on a circle, at times (N,)."""
    yaw, radius = YAW_RATE * np.asarray(t_s), SPEED_MPS / YAW_RATE
    position = np.stack([radius * np.sin(yaw), radius * (1 - np.cos(yaw)), np.zeros_like(yaw)], axis=-1)
    return transform(rotation_from_rpy(0.0, 0.0, yaw), position + ORIGIN)


def moving_log(poses=on_circle, **changes):
    t = np.arange(-0.2, 0.4, 0.01)
    track = PoseTrack(T0_NS + np.round(t * 1e9).astype(np.int64), poses(t))
    ego_T_lidar = transform(rotation_from_rpy(0.02, -0.01, 1.5), np.array([1.1, 0.3, 1.9]))
    log = log_of({"ref": stamps(0, 100, 1)}, {"top": stamps(0, 100, 1)}, ego=track, **changes)
    return replace(log, lidars={"top": Lidar("top", "ego", ego_T_lidar)})


def swept(log, points_map, t_s):
    """What the LiDAR of the moving ego records of world points (N, 3), each at its own time (N,)."""
    map_T_lidar = on_circle(t_s) @ log.lidars["top"].mount_T_lidar
    lidar_R_map = np.swapaxes(map_T_lidar[:, :3, :3], 1, 2)
    xyz = np.einsum("nij,nj->ni", lidar_R_map, points_map - map_T_lidar[:, :3, 3])
    return Sweep(T0_NS, xyz, "lidar", T0_NS + np.round(np.asarray(t_s) * 1e9).astype(np.int64))


def test_compensated_points_lie_where_the_world_has_them_whatever_their_own_time():
    rng = np.random.default_rng(1)
    world = ORIGIN + rng.uniform([-50, -50, 0], [50, 50, 5], (3000, 3))
    t_s = rng.uniform(-0.1, 0.0, 3000)
    log = moving_log()
    found, seconds = sweep_to_map(log, "top", swept(log, world, t_s), compensate=True)
    # 1 rad/s and 50 m may cost 2.5 cm by the module's own word; here it is 0.4 rad/s and 71 m.
    assert np.abs(found - world).max() < 0.02
    near = np.linalg.norm(world - ORIGIN, axis=1) < 8
    assert near.sum() > 10
    assert np.abs(found - world)[near].max() < 0.003
    np.testing.assert_allclose(seconds, t_s, atol=1e-6)


def test_without_compensation_points_are_off_by_what_the_ego_moved():
    log, t_s = moving_log(), np.array([-0.1, -0.05, 0.0])
    world = np.tile(on_circle(0.0)[:3, 3] + [30.0, 0.0, 0.0], (3, 1))
    found, _ = sweep_to_map(log, "top", swept(log, world, t_s), compensate=False)
    for k, t in enumerate(t_s):
        back = on_circle(0.0) @ np.linalg.inv(on_circle(t))
        np.testing.assert_allclose(found[k], apply(back, world[k][None])[0], atol=1e-6)
    assert np.linalg.norm(found[0] - world[0]) > 1.9
    assert np.linalg.norm(found[2] - world[2]) < 1e-6
