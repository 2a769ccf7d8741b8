"""Extremes of whole logs: a small synthetic one, spoiled or moved, goes all the way from its folder to a scenario."""

from __future__ import annotations

import csv
import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from extremes import FAR_M, Outcome, case

from log2sim import Config, Scenario, open_log, reconstruct
from log2sim.errors import Log2SimError, LogError, NothingToReconstruct
from log2sim.logs.writer import write_log
from log2sim.pipeline import Result
from log2sim.synth.assemble import synthesize
from log2sim.synth.scene import scene_from_table
from log2sim.types import Log

LABELS = Config.load(detect={"name": "labels"})
Row = dict[str, str]


@lru_cache
def small_log() -> Log:
    """Six ticks of a street with a car, a parked car and a pedestrian."""
    agents = [
        {"id": "car", "category": "car", "size_m": [4.4, 1.8, 1.5], "waypoints": [[16.0, 2.0, 4.0], [40.0, 2.0, 4.0]]},
        {"id": "parked", "category": "car", "size_m": [4.2, 1.8, 1.5], "pose": [14.0, -4.0, 10.0]},
        {"id": "walker", "category": "pedestrian", "waypoints": [[12.0, 5.0, 1.4], [12.0, -5.0, 1.4]]},
    ]
    lidar = {
        "name": "top",
        "position_m": [1.2, 0.0, 1.9],
        "channels": 20,
        "elevation_deg": [-18.0, 3.0],
        "range_m": 60.0,
    }
    table = {
        "name": "extreme", "duration_s": 0.6, "agent": agents,
        "ego": {"waypoints": [[0.0, 0.0, 3.0], [20.0, 0.0, 3.0]], "poses": "poses"},
        "road": [{"line": [[-10.0, 0.0], [50.0, 0.0]], "width_m": 10.0}],
        "camera": [{"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [320, 200], "offset_s": 0.03}],
        "lidar": [lidar | {"azimuth_deg": [-60.0, 60.0], "azimuth_step_deg": 0.6}],
        "gnss": {"position_sigma_m": 0.0, "angle_sigma_deg": 0.0},
    }  # fmt: skip
    return synthesize(scene_from_table(table), seed=0)[0]


@lru_cache
def files_of_small_log() -> dict[str, bytes]:
    """Everything in the folder of the small log."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "log"
        write_log(small_log(), folder)
        return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


@contextmanager
def folder_of(change: Callable[[Path], object]) -> Iterator[Path]:
    """A folder with the small log, changed."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "log"
        for name, content in files_of_small_log().items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        change(folder)
        yield folder


def result_of(change: Callable[[Path], object], *, picture: bool = False) -> Result:
    with folder_of(change) as folder:
        return reconstruct(open_log(folder), LABELS, picture=picture)


@lru_cache
def sound() -> Result:
    """What the small log gives when nothing is done to it."""
    return result_of(lambda folder: None)


def rows_changed(folder: Path, change: Callable[[Row], object]) -> None:
    """Change every row of every table."""
    for file in folder.rglob("*.csv"):
        with file.open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        for row in rows:
            change(row)
        with file.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


def farthest_m(a: Scenario, b: Scenario, shift_m: tuple[float, ...] = (0.0, 0.0)) -> float:
    """Largest distance of the waypoints of two scenarios in the world; infinite where they do not hold the same agents."""
    if [(x.id, len(x.waypoints)) for x in a.agents] != [(x.id, len(x.waypoints)) for x in b.agents]:
        return float("inf")
    move = np.array(b.map.offset_m[:2]) - np.array(a.map.offset_m[:2]) - np.array(shift_m[:2])
    apart = [
        np.hypot(x.waypoints.x_m - (y.waypoints.x_m + move[0]), x.waypoints.y_m - (y.waypoints.y_m + move[1])).max()
        for x, y in zip(a.agents, b.agents)
    ]
    return float(max(apart))


def same(result: Result, within_m: float, shift_m: tuple[float, ...] = (0.0, 0.0), found: str = "") -> Outcome:
    error = farthest_m(sound().scenario, result.scenario, shift_m)
    return Outcome(error <= within_m, found or ("the same" if error <= within_m else "another scenario"), None, error)


def refused(change: Callable[[Path], object], words: str, kind: type[Log2SimError] = LogError) -> Outcome:
    """The log is refused with a message of ours that holds the words."""
    try:
        result_of(change)
    except kind as error:
        return Outcome(words in str(error), f"refused: {str(error).split('/')[-1][:90]}")
    return Outcome(False, "accepted")


def refused_log(log: Log, words: str, kind: type[Log2SimError] = LogError) -> Outcome:
    """The same for a log in memory, as a reader of others may make it."""
    try:
        reconstruct(log, LABELS)
    except kind as error:
        return Outcome(words in str(error), f"refused: {str(error)[:90]}")
    return Outcome(False, "accepted")


def known_and_finite(result: Result, least_agents: int) -> tuple[bool, str]:
    agents = result.scenario.others
    finite = all(
        np.isfinite(getattr(a.waypoints, k)).all() for a in result.scenario.agents for k in ("x_m", "y_m", "yaw_rad")
    )
    return finite and len(agents) >= least_agents, f"{len(agents)} agents"


# --- places and times


@case("map: UTM coordinates of 5e6 m", "as at the origin to 1e-6 m")
def far_away() -> Outcome:
    def move(row: Row) -> None:
        for column, shift in zip(("x_m", "y_m"), FAR_M):
            if column in row:
                row[column] = repr(float(row[column]) + shift)

    return same(result_of(lambda f: rows_changed(f, move)), 1e-6, tuple(FAR_M))


def later(shift_ns: int) -> Result:
    def shift(row: Row) -> None:
        row["t_ns"] = str(int(row["t_ns"]) + shift_ns)

    return result_of(lambda f: rows_changed(f, shift))


@case("stamps: of 6.7e18 ns", "as at 1.7e18 ns to 1e-9 m")
def large_stamps() -> Outcome:
    return same(later(5_000_000_000_000_000_000), 1e-9)


@case("stamps: negative, and zero among them", "as at 1.7e18 ns to 1e-9 m")
def negative_stamps() -> Outcome:
    return same(later(-int(sound().scenario.t0_ns) - 100_000_000), 1e-9)


@case("stamps: every record twice", "repetitions left out and noted, the same scenario")
def repeated_stamps() -> Outcome:
    def repeat(folder: Path) -> None:
        for file in (folder / "front/index.csv", folder / "top/index.csv", folder / "ego/poses.csv"):
            head, *rows = file.read_text().splitlines()
            file.write_text("\n".join([head, *(r for row in rows for r in (row, row))]) + "\n")

    with folder_of(repeat) as folder:
        log = open_log(folder)
        outcome = same(reconstruct(log, LABELS), 1e-9)
    noted = sum("repeat" in n or "same stamp" in n or "twice" in n or "duplicate" in n for n in log.notes)
    return replace(outcome, ok=outcome.ok and noted > 0, found=f"{outcome.found}, {noted} notes")


@case("stamps: in reverse order", "put in order and noted, the same scenario")
def reversed_stamps() -> Outcome:
    def reverse(folder: Path) -> None:
        for file in (folder / "front/index.csv", folder / "top/index.csv", folder / "ego/poses.csv"):
            head, *rows = file.read_text().splitlines()
            file.write_text("\n".join([head, *reversed(rows)]) + "\n")

    with folder_of(reverse) as folder:
        log = open_log(folder)
        outcome = same(reconstruct(log, LABELS), 1e-9)
    return replace(outcome, ok=outcome.ok and len(log.notes) > 0, found=f"{outcome.found}, {len(log.notes)} notes")


@case("stamps: a frame 1 us after another", "one tick each, finite")
def microsecond_frame() -> Outcome:
    def double(folder: Path) -> None:
        file = folder / "front/index.csv"
        lines = file.read_text().splitlines()
        t_ns, image = lines[3].split(",", 1)
        lines.insert(4, f"{int(t_ns) + 1000},{image}")
        file.write_text("\n".join(lines) + "\n")

    result = result_of(double)
    ok, found = known_and_finite(result, 2)
    increasing = all((np.diff(a.waypoints.t_s) > 0).all() for a in result.scenario.agents)
    return Outcome(ok and increasing and result.report["ticks"] == sound().report["ticks"] + 1, found)


# --- records


@case("cloud: NaN and inf points", "left out, the same scenario")
def bad_points() -> Outcome:
    def spoil(folder: Path) -> None:
        for file in (folder / "top").glob("*.npz"):
            with np.load(file) as data:
                columns = dict(data)
            for bad in (np.nan, np.inf, -np.inf):
                columns["xyz_m"] = np.concatenate([columns["xyz_m"], np.full((50, 3), bad, columns["xyz_m"].dtype)])
                columns["t_offset_ns"] = np.concatenate([columns["t_offset_ns"], columns["t_offset_ns"][:50]])
            np.savez(file, **columns)

    return same(result_of(spoil), 1e-9)


@case("cloud: one sweep without points", "counted, the others do")
def empty_sweep() -> Outcome:
    def empty(folder: Path) -> None:
        file = sorted((folder / "top").glob("*.npz"))[2]
        np.savez(file, xyz_m=np.zeros((0, 3), np.float32), t_offset_ns=np.zeros(0, np.int64))

    result = result_of(empty)
    ok, found = known_and_finite(result, 2)
    count = result.report["unreadable"].get("top", {}).get("count", 0)
    return Outcome(ok and count == 1, f"{found}, {count} unreadable")


@case("image: one cut in half", "counted, the others do")
def cut_image() -> Outcome:
    def cut(folder: Path) -> None:
        file = sorted((folder / "front").glob("*.jpg"))[1]
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])

    result = result_of(cut, picture=True)
    ok, found = known_and_finite(result, 2)
    count = result.report["unreadable"].get("front", {}).get("count", 0)
    return Outcome(ok and count == 1, f"{found}, {count} unreadable")


