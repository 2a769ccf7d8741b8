"""Times of the LiDAR detector, one thread, on logs with a LiDAR on a vehicle and on simulated clouds.

OPENBLAS_NUM_THREADS=1 python tools/bench.py lidar --log PANDASET/002 --log KITTI/2011_09_26 --write BENCHMARKS.md
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from training.clouds import level

from benchmarks.table import markdown, replace_section
from log2sim.config import LidarConfig
from log2sim.logs.opening import open_log
from log2sim.perception.detect3d.detectors import NetworkDetector, open_shipped
from log2sim.perception.detect3d.network import grid_window, level_points, rasterize, viewpoints_xy
from log2sim.perception.first_pass import cloud_origin
from log2sim.perception.lidar.cloud import Cloud, assemble_cloud
from log2sim.synth.returns import LIDAR_MODELS
from log2sim.synth.traffic import Mount, draw_scene

SWEEPS, REPEATS = 12, 5
HEAD = ["clouds", "points in range", "cells", "leveling", "grid", "network", "decoding, second stage", "cloud to boxes", "over network alone"]  # fmt: skip


def fastest_ms(call: Callable[[], Any]) -> float:
    """The least of a few times of the processor, ms: other programs only ever add to it."""
    times = []
    for _ in range(REPEATS):
        begun = time.process_time()
        call()
        times.append(time.process_time() - begun)
    return 1e3 * min(times)


def clouds_of_log(path: Path) -> list[tuple[Cloud, float]]:
    """Clouds of some sweeps of a log, and the time that leveling and motion compensation of each took."""
    log, out = open_log(path), []
    stream = log.streams[next(iter(log.lidars))]
    for k in np.linspace(0, len(stream.t_ns) - 1, SWEEPS).astype(int):
        sweeps = {name: log.streams[name].read(min(k, len(log.streams[name].t_ns) - 1)) for name in log.lidars}
        origin, ground_z = cloud_origin(log, int(stream.t_ns[k]))

        def assemble(sweeps: Any = sweeps, origin: Any = origin, ground_z: float = ground_z) -> Cloud | None:
            return assemble_cloud(log, sweeps, origin=origin, ground_z=ground_z, max_range_m=50.0)

        if (cloud := assemble()) is not None:
            out.append((cloud, fastest_ms(assemble)))
    return out


def simulated_clouds(mount: Mount, lidar: str) -> list[tuple[Cloud, float]]:
    """Clouds of random scenes, and the time that leveling each took."""
    out = []
    for k in range(SWEEPS):
        rng = np.random.default_rng([11, k])
        scene = draw_scene(mount, rng, lidar=LIDAR_MODELS[lidar])
        points, sensor = scene.cast(rng).xyz_m, scene.sensor.position_m
        out.append((level(points, sensor)[0], fastest_ms(lambda points=points, sensor=sensor: level(points, sensor))))
    return out


def row(name: str, clouds: list[tuple[Cloud, float]], detector: NetworkDetector) -> list[str]:
    """Median times of the steps of one detector on some clouds."""
    cell_m, range_m, columns = detector.network.info.cell_m, detector.range_m, []
    for cloud, leveling in clouds:
        xyz, _ = level_points(cloud, range_m)
        low, shape = grid_window(xyz[:, :2], cell_m=cell_m, range_m=range_m, center=viewpoints_xy(cloud)[0])

        def grid_of(xyz: Any = xyz, low: Any = low, shape: Any = shape) -> Any:
            return rasterize(xyz, cell_m=cell_m, low=low, shape=shape)

        grid = grid_of()
        raster, network = fastest_ms(grid_of), fastest_ms(lambda grid=grid: detector.network.run(grid))
        whole = fastest_ms(lambda cloud=cloud: detector.detect(cloud))
        steps = [leveling, raster, network, whole - raster - network, whole, whole / network]
        columns.append([len(xyz), shape[0] * shape[1], *steps])
    m = np.median(columns, axis=0)
    return [name, f"{m[0]:.0f}", f"{m[1] / 1e3:.0f}k", *(f"{v:.1f}" for v in m[2:7]), f"{m[7]:.2f}"]


def main(log: list[Path] = [], write: Path | None = None) -> None:
    cv2.setNumThreads(1)
    vehicle, roadside = (open_shipped(name, LidarConfig()) for name in ("vehicle", "roadside"))
    rows = [row(open_log(path).name, clouds_of_log(path), vehicle) for path in log]
    rows.append(row("simulated, HDL-64E", simulated_clouds("vehicle", "hdl64e"), vehicle))
    rows.append(row("simulated, roadside of 16 lines", simulated_clouds("roadside", "rslidar16-roadside"), roadside))
    text = (
        "## LiDAR detection: time\n\n`OPENBLAS_NUM_THREADS=1 python tools/bench.py lidar --log PANDASET/002 --log KITTI/2011_09_26 --write BENCHMARKS.md`. "
        "Milliseconds of the processor, one thread, medians over a dozen sweeps of the least of five runs. Leveling (motion compensation and "
        'the ground) is part of every run with a LiDAR and not of "cloud to boxes".\n\n' + markdown(HEAD, rows)
    )
    if write:
        replace_section(write, "lidar", text)
    print(text)
