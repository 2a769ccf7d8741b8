"""The rays of a LiDAR, read off its sweeps: those that returned as they were recorded, those that did not between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from log2sim.datatypes import Log, Sweep
from log2sim.files.arrays import Columns
from log2sim.geometry import Array, inverse, rotation_from_rpy, wrap_angle
from log2sim.perception.records import RecordSource

Floats = NDArray[np.float32]

SAMPLED_SWEEPS = 6
POSE_STEP_NS = 200_000  # a vehicle at 30 m/s moves 6 mm meanwhile, less than a LiDAR resolves
MAX_STEPS = 1_000_000  # 200 s
MIN_PATTERN_RANGE_M = 4.0  # nearer, the lasers of a spinning LiDAR are seen not to start at one point
MAX_TILT_RAD = np.deg2rad(4.0)
ELEVATION_BIN_RAD = np.deg2rad(0.02)
MIN_LINE_SHARE = 0.65  # of points within a quarter of the gap of a line; a half of them where there are no lines
MIN_LINE_WIDTH_RAD = np.deg2rad(0.06)  # angles of points are not better where poses were taken off them
MAX_LINES = 300
NEAR_RAYS = 0.7  # between two rays, in steps and lines, that are one
MIN_DOWN_RAD = np.deg2rad(5.0)  # below the horizon: a street is not steeper


@dataclass(frozen=True, eq=False)
class Shots(Columns):
    """Rays of one sweep in the frame of the sensor, each at its own time."""

    direction: Floats  # (N, 3) unit vectors
    t_ns: NDArray[np.int64]  # (N,) absolute stamps
    range_m: Floats  # (N,) as recorded; NaN where nothing came back
    intensity: Floats  # (N,) NaN where unknown


@dataclass(frozen=True, eq=False)
class Pattern:
    """How a LiDAR scans, as far as sweeps show it."""

    level_R_sensor: Array  # (3, 3) rotation in which lines have one elevation each: mounts of logs are not exact
    elevation_rad: Array  # (L,) of the lines, increasing; empty where the sensor has none
    step_rad: float  # between firings of a line
    gap_rad: float  # usual angle between lines; `step_rad` without lines
    # (L + 1, 120) lines by 3 degrees of azimuth from -180 on in which rays may come back; the last row is of any line
    covered: NDArray[np.bool_]


def poses_of(log: Log, name: str, t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.intp], NDArray[np.bool_]]:
    """Interpolate the pose of a sensor where its rays start.

    Returns map_T_sensor (K, 4, 4) of some moments, the moment (N,) of each stamp, and which poses are valid (K,).
    """
    step = t_ns // POSE_STEP_NS
    first = int(step.min(initial=np.iinfo(np.int64).max))
    if 0 <= int(step.max(initial=-1)) - first < MAX_STEPS:  # of one sweep: no need to sort
        seen = np.bincount(step - first) > 0
        moments, index = first + np.flatnonzero(seen), (np.cumsum(seen) - 1).take(step - first)
    else:
        moments, index = np.unique(step, return_inverse=True)
    map_T_sensor, valid = log.map_T_sensor(name, moments * POSE_STEP_NS + POSE_STEP_NS // 2)
    return map_T_sensor, index, valid


def recorded_shots(log: Log, name: str, sweep: Sweep) -> Shots:
    """Return the rays of a sweep that came back, whatever frame its points are in."""
    points = np.asarray(sweep.xyz_m, dtype=np.float64)
    t_ns = np.full(len(points), sweep.stamp_ns) if sweep.t_ns is None else sweep.t_ns
    if sweep.compensated_ns is not None and sweep.frame == "lidar":
        pose = log.map_T_sensor(name, sweep.compensated_ns)[0][0]
        points = points @ pose[:3, :3].T + pose[:3, 3]
    if sweep.frame == "map" or sweep.compensated_ns is not None:
        poses, moment, valid = poses_of(log, name, t_ns)
        poses[~valid] = np.nan
        points = np.einsum("nji,nj->ni", poses[moment, :3, :3], points - poses[moment, :3, 3])
    distance = np.linalg.norm(points, axis=1)
    intensity = np.full(len(points), np.nan) if sweep.intensity is None else sweep.intensity
    keep = distance > 0.1  # not NaN, and not the origin that some logs put for no return
    direction = (points[keep] / distance[keep, None]).astype(np.float32)
    return Shots(direction, t_ns[keep], distance[keep].astype(np.float32), np.asarray(intensity, np.float32)[keep])


def angles_of(direction: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return azimuth and elevation (N,) of vectors (N, 3), rad."""
    return np.arctan2(direction[:, 1], direction[:, 0]), np.arctan2(direction[:, 2], np.hypot(*direction[:, :2].T))