@case("image: all cut in half", "refused, naming the stream")
def cut_images() -> Outcome:
    def cut(folder: Path) -> None:
        for file in (folder / "front").glob("*.jpg"):
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])

    try:
        result_of(cut, picture=True)
    except LogError as error:
        return Outcome("stream 'front'" in str(error), "refused: stream 'front'")
    return Outcome(False, "accepted")


@case("frames: nobody in any", "the ego alone")
def nobody() -> Outcome:
    log = small_log()
    late = {n: replace(b, t_ns=b.t_ns + 10**15) for n, b in log.image_labels.items()}
    result = reconstruct(replace(log, image_labels=late), LABELS)
    return Outcome(
        [a.id for a in result.scenario.agents] == ["ego"], f"{len(result.scenario.others)} agents beside the ego"
    )


# --- logs that lack something


@case("log: one camera", "all agents, no fusion")
def one_camera() -> Outcome:
    ok, found = known_and_finite(sound(), 3)
    return Outcome(ok and not any(p["kept"] for p in sound().report["plan"] if p["stage"] == "fuse"), found)


@case("log: no camera", "refused, saying that ticks are frames")
def no_camera() -> Outcome:
    log = small_log()
    return refused_log(replace(log, cameras={}, image_labels={}, reference_camera=None), "no camera")


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


