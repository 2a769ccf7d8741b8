"""Extremes of a log's sensors: those that it lacks, and calibrations that no sensor has."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from extremes.table import (
    LABELS,
    Outcome,
    RunBy,
    case,
    folder_of,
    known_and_finite,
    refused,
    result_of,
    small_log,
    sound,
)
from log2sim import Config, Scenario, evaluate, open_log, reconstruct
from log2sim.datatypes import CATEGORIES, Log, Stream, Sweep
from log2sim.errors import MissingExtra
from log2sim.evaluation.metrics.comparison import Selection
from log2sim.evaluation.metrics.evaluator import compare_scenarios
from log2sim.geometry import NS_PER_S, Array, rotation_from_rpy, transform
from log2sim.localization.replaced import shift_stream


@case("log: one camera", "all agents, no fusion")
def one_camera() -> Outcome:
    ok, found = known_and_finite(sound(), 3)
    return Outcome(ok and not any(p["kept"] for p in sound().report["plan"] if p["stage"] == "fuse"), found)


@case("log: no camera", "refused, saying that ticks are frames")
def no_camera() -> Outcome:
    log = small_log()
    return refused(
        lambda: reconstruct(replace(log, cameras={}, image_labels={}, reference_camera=None), LABELS), "no camera"
    )


@case("log: no LiDAR", "agents from the image alone, finite")
def no_lidar() -> Outcome:
    log = small_log()
    result = reconstruct(replace(log, lidars={}, streams={"front": log.streams["front"]}), LABELS)
    ok, found = known_and_finite(result, 1)
    condition = result.report["homography"]["front"]["condition"]
    return Outcome(ok and result.report["measurements"]["with_lidar"] == 0, found, condition)


@case("log: no ego pose, sensors on a post", "agents without an ego, finite")
def no_ego() -> Outcome:
    log = small_log()
    assert log.ego is not None
    pose = log.ego.map_T_ego[0]
    cameras = {n: replace(c, mount="map", mount_T_cam=pose @ c.mount_T_cam) for n, c in log.cameras.items()}
    lidars = {n: replace(s, mount="map", mount_T_lidar=pose @ s.mount_T_lidar) for n, s in log.lidars.items()}
    result = reconstruct(replace(log, ego=None, cameras=cameras, lidars=lidars), LABELS)
    ok, found = known_and_finite(result, 2)
    return Outcome(ok and result.scenario.ego is None, found)


@case("log: no ego pose, sensors on the ego", "refused: an empty street does not show it; or names the missing extra")
def lost_ego() -> Outcome:
    try:
        lost = replace(small_log(), ego=None, labels=None)
        return refused(lambda: reconstruct(lost, LABELS), "cannot tell how the ego moves")
    except MissingExtra as missing:
        return Outcome(missing.extra == "odometry", f"refused: {missing}")


@case("log: one frame", "a scenario of one moment")
def one_frame() -> Outcome:
    with folder_of(lambda f: None) as folder:
        result = reconstruct(open_log(folder), LABELS.changed(start_s=0.2, stop_s=0.2))
    ok, found = known_and_finite(result, 1)
    return Outcome(ok and result.scenario.duration_s == 0.0, found)


# --- calibration


def manifest(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], object]:
    def edit(folder: Path) -> None:
        file = folder / "log.json"
        document = json.loads(file.read_text())
        change(document)
        file.write_text(json.dumps(document))

    return edit


FIELDS = {
    "quaternion not of length 1": (
        lambda m: m["sensors"][0].update(rotation_wxyz=[0.5, -0.5, 0.6, -0.5]),
        "rotation_wxyz",
    ),
    "focal length 0 in the file": (lambda m: m["sensors"][0]["intrinsics"].update(fx_px=0), "fx_px"),
}
for _name, (_change, _word) in FIELDS.items():
    case(f"calibration: {_name}", "refused, naming the field")(
        lambda c=_change, w=_word: refused(lambda: result_of(manifest(c)), w)
    )


def with_camera(name: str, change: Callable[[Array], object]) -> Log:
    """The log with an array of its camera changed in place."""
    log = small_log()
    array = getattr(log.cameras["front"], name).copy()
    change(array)
    return replace(log, cameras={"front": replace(log.cameras["front"], **{name: array})})


def with_lidar(scale: float) -> Log:
    lidar = small_log().lidars["top"]
    return replace(small_log(), lidars={"top": replace(lidar, mount_T_lidar=lidar.mount_T_lidar * scale)})


MATRICES = {
    "rotation not orthonormal": (
        lambda: with_camera("mount_T_cam", lambda m: m.__setitem__((0, 0), m[0, 0] + 0.1)),
        "front",
    ),
    "mirrored rotation": (lambda: with_camera("mount_T_cam", lambda m: np.negative(m[:3, 0], out=m[:3, 0])), "front"),
    "singular K": (lambda: with_camera("K", lambda k: k.__setitem__((1, 1), 0.0)), "front"),
    "NaN in K": (lambda: with_camera("K", lambda k: k.__setitem__((0, 2), np.nan)), "front"),
    "LiDAR rotation not orthonormal": (lambda: with_lidar(1.1), "top"),
}
for _name, (_log, _sensor) in MATRICES.items():
    case(f"calibration: {_name} (log in memory)", "refused, naming the sensor")(
        lambda g=_log, s=_sensor: refused(lambda: reconstruct(g(), LABELS), f"'{s}'")
    )


SAMPLE = Path(__file__).resolve().parents[2] / "samples/crossing"
LIDAR = "lidar_top"
START_S, STOP_S = 2.0, 3.0
RANGE_M = 40.0

Change = Callable[[Log], Log]


# Figures of a run with the words of their limits, which are least values of the first two and greatest ones of the others.
LIMITS = {
    "recall": "recall >= {:g}", "precision": "precision >= {:g}", "position_m": "<= {:g} m", "speed_mps": "<= {:g} m/s",
    "ego_m": "ego <= {:g} m", "nees": "NEES <= {:g}",
}  # fmt: skip


@lru_cache
def sample() -> Log:
    return open_log(SAMPLE)


def seconds(log: Log, t_ns: Any) -> Array:
    """Seconds (N,) after the first frame of the front camera."""
    return np.asarray((np.asarray(t_ns) - log.streams["front"].t_ns[0]) / NS_PER_S)


def with_stream(log: Log, stream: Stream) -> Log:
    return log.changed(streams={**log.streams, stream.name: stream})


def reading(log: Log, name: str, source: Callable[[int], int], change: Callable[[int, Any], Any]) -> Log:
    """The log with a stream that gives `change(i, record)` of the record `source(i)` at stamp i."""
    old = log.streams[name]
    return with_stream(log, Stream(name, old.t_ns, lambda i: change(i, old.read(source(i)))))


def frozen_camera(log: Log) -> Log:
    t = seconds(log, log.streams["front"].t_ns)
    last = int(np.flatnonzero(t <= START_S)[-1])
    return reading(log, "front", lambda i: min(i, last), lambda i, image: image)


def black_camera(log: Log) -> Log:
    half = len(log.streams["front"].t_ns) // 2
    return reading(log, "front", lambda i: i, lambda i, image: image * np.uint8(i < half))


def moved_in_time(sweep: Sweep, shift_ns: int) -> Sweep:
    times = None if sweep.t_ns is None else sweep.t_ns + shift_ns
    return replace(sweep, stamp_ns=sweep.stamp_ns + shift_ns, t_ns=times)


def repeated_sweep(log: Log) -> Log:
    stamps = log.streams[LIDAR].t_ns
    t = seconds(log, stamps)
    first = int(np.flatnonzero(t >= START_S)[0])

    def source(i: int) -> int:
        return first if START_S <= t[i] <= STOP_S else i

    return reading(log, LIDAR, source, lambda i, sweep: moved_in_time(sweep, int(stamps[i] - stamps[source(i)])))


def no_sweeps(log: Log) -> Log:
    old = log.streams[LIDAR]
    t = seconds(log, old.t_ns)
    kept = np.flatnonzero((t < START_S) | (t > STOP_S))
    return with_stream(log, Stream(LIDAR, old.t_ns[kept], lambda i: old.read(int(kept[i]))))


def late_sweeps(log: Log) -> Log:
    return with_stream(log, shift_stream(log.streams[LIDAR], 100_000_000))


def yawed(mount_T_sensor: Array, degrees: float) -> Array:
    """The mount turned about the vertical axis of the ego through the sensor."""
    turn = transform(rotation_from_rpy(0.0, 0.0, np.radians(degrees)) @ mount_T_sensor[:3, :3], mount_T_sensor[:3, 3])
    return np.asarray(turn)


def yawed_lidar(log: Log) -> Log:
    lidar = log.lidars[LIDAR]
    return log.changed(lidars={LIDAR: replace(lidar, mount_T_lidar=yawed(lidar.mount_T_lidar, 1.0))})


def yawed_camera(log: Log) -> Log:
    camera = log.cameras["front"]
    return log.changed(cameras={**log.cameras, "front": replace(camera, mount_T_cam=yawed(camera.mount_T_cam, 1.0))})


def swapped_cameras(log: Log) -> Log:
    left, right = log.cameras["front_left"], log.cameras["front_right"]
    swapped = {
        "front_left": replace(left, mount_T_cam=right.mount_T_cam),
        "front_right": replace(right, mount_T_cam=left.mount_T_cam),
    }
    return log.changed(cameras={**log.cameras, **swapped})


def with_poses(log: Log, change: Callable[[Array, Array], Array], kept: NDArray[np.bool_] | None = None) -> Log:
    """The log with changed poses: `change(seconds, map_T_ego)` of those that are kept."""
    assert log.ego is not None
    k = np.flatnonzero(np.ones(len(log.ego.t_ns), dtype=bool) if kept is None else kept)
    t_ns = log.ego.t_ns[k]
    return log.changed(ego=replace(log.ego, t_ns=t_ns, map_T_ego=change(seconds(log, t_ns), log.ego.map_T_ego[k])))


def jumping_poses(log: Log) -> Log:
    def jump(t: Array, poses: Array) -> Array:
        poses = poses.copy()
        poses[(t >= START_S) & (t <= STOP_S), :2, 3] += [3.0, 4.0]
        return poses

    return with_poses(log, jump)


def frozen_poses(log: Log) -> Log:
    def freeze(t: Array, poses: Array) -> Array:
        poses = poses.copy()
        during = np.flatnonzero((t >= START_S) & (t <= STOP_S))
        poses[during] = poses[during[0]]
        return poses

    return with_poses(log, freeze)


def every_s(interval_s: float) -> Change:
    def thin(log: Log) -> Log:
        assert log.ego is not None
        step = round(interval_s / 0.02)  # poses of the sample are 20 ms apart
        kept = np.arange(len(log.ego.t_ns)) % step == 0
        return with_poses(log, lambda t, poses: poses, kept)

    return thin


@lru_cache
def truth() -> Scenario:
    return Scenario.load(SAMPLE / "truth.json")


def nees_during(scenario: Scenario) -> float:
    """Mean squared position error over squared sigma, a half for each axis, of the ticks while the fault lasts."""
    compared, t_s, _ = compare_scenarios(scenario, truth(), Selection(RANGE_M, frozenset(CATEGORIES)))
    ratios: list[float] = []
    for a, row in enumerate(compared.match):
        for k in np.flatnonzero((row >= 0) & compared.counted[a] & (t_s >= START_S) & (t_s <= STOP_S)):
            w = scenario.others[row[k]].waypoints
            error = compared.truth.xy_m[a, k] - compared.other.xy_m[row[k], k]
            sigma = np.interp(t_s[k], w.t_s, w.sigma_xy_m)
            ratios.append(float(error @ error / (2 * sigma**2)))
    return float(np.mean(ratios)) if ratios else float("nan")


def run(change: Change, told: tuple[str, ...] | None, fixes: dict[str, bool], limits: dict[str, float]) -> Outcome:
    """Reconstruct and evaluate the log with a fault."""
    # What is required concerns agents and the ego: the ground and colors only take time.
    config = Config.load(calibration=fixes, map={"lanes": False}, appearance={"colors": False, "signals": False})
    result = reconstruct(change(sample()), config)
    kinds = {fault["kind"] for fault in result.report["faults"]}
    figures = evaluate(result.scenario, truth(), max_range_m=RANGE_M)
    keys = ("recall", "precision", "position_rmse_m", "speed_rmse_mps")
    values = *(figures[key] for key in keys), figures["ego"]["position_rmse_m"], nees_during(result.scenario)
    found = dict(zip(LIMITS, values))
    kept = all(found[k] >= v if k in ("recall", "precision") else found[k] <= v for k, v in limits.items())
    right = told is None or (bool(kinds & set(told)) if told else not kinds)
    words = "told " + "+".join(sorted(kinds)) if kinds else "nothing told"
    numbers = "{recall:.2f} / {precision:.2f} / {speed_mps:.2f} m/s / ego {ego_m:.2f} m / NEES {nees:.1f}"
    return Outcome(kept and right, f"{words}; {numbers.format(**found)}", None, found["position_m"])


# What is done to the sample, kinds of faults of which one has to be told (none: nothing; None: either), what is corrected, and limits.
FAULTS: dict[str, tuple[Change, tuple[str, ...] | None, dict[str, bool], tuple[float | None, ...]]] = {
    "none": (lambda log: log, (), {}, (0.98, 0.98, 0.2, 0.15, 0.1)),
    "front camera frozen from 2 s": (frozen_camera, ("frozen_images",), {}, (None, None, None, 0.2)),
    "front camera black for half the time": (black_camera, ("black_images",), {}, ()),
    "one LiDAR sweep repeated for 1 s": (repeated_sweep, ("repeated_sweeps",), {}, (0.98, 0.97, 0.3, 0.3)),
    "LiDAR stamps + 100 ms": (late_sweeps, ("time_offset",), {}, ()),
    "LiDAR stamps + 100 ms, --fix-time": (late_sweeps, ("time_offset",), {"fix_time": True}, (None, None, 0.2)),
    "LiDAR mount yawed by 1 degree": (yawed_lidar, ("lidar_rotation",), {}, ()),
    "LiDAR mount yawed by 1 degree, --fix-calibration": (
        yawed_lidar, ("lidar_rotation",), {"fix_mounts": True}, (None, None, 0.22),
    ),
    "camera yawed by 1 degree": (yawed_camera, ("camera_rotation",), {}, ()),
    "left and right extrinsics swapped": (swapped_cameras, ("swapped_cameras",), {}, ()),
    "GNSS jump of 5 m for 1 s": (jumping_poses, ("pose_jump",), {}, (0.98, 0.97, 0.22)),
    "GNSS frozen for 1 s": (frozen_poses, ("frozen_poses",), {}, (0.97, 0.97, 0.25, None, 0.15)),
    "poses at 1 Hz": (every_s(1.0), None, {}, (0.98, 0.97)),
    "poses at 0.8 Hz": (every_s(1.25), None, {}, (0.98, 0.97)),
    "no LiDAR for 1 s": (no_sweeps, ("missing_sweeps",), {}, (None, None, None, None, None, 2.0)),
}  # fmt: skip

# A picture stream, a clock and poses; a run takes 20 s, and other tests find the other faults in small logs.
SLOW_TESTS = {"front camera frozen from 2 s", "LiDAR stamps + 100 ms, --fix-time", "GNSS frozen for 1 s"}

for _name, (_change, _told, _fixes, _values) in FAULTS.items():
    _limits = {key: value for key, value in zip(LIMITS, _values) if value is not None}
    _words = [] if _told is None else ["told" if _told else "nothing told"]
    _words += [LIMITS[key].format(value) for key, value in _limits.items()]
    _by: RunBy = "slow tests" if _name in SLOW_TESTS else "tool"
    case(f"sensor: {_name}", ", ".join(_words), run_by=_by)(partial(run, _change, _told, _fixes, _limits))
