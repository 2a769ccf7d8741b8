"""What stands still around a pole: surfaces that the vehicle saw, points that the LiDARs of the pole saw, and how they match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.datatypes import Log, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import Array
from log2sim.localization.ego_sweeps import lidars_on_ego
from log2sim.perception.lidar.cloud import sweep_to_map

# Points farther from a pole than this are too sparse in sweeps of usual LiDARs, and turned farther than any error is meant to be.
MAX_REACH_M = 60.0
# Returns nearer to the vehicle's LiDAR are of its own body.
MIN_RANGE_M = 2.5
MAX_VEHICLE_SWEEPS, MAX_ROAD_SWEEPS = 16, 10
MAX_SWEEP_POINTS = 20_000
# Sweeps of a moving vehicle from places nearer to each other than this show the same.
MIN_APART_M = 0.5
NEIGHBORS = 12
# Voxels and largest neighborhoods: fine ones where there are many points, coarse ones between the rings of a vehicle that stands.
VOXEL_M = 0.25
SCALES_M = ((VOXEL_M, 0.9), (0.7, 3.0), (2.0, 7.0))
# What an error of 0.5 m and 2 degrees moves at the end of the reach.
MAX_ERROR_M = 2.5
# A piece of a plane is thin (RMS over its points, range noise and all) and no line, as the points of one ring are.
MAX_THICKNESS_M, MIN_WIDTH_M = 0.06, 0.1
MIN_UPRIGHT_Z, MAX_POST_WIDTH_M, MIN_POST_LENGTH_M = 0.95, 0.12, 0.25
# What stands still is in a place in a third of the sweeps or more; what passes is not, unless it waits.
STATIC_VOXEL_M, MIN_STATIC_SHARE, STEADY_SHARE = 0.4, 0.35, 0.8
MAX_ROAD_POINTS = 6000


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Pieces of surfaces that the vehicle saw, in the frame of the site: map axes, origin at a pole's LiDARs.

    Attributes
    ----------
    xyz_m : (P, 3) float64, m
    normals : (P, 2, 3) float64
        Directions in which each piece holds a point: one of a plane, turned to where it was seen from, and NaN; two of a post.
    reach_m : (P,) float64, m
        How far along itself each piece goes.
    tree : cKDTree
        Of `xyz_m`.
    """

    xyz_m: Array
    normals: Array
    reach_m: Array
    tree: cKDTree

    @property
    def post(self) -> NDArray[np.bool_]:
        """Whether each piece (P,) is one of a post."""
        return np.isfinite(self.normals[:, 1, 0])


@dataclass(frozen=True, eq=False)
class VehicleView:
    """What the vehicle saw around a site.

    Attributes
    ----------
    xyz_m : (N, 3) float64, m
        Points in the frame of the site, those of several sweeps.
    sensor_m : (S, 3) float64, m
        Where the LiDAR was in the middle of each sweep.
    t_ns : (S,) int64
        Stamps of the sweeps.
    sweep : (N,) int64
        Row of `sensor_m` for each point.
    """

    xyz_m: Array
    sensor_m: Array
    t_ns: NDArray[np.int64]
    sweep: NDArray[np.int64]

    def parts(self, count: int) -> list[VehicleView]:
        """Split into runs of successive sweeps; fewer than `count` where there are fewer sweeps."""
        runs = np.array_split(np.argsort(self.t_ns, kind="stable"), min(count, len(self.t_ns)))
        kept = [np.isin(self.sweep, run) for run in runs]
        return [VehicleView(self.xyz_m[rows], self.sensor_m, self.t_ns, self.sweep[rows]) for rows in kept]


