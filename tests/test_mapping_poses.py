"""Poses refined by sweeps: drift that a log's poses have is taken out, and nothing else is changed."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.config import Config
from log2sim.datatypes import Finding, Lidar, Log, Stream, Sweep
from log2sim.geometry import Array, PoseTrack, apply, inverse, rotation_from_rpy, transform
from log2sim.localization.choice import localize, refine_for_map
from log2sim.localization.pose_refinement import place_as_given, refine_poses, solve_twists
from log2sim.localization.replaced import replace_poses
from log2sim.localization.surfaces import Registration, exp_of, log_of

T_NS = np.arange(0, 41) * 100_000_000 + 10**18
MOUNT = transform(rotation_from_rpy(0.0, 0.0, 0.3), [0.5, 0.0, 1.8])


def true_poses() -> Array:
    """A curve of 20 m."""
    t = (T_NS - T_NS[0]) / 1e9
    yaw = 0.1 * t
    return transform(
        rotation_from_rpy(0 * t, 0 * t, yaw), np.stack([50 * np.sin(yaw), 50 - 50 * np.cos(yaw), 0 * t], axis=1)
    )


def drift() -> Array:
    """Slow errors of all six parts, up to 30 cm and half a degree."""
    s = np.linspace(-1, 1, len(T_NS))[:, None]
    return s * [0.15, 0.3, 0.2, 0.004, 0.006, 0.008] + np.sin(4 * s) * [0.05, 0.05, 0.05, 0.002, 0.002, 0.002]


def drifted() -> Array:
    return true_poses() @ np.stack([exp_of(twist) for twist in drift()])


def street(rng: np.random.Generator, count: int) -> Array:
    """Points on the road, on walls along and across."""
    u, v = rng.uniform(-15, 35, count), rng.uniform(-12, 12, count)
    up, zero = rng.uniform(0, 5, count), np.zeros(count)
    walls = [np.column_stack([u, zero + y, up]) for y in (-12, 12)]
    walls += [np.column_stack([zero + x, np.sign(v) * (8 + np.abs(v) / 3), up]) for x in (-10.0, 3.0, 16.0, 30.0)]
    return np.concatenate([np.column_stack([u, v, zero]), *walls])


def street_log(poses: Array, frame: str = "lidar", slower: int = 1) -> Log:
    """Sweeps from the true poses in a log that states others, and that takes so many times as long."""
    stamps_ns = T_NS[0] + slower * (T_NS - T_NS[0])

    def read(i: int) -> Sweep:
        rng = np.random.default_rng(i)
        world = street(rng, 4000)
        local = apply(inverse(true_poses()[i] @ MOUNT), world) + rng.normal(0, 0.01, (len(world), 3))
        points = local if frame == "lidar" else apply(poses[i] @ MOUNT, local)
        return Sweep(int(stamps_ns[i]), points, frame)  # type: ignore[arg-type]

    streams = {"top": Stream("top", stamps_ns, read)}
    track = PoseTrack(stamps_ns, poses, max_gap_s=1.0 * slower)
    return Log("street", "log2sim", {}, {"top": Lidar("top", "ego", MOUNT)}, streams, track)


def relative_errors(poses: Array) -> Array:
    """Errors (K, 6) of the motion from the first pose."""
    true = inverse(true_poses()[:1]) @ true_poses()
    return log_of(inverse(true) @ (inverse(poses[:1]) @ poses))


@pytest.mark.matrix
@pytest.mark.parametrize(("frame", "slower"), [("lidar", 1), ("map", 1), ("lidar", 30)])
def test_drift_is_taken_out_of_short_logs_and_of_long_ones(frame: str, slower: int) -> None:
    refined = refine_poses(street_log(drifted(), frame, slower))
    assert refined is not None
    before, after = (np.abs(relative_errors(p)).max(axis=0) for p in (drifted(), refined.map_T_ego))
    assert before[:3].max() > 0.5
    assert after[:3].max() < 0.04
    assert np.degrees(after[3:]).max() < 0.15


def test_with_every_sweep_jitter_is_taken_out() -> None:
    """Of pitch and roll, which no other sweep shows."""
    jitter = np.random.default_rng(4).normal(0, [0, 0, 0, 0.001, 0.001, 0], (len(T_NS), 6))
    given = true_poses() @ np.stack([exp_of(twist) for twist in jitter])
    off = []
    for every_sweep in (False, True):
        refined = refine_poses(street_log(given), every_sweep=every_sweep)
        assert refined is not None
        off.append(np.sqrt((relative_errors(refined.map_T_ego)[:, 3:5] ** 2).mean()))
    assert off[1] < 0.0005
    assert off[1] < 0.6 * off[0]


@pytest.mark.slow
def test_the_ground_is_drawn_by_refined_poses_and_put_back_where_the_agents_are() -> None:
    """A sweep in the map, as some logs have it, lies where its refined pose puts it."""
    log = street_log(drifted(), "map")
    given, choice = localize(log, Config())
    choice = refine_for_map(given, choice)
    assert given is log
    assert choice.for_map is not None
    drawn = replace_poses(log, choice.for_map)
    assert drawn.ego is not None
    local = apply(inverse(drifted()[30]), log.streams["top"].read(30).xyz_m)
    on_map = apply(drawn.ego.map_T_ego[30], local)
    np.testing.assert_allclose(drawn.streams["top"].read(30).xyz_m, on_map, atol=1e-6)
    near = np.array([[3.0, 1.5, -0.2], [-1.0, -4.0, 0.0]])
    for k in (0, 30):
        back = place_as_given(apply(drawn.ego.map_T_ego[k], near), drawn, log)
        np.testing.assert_allclose(back, apply(drifted()[k], near), atol=0.06)
    assert np.linalg.norm(drawn.ego.map_T_ego[:, :3, 3] - drifted()[:, :3, 3], axis=1).max() > 0.2
    late = Finding("time_offset", "top")
    assert refine_for_map(log, choice, [late]) is choice  # the sweeps of such a LiDAR show another motion


def test_one_false_registration_changes_little() -> None:
    given, true = drifted()[::4], true_poses()[::4]
    covariance = np.diag([0.01, 0.01, 0.01, 0.001, 0.001, 0.001]) ** 2
    pairs = [(j - lag, j) for j in range(len(true)) for lag in (1, 3) if j >= lag]
    links = [(i, j, Registration(inverse(true[i]) @ true[j], covariance, 1.0)) for i, j in pairs]
    i, j, good = links[5]
    links[5] = (i, j, Registration(good.first_T_second @ transform(np.eye(3), [2.0, 0, 0]), covariance, 1.0))
    fixed = given @ np.stack([exp_of(twist) for twist in solve_twists(T_NS[::4], given, links)])
    off = log_of(inverse(inverse(true[:1]) @ true) @ (inverse(fixed[:1]) @ fixed))
    assert np.abs(off[:, :3]).max() < 0.02


def test_logs_without_lidar_or_way_stay_as_they_are() -> None:
    log = street_log(true_poses())
    bare = log.changed(lidars={}, streams={})
    assert refine_poses(bare) is None
    standing = street_log(np.repeat(true_poses()[:1], len(T_NS), axis=0))
    assert refine_poses(standing) is None