@case("log: no ego pose, sensors on the ego", "refused: nothing has a place")
def lost_ego() -> Outcome:
    return refused_log(replace(small_log(), ego=None, labels=None), "no ego poses", NothingToReconstruct)


@case("log: one frame", "a scenario of one moment")
def one_frame() -> Outcome:
    with folder_of(lambda f: None) as folder:
        result = reconstruct(open_log(folder), replace(LABELS, start_s=0.2, stop_s=0.2))
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


@case("calibration: quaternion not of length 1", "refused, naming the sensor")
def long_quaternion() -> Outcome:
    return refused(manifest(lambda m: m["sensors"][0].update(rotation_wxyz=[0.5, -0.5, 0.6, -0.5])), "rotation_wxyz")


@case("calibration: focal length 0 in the file", "refused, naming the field")
def no_focal_length() -> Outcome:
    return refused(manifest(lambda m: m["sensors"][0]["intrinsics"].update(fx_px=0)), "fx_px")


def with_camera(**changes: Any) -> Log:
    log = small_log()
    return replace(log, cameras={"front": replace(log.cameras["front"], **changes)})


@case("calibration: rotation not orthonormal (log in memory)", "refused, naming the sensor")
def skew_rotation() -> Outcome:
    skew = small_log().cameras["front"].mount_T_cam.copy()
    skew[0, 0] += 0.1
    return refused_log(with_camera(mount_T_cam=skew), "'front'")


@case("calibration: mirrored rotation (log in memory)", "refused, naming the sensor")
def mirrored_rotation() -> Outcome:
    mirror = small_log().cameras["front"].mount_T_cam @ np.diag([-1.0, 1.0, 1.0, 1.0])
    return refused_log(with_camera(mount_T_cam=mirror), "'front'")


@case("calibration: singular K (log in memory)", "refused, naming the camera")
def singular_intrinsics() -> Outcome:
    k = small_log().cameras["front"].K.copy()
    k[1, 1] = 0.0
    return refused_log(with_camera(K=k), "'front'")


@case("calibration: NaN in K (log in memory)", "refused, naming the camera")
def nan_intrinsics() -> Outcome:
    k = small_log().cameras["front"].K.copy()
    k[0, 2] = np.nan
    return refused_log(with_camera(K=k), "'front'")


@case("calibration: LiDAR rotation not orthonormal (log in memory)", "refused, naming the sensor")
def skew_lidar() -> Outcome:
    log = small_log()
    lidar = log.lidars["top"]
    return refused_log(replace(log, lidars={"top": replace(lidar, mount_T_lidar=lidar.mount_T_lidar * 1.1)}), "'top'")
