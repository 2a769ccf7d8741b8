"""LiDAR points of a sweep in the boxes of five cameras: log2sim beside OpenCV and plain numpy.

All do the same work: for each of 100 boxes the median depth of the points whose projection falls inside it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.table import markdown, optional, print_section, timed
from log2sim.geometry import Camera
from log2sim.perception.boxes import upper_median
from log2sim.perception.lidar.projection import View, points_in_image_boxes, project_points

Array = np.ndarray[Any, Any]

WIDTH_PX, HEIGHT_PX, FOCAL_PX, LIDAR_M = 1920, 1280, 2050.0, 2.1
HEADINGS_DEG = (0.0, 45.0, -45.0, 90.0, -90.0)
BOXES = 20
RINGS = 64
NEAREST_M = 0.5


def make_sweep(count: int, rng: np.random.Generator) -> Array:
    """Points (N, 3) float32, m, of a spinning LiDAR: ring by ring, ground, a wavy wall and forty obstacles before it."""
    azimuth = np.tile(np.linspace(-np.pi, np.pi, count // RINGS, endpoint=False), RINGS)
    elevation = np.radians(np.repeat(np.linspace(2.4, -17.6, RINGS), count // RINGS))
    harmonics = np.array([1, 2, 3, 5, 9, 17])
    waves = np.sin(azimuth[:, None] * harmonics + rng.uniform(0, 2 * np.pi, 6)) @ np.array(
        [9.0, 6.0, 4.0, 3.0, 2.0, 1.0]
    )
    wall = 28.0 + waves
    for middle_rad, half_rad, range_m in zip(
        rng.uniform(-np.pi, np.pi, 40), rng.uniform(0.02, 0.12, 40), rng.uniform(6.0, 35.0, 40), strict=True
    ):
        hit = (np.abs(azimuth - middle_rad) < half_rad) & (elevation < 0)
        wall[hit] = np.minimum(wall[hit], range_m)
    ground = np.where(elevation < -0.005, LIDAR_M / np.sin(np.maximum(-elevation, 1e-4)), np.inf)
    range_m = np.minimum(wall, ground) * rng.normal(1.0, 0.001, len(azimuth))
    flat = range_m * np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(elevation)]).astype(
        np.float32
    )


def make_views() -> list[View]:
    """Five cameras half a meter from the LiDAR, each looking its way."""
    k = np.array([[FOCAL_PX, 0, WIDTH_PX / 2], [0, FOCAL_PX, HEIGHT_PX / 2], [0, 0, 1]])
    views = []
    for heading in np.radians(HEADINGS_DEG):
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([[ahead[1], -ahead[0], 0.0], [0.0, 0.0, -1.0], ahead])
        pose[:3, 3] = 0.5 * ahead
        views.append(View(Camera("camera", WIDTH_PX, HEIGHT_PX, k, "ego", pose), 0, pose))
    return views


def make_boxes(rng: np.random.Generator) -> Array:
    """Boxes (20, 4) px around the horizon."""
    center = np.column_stack([rng.uniform(0, WIDTH_PX, BOXES), rng.uniform(560, 760, BOXES)])
    half = np.column_stack([rng.uniform(15, 200, BOXES), rng.uniform(15, 150, BOXES)])
    limits = np.array([WIDTH_PX - 1, HEIGHT_PX - 1])
    return np.concatenate([np.clip(center - half, 0, limits), np.clip(center + half, 0, limits)], axis=1)


def with_log2sim(columns: Array, views: list[View], boxes: list[Array]) -> list[float]:
    """As the measurement does it, which keeps the points of a sweep as columns (3, N) for all of its cameras."""
    out = []
    for view, box in zip(views, boxes, strict=True):
        seen = project_points(view, np.zeros(3), columns)
        out += [
            float(upper_median(seen.depth[i])) if len(i) else float("nan") for i in points_in_image_boxes(seen, box)
        ]
    return out


def with_numpy(dtype: type, xyz: Array, views: list[View], boxes: list[Array]) -> list[float]:
    """Every point through every camera, a mask for each box."""
    points, out = xyz.astype(dtype, copy=False), []
    for view, box in zip(views, boxes, strict=True):
        rotation = view.map_T_cam[:3, :3].T
        cam = points @ rotation.T.astype(dtype) - (rotation @ view.map_T_cam[:3, 3]).astype(dtype)
        with np.errstate(all="ignore"):
            uv = cam[:, :2] / cam[:, 2:] * dtype(FOCAL_PX) + np.array([WIDTH_PX / 2, HEIGHT_PX / 2], dtype)
        out += masked(uv[:, 0], uv[:, 1], cam[:, 2], box.astype(dtype))
    return out


def with_opencv(xyz: Array, views: list[View], boxes: list[Array]) -> list[float]:
    """cv2.projectPoints of what lies ahead, a mask for each box."""
    import cv2

    points, out = xyz.astype(np.float64), []
    for view, box in zip(views, boxes, strict=True):
        rotation = view.map_T_cam[:3, :3].T
        shift = -rotation @ view.map_T_cam[:3, 3]
        depth = points @ rotation[2] + shift[2]
        ahead = np.flatnonzero(depth > NEAREST_M)
        uv, _ = cv2.projectPoints(points[ahead], cv2.Rodrigues(rotation)[0], shift, view.camera.K, None)
        out += masked(uv[:, 0, 0], uv[:, 0, 1], depth[ahead], box)
    return out


def masked(u: Array, v: Array, depth: Array, boxes: Array) -> list[float]:
    """Median depth in each box, each by its own mask over all points."""
    out = []
    for u0, v0, u1, v1 in boxes:
        inside = (depth > NEAREST_M) & (u >= u0) & (u <= u1) & (v >= v0) & (v <= v1)
        out.append(float(np.median(depth[inside])) if inside.any() else float("nan"))
    return out


def floor(views: list[View]) -> Callable[[Array], None] | None:
    """Projection alone in compiled SIMD code, nothing kept: what no method on one core goes below."""
    numba = optional("numba")
    if numba is None:
        return None

    @numba.njit(fastmath=True)  # type: ignore[untyped-decorator, unused-ignore]
    def project_all(x, y, z, m, u, v, depth):  # type: ignore[no-untyped-def]
        for i in range(x.shape[0]):
            d = m[2, 0] * x[i] + m[2, 1] * y[i] + m[2, 2] * z[i] + m[2, 3]
            r = np.float32(1.0) / d
            u[i] = (m[0, 0] * x[i] + m[0, 1] * y[i] + m[0, 2] * z[i] + m[0, 3]) * r
            v[i] = (m[1, 0] * x[i] + m[1, 1] * y[i] + m[1, 2] * z[i] + m[1, 3]) * r
            depth[i] = d

    matrices = []
    for view in views:
        rotation = view.map_T_cam[:3, :3].T
        shift = -rotation @ view.map_T_cam[:3, 3]
        matrices.append((view.camera.K @ np.column_stack([rotation, shift])).astype(np.float32))
    buffers: dict[int, list[Array]] = {}

    def run_all(columns: Array) -> None:
        u, v, depth = buffers.setdefault(columns.shape[1], [np.empty(columns.shape[1], np.float32) for _ in range(3)])
        for m in matrices:
            project_all(*columns, m, u, v, depth)

    return run_all


def sections(*, quick: bool) -> tuple[str, str]:
    """Title and table."""
    rng, views = np.random.default_rng(0), make_views()
    boxes = [make_boxes(rng) for _ in views]
    least = floor(views)
    repeats = 5 if quick else 25
    rows: dict[str, list[str]] = {}
    sweeps = {f"{n // 1000}k": make_sweep(n, rng) for n in (120_000, 180_000)}
    sweeps["180k, random order"] = rng.permutation(sweeps["180k"])
    for xyz in sweeps.values():
        methods: dict[str, Callable[[], Any]] = {
            "log2sim": partial(with_log2sim, np.ascontiguousarray(xyz.T), views, boxes),
            "numpy float64, mask for each box": partial(with_numpy, np.float64, xyz, views, boxes),
            "numpy float32, mask for each box": partial(with_numpy, np.float32, xyz, views, boxes),
            "cv2.projectPoints, mask for each box": partial(with_opencv, xyz, views, boxes),
        }
        if least is not None:
            methods["floor: projection alone, SIMD, one core"] = partial(least, np.ascontiguousarray(xyz.T))
        for call in methods.values():
            call()
        seconds = {name: timed(call, repeats)[1] for name, call in methods.items()}
        base = seconds[list(methods)[-1]]
        truth = np.array(methods["numpy float64, mask for each box"]())
        off = float(np.nanmedian(np.abs(np.array(methods["log2sim"]()) - truth)))
        if not off < 1e-3:
            raise RuntimeError(f"depths of log2sim and numpy differ by {off} m in the middle")
        for name, value in seconds.items():
            rows.setdefault(name, []).extend([f"{value * 1e3:.2f}", f"{value / base:.1f}"])
    head = ["method", *(cell for name in sweeps for cell in (f"{name}: ms", "ratio to the last row"))]
    told = (
        "A sweep of a 64-ring LiDAR seen by five cameras of 1920x1280 px with 20 boxes each; for every box the median depth"
        " of the points inside it, which needs the projection of the whole sweep into every camera."
    )
    return "Projection and points in boxes", f"{told}\n\n{markdown(head, [[k, *v] for k, v in rows.items()])}"


def main(quick: bool = False, write: Path | None = None) -> None:
    """With fewer repeats, to see that everything runs; `write` puts the tables between their markers in a file."""
    print_section("projection", sections, quick, write)