def view_from_vehicle(log: Log, site_m: Array, during_ns: tuple[int, int] | None) -> VehicleView | None:
    """Collect points of the vehicle's LiDARs around a site (3,), m, by the poses of the ego; None where it never comes near."""
    if log.ego is None:
        return None
    points: list[Array] = []
    sensors: list[Array] = []
    rows: list[NDArray[np.int64]] = []
    stamps: list[int] = []
    lidars = lidars_on_ego(log)
    for name in lidars:
        for i in _near_sweeps(log, name, site_m, during_ns, MAX_VEHICLE_SWEEPS // len(lidars) or 1):
            mapped = _read(log, name, int(i))
            if mapped is None:
                continue
            xyz, sensor = mapped[0] - site_m, mapped[1] - site_m
            near = (np.linalg.norm(xyz, axis=1) < MAX_REACH_M) & (np.linalg.norm(xyz - sensor, axis=1) > MIN_RANGE_M)
            rows.append(np.full(int(near.sum()), len(sensors), dtype=np.int64))
            points.append(xyz[near])
            sensors.append(sensor)
            stamps.append(int(log.streams[name].t_ns[i]))
    if not points:
        return None
    return VehicleView(np.concatenate(points), np.array(sensors), np.array(stamps), np.concatenate(rows))


def _near_sweeps(
    log: Log, lidar: str, site_m: Array, during_ns: tuple[int, int] | None, count: int
) -> NDArray[np.intp]:
    """Choose sweeps from places within reach of a site that are apart, or over time where the vehicle stands."""
    t_ns = log.streams[lidar].t_ns
    pose, known = log.map_T_sensor(lidar, t_ns)
    away = np.linalg.norm(pose[:, :3, 3] - site_m, axis=1)
    near = known & (away < MAX_REACH_M)
    if during_ns is not None:
        near &= (t_ns >= during_ns[0]) & (t_ns <= during_ns[1])
    rows = np.flatnonzero(near)
    if len(rows) == 0:
        return rows
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pose[rows, :3, 3], axis=0), axis=1))])
    # A way of its own for time, so that sweeps of a vehicle that stands are chosen too.
    gone += np.linspace(0, MIN_APART_M, len(rows))
    places = np.linspace(0, gone[-1], count)
    return np.asarray(rows[np.unique(np.searchsorted(gone, places).clip(0, len(rows) - 1))])


@dataclass(frozen=True, eq=False)
class RoadView:
    """What stands still around a site by the LiDARs of a pole.

    Attributes
    ----------
    xyz_m : (N, 3) float64, m
        Points in the frame of the site, one a voxel.
    share : (N,) float64
        Of the sweeps that have a point in the same place.
    """

    xyz_m: Array
    share: Array

    @property
    def steady_m(self) -> Array:
        """The points (n, 3) that are there nearly all the time: what waits for a while is not among them."""
        return self.xyz_m[self.share > STEADY_SHARE]


