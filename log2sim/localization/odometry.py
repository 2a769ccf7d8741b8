"""LiDAR odometry: poses of the ego from the sweeps of one LiDAR, registered on a map of Gaussians.

Voxelized GICP (Koide et al., ICRA 2021) as the library small_gicp implements it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Sweep
from log2sim.errors import LogError, MissingExtra
from log2sim.geometry import (
    NS_PER_S,
    Array,
    apply,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    slerp,
    transform,
)
from log2sim.localization.given_poses import MAX_ACCELERATION_MPS2
from log2sim.perception.lidar.cloud import first_of_voxels
from log2sim.perception.records import RecordSource

# Transforms are interpolated between knots this far apart, which errs by 3e-6 rad at 1 rad/s: 0.3 mm at 100 m.
KNOT_NS = 5_000_000
MAX_KNOTS = 4096

# Gives the transforms (K, 4, 4) at stamps (K,) and whether each is known.
TransformAt = Callable[[NDArray[np.int64]], tuple[Array, NDArray[np.bool_]]]


def move_points(xyz_m: NDArray[np.floating[Any]], t_ns: NDArray[np.int64], dst_T_src_at: TransformAt) -> Array | None:
    """Transform points (N, 3), m, each by the transform at its own stamp (N,); None where one is not known."""
    if len(xyz_m) == 0:
        return np.zeros((0, 3))
    first, span = int(t_ns.min()), int(t_ns.max() - t_ns.min())
    bins = min(-(-span // KNOT_NS), MAX_KNOTS)
    if bins == 0:
        dst_T_src, known = dst_T_src_at(np.array([first], dtype=np.int64))
        return apply(dst_T_src[0], xyz_m) if known.all() else None
    knots = first + (np.arange(bins + 1) * span) // bins
    dst_T_src, known = dst_T_src_at(knots)
    if not known.all():
        return None
    place = (t_ns - first) * (bins / span)
    k = np.minimum(place.astype(np.int64), bins - 1)
    order = np.argsort(k, kind="stable")
    edges = np.searchsorted(k[order], np.arange(bins + 1))
    points, fraction = np.asarray(xyz_m, dtype=np.float64)[order], (place - k)[order, None]
    out = np.empty_like(points)
    for b in np.flatnonzero(np.diff(edges)).tolist():
        rows = slice(edges[b], edges[b + 1])
        begin = apply(dst_T_src[b], points[rows])
        out[rows] = begin + fraction[rows] * (apply(dst_T_src[b + 1], points[rows]) - begin)
    unsorted = np.empty_like(out)
    unsorted[order] = out
    return unsorted


# Nearer returns are of the ego's own body; farther ones are too sparse for surfaces.
MIN_RANGE_M, MAX_RANGE_M = 2.5, 100.0
# More points change neither the path nor the scatter of parked cars on recorded drives, and take time.
MAX_POINTS = 60_000
PROBED_SWEEPS = 3
COVERAGE_VOXEL_M = 0.5


@dataclass(frozen=True, eq=False)
class EgoSweep:
    """One sweep in the ego's frame."""

    t_ref_ns: int  # stamp of the pose that the sweep gives, and to which it is compensated where `t_ns` is None
    xyz_m: Array  # (N, 3): points in the ego's frame; at their own times where `t_ns` is given
    # (N,): stamps of the points; None where the ego's motion is out of them or their times are not known
    t_ns: NDArray[np.int64] | None


def lidars_on_ego(log: Log) -> list[str]:
    """List the LiDARs on the ego that have records."""
    return [
        n for n, lidar in log.lidars.items() if lidar.mount == "ego" and n in log.streams and len(log.streams[n].t_ns)
    ]


def densest_lidar(log: Log) -> str | None:
    """Choose the LiDAR on the ego whose sweeps show most of the surroundings; None without one that can be read.

    One LiDAR alone, since those of one vehicle turn at different times: sweeps that are joined would need a motion for each.
    """
    names = lidars_on_ego(log)
    if len(names) <= 1:
        return names[0] if names else None
    coverage = {name: _coverage(log, name) for name in names}
    best = max(names, key=lambda name: coverage[name])
    return best if coverage[best] else None


def _coverage(log: Log, lidar: str) -> int:
    """Count the voxels with points in one sweep; 0 where none of the first can be read."""
    stream = log.streams[lidar]
    for i in range(min(PROBED_SWEEPS, len(stream.t_ns))):
        sweep = read_ego_sweep(log, lidar, i)
        if sweep is not None and len(sweep.xyz_m):
            return len(first_of_voxels(sweep.xyz_m.T.astype(np.float32), COVERAGE_VOXEL_M))
    return 0


