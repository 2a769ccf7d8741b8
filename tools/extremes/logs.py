"""Extremes of a log: places, stamps, clouds and images, sensors that it lacks, calibrations that no sensor has, and faults of its sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from extremes.table import (
    FAR_M,
    LABELS,
    Outcome,
    Row,
    case,
    folder_of,
    known_and_finite,
    refused,
    result_of,
    rows_changed,
    same,
    small_log,
    sound,
)
from log2sim import Config, Scenario, evaluate, open_log, reconstruct
from log2sim.datatypes import CATEGORIES, Log, Stream
from log2sim.errors import MissingExtra
from log2sim.evaluation.metrics.comparison import Selection
from log2sim.evaluation.metrics.evaluator import compare_scenarios
from log2sim.geometry import NS_PER_S, Array, rotation_from_rpy, transform
from log2sim.localization.replaced import shift_stream
from log2sim.report import Result

# --- places and stamps


@case("map: UTM coordinates of 5e6 m", "as at the origin to 1e-6 m")
def far_away() -> Outcome:
    def move(row: Row) -> None:
        for column, shift in zip(("x_m", "y_m"), FAR_M):
            if column in row:
                row[column] = repr(float(row[column]) + float(shift))

    return same(result_of(lambda f: rows_changed(f, move)), 1e-6, tuple(FAR_M))


def later(shift_ns: int) -> Outcome:
    def shift(row: Row) -> None:
        row["t_ns"] = str(int(row["t_ns"]) + shift_ns)

    return same(result_of(lambda f: rows_changed(f, shift)), 1e-9)


case("stamps: of 6.7e18 ns", "as at 1.7e18 ns to 1e-9 m")(lambda: later(5_000_000_000_000_000_000))
case("stamps: negative, and zero among them", "as at 1.7e18 ns to 1e-9 m")(
    lambda: later(-int(sound().scenario.t0_ns) - 100_000_000)
)
INDICES = ("front/index.csv", "top/index.csv", "ego/poses.csv")
Lines = Callable[[list[str]], list[str]]


def with_lines(folder: Path, change: Lines, names: tuple[str, ...] = INDICES) -> None:
    """Change the lines of some tables below their heads."""
    for name in names:
        head, *rows = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join([head, *change(rows)]) + "\n")


def put_in_order(change: Lines, words: tuple[str, ...] = ("",)) -> Outcome:
    """The log gives the same scenario with its lines changed, and a note with one of some words."""
    with folder_of(lambda folder: with_lines(folder, change)) as folder:
        log = open_log(folder)
        outcome = same(reconstruct(log, LABELS), 1e-9)
    noted = sum(any(word in note for word in words) for note in log.notes)
    return replace(outcome, ok=outcome.ok and noted > 0, found=f"{outcome.found}, {noted} notes")


REPEATED = ("repeat", "same stamp", "twice", "duplicate")
case("stamps: every record twice", "repetitions left out and noted, the same scenario")(
    lambda: put_in_order(lambda rows: [r for row in rows for r in (row, row)], REPEATED)
)
case("stamps: in reverse order", "put in order and noted, the same scenario")(
    lambda: put_in_order(lambda rows: rows[::-1])
)


@case("stamps: a frame 1 us after another", "one tick each, nobody lost")
def microsecond_frame() -> Outcome:
    def double(rows: list[str]) -> list[str]:
        t_ns, image = rows[2].split(",", 1)
        return [*rows[:3], f"{int(t_ns) + 1000},{image}", *rows[3:]]

    result = result_of(lambda folder: with_lines(folder, double, INDICES[:1]))
    ok, found = known_and_finite(result, 3)
    increasing = all((np.diff(a.waypoints.t_s) > 0).all() for a in result.scenario.agents)
    return Outcome(ok and increasing and result.report["ticks"] == sound().report["ticks"] + 1, found)


@case("stamps: two frames a sweep", "nobody lost")
def slow_lidar() -> Outcome:
    result = result_of(lambda folder: with_lines(folder, lambda rows: rows[::2], INDICES[1:2]))
    return Outcome(*known_and_finite(result, 3))


# --- records


@case("cloud: NaN and inf points", "left out, the same scenario")
def bad_points() -> Outcome:
    def spoil(folder: Path) -> None:
        for file in (folder / "top").glob("*.npz"):
            with np.load(file) as data:
                columns = dict(data)
            for bad in (np.nan, np.inf, -np.inf):
                columns["xyz_m"] = np.concatenate([columns["xyz_m"], np.full((50, 3), bad, columns["xyz_m"].dtype)])
                for name in set(columns) - {"xyz_m"}:
                    columns[name] = np.concatenate([columns[name], columns[name][:50]])
            np.savez(file, **columns)

    return same(result_of(spoil), 1e-9)


def counted(result: Result, stream: str) -> Outcome:
    """Of one stream one record is unreadable, and agents are known by the others."""
    ok, found = known_and_finite(result, 2)
    count = result.report["unreadable"].get(stream, {}).get("count", 0)
    return Outcome(ok and count == 1, f"{found}, {count} unreadable")


@case("cloud: one sweep without points", "counted, the others do")
def empty_sweep() -> Outcome:
    def empty(folder: Path) -> None:
        file = sorted((folder / "top").glob("*.npz"))[2]
        np.savez(file, xyz_m=np.zeros((0, 3), np.float32), t_offset_ns=np.zeros(0, np.int64))

    return counted(result_of(empty), "top")


def cut_pictures(which: slice) -> Result:
    """Reconstruct the log with pictures that end in their middle."""

    def cut(folder: Path) -> None:
        for file in sorted((folder / "front").glob("*.jpg"))[which]:
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])

    return result_of(cut, decode_images=True)


case("image: one cut in half", "counted, the others do")(lambda: counted(cut_pictures(slice(1, 2)), "front"))
case("image: all cut in half", "refused, naming the stream")(
    lambda: refused(lambda: cut_pictures(slice(None)), "stream 'front'")
)


@case("frames: nobody in any", "the ego alone")
def nobody() -> Outcome:
    log = small_log()
    late = {n: replace(b, t_ns=b.t_ns + 10**15) for n, b in log.image_labels.items()}
    agents = [a.id for a in reconstruct(replace(log, image_labels=late), LABELS).scenario.agents]
    return Outcome(agents == ["ego"], f"{len(agents) - 1} agents beside the ego")


# --- sensors that a log lacks


@case("log: one camera", "all agents, no fusion")
def one_camera() -> Outcome:
    ok, found = known_and_finite(sound(), 3)
    return Outcome(ok and not any(p["kept"] for p in sound().report["plan"] if p["stage"] == "fuse"), found)


@case("log: no camera", "refused, saying that ticks are frames")
def no_camera() -> Outcome:
    blind = replace(small_log(), cameras={}, image_labels={}, reference_camera=None)
    return refused(lambda: reconstruct(blind, LABELS), "no camera")


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


# --- calibrations


def with_array(sensor: str, name: str, place: Any, change: Callable[[Array], Array]) -> Log:
    """The log with a part of an array of its camera or LiDAR changed."""
    log = small_log()
    one = {**log.cameras, **log.lidars}[sensor]
    array = getattr(one, name).copy()
    array[place] = change(array[place])
    one = replace(one, **{name: array})  # type: ignore[type-var]
    return replace(log, cameras={sensor: one}) if sensor in log.cameras else replace(log, lidars={sensor: one})


MATRICES: dict[str, tuple[str, str, Any, Callable[[Array], Array]]] = {
    "rotation not orthonormal": ("front", "mount_T_cam", (0, 0), lambda v: v + 0.1),
    "mirrored rotation": ("front", "mount_T_cam", (slice(3), 0), np.negative),
    "singular K": ("front", "K", (1, 1), lambda v: 0 * v),
    "NaN in K": ("front", "K", (0, 2), lambda v: np.nan * v),
    "LiDAR rotation not orthonormal": ("top", "mount_T_lidar", ..., lambda v: 1.1 * v),
}
for _name, _where in MATRICES.items():
    case(f"calibration: {_name} (log in memory)", "refused, naming the sensor")(
        lambda w=_where: refused(lambda: reconstruct(with_array(*w), LABELS), f"'{w[0]}'")
    )

# --- faults of sensors: what is done to the sample, and what is told of it and comes out

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
def sample() -> tuple[Log, Scenario]:
    return open_log(SAMPLE), Scenario.load(SAMPLE / "truth.json")


def seconds(log: Log, t_ns: Any) -> Array:
    """Seconds (N,) after the first frame of the front camera."""
    return np.asarray((np.asarray(t_ns) - log.streams["front"].t_ns[0]) / NS_PER_S)


def with_stream(log: Log, stream: Stream) -> Log:
    return log.changed(streams={**log.streams, stream.name: stream})


def frozen_camera(log: Log) -> Log:
    old = log.streams["front"]
    last = int(np.flatnonzero(seconds(log, old.t_ns) <= START_S)[-1])
    return with_stream(log, Stream("front", old.t_ns, lambda i: old.read(min(i, last))))


def black_camera(log: Log) -> Log:
    old = log.streams["front"]
    return with_stream(log, Stream("front", old.t_ns, lambda i: old.read(i) * np.uint8(i < len(old.t_ns) // 2)))


def repeated_sweep(log: Log) -> Log:
    old = log.streams[LIDAR]
    t = seconds(log, old.t_ns)
    first = int(np.flatnonzero(t >= START_S)[0])

    def read(i: int) -> Any:
        source = first if START_S <= t[i] <= STOP_S else i
        sweep, shift_ns = old.read(source), int(old.t_ns[i] - old.t_ns[source])
        times = None if sweep.t_ns is None else sweep.t_ns + shift_ns
        return replace(sweep, stamp_ns=sweep.stamp_ns + shift_ns, t_ns=times)

    return with_stream(log, Stream(LIDAR, old.t_ns, read))


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


def yawed_lidar(log: Log, degrees: float = 1.0) -> Log:
    lidar = log.lidars[LIDAR]
    return log.changed(lidars={LIDAR: replace(lidar, mount_T_lidar=yawed(lidar.mount_T_lidar, degrees))})


def yawed_camera(log: Log) -> Log:
    camera = log.cameras["front"]
    return log.changed(cameras={**log.cameras, "front": replace(camera, mount_T_cam=yawed(camera.mount_T_cam, 1.0))})


def swapped_cameras(log: Log) -> Log:
    names = ("front_left", "front_right")
    mounts = [log.cameras[name].mount_T_cam for name in names[::-1]]
    swapped = {name: replace(log.cameras[name], mount_T_cam=mount) for name, mount in zip(names, mounts)}
    return log.changed(cameras={**log.cameras, **swapped})


def with_poses(change: Callable[[Array, Array], object], every_s: float = 0.0) -> Change:
    """Poses changed in place, `change(during, map_T_ego)` with those that are wrong, or only some of them, 20 ms apart as they are."""

    def changed(log: Log) -> Log:
        assert log.ego is not None
        kept = np.arange(0, len(log.ego.t_ns), max(round(every_s / 0.02), 1))
        t_ns, poses = log.ego.t_ns[kept], log.ego.map_T_ego[kept].copy()
        t = seconds(log, t_ns)
        change(np.flatnonzero((t >= START_S) & (t <= STOP_S)), poses)
        return log.changed(ego=replace(log.ego, t_ns=t_ns, map_T_ego=poses))

    return changed


def jump(during: Any, poses: Array) -> None:
    poses[during, :2, 3] += [3.0, 4.0]


def freeze(during: Any, poses: Array) -> None:
    poses[during] = poses[during[0]]


def nees_during(scenario: Scenario) -> float:
    """Mean squared position error over squared sigma, a half for each axis, of the ticks while the fault lasts."""
    compared, t_s, _ = compare_scenarios(scenario, sample()[1], Selection(RANGE_M, frozenset(CATEGORIES)))
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
    log, truth = sample()
    result = reconstruct(change(log), config)
    kinds = {fault["kind"] for fault in result.report["faults"]}
    figures = evaluate(result.scenario, truth, max_range_m=RANGE_M)
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
    # A rider leaves within that second.
    "one LiDAR sweep repeated for 1 s": (repeated_sweep, ("repeated_sweeps",), {}, (0.97, 0.97, 0.3, 0.3)),
    "LiDAR stamps + 100 ms": (late_sweeps, ("time_offset",), {}, ()),
    "LiDAR stamps + 100 ms, --fix-time": (late_sweeps, ("time_offset",), {"fix_time": True}, (None, None, 0.2)),
    "LiDAR mount yawed by 1 degree": (yawed_lidar, ("lidar_rotation",), {}, ()),
    "LiDAR mount yawed by 1 degree, --fix-calibration": (
        yawed_lidar, ("lidar_rotation",), {"fix_mounts": True}, (None, None, 0.22),
    ),
    "camera yawed by 1 degree": (yawed_camera, ("camera_rotation",), {}, ()),
    "left and right extrinsics swapped": (swapped_cameras, ("swapped_cameras",), {}, ()),
    "GNSS jump of 5 m for 1 s": (with_poses(jump), ("pose_jump",), {}, (0.98, 0.97, 0.22)),
    "GNSS frozen for 1 s": (with_poses(freeze), ("frozen_poses",), {}, (0.97, 0.97, 0.25, None, 0.15)),
    "poses at 1 Hz": (with_poses(lambda *_: None, 1.0), None, {}, (0.98, 0.97)),
    "poses at 0.8 Hz": (with_poses(lambda *_: None, 1.25), None, {}, (0.98, 0.97)),
    "no LiDAR for 1 s": (no_sweeps, ("missing_sweeps",), {}, (None, None, None, None, None, 2.0)),
}  # fmt: skip
# A clock and poses; a run takes 20 s, and other tests find the other faults in small logs.
SLOW_TESTS = {"LiDAR stamps + 100 ms, --fix-time", "GNSS frozen for 1 s"}
for _name, (_change, _told, _fixes, _values) in FAULTS.items():
    _limits = {key: value for key, value in zip(LIMITS, _values) if value is not None}
    _words = [] if _told is None else ["told" if _told else "nothing told"]
    _words += [LIMITS[key].format(value) for key, value in _limits.items()]
    case(f"sensor: {_name}", ", ".join(_words), run_by="slow tests" if _name in SLOW_TESTS else "tool")(
        partial(run, _change, _told, _fixes, _limits)
    )
