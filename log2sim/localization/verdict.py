"""Whether given poses are good enough by what the LiDAR shows, and odometry laid on them where they are not.

Two sweeps are laid over each other by the poses. Upright surfaces, that is walls, poles and parked cars, of one should lie on
those of the other. The mean squared distance from surface to surface is the plane variance (Razlaw, Droeschel, Holz, Behnke:
Evaluation of registration methods for sparse 3D laser scans, ECMR 2015). Surfaces that face along and across the ego count the
same, however many there are, as in the mutually orthogonal metric (Kornilova, Ferrer: Be your own benchmark, ECMR 2021): a
street has many walls across and little that shows an error along it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.files.documents import rounded
from log2sim.geometry import (
    NS_PER_S,
    Array,
    PoseTrack,
    apply,
    inverse,
    nearest_index,
    nearest_rotation,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
    slerp,
    transform,
)
from log2sim.geometry.transforms import USUAL_SIGMA_M, USUAL_SIGMA_RAD
from log2sim.localization.given_poses import (
    MAX_SIGMA_M,
    CheckedPoses,
    Stretch,
    join_tracks,
)
from log2sim.localization.odometry import (
    NEIGHBORS,
    EgoSweep,
    Odometry,
    Progress,
    densest_lidar,
    is_during,
    is_installed,
    load_small_gicp,
    move_points,
    read_ego_sweep,
    run_odometry,
)

# The ground is searched this near to the ego, and this far above and below where it is expected.
GROUND_REACH_M, GROUND_MARGIN_M = 15.0, 0.6
MIN_GROUND_POINTS = 200
GROUND_ROUNDS, GROUND_TOLERANCE_M = 10, 0.05
# Roads are not tilted more against the car on them.
MAX_TILT_RAD = np.deg2rad(15.0)


def fit_to_given(estimated: PoseTrack, given: PoseTrack) -> Array | None:
    """Fit the frame of estimated poses to given ones: `map_T_odom` (4, 4); None where no given pose is at their stamps.

    The rotation is the mean of the differences between the attitudes (chordal mean; Hartley et al., IJCV 2013, section 5.3),
    the translation that between the positions. Attitudes of GNSS with an IMU hold the vertical, and the direction where the
    path is short; positions alone would leave the roll about a straight path open.
    """
    map_T_ego, known = given.at(estimated.t_ns)
    if not known.any():
        return None
    target, source = map_T_ego[known], estimated.map_T_ego[known]
    rotation = nearest_rotation(np.einsum("nij,nkj->ik", target[:, :3, :3], source[:, :3, :3]))
    shift = target[:, :3, 3].mean(axis=0) - rotation @ source[:, :3, 3].mean(axis=0)
    return transform(rotation, shift)


def level_on_ground(xyz_m: Array, ground_z_m: float) -> Array | None:
    """Fit the ground around the ego: the pose (4, 4) of the ego in a frame with this ground level at `ground_z_m`.

    `xyz_m` (N, 3): one sweep in the ego's frame. None where there are too few points on a ground. The origin keeps its place above
    the ground, and the x axis its direction. A slope that is the same all around is taken for level: a LiDAR alone does not measure
    the vertical.
    """
    away = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
    points = xyz_m[(away < GROUND_REACH_M) & (np.abs(xyz_m[:, 2] - ground_z_m) < GROUND_MARGIN_M)]
    if len(points) < MIN_GROUND_POINTS:
        return None
    terms, weight = np.column_stack([np.ones(len(points)), points[:, :2]]), np.ones(len(points))
    plane: Array = np.zeros(3)
    for _ in range(GROUND_ROUNDS):
        weighted = terms * weight[:, None]
        plane = np.asarray(np.linalg.lstsq(weighted.T @ terms, weighted.T @ points[:, 2], rcond=None)[0])
        weight = 1 / (1 + ((points[:, 2] - terms @ plane) / GROUND_TOLERANCE_M) ** 2) ** 2
    pitch, roll = np.arctan(plane[1] / np.sqrt(1 + plane[2] ** 2)), -np.arctan(plane[2])
    if max(abs(pitch), abs(roll)) > MAX_TILT_RAD:
        return None
    rotation = rotation_from_rpy(roll, pitch, 0.0)
    height_m = float(plane[0] / np.sqrt(1 + plane[1] ** 2 + plane[2] ** 2))
    return transform(rotation, np.array([0.0, 0.0, ground_z_m - height_m]))


PAIRS = 15
APART_S = 2.0
VOXEL_M = 0.25
# A surface is upright if its normal leaves the horizontal by less than 20 degrees, and faces a direction within 45 degrees.
MAX_NORMAL_Z = 0.35
MIN_FACING = np.sqrt(0.5)
MIN_POINTS_FACING = 50
MAX_REACH_M, MATCH_WITHIN_M, MAX_DISTANCE_M = 50.0, 2.0, 0.5


@dataclass(frozen=True, eq=False)
class Scatter:
    """Distances between the surfaces of pairs of sweeps under some poses."""

    # `neighbors_m`, `apart_m`: (K,): RMS over the surfaces of each pair of neighbors, and of sweeps `apart_s` apart;
    # NaN for a pair that shows too little
    neighbors_m: Array
    apart_m: Array
    apart_s: float  # `APART_S`, or half of a shorter log


def compare_poses(log: Log, lidar: str, tracks: Mapping[str, PoseTrack], t_ns: NDArray[np.int64]) -> dict[str, Scatter]:
    """Measure how sharp the surroundings are under several poses, on the same pairs of the sweeps at stamps (P,), two at least."""
    library, stream_t_ns = load_small_gicp(), log.streams[lidar].t_ns
    apart_ns = min(round(APART_S * NS_PER_S), int(t_ns[-1] - t_ns[0]) // 2)
    starts = np.unique(np.linspace(t_ns[0], t_ns[-1] - apart_ns, PAIRS).astype(np.int64))
    first = np.unique(np.minimum(nearest_index(t_ns, starts), len(t_ns) - 2))
    second = np.maximum(nearest_index(t_ns, t_ns[first] + apart_ns), first + 1)
    index = nearest_index(stream_t_ns, t_ns)
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in tracks}
    for i, j in zip(first.tolist(), second.tolist()):
        sweeps = [read_ego_sweep(log, lidar, int(index[k])) for k in (i, i + 1, j)]
        for name, track in tracks.items():
            found[name].append(_distances(library, sweeps, track))
    table = {name: np.array(rows).reshape(-1, 2) for name, rows in found.items()}
    usable = np.isfinite(np.stack(list(table.values()))).all(axis=0)
    apart_s = float(np.median(t_ns[second] - t_ns[first])) / NS_PER_S
    columns = {name: np.where(usable, rows, np.nan) for name, rows in table.items()}
    return {name: Scatter(rows[:, 0], rows[:, 1], apart_s) for name, rows in columns.items()}


def _distances(library: ModuleType, sweeps: list[EgoSweep | None], track: PoseTrack) -> tuple[float, float]:
    """Measure a sweep against the next one and against one seconds later: RMS distances, m."""
    at, *others = [None if sweep is None else _placed(sweep, track) for sweep in sweeps]
    if at is None:
        return np.nan, np.nan
    map_T_ego, xyz = at
    target, tree = library.preprocess_points(xyz, VOXEL_M, NEIGHBORS, 1)
    points = np.array(target.points())[:, :3]
    out = []
    for other in others:
        if other is None:
            out.append(np.nan)
            continue
        source, _ = library.preprocess_points(other[1], VOXEL_M, NEIGHBORS, 1)
        first_T_other = inverse(map_T_ego) @ other[0]
        normals = np.array(source.normals())[:, :3] @ first_T_other[:3, :3].T
        moved = apply(first_T_other, np.array(source.points())[:, :3])
        out.append(_surface_distance(tree, points, moved, normals))
    return out[0], out[1]


def _placed(sweep: EgoSweep, track: PoseTrack) -> tuple[Array, Array] | None:
    """Return the pose (4, 4) of a sweep and its points (N, 3) in the ego's frame, compensated by the same poses."""
    pose, known = track.at(sweep.t_ref_ns)
    if not known[0] or len(sweep.xyz_m) < NEIGHBORS:
        return None
    if sweep.t_ns is None:
        return pose[0], sweep.xyz_m
    ref_T_map = inverse(pose[0])
    moved = move_points(sweep.xyz_m, sweep.t_ns, lambda t: (ref_T_map @ track.at(t)[0], track.at(t)[1]))
    return None if moved is None else (pose[0], moved)


