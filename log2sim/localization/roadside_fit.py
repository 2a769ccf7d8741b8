"""What ties a roadside unit to the ego's map: standing structure, the ground, and road users that both detect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from log2sim.config import AUTO, GIVEN_PREFIX, LIDAR_PREFIX, Config
from log2sim.datatypes import Log, Sweep
from log2sim.geometry import NS_PER_S, Array, apply, nearest_index, wrap_angle
from log2sim.geometry.transforms import USUAL_SIGMA_M, USUAL_SIGMA_RAD
from log2sim.localization.odometry import MIN_RANGE_M, is_during, lidars_on_ego
from log2sim.localization.surfaces import (
    CAUCHY,
    FEW_PIECES,
    MAD_TO_SIGMA,
    MAX_REACH_M,
    MIN_NORMAL_Z,
    fit_planes,
    number_voxels,
    thin,
)
from log2sim.perception.boxes import rotate
from log2sim.perception.cooperative import SeenBoxes, refine_boxes
from log2sim.perception.detect3d.detectors import LidarDetector, create_lidar_detector
from log2sim.perception.lidar.cloud import ON_GROUND_M, Ground, assemble_cloud, estimate_ground, sweep_to_map
from log2sim.perception.records import RecordSource

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
MIN_UPRIGHT_Z, MAX_POST_WIDTH_M, MIN_POST_LENGTH_M = 0.95, 0.12, 0.25
# What stands still is in a place in a third of the sweeps or more; what passes is not, unless it waits.
STATIC_VOXEL_M, MIN_STATIC_SHARE, STEADY_SHARE = 0.4, 0.35, 0.8
MAX_ROAD_POINTS = 6000


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Pieces of surfaces that the vehicle saw, in the frame of the site: map axes, origin at a pole's LiDARs."""

    xyz_m: Array  # (P, 3)
    # (P, 2, 3): directions in which each piece holds a point: one of a plane, turned to where it was seen from, and
    # NaN; two of a post
    normals: Array
    reach_m: Array  # (P,): how far along itself each piece goes
    tree: cKDTree  # of `xyz_m`


@dataclass(frozen=True, eq=False)
class VehicleView:
    """What the vehicle saw around a site."""

    xyz_m: Array  # (N, 3): points in the frame of the site, those of several sweeps
    sensor_m: Array  # (S, 3): where the LiDAR was in the middle of each sweep
    t_ns: NDArray[np.int64]  # (S,): stamps of the sweeps
    sweep: NDArray[np.int64]  # (N,): row of `sensor_m` for each point

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
    near = known & (away < MAX_REACH_M) & is_during(t_ns, during_ns)
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
    """What stands still around a site by the LiDARs of a pole."""

    xyz_m: Array  # (N, 3): points in the frame of the site, one a voxel
    share: Array  # (N,): of the sweeps that have a point in the same place

    @property
    def steady_m(self) -> Array:
        """The points (n, 3) that are there nearly all the time: what waits for a while is not among them."""
        return self.xyz_m[self.share > STEADY_SHARE]