def read_ego_sweep(log: Log, lidar: str, index: int) -> EgoSweep | None:
    """Read a sweep into the ego's frame; None where it cannot be read or, in the map frame, where the ego's pose is not known.

    Points of the map frame go back by the log's own poses at their own times. Of more than `MAX_POINTS` every second, third ...
    is taken.
    """
    sweep: Sweep | None = RecordSource(log).get(lidar, index)
    if sweep is None:
        return None
    ego_T_lidar = log.lidars[lidar].mount_T_lidar
    sweep = sweep.thinned(MAX_POINTS)
    stamp_ns, t_ns, measured = int(sweep.stamp_ns), sweep.t_ns, sweep.xyz_m
    if sweep.frame == "map":
        track = log.ego
        if track is None:
            return None
        times = np.full(len(measured), stamp_ns, dtype=np.int64) if t_ns is None else t_ns
        known = move_points(measured, times, lambda t: (inverse(track.at(t)[0]), track.at(t)[1]))
        if known is None:
            return None
        xyz = known
    else:
        xyz = apply(ego_T_lidar, measured)
        if sweep.compensated_ns is not None:
            stamp_ns, t_ns = int(sweep.compensated_ns), None
    away = np.linalg.norm(xyz - ego_T_lidar[:3, 3], axis=1)
    near = (away > MIN_RANGE_M) & (away < MAX_RANGE_M)
    return EgoSweep(stamp_ns, xyz[near], None if t_ns is None else t_ns[near])


def compensated(sweep: EgoSweep, motion: Array, motion_s: float) -> Array:
    """Take a constant motion, the pose (4, 4) after `motion_s`, out of a sweep: points (N, 3), m, in the ego's frame at its stamp."""
    if sweep.t_ns is None or motion_s <= 0:
        return sweep.xyz_m

    def ref_T_ego(t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        share = (t_ns - sweep.t_ref_ns) / NS_PER_S / motion_s
        return share_of_motion(motion, share), np.ones(len(t_ns), dtype=bool)

    moved = move_points(sweep.xyz_m, sweep.t_ns, ref_T_ego)
    return sweep.xyz_m if moved is None else moved


def share_of_motion(motion: Array, share: Array) -> Array:
    """Compute the parts (N, 4, 4) of a motion (4, 4) that is steady in the moving frame, for shares (N,) of its time.

    The translation is scaled, which leaves out the bend of the path: 4 mm in 0.1 s at 10 m/s and 0.3 rad/s.
    """
    q = np.repeat(quaternion_from_rotation(motion[:3, :3])[None], len(share), axis=0)
    still = np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (len(share), 1))
    return transform(rotation_from_quaternion(slerp(still, q, share)), share[:, None] * motion[:3, 3])


VOXEL_M = 0.5
MAP_VOXEL_M = 1.0
NEIGHBORS = 10
MAX_ITERATIONS = 30
MIN_POINTS = 100
# Share of the points that fall onto known surfaces: typical sweeps of a drive have 0.7 or more with their map; half of that is
# left where a sweep shows another place.
MIN_OVERLAP = 0.35
# Surfaces are given a variance of 1e-3 along their normals by the library, and of 1 across them: a point on a surface square to
# a direction adds 1 / (2 * 1e-3) of information about it, any other 1 / 2, so that a direction that nothing holds has a
# constraint of 0.001. Noise of the normals raises that: simulated tunnels have 0.001 to 0.015, streets 0.006 to 0.1. Where it is
# low, the fit is repeated from a start farther along that direction than a voxel; it is held if the fit comes back.
INFORMATION_OF_POINT = 500.0
MIN_CONSTRAINT, DOUBTFUL_CONSTRAINT = 0.002, 0.03
PROBE_M = 1.5 * MAP_VOXEL_M
MIN_RETURN = 0.5


@dataclass(frozen=True, eq=False)
class Fit:
    """A registered sweep."""

    pose: Array  # (4, 4): of the ego in the frame of the map
    overlap: float  # share of the sweep's points that fall onto known surfaces
    residual: float  # mean squared Mahalanobis distance of these points, without unit
    constraint: float  # share of points, as if all were square to it, that hold the weakest direction of translation
    weakest: Array  # (3,): that direction, in the frame of the map


def load_small_gicp() -> ModuleType:
    """Import the library for registration; `MissingExtra` where it is not installed."""
    try:
        import small_gicp
    except ImportError:
        raise MissingExtra("LiDAR odometry", "odometry") from None
    module: ModuleType = small_gicp
    return module