def _surface_distance(tree: object, target: Array, points: Array, normals: Array) -> float:
    """Compute the RMS distance, m, from points (N, 3) on upright surfaces with normals (N, 3) to their nearest targets.

    Half of the mean square is of surfaces that face along x, half of those along y; NaN with too few of both.
    """
    upright = (np.abs(normals[:, 2]) < MAX_NORMAL_Z) & (np.hypot(points[:, 0], points[:, 1]) < MAX_REACH_M)
    points, normals = points[upright], normals[upright]
    if len(points) == 0:
        return np.nan
    index, squared = tree.batch_nearest_neighbor_search(points)  # type: ignore[attr-defined]  # small_gicp has no types
    near = np.array(squared) < MATCH_WITHIN_M**2
    points, normals, nearest = points[near], normals[near], target[np.array(index)[near]]
    distance = np.minimum(np.abs(np.einsum("nj,nj->n", nearest - points, normals)), MAX_DISTANCE_M)
    squares = [
        float(np.mean(distance[facing] ** 2))
        for axis in range(2)
        if (facing := np.abs(normals[:, axis]) > MIN_FACING).sum() >= MIN_POINTS_FACING
    ]
    return float(np.sqrt(np.mean(squares))) if squares else np.nan


# Given poses are replaced where surroundings show that they are off by more than this against each other. Smoothing takes ego
# positions for right to 0.02 m, 0.03 m between two of them; odometry errs by as much.
MIN_EXCESS_M = 0.05
MIN_WORSE_SHARE = 0.75
# Odometry replaces given poses only if nearly all sweeps are registered and hold every direction of motion.
MAX_UNSURE_SHARE = 0.1