def view_from_road(
    log: Log, lidars: Sequence[str], site_m: Array, during_ns: tuple[int, int] | None = None
) -> RoadView:
    """Collect the points of what stands still around a site (3,), m, by the LiDARs of a pole."""
    found = [np.zeros((0, 4))]  # of each LiDAR, with the share of its sweeps that have a point in the same place
    for name in lidars:
        rows = np.flatnonzero(is_during(log.streams[name].t_ns, during_ns))
        chosen = rows[
            np.unique(np.linspace(0, len(rows) - 1, min(MAX_ROAD_SWEEPS, len(rows))).round().astype(np.int64))
        ]
        mapped = [_read(log, name, i) for i in chosen.tolist()]
        parts = [read[0] - site_m for read in mapped if read is not None]
        parts = [xyz[np.linalg.norm(xyz, axis=1) < MAX_REACH_M] for xyz in parts]
        if not sum(map(len, parts)):
            continue
        xyz, sweep = np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        place = number_voxels(xyz, STATIC_VOXEL_M)
        seen = np.unique(place * len(parts) + sweep) // len(parts)
        share = (np.bincount(seen, minlength=int(place.max()) + 1) / len(parts))[place]
        static = share >= MIN_STATIC_SHARE
        found.append(thin(np.hstack([xyz[static], share[static, None]]), VOXEL_M))
    points = np.concatenate(found)
    points = points[:: max(-(-len(points) // MAX_ROAD_POINTS), 1)]
    return RoadView(points[:, :3], points[:, 3])


def _read(log: Log, lidar: str, index: int) -> tuple[Array, Array] | None:
    """Read a sweep: points (N, 3) and the place (3,) of the sensor in the map, m; None where that fails."""
    sweep: Sweep | None = RecordSource(log).get(lidar, index)
    if sweep is None:
        return None
    mapped = sweep_to_map(log, lidar, sweep.thinned(MAX_SWEEP_POINTS), compensate=True)
    pose, known = log.map_T_sensor(lidar, sweep.stamp_ns)
    return (mapped[0], pose[0, :3, 3]) if mapped is not None and known[0] and len(mapped[0]) else None


def surfaces_of(view: VehicleView, near_m: Array) -> Surfaces | None:
    """Find pieces of planes and posts in what the vehicle saw, within an error of the pose of points (N, 3) of the road.

    Where points are too sparse for fine pieces, as between the rings of a LiDAR on a vehicle that stands, coarser ones fill in.
    """
    points = thin(np.hstack([view.xyz_m, view.sensor_m[view.sweep]]), VOXEL_M)
    if not len(near_m):
        return None
    near = cKDTree(near_m).query(points[:, :3], distance_upper_bound=MAX_ERROR_M)[0]
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
    middle, spread, axes, plane = fit_planes(around)
    post = ~plane & (np.abs(axes[:, 2, 2]) > MIN_UPRIGHT_Z) & (spread[:, 1] < MAX_POST_WIDTH_M**2)
    post &= spread[:, 2] > MIN_POST_LENGTH_M**2
    normals = axes.transpose(0, 2, 1)[:, :2].copy()
    facing = np.einsum("nj,nj->n", normals[:, 0], sensor - middle)
    normals[:, 0] *= np.where(facing < 0, -1.0, 1.0)[:, None]
    normals[plane, 1] = np.nan
    # The pole, at the origin, cannot see a plane from behind.
    seen = post | (plane & (np.einsum("nj,nj->n", normals[:, 0], -middle) > 0))
    return middle[seen], normals[seen]


# Bins of directions as wide as the gaps between the lines of LiDARs with few of them.
BIN_RAD = np.radians(2.0)
COLUMNS = round(2 * np.pi / BIN_RAD)
ROWS = round(np.pi / BIN_RAD)
# Ranges within this agree, with an error of the pose that is left and what is seen of a thing from another side.
AGREE_M = 1.0
MAX_SWEEPS, MAX_POINTS = 6, 3000
MIN_FREE_RANGE_M = 3.0


@dataclass(frozen=True)
class Visibility:
    """What the vehicle saw where a roadside unit sees upright things."""

    seen: int  # `seen`, `seen_through`: points with a return there, and with returns from behind alone
    seen_through: int

    @property
    def contradicting(self) -> float:
        """Share of points that the vehicle saw through."""
        looked_at = self.seen + self.seen_through
        return self.seen_through / looked_at if looked_at else 0.0


def compare_visibility(view: VehicleView, upright_m: Array) -> Visibility:
    """Compare upright things of a unit, points (N, 3), m, with the ranges of the vehicle's sweeps."""
    upright = upright_m[:: max(len(upright_m) // MAX_POINTS, 1)]
    if len(upright) == 0:
        return Visibility(0, 0)
    seen = np.isfinite(cKDTree(view.xyz_m).query(upright, distance_upper_bound=AGREE_M)[0])
    through = np.zeros(len(upright), bool)
    chosen = np.unique(np.linspace(0, len(view.sensor_m) - 1, MAX_SWEEPS).round().astype(np.int64))
    for row in chosen.tolist():
        sensor = view.sensor_m[row]
        nearest = _nearest(view.xyz_m[view.sweep == row] - sensor)
        place, range_m = _bins(upright - sensor)
        through |= np.isfinite(nearest[place]) & (range_m > MIN_FREE_RANGE_M) & (nearest[place] > range_m + AGREE_M)
    return Visibility(int(seen.sum()), int((through & ~seen).sum()))


def _bins(off: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the bin (N,) of the directions of offsets (N, 3) and their lengths (N,)."""
    range_m = np.linalg.norm(off, axis=1)
    azimuth = np.arctan2(off[:, 1], off[:, 0])
    elevation = np.arcsin(np.clip(off[:, 2] / np.maximum(range_m, 1e-6), -1.0, 1.0))
    column = np.floor((azimuth + np.pi) / BIN_RAD).astype(np.int64) % COLUMNS
    row = np.clip(np.floor((elevation + np.pi / 2) / BIN_RAD).astype(np.int64), 0, ROWS - 1)
    return row * COLUMNS + column, range_m


def _nearest(off: Array) -> Array:
    """Return the nearest range of each bin and those beside it, infinite where there is none."""
    place, range_m = _bins(off)
    nearest = np.full(ROWS * COLUMNS, np.inf)
    np.minimum.at(nearest, place, range_m)
    return np.asarray(minimum_filter(nearest.reshape(ROWS, COLUMNS), 3, mode=("nearest", "wrap"))).ravel()


SPACING_S = 0.2
# Farther from a pole, boxes have too few points.
MAX_AWAY_M = 70.0
MIN_SCORE = 0.4
NO_DETECTIONS = "lidar:labels"
GIVEN = LIDAR_PREFIX + GIVEN_PREFIX


def choose_moments(log: Log, site_m: Array, during_ns: tuple[int, int] | None, count: int) -> NDArray[np.int64]:
    """Choose `count` stamps (K,) or fewer at which the vehicle is near a site (3,), evenly spaced around the nearest."""
    if log.ego is None:
        return np.zeros(0, dtype=np.int64)
    first, last = int(log.ego.t_ns[0]), int(log.ego.t_ns[-1])
    if during_ns is not None:
        first, last = max(first, during_ns[0]), min(last, during_ns[1])
    t_ns = np.arange(first, last + 1, round(SPACING_S * NS_PER_S), dtype=np.int64)
    pose, known = log.ego.at(t_ns)
    away = np.hypot(*(pose[:, :2, 3] - site_m[:2]).T)
    usable = np.flatnonzero(known & (away < MAX_AWAY_M))
    if len(usable) > count:
        nearest = int(np.argmin(away[usable]))
        begin = int(np.clip(nearest - count // 2, 0, len(usable) - count))
        usable = usable[begin : begin + count]
    return np.asarray(t_ns[usable])


def detect_boxes(
    log: Log, lidars: Sequence[str], detector: LidarDetector, moments_ns: NDArray[np.int64], floor_m: Array
) -> list[SeenBoxes]:
    """Detect road users in the clouds of some LiDARs nearest to moments (K,); sides are moved to the points.

    Clouds begin at `floor_m` (K, 3), places on the ground, map frame.
    """
    out, before, records = [], None, RecordSource(log)
    for moment, floor in zip(moments_ns.tolist(), floor_m):
        index = {name: int(nearest_index(log.streams[name].t_ns, moment)[0]) for name in lidars}
        if index == before:
            continue
        before = index
        sweeps = {name: sweep for name, i in index.items() if (sweep := records.get(name, i)) is not None}
        cloud = assemble_cloud(log, sweeps, origin=floor, ground_z=float(floor[2]), max_range_m=MAX_REACH_M)
        if cloud is not None:
            boxes = detector.detect(cloud)
            boxes = refine_boxes(boxes.take(boxes.score >= MIN_SCORE), cloud)
            out.append(SeenBoxes.of(boxes, cloud.sensor.astype(np.float64) + cloud.origin))
    return out


def detectors_of(log: Log, config: Config) -> tuple[LidarDetector, LidarDetector]:
    """Make the detectors for the clouds of the vehicle and of the road.

    Labels are no detections: they are where they are, whatever a sensor's pose.
    """
    vehicle, road = config.detect.in_sweeps, config.cooperation.road_detector
    names = (
        vehicle if vehicle not in ("", NO_DETECTIONS) and not vehicle.startswith(GIVEN) else "lidar:vehicle",
        road if road not in (AUTO, NO_DETECTIONS) else "lidar:roadside",
    )
    return create_lidar_detector(names[0], log, config.lidar), create_lidar_detector(names[1], log, config.lidar)


# Standard deviations before the fit: a direction that the data do not determine keeps its value.
PRIOR_SIGMA = np.array([0.5, 0.5, 0.5, np.radians(2.0), np.radians(2.0), np.radians(2.0), 0.3])
DELAY = 6
# Errors of poses last for seconds, by GNSS with an IMU: their time constant.
ERRORS_LAST_S = 2.0


def independent_parts(duration_s: float) -> float:
    """Count the independent errors in the mean over a time, for errors that last as long as those of poses do."""
    return 1.0 + duration_s / (2 * ERRORS_LAST_S)


MIN_SCALE_M = 0.02
# Points on surfaces that face one way err together, as those on all posts do: by so much, m.
PLANE_BIAS_M, POST_BIAS_M = 0.02, 0.1
# A turn moves points at this distance as much as a translation does.
LEVER_M = 15.0
# Points nearer than this to a surface lie on it.
ON_SURFACE_M = 0.1


@dataclass(frozen=True, eq=False)
class Evidence:
    """What some observations say about a correction: translation, m, and rotation vector, rad, of the site, and delay, s."""

    information: Array  # (7, 7)
    gradient: Array  # (7,): of half the sum of weighted squares at the correction so far


@dataclass(frozen=True, eq=False)
class MatchedStructure:
    """Points of the road on surfaces of the vehicle."""

    evidence: Evidence
    points: int  # matched points
    on_surface: int  # those within `ON_SURFACE_M`
    rms_m: float  # robust, of the distances along the normals


def match_structure(surfaces: Surfaces, road_m: Array, correction: Array, within_m: float) -> MatchedStructure | None:
    """Match points (N, 3) of the road, corrected by a transform (4, 4), with surfaces of the vehicle; None with too few.

    Point-to-plane ICP (Chen, Medioni, IVC 1992) with Cauchy weights; posts hold points in two directions.
    """
    at = apply(correction, road_m)
    away, index = surfaces.tree.query(at, distance_upper_bound=np.hypot(within_m, surfaces.reach_m.max()))
    found = np.flatnonzero(np.isfinite(away))
    off = at[found] - surfaces.xyz_m[index[found]]
    first = np.einsum("kj,kj->k", surfaces.normals[index[found], 0], off)
    along_m = np.sqrt(np.maximum(away[found] ** 2 - first**2, 0.0))
    near = (np.abs(first) < within_m) & (along_m < np.maximum(surfaces.reach_m[index[found]], within_m))
    found, off, first = found[near], off[near], first[near]
    if len(found) < FEW_PIECES:
        return None
    at, piece = at[found], index[found]
    post = np.isfinite(surfaces.normals[piece, 1, 0])
    normals = np.concatenate([surfaces.normals[piece, 0], surfaces.normals[piece[post], 1]])
    at, off = np.concatenate([at, at[post]]), np.concatenate([off, off[post]])
    residual = np.einsum("kj,kj->k", normals, off)
    jacobian = np.hstack([normals, np.cross(at, normals)])
    share, weight = _weights(normals, residual, np.concatenate([post, post[post]]))
    return MatchedStructure(
        _damped(jacobian, residual, share, weight),
        len(found),
        int((np.abs(first) < ON_SURFACE_M).sum()),
        MAD_TO_SIGMA * float(np.median(np.abs(first))),
    )


def _weights(normals: Array, residual: Array, post: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Weigh rows (K,): the share that each counts by Cauchy's function, and the inverse variance with what rows have in common."""
    up = ~post & (np.abs(normals[:, 2]) > MIN_NORMAL_Z)
    along = ~post & ~up & (np.abs(normals[:, 0]) > np.abs(normals[:, 1]))
    across = ~post & ~up & ~along
    share, weight = np.zeros(len(residual)), np.zeros(len(residual))
    for group, bias_m in ((up, PLANE_BIAS_M), (along, PLANE_BIAS_M), (across, PLANE_BIAS_M), (post, POST_BIAS_M)):
        if group.any():
            share[group], weight[group] = _cauchy(residual[group], bias_m)
    return share, weight


def _cauchy(residual: Array, bias_m: float) -> tuple[Array, Array]:
    """Weigh rows that have an error of `bias_m` in common."""
    scale = max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), MIN_SCALE_M)
    share = 1.0 / (1.0 + (residual / (CAUCHY * scale)) ** 2)
    return share, share / (scale**2 + float(share.sum()) * bias_m**2)


def _damped(jacobian: Array, residual: Array, share: Array, weight: Array) -> Evidence:
    """Weaken what rows (K, 6) say about directions that few of them hold, as the noise of normals makes it up."""
    scaled = jacobian * np.array([1.0, 1.0, 1.0, 1 / LEVER_M, 1 / LEVER_M, 1 / LEVER_M])
    pieces, directions = np.linalg.eigh((scaled * share[:, None]).T @ scaled)
    pieces = np.maximum(pieces, 0.0)
    trust = (directions * np.sqrt(pieces / (pieces + FEW_PIECES))) @ directions.T
    information = (scaled * weight[:, None]).T @ scaled
    best = np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ ((scaled * weight[:, None]).T @ residual)
    trusted = trust @ information @ trust
    unscale = np.array([1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M])
    full, gradient = np.zeros((7, 7)), np.zeros(7)
    full[:6, :6] = trusted * unscale * unscale[:, None]
    gradient[:6] = (trusted @ best) * unscale
    return Evidence(full, gradient)


def solve(evidence: Sequence[Evidence], so_far: Array) -> tuple[Array, Array]:
    """Find the step (7,) that fits best and the covariance (7, 7) of the whole, given what was corrected so far (7,)."""
    information, gradient = np.diag(PRIOR_SIGMA**-2.0), PRIOR_SIGMA**-2.0 * so_far
    for part in evidence:
        information = information + part.information
        gradient = gradient + part.gradient
    covariance = np.linalg.inv(information)
    return np.asarray(-covariance @ gradient), np.asarray(covariance)


# Where the vehicle has no ground point so near, its surface is a guess; measured in synthetic streets it errs by 5 cm up to here.
MAX_GAP_M = 1.5
BIAS_M = 0.03
GROUND_VOXEL_M = 0.5
# For slopes of the surface.
STEP_M = 0.5
# Of upright things: above curbs and the errors of a surface on slopes.
MIN_HEIGHT_M = 0.7
# Of the lowest points around a pole, those of the ground.
GROUND_RADIUS_M, GROUND_SHARE = 20.0, 0.1
# Of a pole that sees no ground.
USUAL_BELOW_M = 4.0


@dataclass(frozen=True, eq=False)
class CommonGround:
    """Ground around a unit."""

    surface: Ground  # by the vehicle, in the frame of the site
    known: cKDTree  # of the places (x, y) of the vehicle's ground points
    road_m: Array  # (N, 3): ground points of the unit, thinned out


def ground_below(road_m: Array) -> float:
    """Estimate the height of the ground at a pole, m, in the frame of the site, from the unit's points (N, 3)."""
    near = road_m[np.hypot(road_m[:, 0], road_m[:, 1]) < GROUND_RADIUS_M, 2]
    return float(np.quantile(near, GROUND_SHARE)) if len(near) else -USUAL_BELOW_M


def upright_points(road_m: Array) -> Array:
    """Choose the points (n, 3) of a unit, m, that are above the ground as it sees it itself."""
    if len(road_m) == 0:
        return road_m
    surface = estimate_ground(road_m, np.zeros(2), ground_below(road_m))
    return road_m[road_m[:, 2] - surface.at(road_m[:, :2]) > MIN_HEIGHT_M]


def common_ground(view: VehicleView, road_m: Array) -> CommonGround | None:
    """Find the ground among points of both ends; None where one of them sees none."""
    below = ground_below(road_m)
    surface, own = (estimate_ground(xyz, np.zeros(2), below) for xyz in (view.xyz_m, road_m))
    seen = view.xyz_m[np.abs(view.xyz_m[:, 2] - surface.at(view.xyz_m[:, :2])) < ON_GROUND_M]
    ground = thin(road_m[np.abs(road_m[:, 2] - own.at(road_m[:, :2])) < ON_GROUND_M], GROUND_VOXEL_M)
    if len(seen) == 0 or len(ground) == 0:
        return None
    return CommonGround(surface, cKDTree(thin(seen, GROUND_VOXEL_M)[:, :2]), ground)


def match_ground(ground: CommonGround, correction: Array, within_m: float) -> Evidence | None:
    """Compare heights of the unit's ground points, corrected by a transform (4, 4), with the vehicle's surface."""
    at = apply(correction, ground.road_m)
    away = ground.known.query(at[:, :2], distance_upper_bound=MAX_GAP_M)[0]
    residual = at[:, 2] - ground.surface.at(at[:, :2])
    kept = np.isfinite(away) & (np.abs(residual) < within_m)
    at, residual = at[kept], residual[kept]
    if len(at) < FEW_PIECES:
        return None
    step = STEP_M * np.eye(2)
    slope = [(ground.surface.at(at[:, :2] + d) - ground.surface.at(at[:, :2] - d)) / (2 * STEP_M) for d in step]
    normals = np.stack([-slope[0], -slope[1], np.ones(len(at))], axis=1)
    _, weight = _cauchy(residual, BIAS_M)
    # Slopes show height and tilt alone: what they say about the plane is the noise of the surface.
    jacobian = np.zeros((len(at), 7))
    jacobian[:, 2] = 1.0
    jacobian[:, 3:5] = np.cross(at, normals)[:, :2]
    return Evidence((jacobian * weight[:, None]).T @ jacobian, (jacobian * weight[:, None]).T @ residual)


# Nobody drives faster on roads with LiDARs at the side; a box errs by half a meter.
MAX_SPEED_MPS, MAX_JUMP_M = 35.0, 1.5
MIN_BOXES = 3
# Within so much time of a box the velocity of its track is taken from.
VELOCITY_SPAN_S = 0.5
MAX_GAP_S = 0.7
# Boxes of one object are of different sweeps; what is farther away than any limit is not linked.
MIN_STEP_S, UNLIKELY_M = 0.01, 1e6
# Kinds of road users that detectors distinguish.
GROUPS = {"car": 0, "truck": 0, "bus": 0, "pedestrian": 1, "cyclist": 2, "motorcycle": 2, "bicycle": 2}


# Axes of boxes that differ by more are those of a length and of a width, or of somebody who walks, whose axes say little.
MAX_AXES_APART_RAD = np.pi / 4
# Two tracks of one object have velocities as similar as boxes over a second show.
MAX_VELOCITY_APART_MPS = 4.0
# Boxes so many standard deviations apart count a quarter (Geman, McClure 1987), as they may be of different objects.
TOO_FAR = 2.5
MOVING_MPS = 1.0
# Of the error of a box, what all boxes of a track have in common; in synthetic streets with known poses the mean over a track is
# off by 0.3 to 0.7 of it.
COMMON_SHARE = 0.6
DRIFT = np.array([USUAL_SIGMA_M, USUAL_SIGMA_M, USUAL_SIGMA_RAD])
# Columns of `ObjectTrack.box`.
HALF, SIDES, YAW, YAW_SIGMA = slice(3, 5), slice(5, 9), 9, 10
# By an error of a unit's pose, and of boxes.
MAX_APART_M = 5.0


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """Boxes of one road user as one end saw it."""

    t_s: Array  # (K,): since a common time, by the clock of the end, increasing
    # (K, 11): place in the frame of the site, half the length and the width, standard deviations of the rear, the front, the
    # right and the left side, m; yaw without jumps by half turns and more, and its standard deviation, rad
    box: Array
    velocity_mps: Array  # (K, 2)
    group: int

    def at(self, t_s: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Interpolate boxes (N, 11) and velocities (N, 2) at times (N,), and say where they are known (N,)."""
        after = np.searchsorted(self.t_s, t_s, side="left").clip(1, len(self.t_s) - 1)
        begin, gap = self.t_s[after - 1], self.t_s[after] - self.t_s[after - 1]
        share = ((t_s - begin) / gap)[:, None]
        box, velocity = (c[after - 1] + share * (c[after] - c[after - 1]) for c in (self.box, self.velocity_mps))
        return box, velocity, (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1]) & (gap <= MAX_GAP_S)


def link_boxes(seen: Sequence[SeenBoxes], site_m: Array, start_ns: int) -> list[ObjectTrack]:
    """Link boxes of successive moments to tracks."""
    growing: list[list[Array]] = []
    done: list[list[Array]] = []
    for found in seen:
        boxes, sides = found.boxes, found.sigma_m.reshape(-1, 4)
        if len(boxes) == 0:
            continue
        # Group, time, and box as in `ObjectTrack`.
        group, t_s = [GROUPS.get(str(c), -1) for c in boxes.category], (boxes.t_ns - start_ns) / NS_PER_S
        at = [boxes.center_m - site_m, boxes.size_m[:, :2] / 2, sides, boxes.yaw_rad, found.sigma_rad]
        rows = np.column_stack([group, t_s, *at])
        costs = np.array([_costs(track, rows) for track in growing]).reshape(len(growing), len(rows))
        pairs = zip(*linear_sum_assignment(np.where(np.isfinite(costs), costs, UNLIKELY_M)))
        taken = {int(b): int(a) for a, b in pairs if np.isfinite(costs[a, b])}
        for b, a in taken.items():
            growing[a].append(rows[b])
        growing += [[row] for b, row in enumerate(rows) if b not in taken]
        over_s = rows[:, 1].max() - MAX_GAP_S
        done += [track for track in growing if track[-1][1] < over_s]
        growing = [track for track in growing if track[-1][1] >= over_s]
    return [track_of(np.array(track)) for track in (*done, *growing) if len(track) >= MIN_BOXES]


def _costs(track: list[Array], rows: Array) -> Array:
    """Compute how far boxes (M,) are from where a track leads, m; infinite where they cannot be one object."""
    last = track[-1]
    ahead_s = rows[:, 1] - last[1]
    expected, limit = last[2:4], MAX_SPEED_MPS * ahead_s + MAX_JUMP_M
    if len(track) > 1:
        velocity = (last[2:4] - track[-2][2:4]) / (last[1] - track[-2][1])
        expected, limit = last[2:4] + velocity * ahead_s[:, None], np.full(len(rows), MAX_JUMP_M)
    away = np.hypot(*(rows[:, 2:4] - expected).T)
    return np.where((rows[:, 0] == last[0]) & (ahead_s > MIN_STEP_S) & (away < limit), away, np.inf)


def track_of(rows: Array) -> ObjectTrack:
    """Make a track of rows (K, 13): group, time, and box as in `ObjectTrack`, whose yaw may jump."""
    t_s, box = rows[:, 1], rows[:, 2:].copy()
    box[:, YAW] = np.unwrap(rows[:, 2 + YAW], period=np.pi)
    turned = np.cos(box[:, YAW] - rows[:, 2 + YAW]) < 0
    box[turned, SIDES] = box[turned][:, [6, 5, 8, 7]]
    near = np.abs(t_s[:, None] - t_s) <= VELOCITY_SPAN_S
    count = near.sum(axis=1)
    mean_s = near @ t_s / count
    off_s = np.where(near, t_s - mean_s[:, None], 0.0)
    velocity = (off_s @ box[:, :2]) / np.maximum((off_s**2).sum(axis=1), 1e-6)[:, None]
    return ObjectTrack(t_s, box, velocity, int(rows[0, 0]))


@dataclass(frozen=True, eq=False)
class CommonObjects:
    """Tracks of the vehicle, with the vehicle itself, and for each those of the road that may show the same road user."""

    pairs: tuple[tuple[ObjectTrack, tuple[ObjectTrack, ...]], ...]

    @classmethod
    def of(cls, vehicle: Sequence[ObjectTrack], road: Sequence[ObjectTrack]) -> CommonObjects:
        """Pair tracks of one group that come near each other, at whatever time."""
        near = []
        for seen in vehicle:
            low, high = seen.box[:, :2].min(axis=0) - MAX_APART_M, seen.box[:, :2].max(axis=0) + MAX_APART_M
            alike = (other for other in road if other.group == seen.group)
            others = tuple(
                o for o in alike if (o.box[:, :2].max(axis=0) > low).all() and (o.box[:, :2].min(axis=0) < high).all()
            )
            near += [(seen, others)] if others else []
        return cls(tuple(near))


@dataclass(frozen=True, eq=False)
class Matched:
    """Places of common objects at common times."""

    evidence: Evidence
    pairs: int  # of tracks
    moving: int  # of those, how many move
    gain: float  # how well all fits together: 1 for each place that fits perfectly, 0 for one that does not
    rms_m: float  # robust, of the distances between places


def match_objects(objects: CommonObjects, correction: Array, delay_s: float, within_m: float) -> Matched | None:
    """Match boxes of road users with those nearest to them, given a correction (4, 4) and a delay of the road's stamps."""
    information, gradient = np.zeros((7, 7)), np.zeros(7)
    away, moving, gain = [], 0, 0.0
    for seen, others in objects.pairs:
        best = _best_match(seen, others, correction, delay_s, within_m)
        if best is None:
            continue
        axes, place, velocity, off, sigma, t_s = best
        away.append(np.hypot(*off[:, :2].T))
        moves = float(np.hypot(*velocity.mean(axis=0))) > MOVING_MPS
        moving += moves
        gain += float((1 - away[-1] ** 2 / within_m**2).sum())
        jacobian = np.zeros((len(off), 3, 7))
        (x, y, z), in_plane = place.T, np.zeros((len(off), 2, 7))  # places along x and y by a correction
        in_plane[:, 0, 0] = in_plane[:, 1, 1] = 1.0
        in_plane[:, 0, 4], in_plane[:, 0, 5] = z, -y
        in_plane[:, 1, 3], in_plane[:, 1, 5] = -z, x
        # What stands says nothing about time: its boxes jump.
        in_plane[:, :, DELAY] = velocity if moves else 0.0
        jacobian[:, :2] = axes @ in_plane
        jacobian[:, 2, 5] = 1.0
        share = (1.0 + ((off / sigma)[:, :2] ** 2).sum(axis=1) / TOO_FAR**2) ** -2.0
        of_track = _evidence_of_track(jacobian, off, sigma, share / share.sum(), float(t_s[-1] - t_s[0]))
        information, gradient = information + of_track.information, gradient + of_track.gradient
    if not away:
        return None
    # Of a distance in the plane, the median is 1.18 times the standard deviation along an axis.
    rms_m = float(np.median(np.concatenate(away))) / 1.18 * np.sqrt(2.0)
    return Matched(Evidence(information, gradient), len(away), moving, gain, float(rms_m))


def _evidence_of_track(jacobian: Array, off: Array, sigma: Array, share: Array, duration_s: float) -> Evidence:
    """Weigh the offsets (N, 3) of the boxes of a track, with their derivatives (N, 3, 7) and the shares (N,) of the boxes.

    Each end sees the same sides again and again: what boxes have in common is an error of its own, of which nothing remains in what
    they say about the way of the track, which turns with the unit. The rest is what they scatter by, with the errors of the poses.
    """
    information, gradient = np.zeros((7, 7)), np.zeros(7)
    precision = share @ sigma**-2.0
    scatter = share @ (off - share @ off) ** 2
    for axis in np.flatnonzero(precision):
        # The scatter of few boxes is uncertain: as if there were one more box, with the error of a box.
        own = scatter[axis] + 1 / (precision[axis] * len(off)) + DRIFT[axis] ** 2
        weight = share * independent_parts(duration_s) / own
        of_common = weight @ jacobian[:, axis]
        variance = 1 / (weight.sum() + precision[axis] / COMMON_SHARE**2)
        information += (jacobian[:, axis] * weight[:, None]).T @ jacobian[:, axis] - variance * np.outer(
            of_common, of_common
        )
        gradient += (weight * off[:, axis]) @ jacobian[:, axis] - variance * (weight @ off[:, axis]) * of_common
    return Evidence(information, gradient)


Match = tuple[Array, Array, Array, Array, Array, Array]
"""Of N boxes: axes (N, 2, 2), places (N, 3), velocities (N, 2), and along both axes and in yaw offsets (N, 3) and their sigmas; times (N,), s."""


def _best_match(
    seen: ObjectTrack, road: Sequence[ObjectTrack], correction: Array, delay_s: float, within_m: float
) -> Match | None:
    """Find the track of the road whose boxes lie on those of a vehicle's track best."""
    best: Match | None = None
    best_gain = 0.0
    for other in road:
        box, velocity, known = other.at(seen.t_s + delay_s)
        known &= np.hypot(*(velocity - seen.velocity_mps).T) < MAX_VELOCITY_APART_MPS
        if not known.any():
            continue
        box[:, :3] = apply(correction, box[:, :3])
        box[:, YAW] += np.arctan2(correction[1, 0], correction[0, 0])
        off, sigma = _offsets(seen.box, box, walks=seen.group == GROUPS["pedestrian"])
        away = np.hypot(*off[:, :2].T)
        known &= away < within_m
        gain = float((1 - away[known] ** 2 / within_m**2).sum())
        if gain > best_gain and known.sum() >= min(MIN_BOXES, len(known)):
            cos, sin = np.cos(seen.box[:, YAW]), np.sin(seen.box[:, YAW])
            axes = np.stack([cos, sin, -sin, cos], axis=1).reshape(-1, 2, 2)
            best = axes[known], box[known, :3], velocity[known], off[known], sigma[known], seen.t_s[known]
            best_gain = gain
    return best


def _offsets(seen: Array, road: Array, *, walks: bool) -> tuple[Array, Array]:
    """Compare boxes (N, 11) along the axes of the first ones: offsets (N, 3) of the others, m and rad of yaw, and their sigmas.

    Each end knows the sides that it sees: what both see well decides, not the centers.
    """
    turn = road[:, YAW] - seen[:, YAW]
    center = rotate(road[:, :2] - seen[:, :2], -seen[:, YAW])
    sides = [np.square(box[:, SIDES]).reshape(-1, 2, 2) for box in (seen, road)]
    sides[1] = np.where((np.cos(turn) < 0)[:, None, None], sides[1][..., ::-1], sides[1])
    variance = sides[0] + sides[1]
    weight = 1 / variance
    longer = (road[:, HALF] - seen[:, HALF]) * (weight[..., 1] - weight[..., 0]) / weight.sum(axis=-1)
    off_yaw = wrap_angle(2 * turn) / 2
    alike = (np.abs(off_yaw) < MAX_AXES_APART_RAD) & (not walks)
    off = np.where(alike[:, None], center + longer, center)
    sigma = np.where(alike[:, None], np.sqrt(1 / weight.sum(axis=-1)), np.sqrt(variance.sum(axis=-1)) / 2)
    yaw_sigma = np.where(alike, np.hypot(seen[:, YAW_SIGMA], road[:, YAW_SIGMA]), np.inf)
    return np.column_stack([off, np.where(alike, off_yaw, 0.0)]), np.column_stack([sigma, yaw_sigma])
