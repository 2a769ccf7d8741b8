"""Extremes of a log's sensors: those that it lacks, and calibrations that no sensor has."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from extremes.small_log import LABELS, folder_of, known_and_finite, refused, refused_log, small_log, sound
from extremes.table import Outcome, case
from log2sim import open_log, reconstruct
from log2sim.datatypes import Log
from log2sim.errors import MissingExtra


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


@case("log: no ego pose, sensors on the ego", "refused: an empty street does not show it; or names the missing extra")
def lost_ego() -> Outcome:
    try:
        return refused_log(replace(small_log(), ego=None, labels=None), "cannot tell how the ego moves")
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
