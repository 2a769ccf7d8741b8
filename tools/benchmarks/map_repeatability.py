"""How well the map of the ground repeats: maps of parts of a log laid on each other.

The poses are refined once, with all records, as for a map of the whole log. The parts are the odd and the even records, both halves of the time, and the cameras that look ahead and those that look back.
Patches of the ground that both parts show are registered; what counts is how far they are shifted against each other where a
LiDAR saw the ground, and by how much the heights differ.

    python tools/bench.py map_repeatability LOG [--as-logged]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.config import MapConfig
from log2sim.datatypes import Log, Scenario, Stream
from log2sim.errors import LogError
from log2sim.evaluation.metrics.truth import truth_from_log
from log2sim.geometry import Array
from log2sim.localization.pose_refinement import refine_poses
from log2sim.localization.replaced import replace_poses
from log2sim.logs.opening import open_log
from log2sim.road.builder import map_ground
from log2sim.road.ground_map import GroundMap

CELL_M = 0.05
PATCH_M, STRIDE_M, SEARCH_M = 3.0, 1.5, 0.5
# Parts of a patch that must be known in both maps.
MIN_KNOWN = 0.9
# A direction counts where the texture tells the offset along it this well (one sigma); a straight line tells nothing along itself.
MAX_SIGMA_M = 0.01
# Below this correlation the maps do not show the same, and the offset means nothing; such patches are counted.
MIN_CORRELATION = 0.6
# Cells of a resampled map have errors in common with their neighbors: of so many cells one is independent.
CORRELATED_CELLS = 9.0


@dataclass(frozen=True, eq=False)
class Offsets:
    """Offsets of patches between two maps, along the directions that their texture tells."""

    xy: Array  # (N, 2), m: middle of the patches
    offset_m: Array  # (N,): length of what is told of the offset of the second map
    vector_m: Array  # (N, 2): the offset itself, 0 along directions that the texture does not tell
    unlike: int  # patches of texture that do not look alike in both maps


def on_common_cells(a: GroundMap, b: GroundMap) -> tuple[tuple[slice, slice], tuple[slice, slice]] | None:
    """Rows and columns of what both maps cover; their cells lie on the same lines."""
    d = a.resolution_m
    x0, x1 = max(a.extent_m[0], b.extent_m[0]), min(a.extent_m[1], b.extent_m[1])
    y0, y1 = max(a.extent_m[2], b.extent_m[2]), min(a.extent_m[3], b.extent_m[3])
    if x1 - x0 < PATCH_M or y1 - y0 < PATCH_M:
        return None
    parts = []
    for ground in (a, b):
        row, column = round((ground.extent_m[3] - y1) / d), round((x0 - ground.extent_m[0]) / d)
        parts.append((slice(row, row + round((y1 - y0) / d)), slice(column, column + round((x1 - x0) / d))))
    return parts[0], parts[1]


def measure_offsets(a: GroundMap, b: GroundMap, layer: str = "color") -> Offsets | None:
    """Register the patches that two maps share; None where they share no ground."""
    parts = on_common_cells(a, b)
    if parts is None:
        return None
    pictures, known = [], []
    for ground, part in zip((a, b), parts):
        seen = np.isfinite(ground.height_m[part])
        if layer == "color":
            value = cv2.cvtColor(ground.color_bgr[part], cv2.COLOR_BGR2GRAY).astype(np.float32)
            seen &= ground.alpha[part] > 127
        else:
            value = 255 * np.nan_to_num(ground.intensity[part])
            seen &= np.isfinite(ground.intensity[part])
        pictures.append(cv2.GaussianBlur(value, (0, 0), 1.0))
        known.append(seen)
    d = a.resolution_m
    n, step, reach = round(PATCH_M / d), round(STRIDE_M / d), round(SEARCH_M / d)
    rows, columns = pictures[0].shape
    # Edges of what is seen are no texture of the ground.
    both = cv2.erode((known[0] & known[1]).astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0)
    found, unlike = [], 0
    for r in range(reach, rows - n - reach, step):
        for c in range(reach, columns - n - reach, step):
            patch = (slice(r, r + n), slice(c, c + n))
            around = (slice(r - reach, r + n + reach), slice(c - reach, c + n + reach))
            if both[around].mean() < MIN_KNOWN or both[patch].mean() < 0.99:
                continue
            offset = _register(pictures[0][patch], pictures[1][around], reach, d)
            if offset is None:
                continue
            if np.isnan(offset).any():
                unlike += 1
                continue
            middle = a.raster.xy_of(parts[0][0].start + r + n / 2 - 0.5, parts[0][1].start + c + n / 2 - 0.5)
            found.append((*middle, *offset))
    table = np.array(found).reshape(-1, 4)
    return Offsets(table[:, :2], np.hypot(*table[:, 2:].T), table[:, 2:], unlike)


def _register(patch: NDArray[np.float32], around: NDArray[np.float32], reach: int, d: float) -> Array | None:
    """Offset (2,) east, north, m, of a patch within its surroundings; NaN where they do not look alike, None without texture."""
    gy, gx = np.gradient(patch)
    tensor = np.array([[(gx * gx).sum(), (gx * gy).sum()], [(gx * gy).sum(), (gy * gy).sum()]])
    values, axes = np.linalg.eigh(tensor)
    # Noise of the road itself, by what neighboring cells differ: no texture where nothing stands out of it.
    if np.sqrt(4.0 * CORRELATED_CELLS / max(values[1], 1e-9)) * d > MAX_SIGMA_M:
        return None
    score = cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED)
    _, best, _, (column, row) = cv2.minMaxLoc(score)
    if best < MIN_CORRELATION:
        return np.full(2, np.nan)
    shift = np.array([column - reach, row - reach], float)
    n = len(patch)
    for _ in range(3):
        moved = _shifted(around, shift, reach, n)
        my, mx = np.gradient(moved)
        jx, jy = (gx + mx) / 2, (gy + my) / 2
        gain = moved.std() / max(patch.std(), 1e-6)
        error = (patch - patch.mean()) * gain - (moved - moved.mean())
        normal = np.array([[(jx * jx).sum(), (jx * jy).sum()], [(jx * jy).sum(), (jy * jy).sum()]])
        values, axes = np.linalg.eigh(normal)
        right = np.array([(jx * error).sum(), (jy * error).sum()])
        told = values > 1e-9 + values[1] * 1e-4
        shift += axes @ np.where(told, (axes.T @ right) / np.where(told, values, 1), 0)
        if np.abs(shift).max() > reach - 1:
            return np.full(2, np.nan)
    sigma = np.sqrt(error.var() * CORRELATED_CELLS / np.maximum(values, 1e-9)) * d
    if sigma[1] > MAX_SIGMA_M:
        return None
    along = np.where(sigma <= MAX_SIGMA_M, axes.T @ shift, 0)
    east, south = axes @ along * d
    return np.array([east, -south])


def _shifted(around: NDArray[np.float32], shift: Array, reach: int, n: int) -> NDArray[np.float32]:
    matrix = np.array([[1, 0, reach + shift[0]], [0, 1, reach + shift[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(around, matrix, (n, n), flags=flags), dtype=np.float32)


def height_differences(a: GroundMap, b: GroundMap) -> Array:
    """Differences (N,), m, of the heights of cells that both maps know."""
    parts = on_common_cells(a, b)
    if parts is None:
        return np.zeros(0)
    off = b.height_m[parts[1]].astype(np.float64) - a.height_m[parts[0]]
    return off[np.isfinite(off)]


def thinned(log: Log, rows: dict[str, NDArray[np.int64]]) -> Log:
    """Return the log with only some records of each stream."""
    streams = {}
    for name, kept in rows.items():
        stream = log.streams[name]
        streams[name] = Stream(name, stream.t_ns[kept], lambda i, s=stream, k=kept: s.read(int(k[i])))
    return log.changed(streams=streams)


def parts_of(log: Log) -> Iterator[tuple[str, Log, Log]]:
    """Yield pairs of logs with different records of the same ground."""
    count = {name: np.arange(len(stream.t_ns)) for name, stream in log.streams.items()}
    yield "odd and even records", *(thinned(log, {n: k[p::2] for n, k in count.items()}) for p in (0, 1))
    yield (
        "first and second half",
        *(thinned(log, {n: np.array_split(k, 2)[p] for n, k in count.items()}) for p in (0, 1)),
    )
    sides = {name: float(camera.mount_T_cam[0, 2]) for name, camera in log.cameras.items() if camera.mount == "ego"}
    ahead = {n: log.cameras[n] for n, x in sides.items() if x > 0.3}
    rest = {n: camera for n, camera in log.cameras.items() if n not in ahead}
    if ahead and rest:
        yield "cameras ahead and others", log.changed(cameras=ahead), log.changed(cameras=rest)


def quantile_text(values_m: Array) -> str:
    """Median, 95th percentile and share within 5 cm."""
    if not len(values_m):
        return "nothing in common"
    p50, p95 = np.percentile(values_m, [50, 95])
    return f"{100 * p50:.1f} cm median, {100 * p95:.1f} cm 95 %, {np.mean(values_m <= 0.05):.3f} within 5 cm, {len(values_m)}"


def main(path: Path, as_logged: bool = False) -> None:
    """Print what repeats, with the poses refined by registration or as they were logged."""
    log = open_log(path)
    scenario = scenario_of(log)
    if not as_logged and (refined := refine_poses(log)) is not None:
        log = replace_poses(log, refined)
    for title, *pair in parts_of(log):
        try:
            a, b = (
                map_ground(part, restricted(scenario, part), MapConfig(cell_m=CELL_M), refine=False) for part in pair
            )
        except LogError as error:
            print(f"{title}: {error}")
            continue
        print(f"{title}\n  height     {quantile_text(np.abs(height_differences(a, b)))} cells")
        for layer in ("color", "intensity"):
            offsets = measure_offsets(a, b, layer)
            words = (
                "nothing in common"
                if offsets is None
                else f"{quantile_text(offsets.offset_m)} patches, {offsets.unlike} unlike"
            )
            print(f"  {layer:10} {words}")


def scenario_of(log: Log) -> Scenario:
    """The labeled agents of a log, or none."""
    if log.labels is not None:
        return truth_from_log(log)
    stamps = np.concatenate([stream.t_ns for stream in log.streams.values()])
    return Scenario(log.name, int(stamps.min()), float(np.ptp(stamps)) / 1e9, (), log.map)


def restricted(scenario: Scenario, log: Log) -> Scenario:
    """The scenario, naming only the cameras that a part of the log has."""
    return replace(scenario, cameras=tuple({"name": name, "used": True} for name in log.cameras))