def view_from_road(
    log: Log, lidars: Sequence[str], site_m: Array, during_ns: tuple[int, int] | None = None
) -> RoadView:
    """Collect the points of what stands still around a site (3,), m, by the LiDARs of a pole."""
    parts = [_static_points(log, name, site_m, during_ns) for name in lidars]
    points = np.concatenate(parts) if parts else np.zeros((0, 4))
    points = points[:: max(-(-len(points) // MAX_ROAD_POINTS), 1)]
    return RoadView(points[:, :3], points[:, 3])


def _static_points(log: Log, lidar: str, site_m: Array, during_ns: tuple[int, int] | None) -> Array:
    """Return points with the share of sweeps that have one in the same place, (N, 4)."""
    t_ns = log.streams[lidar].t_ns
    rows = np.arange(len(t_ns))
    if during_ns is not None:
        rows = rows[(t_ns >= during_ns[0]) & (t_ns <= during_ns[1])]
    chosen = (
        rows[np.unique(np.linspace(0, len(rows) - 1, MAX_ROAD_SWEEPS).round().astype(np.int64))] if len(rows) else rows
    )
    parts = []
    for i in chosen.tolist():
        mapped = _read(log, lidar, i)
        if mapped is not None:
            xyz = mapped[0] - site_m
            parts.append(xyz[np.linalg.norm(xyz, axis=1) < MAX_REACH_M])
    if not parts or not sum(map(len, parts)):
        return np.zeros((0, 4))
    xyz = np.concatenate(parts)
    sweep = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    place = _voxels(xyz, STATIC_VOXEL_M)
    seen = np.unique(place * len(parts) + sweep) // len(parts)
    share = (np.bincount(seen, minlength=int(place.max()) + 1) / len(parts))[place]
    static = share >= MIN_STATIC_SHARE
    return thin(np.hstack([xyz[static], share[static, None]]), VOXEL_M)


def _read(log: Log, lidar: str, index: int) -> tuple[Array, Array] | None:
    """Read a sweep: points (N, 3) and the place (3,) of the sensor in the map, m; None where that fails."""
    try:
        sweep: Sweep = log.streams[lidar].read(index)
    except RecordError:
        return None
    step = max(-(-len(sweep.xyz_m) // MAX_SWEEP_POINTS), 1)
    t_ns = None if sweep.t_ns is None else sweep.t_ns[::step]
    sweep = Sweep(sweep.stamp_ns, sweep.xyz_m[::step], sweep.frame, t_ns, sweep.compensated_ns)
    mapped = sweep_to_map(log, lidar, sweep, compensate=True)
    pose, known = log.map_T_sensor(lidar, sweep.stamp_ns)
    return (mapped[0], pose[0, :3, 3]) if mapped is not None and known[0] and len(mapped[0]) else None


def _voxels(xyz_m: Array, voxel_m: float) -> NDArray[np.int64]:
    """Assign numbers (N,), from 0 without gaps, to the voxels of points (N, 3)."""
    cell = np.floor(xyz_m / voxel_m).astype(np.int64) + (1 << 20)
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    return np.asarray(np.unique(key, return_inverse=True)[1], dtype=np.int64)


def thin(xyz_m: Array, voxel_m: float) -> Array:
    """Replace the points (N, D), of which three columns are coordinates, of each voxel by their mean."""
    if len(xyz_m) == 0:
        return xyz_m
    place = _voxels(xyz_m[:, :3], voxel_m)
    count = np.bincount(place)
    return np.stack([np.bincount(place, column) / count for column in xyz_m.T], axis=1)


def surfaces_of(view: VehicleView, near_m: Array) -> Surfaces | None:
    """Find pieces of planes and posts in what the vehicle saw, within an error of the pose of points (N, 3) of the road.

    Where points are too sparse for fine pieces, as between the rings of a LiDAR on a vehicle that stands, coarser ones fill in.
    """
    points = thin(np.hstack([view.xyz_m, view.sensor_m[view.sweep]]), VOXEL_M)
    near = (
        cKDTree(near_m).query(points[:, :3], distance_upper_bound=MAX_ERROR_M)[0]
        if len(near_m)
        else np.full(len(points), np.inf)
    )
    points = points[np.isfinite(near)]
    middles, normals, reach = np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros(0)
    for voxel_m, radius_m in SCALES_M:
        found, facing = _pieces(thin(points, voxel_m), radius_m)
        if len(middles) and len(found):
            alone = ~np.isfinite(cKDTree(middles).query(found, distance_upper_bound=voxel_m)[0])
            found, facing = found[alone], facing[alone]
        middles, normals = np.concatenate([middles, found]), np.concatenate([normals, facing])
        reach = np.concatenate([reach, np.full(len(found), voxel_m)])
    return Surfaces(middles, normals, reach, cKDTree(middles)) if len(middles) else None


def _pieces(points: Array, radius_m: float) -> tuple[Array, Array]:
    """Find pieces of planes and posts among points with the places of their sensors (N, 6): middles (P, 3), normals (P, 2, 3)."""
    if len(points) < NEIGHBORS:
        return np.zeros((0, 3)), np.zeros((0, 2, 3))
    away, index = cKDTree(points[:, :3]).query(points[:, :3], k=NEIGHBORS)
    near = away[:, -1] < radius_m
    sensor, around = points[near, 3:], points[index[near], :3]
    middle = around.mean(axis=1)
    off = around - middle[:, None]
    spread, axes = np.linalg.eigh(off.transpose(0, 2, 1) @ off / NEIGHBORS)
    plane = (spread[:, 0] < MAX_THICKNESS_M**2) & (spread[:, 1] > MIN_WIDTH_M**2) & (spread[:, 1] > 9 * spread[:, 0])
    post = ~plane & (np.abs(axes[:, 2, 2]) > MIN_UPRIGHT_Z) & (spread[:, 1] < MAX_POST_WIDTH_M**2)
    post &= spread[:, 2] > MIN_POST_LENGTH_M**2
    normals = axes.transpose(0, 2, 1)[:, :2].copy()
    facing = np.einsum("nj,nj->n", normals[:, 0], sensor - middle)
    normals[:, 0] *= np.where(facing < 0, -1.0, 1.0)[:, None]
    normals[plane, 1] = np.nan
    # The pole, at the origin, cannot see a plane from behind.
    seen = post | (plane & (np.einsum("nj,nj->n", normals[:, 0], -middle) > 0))
    return middle[seen], normals[seen]