def is_installed() -> bool:
    """Return whether the library for registration is installed."""
    try:
        load_small_gicp()
    except MissingExtra:
        return False
    return True


class SurfaceMap:
    """Surfaces of the sweeps so far, as one Gaussian in each voxel."""

    def __init__(self) -> None:
        self._library = load_small_gicp()
        self._voxels = self._library.GaussianVoxelMap(MAP_VOXEL_M)

    def surfaces_of(self, xyz_m: Array) -> Any:
        """Thin out points (N, 3) and estimate their surfaces; None for fewer than `MIN_POINTS` of them."""
        if len(xyz_m) < MIN_POINTS:
            return None
        surfaces, _ = self._library.preprocess_points(xyz_m, VOXEL_M, NEIGHBORS, 1)
        return surfaces if surfaces.size() >= MIN_POINTS else None

    def insert(self, surfaces: Any, pose: Array) -> None:
        """Add surfaces of the ego's frame at a pose (4, 4); those without points for 100 sweeps are removed."""
        self._voxels.insert(surfaces, pose)

    def fit(self, surfaces: Any, guess: Array) -> Fit:
        """Register surfaces from a guessed pose (4, 4)."""
        found = self._library.align(self._voxels, surfaces, guess, max_iterations=MAX_ITERATIONS)
        count = max(int(found.num_inliers), 1)
        pose, information = np.array(found.T_target_source), np.array(found.H)
        constraint, weakest = weakest_direction(information, count)
        return Fit(
            pose,
            found.num_inliers / surfaces.size(),
            2 * float(found.error) / count,
            constraint,
            pose[:3, :3] @ weakest,
        )

    def holds(self, surfaces: Any, fit: Fit) -> bool:
        """Return whether a fit holds every direction of motion, by fitting again from a start shifted along the weakest one."""
        if not MIN_CONSTRAINT <= fit.constraint < DOUBTFUL_CONSTRAINT:
            return fit.constraint >= DOUBTFUL_CONSTRAINT
        shift = np.zeros((4, 4))
        shift[:3, 3] = PROBE_M * fit.weakest
        again = self._library.align(self._voxels, surfaces, fit.pose + shift, max_iterations=MAX_ITERATIONS)
        stayed_m = float((np.array(again.T_target_source) - fit.pose)[:3, 3] @ fit.weakest)
        return abs(stayed_m) < (1 - MIN_RETURN) * PROBE_M


def weakest_direction(information: Array, points: int) -> tuple[float, Array]:
    """Find the direction of translation that a registration holds least: its constraint and unit vector (3,), ego frame.

    The least eigenvalue of the information (6, 6) about translation alone, with rotation free (Zhang, Kaess, Singh, ICRA 2016, look
    at the same eigenvalues).
    """
    rotation, both, translation = information[:3, :3], information[:3, 3:], information[3:, 3:]
    alone = translation - both.T @ np.linalg.pinv(rotation) @ both
    values, vectors = np.linalg.eigh((alone + alone.T) / 2)
    return float(values[0]) / points / INFORMATION_OF_POINT, vectors[:, 0]


# Room for the error of two fits.
MAX_JUMP_M = 0.5
# The first motion is searched forward and backward in steps within which a fit finds its way, up to these speeds.
SEARCH_STEP_M, MAX_SPEED_MPS, MAX_REVERSE_MPS = 1.0, 50.0, 5.0
# A compensation by another motion than the one found is repeated from these differences over a sweep on.
REPEAT_FROM_M, REPEAT_FROM_RAD = 0.1, 0.005
MAX_COASTING_S = 1.0

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Odometry:
    """Poses of the ego by LiDAR odometry, in a frame of its own."""

    lidar: str
    t_ns: NDArray[np.int64]  # (P,): increasing stamps
    odom_T_ego: Array  # (P, 4, 4)
    overlap: Array  # `overlap`, `residual`, `constraint`: (P,): see `Fit`; NaN where the pose is only predicted
    residual: Array
    constraint: Array
    degenerate: NDArray[np.bool_]  # (P,): whether the sweep does not constrain some direction of the motion
    # (P,): whether the sweep did not fit to the others and the pose is predicted by constant velocity
    predicted: NDArray[np.bool_]
    sweeps: int  # number of sweeps in the log
    problems: dict[str, int]  # sweeps that gave no pose of their own, by reason

    @property
    def path_m(self) -> float:
        """Length of the path, m."""
        return float(np.linalg.norm(np.diff(self.odom_T_ego[:, :3, 3], axis=0), axis=1).sum())


