"""Ground, clusters and pictures: log2sim beside Patchwork++, Open3D's DBSCAN and another network, on the same records, one thread each.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python tools/bench.py lidar_peers LOG ... --model yolox_nano.onnx

Needs the packages pypatchworkpp and open3d; what is right is counted where a log has labels. Milliseconds of the processor a sweep or picture, medians of a dozen.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.lidar import clouds_of_log
from benchmarks.table import markdown
from log2sim.datatypes import Frame, Log
from log2sim.geometry import Array
from log2sim.logs.opening import open_log
from log2sim.perception.boxes import rotate
from log2sim.perception.detect.detectors import create_detector
from log2sim.perception.lidar.cloud import Cloud, estimate_ground
from log2sim.perception.lidar.clusters import _cluster
from log2sim.plan import IMAGE_DETECTOR

# Points this high above the bottom of a labeled box are its object's and no ground.
BODY_M = 0.3
# Objects with fewer points do not count. A cluster is that of an object with at least this overlap (IoU) of their points.
MIN_POINTS, MIN_OVERLAP = 20, 0.5
# Edge of log2sim's cells and radius of DBSCAN; least points of DBSCAN's core points.
APART_M, CORE_POINTS = 0.4, 5
NEAREST_LABEL_NS = 60_000_000
PICTURES = 12


def timed(call: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return what a call returns, and its time of the processor, ms."""
    begun = time.process_time()
    return call(*arguments), 1e3 * (time.process_time() - begun)


def bodies(log: Log, cloud: Cloud) -> list[Array]:
    """Return the points, as a mask (N,), of each labeled object of a cloud that are not near the ground."""
    labels, out = log.labels, list[Array]()
    if labels is None:
        return []
    off_ns = np.abs(labels.t_ns - cloud.stamp_ns)
    for track in np.unique(labels.track_id[off_ns < NEAREST_LABEL_NS]):
        k = int(np.argmin(np.where(labels.track_id == track, off_ns, np.iinfo(np.int64).max)))
        away = cloud.xyz - (labels.center_m[k] - cloud.origin)
        half, local = labels.size_m[k] / 2, rotate(away[:, :2], -float(labels.yaw_rad[k]))
        inside = (np.abs(local) <= half[:2]).all(axis=1) & (away[:, 2] > BODY_M - half[2]) & (away[:, 2] < half[2])
        out.append(np.asarray(inside))
    return out


def count_clustered(clusters: Array, objects: list[Array], rows: Array) -> tuple[int, int]:
    """Count the objects with a cluster of their own, by labels (n,) of points `rows` (n,), and all that have enough points."""
    good = total = 0
    for mask in (of[rows] for of in objects):
        own = clusters[mask]
        if len(own) >= MIN_POINTS:
            names, count = np.unique(own[own >= 0], return_counts=True)
            overlaps = [n / (np.count_nonzero(clusters == name) + len(own) - n) for name, n in zip(names, count)]
            good, total = good + (max(overlaps, default=0.0) > MIN_OVERLAP), total + 1
    return good, total


def of_sweeps(path: Path) -> tuple[list[list[Any]], list[list[Any]]]:
    """Return rows about ground and about clusters of a log."""
    import open3d
    import pypatchworkpp

    log, ground, clusters = open_log(path), dict[str, list[Any]](), dict[str, list[Any]]()
    peer: Any = None
    for cloud, _ in clouds_of_log(path):
        objects = bodies(log, cloud)
        body = np.any(objects, axis=0) if objects else np.zeros(len(cloud.xyz), dtype=bool)
        plane, ms = timed(estimate_ground, cloud.xyz, np.zeros(2), 0.0)
        _, of_points_ms = timed(plane.at, cloud.xyz[:, :2])
        ground.setdefault("log2sim", []).append((ms + of_points_ms, _mean(cloud.ground[body]), _mean(cloud.ground)))
        if peer is None:
            settings = pypatchworkpp.Parameters()
            settings.sensor_height = float(cloud.sensor[2] - plane.at(cloud.sensor[None, :2])[0])
            settings.verbose = False
            peer = pypatchworkpp.patchworkpp(settings)
        local = np.column_stack([cloud.xyz - cloud.sensor, np.zeros(len(cloud.xyz))]).astype(np.float64)
        _, ms = timed(peer.estimateGround, local)
        theirs = np.zeros(len(local), dtype=bool)
        theirs[peer.getGroundIndices()] = True
        ground.setdefault("Patchwork++", []).append((ms, _mean(theirs[body]), _mean(theirs)))
        rows = cloud.obstacles
        (ours, _, _), ms = timed(_cluster, cloud.xyz[rows, :2], APART_M)
        clusters.setdefault("log2sim, connected cells", []).append((ms, *count_clustered(ours, objects, rows)))
        points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.xyz[rows].astype(np.float64)))
        labels, ms = timed(points.cluster_dbscan, APART_M, CORE_POINTS)
        clusters.setdefault("Open3D, DBSCAN", []).append((ms, *count_clustered(np.array(labels), objects, rows)))
    about_ground, about_clusters = [], []
    for name, of in ground.items():
        ms, of_bodies, of_all = zip(*of)
        about_ground.append([log.name, name, f"{np.median(ms):.1f}", _share(of_bodies), _share(of_all)])
    for name, of in clusters.items():
        ms, own, total = zip(*of)
        found = f"{sum(own)} of {sum(total)}" if sum(total) else "-"
        about_clusters.append([log.name, name, f"{np.median(ms):.1f}", found])
    return about_ground, about_clusters


def _mean(marked: Array) -> float:
    return float(marked.mean()) if len(marked) else np.nan


def _share(values: Sequence[float]) -> str:
    known = [value for value in values if np.isfinite(value)]
    return f"{np.mean(known):.3f}" if known else "-"


def of_pictures(path: Path, models: list[str]) -> list[list[Any]]:
    """Return rows about detectors in pictures of the first camera of a log."""
    log, rows = open_log(path), []
    if not log.cameras:
        return []
    name, camera = next(iter(log.cameras.items()))
    stream = log.streams[name]
    chosen = np.linspace(0, len(stream.t_ns) - 1, PICTURES).astype(int).tolist()
    for model in models:
        detector, spent = create_detector(model, log), list[float]()
        for k in chosen:
            frame = Frame(camera, int(stream.t_ns[k]), partial(np.asarray, stream.read(k)))
            spent.append(timed(detector.detect, frame)[1])
        rows.append([log.name, detector.name, f"{camera.width_px} x {camera.height_px}", f"{np.median(spent):.1f}"])
    return rows


def main(logs: list[Path], model: Path | None = None) -> None:
    cv2.setNumThreads(1)
    sweeps = [of_sweeps(path) for path in logs]
    pictures = [of_pictures(path, [IMAGE_DETECTOR, *([] if model is None else [str(model)])]) for path in logs]
    about_ground, about_clusters = ([row for of in about for row in of] for about in zip(*sweeps))
    print(markdown(["log", "ground by", "ms", "of bodies called ground", "of all"], about_ground))
    print(markdown(["log", "clusters by", "ms", "objects with a cluster"], about_clusters))
    print(markdown(["log", "detector", "picture, px", "ms"], [r for of in pictures for r in of]))
