"""Times of the LiDAR detector and of the simulated LiDAR, one thread.

python tools/bench.py lidar [--log PANDASET] [--log KITTI] [--write BENCHMARKS.md]
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from entry import parser_of

from benchmarks.table import markdown, replace_section
from log2sim.config import LidarConfig
from log2sim.logs.opening import open_log
from log2sim.perception.detect3d.detectors import WEIGHTS, NetworkDetector, open_shipped
from log2sim.perception.detect3d.network import grid_window, level_points, rasterize, viewpoints_xy
from log2sim.perception.first_pass import cloud_origin
from log2sim.perception.lidar.cloud import Cloud, assemble_cloud
from log2sim.synth.returns import LIDAR_MODELS
from log2sim.synth.traffic import Mount, draw_scene, labeled_cloud

SWEEPS = 12
REPEATS = 5


def fastest_ms(call: Callable[[], Any]) -> float:
    """The least of a few times of the processor, ms: other programs only ever add to it."""
    times = []
    for _ in range(REPEATS):
        begun = time.process_time()
        call()
        times.append(time.process_time() - begun)
    return 1e3 * min(times)


def clouds_of_log(path: str) -> list[tuple[Cloud, float]]:
    """Clouds of some sweeps of a log, and the time that leveling and motion compensation of each took."""
    log = open_log(path)
    stream = log.streams[next(iter(log.lidars))]
    out = []
    for k in np.linspace(0, len(stream.t_ns) - 1, SWEEPS).astype(int):
        sweeps = {name: log.streams[name].read(min(k, len(log.streams[name].t_ns) - 1)) for name in log.lidars}
        origin, ground_z = cloud_origin(log, int(stream.t_ns[k]))

        def assemble(sweeps: Any = sweeps, origin: Any = origin, ground_z: float = ground_z) -> Cloud | None:
            return assemble_cloud(log, sweeps, origin=origin, ground_z=ground_z, max_range_m=50.0)

        cloud = assemble()
        if cloud is not None:
            out.append((cloud, fastest_ms(assemble)))
    return out


def simulated_clouds(mount: Mount, lidar: str) -> list[tuple[Cloud, float]]:
    """Clouds of random scenes, and the time that leveling each took."""
    from lidar_training.clouds import level

    out = []
    for k in range(SWEEPS):
        rng = np.random.default_rng([11, k])
        scene = draw_scene(mount, rng, lidar=LIDAR_MODELS[lidar])
        points = labeled_cloud(scene, rng).xyz_m
        sensor = scene.sensor.position_m
        out.append((level(points, sensor), fastest_ms(lambda points=points, sensor=sensor: level(points, sensor))))
    return out


def row(name: str, clouds: list[tuple[Cloud, float]], detector: NetworkDetector) -> list[str]:
    """Median times of the steps of one detector on some clouds."""
    info, columns = detector.network.info, []
    for cloud, leveling in clouds:
        xyz, _ = level_points(cloud, detector.range_m)
        low, shape = grid_window(
            xyz[:, :2], cell_m=info.cell_m, range_m=detector.range_m, center=viewpoints_xy(cloud)[0]
        )
        grid = rasterize(xyz, cell_m=info.cell_m, low=low, shape=shape)
        raster = fastest_ms(
            lambda xyz=xyz, low=low, shape=shape: rasterize(xyz, cell_m=info.cell_m, low=low, shape=shape)
        )
        network = fastest_ms(lambda grid=grid: detector.network.run(grid))
        whole = fastest_ms(lambda cloud=cloud: detector.detect(cloud))
        columns.append(
            [len(xyz), shape[0] * shape[1], leveling, raster, network, whole - raster - network, whole, whole / network]
        )
    m = np.median(columns, axis=0)
    return [name, f"{m[0]:.0f}", f"{m[1] / 1e3:.0f}k", *(f"{v:.1f}" for v in m[2:7]), f"{m[7]:.2f}"]


def generator_rows() -> list[list[str]]:
    """Scenes a second of the simulated LiDAR."""
    rows = []
    for mount, lidar in (
        ("vehicle", "hdl64e"),
        ("vehicle", "pandar64"),
        ("vehicle", "os1-128"),
        ("roadside", "rslidar16-roadside"),
    ):
        draw, cast, points = [], [], []
        for k in range(SWEEPS):
            rng = np.random.default_rng([12, k])
            begun = time.process_time()
            scene = draw_scene(mount, rng, lidar=LIDAR_MODELS[lidar])
            drawn = time.process_time()
            points.append(len(labeled_cloud(scene, rng).xyz_m))
            draw.append(drawn - begun)
            cast.append(time.process_time() - drawn)
        rows.append([
            lidar, f"{np.median(points):.0f}", f"{1e3 * np.median(draw):.0f}", f"{1e3 * np.median(cast):.0f}",
            f"{1 / np.mean(np.add(draw, cast)):.1f}",
        ])  # fmt: skip
    return rows


def cards() -> str:
    """Tables of what the shipped networks find in simulated scenes, from their model cards."""
    out = ["## LiDAR detection: simulated scenes\n"]
    for name in ("vehicle", "roadside"):
        card = json.loads((WEIGHTS / f"{name}.json").read_text())
        figures, rows, bins = card["simulated"], [], []
        for group in ("vehicle", "two_wheeler", "pedestrian"):
            f = figures[group]
            shares = {**f["recall_by_range_m"], **f["recall_by_points"]}
            flipped = "-" if f["headings_flipped"] is None else f"{f['headings_flipped']:.3f}"
            rows.append([
                group, f["match"], str(f["truths"]), *(f"{f[k]:.3f}" for k in ("average_precision", "precision", "recall", "f1")),
                flipped, *(f"{share:.2f}" if count else "-" for share, count in shares.values()),
            ])  # fmt: skip
            bins.append([group, *(f"{right:.2f} ({count})" for _, right, count in f["calibration"])])
        first = figures["vehicle"]
        head = ["group", "match", "truths", "AP R40", "precision", "recall", "F1", "headings > 90 deg"]
        head += [f"recall {k} m" for k in first["recall_by_range_m"]] + [
            f"recall {k} points" for k in first["recall_by_points"]
        ]
        rounds = "; ".join(f"{r['scenes']} scenes, {r['steps']} steps" for r in card["rounds"])
        out.append(
            f"### lidar:{name}\n\n{figures['scenes']} scenes that were not trained on, objects of 5 points and more within "
            f"{figures['max_range_m']:g} m, precision and recall at a score of {figures['score']:g}. Trained on {rounds} of "
            f"{card['batch']} clouds.\n\n{markdown(head, rows)}\n\nShare of boxes that are right by their score (count):\n\n"
            + markdown(
                ["group", *(f"{k / 10:.1f}-{(k + 1) / 10:.1f}" for k in range(1, 1 + max(len(b) for b in bins) - 1))],
                bins,
            )
            + "\n"
        )
    return "\n".join(out)


def main(arguments: list[str] | None = None) -> None:
    """Measure and print, or write into a file."""
    parser = parser_of(__doc__)
    parser.add_argument("--log", action="append", default=[], help="log with a LiDAR on a vehicle; may be repeated")
    parser.add_argument("--write", type=Path)
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    vehicle, roadside = (open_shipped(name, LidarConfig()) for name in ("vehicle", "roadside"))
    rows = [row(open_log(path).name, clouds_of_log(path), vehicle) for path in options.log]
    rows.append(row("simulated, HDL-64E", simulated_clouds("vehicle", "hdl64e"), vehicle))
    rows.append(row("simulated, roadside of 16 lines", simulated_clouds("roadside", "rslidar16-roadside"), roadside))
    head = [
        "clouds",
        "points in range",
        "cells",
        "leveling",
        "grid",
        "network",
        "decoding",
        "cloud to boxes",
        "over network alone",
    ]
    text = (
        "## LiDAR detection: time\n\n`OPENBLAS_NUM_THREADS=1 python tools/bench.py lidar --log PANDASET/002 --log KITTI/2011_09_26 --write BENCHMARKS.md`. Milliseconds of the processor, one thread, medians over a dozen sweeps of the least of five runs. "
        'Leveling (motion compensation and the ground) is part of every run with a LiDAR and not of "cloud to boxes".\n\n'
        + markdown(head, rows)
        + "\n\n## Simulated LiDAR: time\n\nMilliseconds of the processor a scene: drawing the world, casting the sweep.\n\n"
        + markdown(["sensor", "points", "draw", "cast", "scenes/s"], generator_rows())
    )
    text += "\n\n" + cards()
    if options.write:
        replace_section(options.write, "lidar", text)
    print(text)
