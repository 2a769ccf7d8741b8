"""The sound inputs: a small synthetic log in each format, a scenario of it, and an OpenSCENARIO file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

from log_encoders import argoverse, kitti, kitti_object, native, nuscenes, pandaset, ros, waymo, waymo_parquet
from log_encoders.world import make_world

from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import Log
from log2sim.export.exporters import Options, export

CAMERA = [{"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [240, 150], "offset_s": 0.05}]
DURATION_S = 0.25


@cache
def small_world() -> Log:
    """The world of the encoders, some ticks of it, with small images."""
    return make_world(duration_s=DURATION_S, camera=CAMERA)


def _nuscenes(log: Log, folder: Path) -> Path:
    """With the LiDAR of the encoder's own world."""
    view_deg = 180.0 * 10.0 * nuscenes.VIEW_FIRINGS * nuscenes.FIRING_NS / 1e9
    step = 2 * view_deg * nuscenes.FIRING_STEP / nuscenes.VIEW_FIRINGS
    lidar = {
        "name": "top", "position_m": [0.75, 0.0, 2.125], "channels": nuscenes.RINGS, "elevation_deg": [-20.0, 2.0],
        "azimuth_deg": [-view_deg, view_deg], "azimuth_step_deg": step, "range_m": 60.0,
    }  # fmt: skip
    world = make_world(duration_s=DURATION_S, camera=CAMERA, lidar=[lidar])
    return nuscenes.encode(replace(world, name=log.name), folder)


def _bag(container: str, compression: str = "") -> Callable[[Log, Path], Path]:
    return lambda log, folder: ros.encode_as(log, folder, ros.Style(container=container, compression=compression))


LOGS: dict[str, Callable[[Log, Path], Path]] = {
    "native": native.encode,
    "kitti raw": kitti.encode_raw,
    "kitti object": kitti_object.encode,
    "kitti tracking": kitti.encode_tracking,
    "pandaset": pandaset.encode,
    "nuscenes": _nuscenes,
    "argoverse 2": argoverse.encode,
    "waymo v1": waymo.encode,
    "waymo v2": waymo_parquet.encode,
    "ros1 bag": _bag("bag"),
    "ros1 bag bz2": _bag("bag", "bz2"),
    "rosbag2 db3": _bag("db3"),
    "mcap": _bag("mcap"),
    "mcap zstd": _bag("mcap", "storage"),
}
WITHOUT_LABELS = ("ros1 bag", "ros1 bag bz2", "rosbag2 db3", "mcap", "mcap zstd")
SCENARIO, XOSC = "scenario", "xosc"
KINDS = (*LOGS, SCENARIO, XOSC)


def write_base(kind: str, folder: Path) -> Path:
    """Write the sound input of a kind below a folder; return what a command gets."""
    folder.mkdir(parents=True)
    if kind in LOGS:
        return LOGS[kind](small_world(), folder)
    log = native.encode(small_world(), folder / "log")
    scenario = reconstruct(open_log(log), Config.load(detect={"name": "labels"})).scenario
    (folder / "input").mkdir()
    if kind == SCENARIO:
        path = folder / "input" / "scenario.json"
        scenario.save(path)
        return path
    export(scenario, "openscenario", folder / "export", Options())
    path = folder / "input" / "scenario.xosc"
    next((folder / "export").glob("*.xosc")).rename(path)
    return path