def find_pattern(log: Log, name: str) -> Pattern:
    """Read lines, steps and coverage off some sweeps of a LiDAR."""
    stream = log.streams[name]
    chosen = np.unique(np.linspace(0, len(stream.t_ns) - 1, SAMPLED_SWEEPS + 2).astype(int)[1:-1])
    sweeps = [recorded_shots(log, name, RecordSource(log).require(name, int(i))) for i in chosen]
    direction = np.concatenate([s.direction[s.range_m > MIN_PATTERN_RANGE_M] for s in sweeps]).astype(np.float64)
    azimuth, elevation = angles_of(direction)
    some = np.random.default_rng(0).permutation(len(direction))[:40_000]
    along, across = _tilt(azimuth[some], elevation[some])
    rotation = rotation_from_rpy(across, along, 0.0)
    elevation = angles_of(direction @ rotation.T)[1]
    lines = _lines(elevation)
    covered = np.zeros((len(lines) + 1, 120), dtype=bool)
    covered[:, _cell(azimuth)] = True
    if len(lines):
        # What looks down and never comes back is hidden by the vehicle; what looks up may meet something yet.
        seen = np.zeros_like(covered)
        every = np.concatenate([s.direction for s in sweeps]) @ rotation.T
        a, e = angles_of(every)
        seen[_nearest(lines, e), _cell(a)] = True
        covered[:-1] &= seen[:-1] | (lines > -MIN_DOWN_RAD)[:, None]
    # Firings of one line follow each other; without lines, points do.
    a, e = angles_of(sweeps[len(sweeps) // 2].direction @ rotation.T)
    line = _nearest(lines, e) if len(lines) else np.zeros(len(a), np.intp)
    order = np.lexsort((a, line))
    gap = np.diff(a[order])[np.diff(line[order]) == 0]
    steps = gap[gap > np.deg2rad(0.03)]
    step = float(np.median(steps)) if len(lines) and len(steps) else np.deg2rad(0.2)
    return Pattern(rotation, lines, step, float(np.median(np.diff(lines))) if len(lines) > 1 else step, covered)


def _cell(azimuth: NDArray[Any]) -> NDArray[np.int64]:
    cell: NDArray[np.int64] = np.clip((np.degrees(azimuth) + 180) / 3, 0, 119).astype(np.int64)
    return cell


def _tilt(azimuth: Array, elevation: Array) -> tuple[float, float]:
    """Find pitch and roll, rad, by which elevations gather most at few values."""
    best, span = (0.0, 0.0), MAX_TILT_RAD
    c, s = np.cos(azimuth), np.sin(azimuth)

    def gathered(pitch: float, roll: float, bin_rad: float) -> float:
        level = elevation - pitch * c + roll * s
        count = np.bincount(((level + 1.6) / bin_rad).astype(np.int64))
        return float((count.astype(np.float64) ** 2).sum())

    flat = gathered(0.0, 0.0, np.deg2rad(0.05))
    while span > np.deg2rad(0.02):
        bin_rad = max(span / 8, np.deg2rad(0.05))
        steps = np.linspace(-span, span, 13)
        tries = [(best[0] + p, best[1] + r) for p in steps for r in steps]
        best = max(tries, key=lambda t: gathered(t[0], t[1], bin_rad))
        span /= 5
    return best if gathered(*best, np.deg2rad(0.05)) > 1.1 * flat else (0.0, 0.0)


def _lines(elevation: Array) -> Array:
    """Return the elevations at which points gather; none where they do not."""
    low = elevation.min() - 0.02
    count = np.bincount(((elevation - low) / ELEVATION_BIN_RAD).astype(np.int64), minlength=8).astype(np.float64)
    smooth = gaussian_filter1d(count, 2.5, mode="constant")
    peak = np.flatnonzero((smooth[1:-1] > smooth[:-2]) & (smooth[1:-1] >= smooth[2:])) + 1
    peak = peak[smooth[peak] > 0.1 * np.median(smooth[peak])] if len(peak) else peak
    lines = low + (peak + 0.5) * ELEVATION_BIN_RAD
    if not 1 < len(lines) <= MAX_LINES or np.median(np.diff(lines)) < np.deg2rad(0.15):
        return np.zeros(0)
    gap = np.diff(lines, prepend=2 * lines[0] - lines[1], append=2 * lines[-1] - lines[-2])
    line = _nearest(lines, elevation)
    near = np.abs(elevation - lines[line]) < np.maximum(np.minimum(gap[1:], gap[:-1])[line] / 4, MIN_LINE_WIDTH_RAD)
    return lines if near.mean() > MIN_LINE_SHARE else np.zeros(0)


def _nearest(lines: Array, elevation: Array) -> NDArray[np.intp]:
    return np.searchsorted((lines[1:] + lines[:-1]) / 2, elevation)


def all_shots(shots: Shots, pattern: Pattern) -> Shots:
    """Add the rays that must have been sent between those that came back: firings that each line lacks."""
    lines = pattern.elevation_rad
    if not len(lines) or not len(shots.t_ns):
        return shots
    azimuth, elevation = angles_of(shots.direction @ pattern.level_R_sensor.T.astype(np.float32))
    line = _nearest(lines, elevation)
    order = np.argsort(line * 8.0 + azimuth)  # a turn is less than that; numbers are sorted faster than pairs
    a, k = azimuth[order].astype(np.float64), line[order]
    # Every line begins and ends at the seam at -180 degrees.
    first, last = np.searchsorted(k, np.arange(len(lines))), np.searchsorted(k, np.arange(len(lines)), side="right")
    empty = first == last
    begin = np.insert(a, np.append(first, last), np.repeat([-np.pi, np.pi], len(lines)))
    own = np.insert(k, np.append(first, last), np.tile(np.arange(len(lines)), 2))
    width = np.where(own[1:] == own[:-1], np.diff(begin), 0.0)
    missing = np.maximum(np.rint(width / pattern.step_rad).astype(np.int64) - 1, 0)
    missing[width < 1.6 * pattern.step_rad] = 0
    which = np.repeat(np.arange(len(missing)), missing)
    nth = np.arange(len(which)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
    fill_a = begin[which] + nth * width[which] / (missing[which] + 1)
    fill_e = lines[own[which]]
    inside = pattern.covered[own[which], _cell(fill_a)] & ~empty[own[which]]
    fill_a, fill_e = fill_a[inside], fill_e[inside]
    # Lines that are no straight ones in these angles may look like two, either with gaps where the other has points. Of a
    # line's own points none is as near as that, and of those of the next ones only what lies off them toward it.
    rows = [np.interp(e, lines, np.arange(len(lines))) for e in (elevation, fill_e)]
    off = np.flatnonzero(np.abs(rows[0] - line) > 1 - NEAR_RAYS)
    taken = cKDTree(np.column_stack([azimuth[off] / pattern.step_rad, rows[0][off]]))
    alone = np.isinf(
        taken.query(np.column_stack([fill_a / pattern.step_rad, rows[1]]), distance_upper_bound=NEAR_RAYS)[0]
    )
    fill_a, fill_e = fill_a[alone], fill_e[alone]
    level = np.stack([np.cos(fill_e) * np.cos(fill_a), np.cos(fill_e) * np.sin(fill_a), np.sin(fill_e)], 1)
    # The time of the nearest azimuth: a LiDAR that turns has little else.
    turn = np.argsort(azimuth)
    near = turn[np.clip(np.searchsorted(azimuth[turn], fill_a), 0, len(turn) - 1)]
    nothing = np.full(len(fill_a), np.nan, np.float32)
    return Shots(
        np.concatenate([shots.direction, (level @ pattern.level_R_sensor).astype(np.float32)]),
        np.concatenate([shots.t_ns, shots.t_ns[near]]),
        np.concatenate([shots.range_m, nothing]),
        np.concatenate([shots.intensity, nothing]),
    )


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of one sweep in the map."""

    azimuth: Floats  # (N,) rad, in the sensor's frame; likewise `elevation`
    elevation: Floats
    origin: Floats  # (N, 3) m, in the map less `shift_m`
    direction: Floats  # (N, 3) in the axes of the map
    t_ns: NDArray[np.int64]  # (N,)
    shift_m: Array  # (3,) place near the sensor that keeps the numbers small
    bin_T_map: Array  # (B, 4, 4) for each bin of azimuth, from the shifted map to the sensor when its rays go out
    bin_ns: NDArray[np.int64]  # (B,) mean time of the bins' rays
    spread_m: float  # how far rays of one bin start from each other

    def bins_toward(self, count: int, points: Callable[[NDArray[np.int64]], Any]) -> NDArray[np.int64]:
        """Return the bins (N,) in which rays go toward `count` points.

        `points`: gives their places (3, N), m, in the shifted map at the times of bins (N,).

        Points and sensor move while it turns, so each round takes both where they are in the bin of the round before: of a surface 2 m
        beside an ego at 30 m/s a fourth of the error remains each time.
        """
        pose, bins = self.bin_T_map.astype(np.float32), np.full(count, len(self.bin_ns) // 2)
        for _ in range(BIN_ROUNDS):
            at = points(bins)
            ahead, left = (
                sum(pose[:, axis, j].take(bins) * at[j] for j in range(3)) + pose[:, axis, 3].take(bins)
                for axis in range(2)
            )
            bins = bin_of(np.arctan2(left, ahead))
        return bins


TIME_BINS = 720
BIN_ROUNDS = 3


def bin_of(azimuth: NDArray[Any]) -> NDArray[np.int64]:
    """Return the bin of time of azimuths (N,), rad."""
    return np.clip((azimuth + np.pi) * (TIME_BINS / (2 * np.pi)), 0, TIME_BINS - 1).astype(np.int64)


def rays_in_map(shots: Shots, map_T_sensor: Array, moment: NDArray[np.intp]) -> Rays:
    """Place rays by the poses (K, 4, 4) of the moments at which they go out."""
    shift = np.rint(map_T_sensor[0, :3, 3])
    local = map_T_sensor.copy()
    local[:, :3, 3] -= shift
    azimuth, elevation = angles_of(shots.direction)
    # Column by column: einsum takes several times as long.
    turn, ray = local[:, :3, :3].astype(np.float32), shots.direction.T
    direction = np.stack([sum(turn[:, i, j].take(moment) * ray[j] for j in range(3)) for i in range(3)], axis=1)
    bins = bin_of(azimuth)
    count = np.bincount(bins, minlength=TIME_BINS)
    begin = int(shots.t_ns.min())
    mean = np.bincount(bins, shots.t_ns - begin, TIME_BINS) / np.maximum(count, 1)
    of_moment = np.bincount(bins, moment, TIME_BINS) / np.maximum(count, 1)
    known = np.flatnonzero(count)
    nearest, empty = np.arange(TIME_BINS), np.flatnonzero(count == 0)
    nearest[empty] = known[np.abs(wrap_angle((empty[:, None] - known) * 2 * np.pi / TIME_BINS)).argmin(axis=1)]
    poses = local[np.rint(of_moment[nearest]).astype(np.intp)]
    origin = local[moment, :3, 3]
    some = slice(None, None, max(1, len(bins) // 4096))
    spread = np.linalg.norm(origin[some] - poses[bins[some], :3, 3], axis=1)
    return Rays(
        azimuth, elevation, origin.astype(np.float32), direction, shots.t_ns, shift, inverse(poses),
        begin + np.rint(mean[nearest]).astype(np.int64), float(np.quantile(spread, 0.99)),
    )  # fmt: skip