Figures = dict[str, float | None]


@dataclass(frozen=True, eq=False)
class Verdict:
    """Whether given poses are kept."""

    keep: bool
    reason: str  # for people
    excess_m: Figures  # `excess_m`, `scatter_m`: see `PoseChoice`
    scatter_m: dict[str, Figures]


def compare_with_given(log: Log, found: Odometry, track: PoseTrack) -> Verdict:
    """Compare the given poses of a log with those of odometry, `track`, by the scatter of upright surfaces.

    Odometry is fitted to the very sweeps that judge it, so that it is always somewhat sharper: given poses are replaced only
    where they are worse by more than `MIN_EXCESS_M`, in most pairs. What no surface holds, such as the way along a tunnel,
    shows in neither scatter; there given poses are kept.
    """
    assert log.ego is not None
    both = compare_poses(log, found.lidar, {"given": log.ego, "lidar": track}, found.t_ns)
    scatter: dict[str, Figures] = {source: {} for source in both}
    excess, worse, words = Figures(), False, list[str]()
    apart_s = both["given"].apart_s
    for name, pairs in (("apart", f"in sweeps {apart_s:.1f} s apart"), ("neighbors", "in successive sweeps")):
        squares = {source: getattr(rows, f"{name}_m") ** 2 for source, rows in both.items()}
        known = {source: square[np.isfinite(square)] for source, square in squares.items()}
        for source, square in known.items():
            scatter[source][name] = rounded(float(np.sqrt(np.mean(square))), 4) if len(square) else None
        usable = np.isfinite(squares["given"]) & np.isfinite(squares["lidar"])
        excess[name] = None
        if usable.any():
            given, lidar = squares["given"][usable], squares["lidar"][usable]
            value = rounded(float(np.sqrt(max(float(np.mean(given) - np.mean(lidar)), 0.0))), 4)
            excess[name] = value
            worse |= value is not None and value > MIN_EXCESS_M and float(np.mean(given > lidar)) >= MIN_WORSE_SHARE
        given_m, lidar_m = scatter["given"][name], scatter["lidar"][name]
        if given_m is not None and lidar_m is not None:
            words.append(f"{pairs} {given_m:.3f} m with the given poses and {lidar_m:.3f} m with odometry")
    said = f"upright surfaces differ {', '.join(words)}" if words else "no upright surface to compare"
    unsure = unsure_share(found)
    if unsure > MAX_UNSURE_SHARE:
        return Verdict(True, f"LiDAR odometry is not sure of {unsure:.0%} of the sweeps; {said}", excess, scatter)
    more = "more" if worse else "no more"
    return Verdict(not worse, f"{said}; the given poses are off by {more} than {MIN_EXCESS_M} m", excess, scatter)


