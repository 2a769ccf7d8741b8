"""LiDAR points of a log from above: one in each cell of a grid, as few bytes a point."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import NS_PER_S, Array, nearest_index
from log2sim.perception.frames import RecordReader
from log2sim.perception.lidar.cloud import cloud_origin, sweep_to_map
from log2sim.perception.lidar.ground import estimate_ground
from log2sim.perception.sync import sweep_middle_ns
from log2sim.visualization.recording.choice import records_within, take_at_rate, take_evenly

UNIT_M = 0.05
"""Of stored positions: a pixel of a screen that shows 50 m."""

REACH_M = 120.0
"""Points farther from the ego, or from the middle of the sensors, are left out."""

MIN_HEIGHT_M, MAX_HEIGHT_M = -1.0, 5.0
"""Above the ground: what is higher, such as trees and bridges, would cover the road from above."""

HEIGHT_UNIT_M = (MAX_HEIGHT_M - MIN_HEIGHT_M) / 255
MAX_APART_S = 0.1
"""Between the sweeps of several LiDARs that are shown as one."""


class PointSpacing(NamedTuple):
    """Edge of the cells that keep one point each, m, and how many sweeps a second are taken."""

    cell_m: float
    rate_hz: float


SPACINGS = tuple(
    PointSpacing(*spacing)
    for spacing in ((0.15, 10), (0.25, 10), (0.4, 10), (0.4, 5), (0.6, 5), (0.6, 2), (1.0, 2), (1.0, 1), (1.0, 0.5), (1.0, 0.2))
)  # fmt: skip
"""From the best down; the first that fits is taken. People are still seen as a point or two at 0.4 m."""

PROBES, SAFETY = 3, 1.15
BYTES_OF_ENTRY = 60
"""Time and origin of a sweep in the page."""


@dataclass(frozen=True, eq=False)
class PointsAbove:
    """Points of one moment.

    Attributes
    ----------
    t_ns : int
    origin : (2,) tuple of int, m
        Map position that the points are relative to.
    xy_m : (N, 2) float64
        Relative to `origin`.
    height_m : (N,) float64
        Above the ground.
    intensity : (N,) float64
        NaN where it is not known.
    """

    t_ns: int
    origin: tuple[int, int]
    xy_m: Array
    height_m: Array
    intensity: Array


def point_document(
    log: Log, scenario: Scenario, budget_bytes: int, reader: RecordReader, progress: Callable[[int, int], None]
) -> dict[str, Any] | None:
    """Return the points of a log's LiDARs within a budget; None where there are none during the scenario.

    Returns
    -------
    dict
        "t_s", "origin_m" and "points" of each moment, the last as base64 of deflated columns, see `pack`; "unit_m",
        "height_m", the lowest height and the step of a byte; "intensity", whether there is any; "cell_m", "rate_hz" and
        "bytes" as chosen.

    Raises
    ------
    ConfigError
        When not even one sweep fits.
    """
    lidars = [n for n in log.lidars if n in log.streams and len(records_within(log.streams[n].t_ns, scenario))]
    if not lidars:
        return None
    sweeps = _Sweeps(log, lidars, reader)
    main = max(lidars, key=lambda name: len(records_within(log.streams[name].t_ns, scenario)))
    within = records_within(log.streams[main].t_ns, scenario)
    probes = [p for i in take_evenly(len(within), PROBES) if (p := sweeps.at(main, int(within[i]))) is not None]
    if not probes:
        return None
    bright = _brightest(probes)
    spacing, chosen = _fit(log.streams[main].t_ns, within, scenario.t0_ns, probes, bright, budget_bytes)
    moments: list[tuple[PointsAbove, str]] = []
    for done, i in enumerate(chosen.tolist()):
        if (points := sweeps.at(main, i)) is not None:
            moments.append((points, pack(points, spacing.cell_m, bright)))
        progress(done + 1, len(chosen))
    while (total := sum(len(text) + BYTES_OF_ENTRY for _, text in moments)) > budget_bytes and len(moments) > 1:
        moments = [moments[k] for k in take_evenly(len(moments), int(0.97 * len(moments) * budget_bytes / total))]
    return {
        "t_s": [round((points.t_ns - scenario.t0_ns) / NS_PER_S, 4) for points, _ in moments],
        "origin_m": [list(points.origin) for points, _ in moments],
        "points": [text for _, text in moments],
        "unit_m": UNIT_M,
        "height_m": [MIN_HEIGHT_M, HEIGHT_UNIT_M],
        "intensity": bright > 0,
        "cell_m": spacing.cell_m,
        "rate_hz": spacing.rate_hz,
        "bytes": total,
    }


def pack(points: PointsAbove, cell_m: float, bright: float) -> str:
    """Keep the highest point of each cell and pack the rest as base64 of a zlib stream.

    Notes
    -----
    For N points in rows of cells from south to north, each from west to east: low bytes of the steps in x (N), their high
    bytes, the same of y, heights and intensities as bytes. Steps are in `UNIT_M`, modulo 2**16, the first from 0. Small steps
    in planes of bytes deflate to less than half.
    """
    cells = np.floor(points.xy_m / cell_m).astype(np.int64)
    order = np.lexsort((points.height_m, cells[:, 0], cells[:, 1]))
    cells = cells[order]
    last = np.append(np.any(np.diff(cells, axis=0) != 0, axis=1), True) if len(order) else np.zeros(0, dtype=bool)
    kept = order[last]
    whole = np.rint(points.xy_m[kept] / UNIT_M).astype(np.int64)
    steps = np.diff(whole, axis=0, prepend=[[0, 0]]).astype(np.uint16)
    height = np.clip(np.rint((points.height_m[kept] - MIN_HEIGHT_M) / HEIGHT_UNIT_M), 0, 255)
    intensity = np.clip(np.nan_to_num(points.intensity[kept]) / (bright or 1.0) * 255, 0, 255)
    planes = [steps[:, 0] & 255, steps[:, 0] >> 8, steps[:, 1] & 255, steps[:, 1] >> 8, height, intensity]
    return base64.b64encode(zlib.compress(np.concatenate(planes).astype(np.uint8).tobytes(), 9)).decode()


def _brightest(points: list[PointsAbove]) -> float:
    """Return the intensity that is shown as the brightest, which only mirrors exceed; 0 where none is known."""
    known = np.concatenate([p.intensity[np.isfinite(p.intensity)] for p in points])
    return max(float(np.percentile(known, 98)), 0.0) if len(known) else 0.0


def _fit(
    t_ns: NDArray[np.int64],
    within: NDArray[np.int64],
    start_ns: int,
    probes: list[PointsAbove],
    bright: float,
    budget_bytes: int,
) -> tuple[PointSpacing, NDArray[np.int64]]:
    """Choose the finest spacing that fits, and the sweeps."""
    sizes: Mapping[float, float] = {}
    for spacing in SPACINGS:
        if spacing.cell_m not in sizes:
            mean = np.mean([len(pack(p, spacing.cell_m, bright)) for p in probes])
            sizes = {**sizes, spacing.cell_m: SAFETY * float(mean) + BYTES_OF_ENTRY}
        chosen = take_at_rate(t_ns, within, spacing.rate_hz, start_ns)
        if len(chosen) * sizes[spacing.cell_m] <= budget_bytes:
            return spacing, chosen
    most = int(budget_bytes / sizes[spacing.cell_m])
    if most < 1:
        raise ConfigError(
            f"--max-mb: {budget_bytes / 1e6:.2f} MB are left for LiDAR points, and one sweep has {sizes[spacing.cell_m] / 1e6:.2f} MB; "
            f"give more"
        )
    return spacing, chosen[take_evenly(len(chosen), most)]


class _Sweeps:
    """Reads the sweeps of all LiDARs around a moment as points from above."""

    def __init__(self, log: Log, lidars: list[str], reader: RecordReader) -> None:
        self._log, self._reader = log, reader
        self._middle_ns = {name: sweep_middle_ns(log.streams[name]) for name in lidars}

    def at(self, main: str, index: int) -> PointsAbove | None:
        """Return the points around a sweep of one LiDAR; None where it cannot be read or has no known pose."""
        t_ns = int(self._log.streams[main].t_ns[index]) + self._middle_ns[main]
        xyz, intensity = [], []
        for name, middle_ns in self._middle_ns.items():
            stamps = self._log.streams[name].t_ns + middle_ns
            near = index if name == main else int(nearest_index(stamps, t_ns)[0])
            if abs(int(stamps[near]) - t_ns) > MAX_APART_S * NS_PER_S:
                continue
            sweep = self._reader.get(name, near)
            mapped = None if sweep is None else sweep_to_map(self._log, name, sweep, compensate=True)
            if sweep is None or mapped is None:
                if name == main:
                    return None
                continue
            xyz.append(mapped[0])
            none = np.full(len(mapped[0]), np.nan)
            intensity.append(none if sweep.intensity is None else np.asarray(sweep.intensity, dtype=np.float64))
        return self._from_above(t_ns, np.concatenate(xyz), np.concatenate(intensity))

    def _from_above(self, t_ns: int, xyz: Array, intensity: Array) -> PointsAbove:
        """Keep what is near and neither under the ground nor high above it."""
        middle, ground_z = cloud_origin(self._log, t_ns)
        origin = np.rint(middle[:2])
        local = xyz - [*origin, 0.0]
        near = np.flatnonzero(np.abs(local[:, :2]).max(axis=1) <= REACH_M)
        local = local[near]
        height = local[:, 2] - estimate_ground(local, middle[:2] - origin, ground_z).at(local[:, :2])
        kept = np.flatnonzero((height >= MIN_HEIGHT_M) & (height <= MAX_HEIGHT_M))
        at = (int(origin[0]), int(origin[1]))
        return PointsAbove(t_ns, at, local[kept, :2], height[kept], intensity[near][kept])