def is_during(t_ns: NDArray[np.int64], during_ns: tuple[int, int] | None) -> NDArray[np.bool_]:
    """Mark the stamps (N,) from the first to the last one of a time; all without it."""
    return np.full(len(t_ns), True) if during_ns is None else (t_ns >= during_ns[0]) & (t_ns <= during_ns[1])


def run_odometry(
    log: Log, lidar: str, *, during_ns: tuple[int, int] | None = None, progress: Progress | None = None
) -> Odometry:
    """Estimate the motion of the ego from the sweeps of a LiDAR on it, all or those of a time.

    Each sweep is compensated by the motion that is expected at constant velocity, and again by the one found where they
    differ. Sweeps that do not fit are bridged for `MAX_COASTING_S`; after that a new path begins, and the longest is kept.
    Raises `LogError` when no sweeps fit to each other, `MissingExtra` where the library for registration is not installed.
    """
    index = np.flatnonzero(is_during(log.streams[lidar].t_ns, during_ns))
    run = _Run(SurfaceMap())
    for done, i in enumerate(index.tolist(), 1):
        run.add(read_ego_sweep(log, lidar, i))
        if progress is not None:
            progress(done, len(index))
    paths = [p for p in (*run.paths, run.path) if any(step.fit is not None for step in p)]
    if not paths:
        found = ", ".join(f"{reason}: {count}" for reason, count in run.problems.items()) or "too few sweeps"
        raise LogError(
            f"{log.name}: LiDAR odometry found no motion in the {len(index)} sweeps of '{lidar}' ({found}); expected at "
            "least two in succession that show the same surroundings"
        )
    best = max(paths, key=lambda p: p[-1].t_ns - p[0].t_ns)
    lost = sum(len(p) for p in paths) - len(best)
    problems = dict(run.problems) | ({"of another part of the drive": lost} if lost else {})
    fits = [step.fit for step in best]

    def column(name: str) -> Array:
        return np.array([np.nan if fit is None else getattr(fit, name) for fit in fits], dtype=np.float64)

    return Odometry(
        lidar, np.array([step.t_ns for step in best], dtype=np.int64), np.stack([step.pose for step in best]),
        column("overlap"), column("residual"), column("constraint"),
        np.array([not step.held for step in best]), np.array([step.predicted for step in best]), len(index), problems,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Step:
    """A pose; `fit` is None where it is predicted, and at the first sweep of a path; `held` whether every direction is held."""

    t_ns: int
    pose: Array
    fit: Fit | None = None
    predicted: bool = False
    held: bool = True


@dataclass(eq=False)
class _Run:
    """State of the odometry from sweep to sweep.

    `path` is the current path, `motion` the last motion with its time `motion_s`; `first` the first sweep of a path until a
    second one fits to it.
    """

    map: SurfaceMap
    path: list[_Step] = field(default_factory=list)
    paths: list[list[_Step]] = field(default_factory=list)
    first: EgoSweep | None = None
    motion: Array = field(default_factory=lambda: np.eye(4))
    motion_s: float = 0.0
    problems: Counter[str] = field(default_factory=Counter)

    def add(self, sweep: EgoSweep | None) -> None:
        """Take the next sweep; None for one that cannot be read."""
        last_ns = self.path[-1].t_ns if self.path else None if self.first is None else self.first.t_ref_ns
        if sweep is None:
            self.problems["unreadable or without a pose"] += 1
        elif last_ns is not None and sweep.t_ref_ns <= last_ns:
            self.problems["stamp not after the one before"] += 1
        elif not self.path:
            self._begin(sweep)
        elif (sweep.t_ref_ns - self.path[-1].t_ns) / NS_PER_S > MAX_COASTING_S:
            self._break(sweep)
        else:
            self._follow(sweep)

    def _begin(self, sweep: EgoSweep) -> None:
        """Find the first motion of a path by trying speeds; the first sweep stays as it is until then."""
        first = self.first
        self.first = sweep
        if first is None:
            return
        dt_s = (sweep.t_ref_ns - first.t_ref_ns) / NS_PER_S
        found = None if dt_s > MAX_COASTING_S else self._first_fit(first, sweep, dt_s)
        if found is None:
            self.problems["no overlap with the sweep before"] += 1
            return
        fit, held = found
        self.path = [_Step(first.t_ref_ns, np.eye(4), held=held), _Step(sweep.t_ref_ns, fit.pose, fit, held=held)]
        self.motion, self.motion_s, self.first = fit.pose, dt_s, None

    def _first_fit(self, first: EgoSweep, sweep: EgoSweep, dt_s: float) -> tuple[Fit, bool] | None:
        """Fit two sweeps without a motion before them, and once more with this motion taken out of both; whether it is held."""
        reach = np.arange(-MAX_REVERSE_MPS * dt_s, MAX_SPEED_MPS * dt_s + SEARCH_STEP_M, SEARCH_STEP_M)
        shifts = reach[np.argsort(np.abs(reach))]
        self.map = SurfaceMap()
        target, source = self.map.surfaces_of(first.xyz_m), self.map.surfaces_of(sweep.xyz_m)
        if target is None or source is None:
            return None
        self.map.insert(target, np.eye(4))
        fits = [self.map.fit(source, transform(np.eye(3), np.array([shift, 0.0, 0.0]))) for shift in shifts.tolist()]
        # The best has many points, near to their surfaces.
        best = max(fits, key=lambda fit: fit.overlap / (1.0 + fit.residual))
        if best.overlap < MIN_OVERLAP:
            return None
        self.map = SurfaceMap()
        target = self.map.surfaces_of(compensated(first, best.pose, dt_s))
        source = self.map.surfaces_of(compensated(sweep, best.pose, dt_s))
        if target is None or source is None:
            return None
        self.map.insert(target, np.eye(4))
        fit = self.map.fit(source, best.pose)
        if fit.overlap < MIN_OVERLAP:
            return None
        held = self.map.holds(source, fit)
        self.map.insert(source, fit.pose)
        return fit, held

    def _follow(self, sweep: EgoSweep) -> None:
        """Register a sweep from the pose that constant velocity predicts."""
        last = self.path[-1]
        dt_s = (sweep.t_ref_ns - last.t_ns) / NS_PER_S
        expected = share_of_motion(self.motion, np.array([dt_s / self.motion_s]))[0]
        fit, surfaces = self._fit(sweep, expected, dt_s)
        if fit is None:
            self.problems["too few points"] += 1
        elif fit.overlap < MIN_OVERLAP:
            self.problems["no overlap with the sweeps before"] += 1
        elif not _is_possible(expected, (motion := inverse(last.pose) @ fit.pose), dt_s):
            self.problems["a motion that no vehicle makes"] += 1
        else:
            held = self.map.holds(surfaces, fit)
            self.map.insert(surfaces, fit.pose)
            self.path.append(_Step(sweep.t_ref_ns, fit.pose, fit, held=held))
            self.motion, self.motion_s = motion, dt_s
            return
        registered = next(step for step in reversed(self.path) if not step.predicted)
        if (sweep.t_ref_ns - registered.t_ns) / NS_PER_S > MAX_COASTING_S:
            self._break(sweep)
        else:
            self.path.append(_Step(sweep.t_ref_ns, last.pose @ expected, predicted=True))
            self.motion, self.motion_s = expected, dt_s

    def _break(self, sweep: EgoSweep) -> None:
        """End the path at its last registered sweep and begin another one."""
        registered = max(k for k, step in enumerate(self.path) if not step.predicted)
        self.paths.append(self.path[: registered + 1])
        self.path, self.first, self.motion = [], sweep, np.eye(4)

    def _fit(self, sweep: EgoSweep, expected: Array, dt_s: float) -> tuple[Fit | None, object]:
        """Fit a sweep, and once more where the motion found differs from the one that was taken out of it."""
        last = self.path[-1].pose
        surfaces = self.map.surfaces_of(compensated(sweep, expected, dt_s))
        if surfaces is None:
            return None, None
        fit = self.map.fit(surfaces, last @ expected)
        found = inverse(last) @ fit.pose
        off = inverse(expected) @ found
        sweep_s = 0.0 if sweep.t_ns is None else float(np.ptp(sweep.t_ns)) / NS_PER_S
        moved_m, turned = np.linalg.norm(off[:3, 3]), np.linalg.norm(off[:3, :3] - np.eye(3)) / np.sqrt(2)
        if max(moved_m / REPEAT_FROM_M, turned / REPEAT_FROM_RAD) * sweep_s / dt_s < 1 or fit.overlap < MIN_OVERLAP:
            return fit, surfaces
        surfaces = self.map.surfaces_of(compensated(sweep, found, dt_s))
        return self.map.fit(surfaces, fit.pose), surfaces


def _is_possible(expected: Array, found: Array, dt_s: float) -> bool:
    """Return whether a vehicle can make the motion found instead of the one expected."""
    off_m = float(np.linalg.norm(found[:3, 3] - expected[:3, 3]))
    return off_m <= MAX_JUMP_M + 0.5 * MAX_ACCELERATION_MPS2 * dt_s * max(dt_s, 0.1)