def unsure_share(found: Odometry) -> float:
    """Compute the share of sweeps without a pose, or with one that is predicted or poorly held in one direction."""
    sure = np.sum(~(found.degenerate | found.predicted))
    return 1.0 - float(sure) / max(found.sweeps, 1)


# Odometry begins this long before and ends this long after, which fits it to the poses there.
MARGIN_S = 2.0
# Odometry that differs from the poses before or after by more, RMS, is not sure of the motion; nor does it meet both.
MAX_MISFIT_M = 0.1
# Fewer poses do not tell whether odometry fits to them.
MIN_FITTED, MIN_FITTED_M = 5, 1.0
# Sweeps farther apart leave too much to the motion between them.
MAX_STEP_S = 0.6
# Odometry drifts by up to this share of its path and by this much per m of it: centimeters over twenty meters.
DRIFT_SHARE, DRIFT_RAD_PER_M = 0.005, 2e-4


def bridge_by_lidar(log: Log, checked: CheckedPoses, progress: Progress) -> CheckedPoses:
    """Take poses from LiDAR odometry where given ones are not known, as far as sweeps and its library are there.

    `log`: with the poses that were given, by which its sweeps may be placed.
    """
    if not any(s.unknown_s for s in checked.stretches) or not is_installed():
        return checked
    lidar = densest_lidar(log)
    if lidar is None:
        return checked
    track, stretches = checked.track, []
    for stretch in checked.stretches:
        found = _bridge(log, lidar, track, stretch, progress) if stretch.unknown_s else None
        stretches.append(stretch if found is None else found[1])
        track = track if found is None else found[0]
    return replace(checked, track=track, stretches=tuple(stretches))


def _bridge(
    log: Log, lidar: str, track: PoseTrack, stretch: Stretch, progress: Progress
) -> tuple[PoseTrack, Stretch] | None:
    """Replace the poses of a stretch by those of odometry; None where it is not sure of them."""
    margin_ns = round(MARGIN_S * NS_PER_S)
    window = stretch.first_ns - margin_ns, stretch.last_ns + margin_ns
    if is_during(log.streams[lidar].t_ns, window).sum() < 2:
        return None
    try:
        found = run_odometry(log, lidar, during_ns=window, progress=progress)
    except LogError:
        return None
    placed = _placed_on_poses(found, track, stretch)
    if placed is None or unsure_share(found) > MAX_UNSURE_SHARE:
        return None
    rows = (track.t_ns < placed.t_ns[0]) | (track.t_ns > placed.t_ns[-1])
    rows &= (track.t_ns < stretch.first_ns) | (track.t_ns > stretch.last_ns)
    joined = join_tracks(replace(track, max_gap_s=max(track.max_gap_s, MAX_STEP_S)), np.flatnonzero(rows), placed)
    assert placed.sigma_m is not None
    bridged = replace(stretch, unknown_s=0.0, sigma_m=float(placed.sigma_m.max()), by="LiDAR odometry")
    return joined, bridged


@dataclass(frozen=True, eq=False)
class _Side:
    """Odometry laid on the poses before or after a stretch."""

    poses: Array  # (n, 4, 4): of the stretch
    away_m: Array  # (n,): way from the nearest of the poses before or after
    misfit_m: float  # RMS distance from these
    fitted_m: float  # length of the path along these

    @property
    def sigma_m(self) -> Array:
        """Standard deviations (n,) of the poses: a misfit may be of the speed, so that it grows beyond the poses it is fitted to."""
        growth = 1 + 2 * self.away_m / max(self.fitted_m, MIN_FITTED_M)
        return np.asarray(np.hypot(self.misfit_m * growth, DRIFT_SHARE * self.away_m))


def _placed_on_poses(found: Odometry, track: PoseTrack, stretch: Stretch) -> PoseTrack | None:
    """Lay odometry on the poses before and after a stretch: its poses in between; None where it covers or fits too little."""
    t_ns = found.t_ns
    known = track.at(t_ns)[1]
    inside = np.flatnonzero((t_ns >= stretch.first_ns) & (t_ns <= stretch.last_ns))
    before = np.flatnonzero((t_ns < stretch.first_ns) & known)
    after = np.flatnonzero((t_ns > stretch.last_ns) & known)
    edges = np.concatenate([t_ns[before[-1:]], t_ns[inside], t_ns[after[:1]]])
    if not len(inside) or np.diff(edges).max(initial=0) > MAX_STEP_S * NS_PER_S:
        return None
    sides = [_side(found, track, rows, inside) for rows in (before, after) if len(rows) >= MIN_FITTED]
    if not sides or max(side.misfit_m for side in sides) > MAX_MISFIT_M:
        return None
    share = np.zeros(len(inside))
    if len(sides) == 2:
        share = sides[0].away_m / np.maximum(sides[0].away_m + sides[1].away_m, 1e-6)
    first, last = sides[0], sides[-1]
    apart_m = np.linalg.norm(first.poses[:, :3, 3] - last.poses[:, :3, 3], axis=1)
    away_m = np.minimum(first.away_m, last.away_m)
    odometry_m = np.minimum(first.sigma_m, last.sigma_m)
    sigma_m = np.sqrt(USUAL_SIGMA_M**2 + odometry_m**2 + (apart_m / 2) ** 2)
    sigma_rad = np.hypot(USUAL_SIGMA_RAD, DRIFT_RAD_PER_M * away_m)
    if sigma_m.max() > MAX_SIGMA_M:
        return None
    # One goes over to the other.
    first_q, last_q = (quaternion_from_rotation(side.poses[:, :3, :3]) for side in (first, last))
    weight = share[:, None]
    place = (1 - weight) * first.poses[:, :3, 3] + weight * last.poses[:, :3, 3]
    poses = transform(rotation_from_quaternion(slerp(first_q, last_q, share)), place)
    return PoseTrack(t_ns[inside], poses, sigma_m=sigma_m, sigma_yaw_rad=sigma_rad)


def _side(found: Odometry, track: PoseTrack, rows: NDArray[np.intp], inside: NDArray[np.intp]) -> _Side:
    """Fit odometry to the poses of a track at some of its rows, all before or all after the rows `inside`."""
    map_T_odom = fit_to_given(PoseTrack(found.t_ns[rows], found.odom_T_ego[rows]), track)
    assert map_T_odom is not None
    off = (map_T_odom @ found.odom_T_ego[rows])[:, :3, 3] - track.at(found.t_ns[rows])[0][:, :3, 3]
    path_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(found.odom_T_ego[:, :3, 3], axis=0), axis=1)))
    nearest = rows[-1] if rows[0] < inside[0] else rows[0]
    return _Side(
        map_T_odom @ found.odom_T_ego[inside],
        np.abs(path_m[inside] - path_m[nearest]),
        float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1)))),
        float(np.ptp(path_m[rows])),
    )
